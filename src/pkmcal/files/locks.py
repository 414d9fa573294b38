"""Locks between processes; the operating system releases a lock when its process ends."""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from hashlib import blake2b
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files.cache import cache_folder

FOLDER_LOCK_FILE = "lock"
"""Empty file in a folder in which one process at a time works; it is not removed."""
LONGEST_WAIT_FOR_OUTPUT = 60.0
"""Seconds that a process waits while another one moves its files, which takes a second or so."""
LOCK_ATTEMPT_INTERVAL = 0.05
"""Seconds between two attempts."""
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
"""Flag of os.open that refuses links, where the operating system has it."""

_PLACES: ContextVar[frozenset[str]] = ContextVar("_PLACES", default=frozenset())
"""Parent folders of outputs that this context has locked."""


def lock(file: int) -> bool | None:
    """Lock an open file, by its descriptor, until this process closes it.

    Returns False where another process has locked it, None where the file system has no locks, as
    some network file systems.
    """
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        held = error.errno in (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK)
        return False if held else None
    return True


@contextmanager
def output_lock(output: Path) -> Generator[None]:
    """Exclusive access to an output, to inspect it and to move files to it.

    Waits for another process, and raises `InputError` after LONGEST_WAIT_FOR_OUTPUT. Reentrant;
    without effect where the file system has no locks.
    """
    place = _place(output)
    if place in _PLACES.get():
        yield
        return
    with suppress(OSError):  # or two processes, one before and one after it, lock different things
        Path(place).mkdir(parents=True, exist_ok=True)
    file = _locked_file(place, output)
    token = _PLACES.set(_PLACES.get() | {place})
    try:
        yield
    finally:
        _PLACES.reset(token)
        if file is not None:
            os.close(file)


def output_busy(output: Path) -> bool:
    """Whether another process may be moving files to an output at this moment."""
    place = _place(output)
    if place in _PLACES.get():
        return False
    for file in _lockable_files(place):
        success = lock(file)
        os.close(file)
        if success is not None:
            return not success
    return True


def _place(output: Path) -> str:
    """The parent folder of an output, which has one lock."""
    return str(Path(os.path.realpath(output)).parent)


def _locked_file(place: str, output: Path) -> int | None:
    """An open file that holds the lock of a folder, or None where there are no locks."""
    end = time.monotonic() + LONGEST_WAIT_FOR_OUTPUT
    for file in _lockable_files(place):
        while (success := lock(file)) is False:
            if time.monotonic() > end:
                os.close(file)
                raise InputError(
                    "another process writes here",
                    where=str(output),
                    next_step="Wait until it has ended, or name another folder with -o",
                )
            time.sleep(LOCK_ATTEMPT_INTERVAL)
        if success:
            return file
        os.close(file)
    return None


def _lockable_files(place: str) -> Iterator[int]:
    """Open files to lock for a folder: the folder itself, so that no lock file remains in it; then
    a file in the user's cache folder, for systems such as Windows that cannot open folders.
    """
    with suppress(OSError):
        yield os.open(place, os.O_RDONLY)
    name = blake2b(place.encode("utf-8", "surrogateescape"), digest_size=8).hexdigest()
    with suppress(OSError):
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        yield os.open(folder / f"lock-{name}", os.O_RDWR | os.O_CREAT, 0o600)
