"""Pages in a real browser, and the parts of their HTML."""

from __future__ import annotations

import re
import shutil
import subprocess
from html.parser import HTMLParser

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


class PageParts(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._texts: list[str] = []
        self.feed(text)
        self.text = "".join(self._texts)

    def updatepos(self, i, j):
        """Line numbers are not needed; counting lines in megabytes takes longer than all else."""
        return j

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self._texts.append(data)


FRAME = """<!doctype html><html lang="en"><title>Frame</title>
<iframe src="page.html" width="WIDTH" height="860"></iframe>
<script>addEventListener("message", (event) => {
  Object.assign(document.documentElement.dataset, event.data);
});</script></html>"""
"""Browsers have no window as narrow as a phone."""


def browse(address: str, folder, width: int, *options: str) -> dict[str, str]:
    """Data that the script left on the root element."""
    if CHROMIUM is None:
        pytest.skip("NO CHROMIUM: the machine's page was not opened in a browser")
    done = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--no-first-run", "--enable-logging=stderr",
         "--disable-background-networking", f"--user-data-dir={folder / 'profile'}", "--v=0",
         f"--window-size={width},900", "--virtual-time-budget=60000", "--dump-dom", *options,
         address],
        capture_output=True, text=True, timeout=240, check=True,
    )  # fmt: skip
    assert not re.search(r"ERROR:CONSOLE|Uncaught|Refused", done.stderr), done.stderr
    root = PageParts(done.stdout).tags[0][1]
    assert root.get("data-done") == "yes", root
    return {name.removeprefix("data-"): value or "" for name, value in root.items()}


SOFTWARE = ("--disable-gpu", "--enable-unsafe-swiftshader")
NO_GL = ("--disable-gpu", "--disable-3d-apis")
DARK = "--blink-settings=preferredColorScheme=0"
