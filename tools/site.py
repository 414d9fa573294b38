"""Differences between the documentation's site and the pages in the repository (a MkDocs hook).

Pages link to sources, which are no pages of the site: there such a link is its text alone. The
README, to which pages link as well, is included as a page.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
OUTSIDE = r"\[([^\]]+)\]\({}(?!README\.md)[^)]+\)"
"""A link out of the folder of the pages, by the way up from the page's own folder."""


def on_files(files: Any, config: Any) -> Any:
    """Takes in the README."""
    text = (ROOT / "README.md").read_text("utf-8").replace("](docs/", "](")
    text = re.sub(r"\[([^\]]+)\]\((?!https?:|#|pictures/)([^)]+?)\)", _inside, text)
    files.append(File.generated(config, "readme.md", content=text))
    return files


def _inside(link: re.Match[str]) -> str:
    """A link of the README where it leads to a page; else its text."""
    there = (ROOT / "docs" / link[2].partition("#")[0]).is_file()
    return link[0] if there else link[1]


FENCE = re.compile(r"^```(\w+) [\w ]+$", re.MULTILINE)
"""Fence of code that the tests run; Python's Markdown takes one word only."""


ROLE = re.compile(r":(?:class|data|func|meth|mod):<code>~?(?:pkmcal\.(?:\w+\.)+(?=[A-Z]))?")
"""Role in a docstring, which Markdown leaves before the name."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links that lead out of the pages' folder, and fences of two words."""
    markdown = FENCE.sub(r"```\1", markdown)
    outside = OUTSIDE.format(re.escape("../" * (page.file.src_uri.count("/") + 1)))
    return re.sub(outside, r"\1", markdown).replace("(../README.md", "(readme.md")


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Docstrings' roles (``:func:`name```) as code alone; and heads of tables that are empty are no
    heads to a screen reader, as in the program's pages.
    """
    del page
    html = ROLE.sub("<code>", html)
    return re.sub(r"<th([^>]*)></th>", r"<td\1></td>", html)
