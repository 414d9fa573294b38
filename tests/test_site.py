"""The documentation as a site: builds without a warning, fetches nothing, and leads nowhere that is
not there.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import pkmcal
from pkmcal.ranges import default
from test_report_page import CHROMIUM

ROOT = Path(__file__).parents[1]


class Links(HTMLParser):
    """Links, parts, anchors and headings of a page."""

    def __init__(self):
        super().__init__()
        self.links, self.parts, self.marks, self.tags = [], [], set(), []

    def handle_starttag(self, tag, attrs):
        results = dict(attrs)
        urls = [results[key] for key in ("href", "src") if results.get(key)]
        self.tags.append(tag)
        self.links += urls
        if tag != "a":
            self.parts += urls
        self.marks |= {results[key] for key in ("id", "name") if results.get(key)}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    report = tmp_path_factory.mktemp("demo") / "report.html"
    report.write_text("<!doctype html><title>Report</title><h1>Report</h1>")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict"]  # --quiet counts no warnings
    done = subprocess.run(
        [*command, "--site-dir", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | {"PKMCAL_DEMO_REPORT": str(report), "NO_MKDOCS_2_WARNING": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site):
    """Links of every page, by its path."""
    parsed = {}
    for path in site.rglob("*.html"):
        parsed[path] = Links()
        parsed[path].feed(path.read_text("utf-8"))
    return parsed


def test_every_link_leads_somewhere(pages):
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


def test_nothing_is_fetched(site, pages):
    """Scripts, styles, images and frames are the site's own."""
    outside = re.compile(r"(?:[a-z]+:)?//", re.IGNORECASE)
    assert [f"{path.name}: {url}" for path, page in pages.items() for url in page.parts
            if outside.match(url)] == []  # fmt: skip
    for path in site.rglob("*.css"):
        assert not re.search(r"@import|url\([\"']?(?:https?:)?//", path.read_text("utf-8")), (
            path.name
        )
    # the theme's script would fetch a library for diagrams, where a page had one
    assert not any('class="mermaid"' in path.read_text("utf-8") for path in pages)


def test_every_page_has_a_title_and_one_heading_of_the_first_level(pages):
    titles = []
    for path, page in pages.items():
        titles += re.findall(r"<title>(.+?)</title>", path.read_text("utf-8"))[:1]
        assert page.tags.count("h1") == 1, path.name
    assert len(set(titles)) >= len(pages) - 1  # that of a page not found is the site's


def test_the_search_has_every_page(site):
    """The index is a script too, for a site that is opened from a file."""
    index = json.loads((site / "search" / "search_index.json").read_text("utf-8"))
    names = {entry["location"].partition("#")[0] for entry in index["docs"]}
    sources = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    assert names >= {path.with_suffix(".html").as_posix() for path in sources}
    assert (site / "search" / "search_index.js").is_file()


def test_the_home_page_shows_the_demos_report(site):
    text = (site / "index.html").read_text("utf-8")
    assert re.search(r'<iframe[^>]*src="demo-report.html"[^>]*title="[^"]+"', text)
    assert "<h1>Report</h1>" in (site / "demo-report.html").read_text("utf-8")


def test_equations_are_mathml(site):
    count = 0
    for path in site.rglob("*.html"):
        text = re.sub(r"<(pre|code|script).*?</\1>", "", path.read_text("utf-8"), flags=re.DOTALL)
        count += text.count("<math")
        display = re.sub(r"<[^>]+>", "", text)
        assert not re.search(r"\\[a-zA-Z(\[]|\$\$", display), path.name
    assert count > 100


def opened(site: Path, url: str, folder: Path) -> str:
    """The document of a page, opened from its file, after its scripts ran."""
    if CHROMIUM is None:
        pytest.skip("NO CHROMIUM: the site was not opened in a browser (apt install chromium)")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
               f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=10000",
               "--window-size=500,900", "--dump-dom", site.as_uri() + url]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def test_code_can_be_copied_and_scrolled_by_the_keyboard(site, tmp_path):
    document = opened(site, "/control.html", tmp_path)
    code = re.findall(r"<pre[^>]*>.*?</pre>", document, re.DOTALL)
    assert code
    assert all("data-clipboard-target" in block for block in code)
    assert any(re.search(r'<code[^>]* tabindex="0"', block) for block in code)


def test_the_search_works_from_a_file(site, tmp_path):
    document = opened(site, "/index.html?q=gauge", tmp_path)
    assert re.search(r'href="[^"]*conventions\.html[^"]*" class="md-search-result__link"', document)


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
    assert inspect.getdoc(pkmcal.load_camera).partition(",")[0] in text


def test_docstrings_are_typeset(site):
    """Sections of numpydoc become tables, and no role of Sphinx is printed as it is written."""
    text = (site / "api.html").read_text("utf-8")
    display = re.sub(r"<[^>]+>", "", text)
    assert not re.search(r":(class|data|func|meth|mod):", display)
    assert not re.search(r"^-{4,}$", display, re.MULTILINE)
    for name in ("calibrate", "load_session", "load_mechanism", "load_camera", "plan", "study"):
        own = text[text.index(f'id="pkmcal.{name}"') :]
        table = own[own.index("Parameters:") :].partition("</table>")[0]
        assert own.index("Parameters:") < 12_000, name
        assert all(f"<th>{head}</th>" in table for head in ("Name", "Type", "Description")), name


def test_defaults_and_choices_are_values(site):
    text = (site / "api.html").read_text("utf-8")
    cells = [re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", cell)).strip()
             for cell in re.findall(r"<td[^>]*>(.*?)</td>", text, re.DOTALL)]  # fmt: skip
    rows = {cells[i]: cells[i : i + 4] for i in range(len(cells))}
    assert rows["count"][3] == str(default("plan", "configurations"))
    assert rows["corner_noise"][3] == str(default("plan", "corner_noise"))
    assert "&#39;directions&#39;" in rows["law"][1]
    assert "default(" not in re.sub(r"<[^>]+>", "", text)


def test_parameters_of_short_docstrings_are_tabulated():
    spec = importlib.util.spec_from_file_location("docstrings", ROOT / "tools" / "docstrings.py")
    docstrings = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(docstrings)
    text = "Write files.\n\nfolder : a new one. force, keep : replace others\nthere. Raises Fault."
    parts = docstrings.with_section(text, "Parameters", ["folder", "force", "keep"])
    assert parts.splitlines() == [
        "Write files.", "", "Raises Fault.", "", "Parameters", "----------", "folder :",
        "    A new one.", "force, keep :", "    Replace others there.",
    ]  # fmt: skip
    assert docstrings.with_section(parts, "Parameters", ["folder"]) == parts
    assert docstrings.with_section("A note : no.", "Parameters", ["folder"]) == "A note : no."


def test_every_page_stands_in_the_menu_once():
    pages = re.findall(
        r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text("utf-8").partition("nav:")[2]
    )
    docs = ROOT / "docs"
    there = [path.relative_to(docs).as_posix() for path in docs.rglob("*.md")]
    assert sorted(pages) == sorted([*there, "readme.md"])  # the README is taken in
