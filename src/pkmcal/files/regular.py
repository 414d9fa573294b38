"""Checks that a path is a regular file; reading a pipe or a device could block for ever."""

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
    """Absolute path with links followed; a link to itself stays as it is, where `Path.resolve`
    raises an error of its own kind.
    """
    return Path(os.path.realpath(path))


def given_path(value: object, expected: str) -> Path:
    """Path of an argument of a public function; InputError for an object of another type.

    expected : what the path is of, such as "a session's folder".
    """
    if isinstance(value, str | Path):
        return Path(value)
    in_memory = hasattr(value, "save")
    raise InputError(
        "this is not a path",
        found=f"an object of type {type(value).__name__}",
        expected=expected,
        next_step="Save it with save(FOLDER), and name that folder" if in_memory else None,
        code="argument.not_a_path",
    )


def check_regular(path: Path, label: str) -> None:
    """Raise `InputError` where `path` exists and is not a regular file, before it is opened.

    label : the file's name in messages. Raises FileNotFoundError where nothing exists.
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
            code="file.irregular",
        ) from None
    if stat.S_ISREG(mode):
        return
    kind = next((kind for is_kind, kind in _KINDS if is_kind(mode)), "something else")
    raise InputError(
        f"this is {kind}, not a file", where=label, expected="a file", code="file.irregular"
    )
