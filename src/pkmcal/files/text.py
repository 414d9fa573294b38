"""Text files read, and the small phrases that error messages are made of."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from pkmcal.errors import InputError

LONGEST_SHOWN = 60
"""Characters of a found value that a message quotes: enough to recognise it, short enough for
one line."""


def read_text(path: Path, label: str | None = None) -> str:
    """Text of a UTF-8 file, without byte-order mark and with Unix line ends.

    label : the file's name in messages; the path's last part unless told.
    """
    label = label or path.name
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        raise InputError(
            "the file does not exist", where=label, expected=wanted_file(path)
        ) from None
    except IsADirectoryError:
        raise InputError("this is a folder", where=label, expected="a file") from None
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"the file cannot be read ({reason})", where=label) from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise InputError(
            "the file is not UTF-8 text",
            where=f"{label}, line {line}",
            found=f"byte 0x{raw[error.start]:02x}",
            expected="UTF-8",
            next_step="Save it as UTF-8 in the editor",
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def wanted_file(path: Path) -> str:
    """Say, for a message, which file is missing, and the name like it that is there."""
    folder = path.parent
    if not folder.is_dir():
        return f"a file {path} (its folder does not exist either)"
    neighbour = closest(path.name, (entry.name for entry in folder.iterdir()))
    return f"a file {path}" + (f" (there is {neighbour})" if neighbour else "")


def closest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that a misspelt one most likely means, or None."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    # 0.6 is difflib's own threshold: one or two wrong letters in a short key.
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.6)
    return by_lower[matches[0]] if matches else None


def shown(value: object) -> str:
    """Quote a found value briefly."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    return text if len(text) <= LONGEST_SHOWN else text[: LONGEST_SHOWN - 1] + "…"
