"""What takes a while to make and comes out the same each time, kept in the user's cache folder.

Nothing depends on it: where the folder cannot be read or written, all is made anew.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def remembered(name: str) -> bytes | None:
    """What is kept under a name; None for nothing."""
    try:
        return (cache_folder() / name).read_bytes()
    except OSError:
        return None


def remember(name: str, content: bytes) -> None:
    """Keep it, whole or not at all, for this user alone to read: code is kept, and a key."""
    place = cache_folder()
    new = place / f"{name}.{os.getpid()}"
    with suppress(OSError):
        place.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            new.touch(mode=0o600)
            new.write_bytes(content)
            new.replace(place / name)
        finally:
            new.unlink(missing_ok=True)


def cache_folder() -> Path:
    """The user's cache folder; it may not exist yet."""
    from platformdirs import user_cache_path

    return user_cache_path("pkmcal", appauthor=False)
