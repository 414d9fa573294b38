"""The documentation as a site: builds without a warning, leads nowhere that is not there."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import pkmcal

ROOT = Path(__file__).parents[1]


class Links(HTMLParser):
    """Links, images and anchors of a page."""

    def __init__(self):
        super().__init__()
        self.links, self.marks = [], set()

    def handle_starttag(self, tag, attrs):
        del tag
        results = dict(attrs)
        self.links += [results[key] for key in ("href", "src") if results.get(key)]
        self.marks |= {results[key] for key in ("id", "name") if results.get(key)}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict"]  # --quiet counts no warnings
    done = subprocess.run(
        [*command, "--site-dir", str(folder)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


def test_every_link_leads_somewhere(site):
    pages = {}
    for path in site.rglob("*.html"):
        parser = Links()
        parser.feed(path.read_text("utf-8"))
        pages[path] = parser
    assert len(pages) > len(list((ROOT / "docs").rglob("*.md")))
    lost = []
    for path, page in pages.items():
        for link in page.links if path.name != "404.html" else ():
            if re.match(r"[a-z]+:", link) or link.startswith(("//", "#")):
                continue
            name, _, mark = link.partition("#")
            there = (path.parent / name).resolve()
            reference_values = pages.get(there)
            if not there.exists() or (
                mark and reference_values and mark not in reference_values.marks
            ):
                lost.append(f"{path.name}: {link}")
    assert not lost


def test_no_mark_of_the_pages_source_is_left_over(site):
    for path in site.rglob("*.html"):
        text = re.sub(r"<(pre|code).*?</\1>", "", path.read_text("utf-8"), flags=re.DOTALL)
        assert not re.search(r"```|^#+ |^\| ?---", text, re.MULTILINE), path.name


def test_no_head_of_a_table_is_empty(site):
    for path in site.rglob("*.html"):
        assert not re.search(r"<th[^>]*>\s*</th>", path.read_text("utf-8")), path.name


def test_the_page_of_python_has_every_public_name(site):
    text = (site / "api.html").read_text("utf-8")
    for name in pkmcal.__all__:
        if not name.startswith("__"):
            assert f'id="pkmcal.{name}"' in text, name
    # what stands in docstrings, and not names alone
    assert "Read a camera file of pkmcal, OpenCV, ROS or Kalibr" in text


def test_docstrings_are_typeset(site):
    """Sections of numpydoc become lists, and no role of Sphinx is printed as it is written."""
    text = (site / "api.html").read_text("utf-8")
    display = re.sub(r"<[^>]+>", "", text)
    assert not re.search(r":(class|data|func|meth|mod):", display)
    assert not re.search(r"^-{4,}$", display, re.MULTILINE)
    for name in ("calibrate", "load_session", "load_mechanism", "load_camera", "plan", "study"):
        own = display[display.index(f"{name}(\n") :]
        assert re.match(r".*?\bParameters:", own, re.DOTALL), name
        assert own.index("Parameters:") < 2000, name


def test_every_page_stands_in_the_menu_once():
    pages = re.findall(
        r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text("utf-8").partition("nav:")[2]
    )
    docs = ROOT / "docs"
    there = [path.relative_to(docs).as_posix() for path in docs.rglob("*.md")]
    assert sorted(pages) == sorted([*there, "readme.md"])  # the README is taken in
