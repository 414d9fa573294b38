"""XML of exports: numbers with all digits, and comments that their text cannot end."""

from __future__ import annotations

from collections.abc import Iterable
from textwrap import wrap
from xml.etree.ElementTree import Comment, Element, indent, tostring

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import legible


def numbers_text(*values: float | Array) -> str:
    """Numbers with all digits, at most 16 decimals; no negative zeros."""
    flat = np.concatenate([np.atleast_1d(np.asarray(v, dtype=float)).ravel() for v in values])
    return " ".join(repr(round(float(v), 16) + 0.0) for v in flat)


def comment_text(text: str) -> str:
    """Text that is valid in an XML comment: printable, without two hyphens in a row."""
    text = legible(text)
    while "--" in text:
        text = text.replace("--", "- -")
    return f"{text} " if text.endswith("-") else text


def comment(parent: Element, text: str) -> None:
    """Append a comment."""
    parent.append(Comment(f" {comment_text(text)} "))


def document(root: Element, source: MachineSource, conventions: Iterable[str]) -> str:
    """XML text with a comment on top: origin, conventions, and parameters with their sigmas."""
    indent(root)
    lines = [comment_text(line) for line in (*source.header(*conventions), "Parameters:")]
    lines = [part for line in lines for part in wrap(line, 96, break_on_hyphens=False)]
    lines += [comment_text(line) for line in source.sigma_lines()]
    about = "\n".join(["<!--", *(f"  {line}" for line in lines), "-->"])
    return f"{about}\n{tostring(root, encoding='unicode')}\n"


def file_name(name: str) -> str:
    """File name, without suffix, for a machine's name."""
    characters = "".join(c if c.isalnum() or c in "-_" else "-" for c in name)
    return characters.strip("-") or "machine"
