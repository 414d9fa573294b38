"""Files of the viewer's bundle, which is built from ``viewer/`` by ``make viewer``.

The first line of each is a comment with the SHA-256 of the sources.
"""

from __future__ import annotations

from functools import cache
from importlib import resources

SCRIPT_FILE, STYLE_FILE = "viewer.js", "viewer.css"
"""The viewer."""


@cache
def bundle_file(name: str) -> str:
    """Text of a file of the bundle."""
    return (resources.files("pkmcal.web") / "bundle" / name).read_text("utf-8")
