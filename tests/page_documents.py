"""Documents of pages, read back from their HTML."""

from __future__ import annotations

import json
import re
from typing import Any


def page_document(html: str) -> dict[str, Any]:
    """Document that a page of the viewer holds."""
    match = re.search(r'<script type="application/json" id="document">(.*?)</script>', html, re.S)
    assert match is not None, "the page holds no document"
    return json.loads(match[1])


def page_section(document: dict[str, Any], name: str) -> dict[str, Any]:
    """Section of a report's document by its name."""
    return next(section for section in document["sections"] if section["name"] == name)


def page_blocks(document: dict[str, Any], kind: str, section: str = "") -> list[dict[str, Any]]:
    """Blocks of one kind in all sections of a report's document, or in the one named."""
    return [
        block
        for part in document["sections"]
        if section in ("", part["name"])
        for block in part["blocks"]
        if block["kind"] == kind
    ]


def page_text(value: Any) -> str:
    """All texts of a document or of a part of it, one a line."""
    if isinstance(value, str):
        return value
    if not isinstance(value, dict | list):
        return ""
    children = value.values() if isinstance(value, dict) else value
    return "\n".join(text for text in map(page_text, children) if text)
