"""Blocks of text: paragraphs, lists, facts, and files to download."""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Text


class Paragraph(Schema):
    """Paragraph; small : as small print."""

    kind: Literal["paragraph"] = "paragraph"
    text: Text
    small: bool = False


class Hint(Schema):
    """How to use the page, in small print; not on paper."""

    kind: Literal["hint"] = "hint"
    text: Text


class Listing(Schema):
    """List with a heading, which may be empty.

    items : texts; what follows a line break is the next step.
    folded : collapsed until it is opened.
    """

    kind: Literal["listing"] = "listing"
    title: Text
    items: tuple[Text, ...]
    folded: bool = False


class Fact(Schema):
    """Name of a quantity or setting, and its value as text."""

    name: Text
    value: Text


class Facts(Schema):
    """Pairs of name and value with a heading."""

    kind: Literal["facts"] = "facts"
    title: Text
    facts: tuple[Fact, ...]


class Download(Schema):
    """File that the page holds; content : its text."""

    name: str
    media_type: str
    content: str


class Downloads(Schema):
    """Files that the page holds."""

    kind: Literal["downloads"] = "downloads"
    files: tuple[Download, ...]
