"""Check that a path is a regular file: reading a pipe or a device would block."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from pkmcal.errors import InputError

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def resolved(path: Path) -> Path:
    """Absolute path with its links followed as far as they lead, up to a link that leads to itself,
    where `Path.resolve` raises another kind of error.
    """
    return Path(os.path.realpath(path))


def check_regular(path: Path, label: str) -> None:
    """Raise `InputError`, before it is opened, where `path` exists and is not a regular file.

    label : its name in messages. Raises FileNotFoundError where nothing is there.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        if not path.is_symlink():
            raise
        raise InputError(
            "this is a link to what is not there",
            where=label,
            found=str(path.readlink()),
            expected="a file",
        ) from None
    if stat.S_ISREG(mode):
        return
    kind = next((kind for is_kind, kind in _KINDS if is_kind(mode)), "something else")
    raise InputError(f"this is {kind}, not a file", where=label, expected="a file")
