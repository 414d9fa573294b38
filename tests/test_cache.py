"""The user's cache folder: its contents, and that nothing depends on it."""

import base64
import gzip

import pytest

from pkmcal.files import remember, remembered
from pkmcal.pages.page import environment, plotly_script


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder, and a page that has not been made yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    for made in (environment, plotly_script):
        made.cache_clear()
    yield tmp_path
    for made in (environment, plotly_script):
        made.cache_clear()


def test_what_is_kept_is_read_again(folder):
    assert remembered("a") is None
    remember("a", b"first")
    remember("a", b"second")
    assert remembered("a") == b"second"
    retained = [path.name for path in folder.rglob("*") if path.is_file()]
    assert retained == ["a"]  # nothing half written is left beside it


def test_templates_are_compiled_once(folder, monkeypatch):
    first = environment().get_template("how.html.j2")
    assert any("template-" in path.name for path in folder.rglob("*"))
    environment.cache_clear()
    monkeypatch.setattr("jinja2.Environment.compile", lambda *a, **k: pytest.fail("compiled again"))
    second = environment().get_template("how.html.j2")
    assert first.root_render_func.__code__ == second.root_render_func.__code__


def test_plotly_is_whole_from_the_cache_as_well(folder):
    first = plotly_script()
    plotly_script.cache_clear()
    assert plotly_script() == first
    assert b"plotly" in gzip.decompress(base64.b64decode(first))[:500].lower()


def test_a_cache_that_cannot_be_written_changes_nothing(folder, monkeypatch):
    blocked = folder / "file"
    blocked.write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    remember("a", b"b")
    assert remembered("a") is None
    assert environment().get_template("how.html.j2")
    assert plotly_script()
