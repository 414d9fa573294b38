"""One process at a time works in a folder."""

from __future__ import annotations

import errno
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files.writing import check_writable

LOCK = "lock"
"""An empty file in the folder, which stays there. The system gives it free when its process ends,
however that ends."""


@contextmanager
def alone_in(folder: Path, what: str) -> Generator[None]:
    """Work in a folder, made where missing, while no other process that asks for it may.

    what : what works there, such as "study". Raises InputError where another one does.
    """
    check_writable(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK).open("ab") as stream:
        if _taken(stream.fileno()):
            raise InputError(
                f"another {what} works in this folder",
                where=str(folder),
                next_step="Wait until it has ended, or name another folder with -o",
            )
        yield


def _taken(file: int) -> bool:
    """Whether another process holds the lock of an open file; else it is this one's from now on."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # some network file systems have no locks at all: then there is none
        return error.errno in (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK)
    return False
