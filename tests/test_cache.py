"""The user's cache folder: its contents, and that nothing depends on it."""

import pytest

from pkmcal.files import remember, remembered


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def test_what_is_kept_is_read_again(folder):
    assert remembered("a") is None
    remember("a", b"first")
    remember("a", b"second")
    assert remembered("a") == b"second"
    retained = [path.name for path in folder.rglob("*") if path.is_file()]
    assert retained == ["a"]  # nothing half written is left beside it


def test_a_cache_that_cannot_be_written_changes_nothing(folder, monkeypatch):
    blocked = folder / "file"
    blocked.write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    remember("a", b"b")
    assert remembered("a") is None
