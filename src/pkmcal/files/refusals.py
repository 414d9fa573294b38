"""Messages and next steps for errors of the operating system."""

from __future__ import annotations

import errno

from pkmcal.errors import InputError

_NEXT_STEPS = {
    errno.ENOSPC: "Free space on this disk, or name a folder on another one",
    errno.EDQUOT: "Free space of your quota on this disk, or name a folder on another one",
    errno.EFBIG: "Name a folder on a file system that takes files of this size",
    errno.EROFS: "This file system can only be read: name a folder on another one",
    errno.EACCES: "Change the permissions of this folder, or name another one",
    errno.EPERM: "Change the permissions of this folder, or name another one",
    errno.ENAMETOOLONG: "Name it more briefly",
    errno.EMFILE: "Close files, or raise the limit of open files (ulimit -n)",
    errno.ENFILE: "Close other programs, which have too many files open",
}


def next_step_after(error: OSError) -> str:
    """The ``next_step`` of a message, without a full stop."""
    return _NEXT_STEPS.get(error.errno or 0, "Name another folder")


def refused_by_system(error: OSError) -> InputError:
    """Message of an error such as no space, no permission, or a disk that was taken away."""
    reason = (error.strerror or str(error) or type(error).__name__).lower()
    return InputError(
        f"the operating system refused: {reason}",
        where=str(error.filename) if error.filename else None,
        next_step=next_step_after(error),
    )
