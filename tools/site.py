"""Differences between the documentation's site and the pages in the repository (a MkDocs hook).

The pages are written for a reader of the repository as well, so the site adapts them: links to
sources, which are no pages of the site, become text; the README is taken in as a page; equations
become MathML; the home page shows the demo's report, where ``make docs`` made it.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
REPORT = "demo-report.html"
"""The demo's report in the site."""
OUTSIDE = r"\[([^\]]+)\]\({}(?!README\.md)[^)]+\)"
"""A link out of the folder of the pages, by the way up from the page's own folder."""
FENCE = re.compile(r"^```(\w+) [\w ]+$", re.MULTILINE)
"""Fence of code that the tests run; the site's Markdown takes one word only."""
ROLE = re.compile(r":(?:class|data|func|meth|mod):<code>~?([\w.]+)</code>")
"""Role of Sphinx in a docstring, which Markdown leaves before the name."""
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.+?)\\[)\]]</\1>', re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Takes in the README, and the demo's report."""
    text = (ROOT / "README.md").read_text("utf-8").replace("](docs/", "](")
    text = re.sub(r"\[([^\]]+)\]\((?!https?:|#|pictures/)([^)]+?)\)", _inside, text)
    files.append(File.generated(config, "readme.md", content=text))
    if (report := ROOT / config.extra["report"]).is_file():
        files.append(File.generated(config, REPORT, abs_src_path=str(report)))
    return files


def _inside(link: re.Match[str]) -> str:
    """A link of the README where it leads to a page; else its text."""
    there = (ROOT / "docs" / link[2].partition("#")[0]).is_file()
    return link[0] if there else link[1]


def on_page_markdown(markdown: str, page: Any, files: Any, **_: Any) -> str:
    """Links that lead out of the pages' folder, fences of two words, and the report's frame."""
    if page.is_homepage:
        markdown = markdown.replace("<!-- report -->", _report(files))
        page.meta["hide"] = ["navigation", "toc"]
    markdown = FENCE.sub(r"```\1", markdown)
    outside = OUTSIDE.format(re.escape("../" * (page.file.src_uri.count("/") + 1)))
    return re.sub(outside, r"\1", markdown).replace("(../README.md", "(readme.md")


def _report(files: Any) -> str:
    """Frame with the demo's report, or a sentence where there is none."""
    if not files.get_file_from_path(REPORT):
        return "(This copy of the site was built without the report; `pkmcal demo` opens it.)"
    return (
        f'<iframe class="report" src="{REPORT}" title="Report of the demo" loading="lazy"></iframe>'
        f'\n\n<a href="{REPORT}">The report in a window of its own</a>'
    )


def on_page_content(text: str, **_: Any) -> str:
    """Equations as MathML, docstrings' roles (``:func:`name```) as links where the name is on a
    page, and heads of tables that are empty as cells: they are no heads to a screen reader.
    """
    text = EQUATION.sub(_mathml, text)
    text = ROLE.sub(_reference, text)
    return re.sub(r"<th([^>]*)></th>", r"<td\1></td>", text)


def _mathml(equation: re.Match[str]) -> str:
    tag = equation[1]
    math = convert(html.unescape(equation[2]), display="block" if tag == "div" else "inline")
    return f'<{tag} class="equation">{math}</{tag}>'


def _reference(role: re.Match[str]) -> str:
    name = role[1]
    return f'<autoref optional identifier="{name}"><code>{name.split(".")[-1]}</code></autoref>'
