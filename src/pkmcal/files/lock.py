"""The system's lock of an open file, which it gives free when the process ends, however it ends."""

from __future__ import annotations

import errno
import sys


def lock(file: int) -> bool | None:
    """Lock an open file for this process, by its descriptor; False where another process has it.

    None where the file system has no locks at all, as some of a network have none.
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
