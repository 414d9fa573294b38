"""Cache of slow, reproducible results in the user's cache folder.

The program works without the folder: where it cannot be read or written, results are made anew.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path


def remembered(name: str) -> bytes | None:
    """Cached content under a name, or None."""
    try:
        return (cache_folder() / name).read_bytes()
    except OSError:
        return None


def remember(name: str, content: bytes) -> None:
    """Cache content, whole or not at all, readable by this user alone: it may be code, or a key."""
    place = cache_folder()
    new = place / f"{name}.{os.getpid()}-{threading.get_ident()}"
    with suppress(OSError):
        place.mkdir(parents=True, exist_ok=True, mode=0o700)
        try:
            new.touch(mode=0o600)
            new.write_bytes(content)
            new.replace(place / name)
        finally:
            new.unlink(missing_ok=True)


def cache_folder() -> Path:
    """The user's cache folder, which may not exist yet."""
    from platformdirs import user_cache_path

    return user_cache_path("pkmcal", appauthor=False)
