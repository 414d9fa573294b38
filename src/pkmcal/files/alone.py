"""One process at a time works in a folder."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files.lock import lock
from pkmcal.files.writing import check_writable

LOCK = "lock"
"""An empty file in the folder, which stays there."""


@contextmanager
def alone_in(folder: Path, what: str) -> Generator[None]:
    """Work in a folder, made where missing, while no other process that asks for it may.

    what : what works there, such as "study". Raises InputError where another one does.
    """
    check_writable(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("ab") as stream:
        if lock(stream.fileno()) is False:
            raise InputError(
                f"another {what} works in this folder",
                where=str(folder),
                next_step="Wait until it has ended, or name another folder with -o",
            )
        yield
