"""Arrays in the user's cache folder, under names made from the digest of all that they depend on.

A file that is damaged counts as absent. Files of another version of the program, or of the packages
that numbers depend on, have other names.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from pkmcal.files.cache import cache_folder, remember, remembered
from pkmcal.files.documents import json_text
from pkmcal.files.versions import versions

MOST_CACHED_BYTES = 2**28
"""Size of all cached arrays above which the oldest are removed."""
_ENDING = ".npz"


def digest_of(*parts: Any) -> str:
    """Digest of arrays and plain data, of the program's source, and of the versions of packages,
    for the name of a result that depends on nothing else.
    """
    digest = blake2b(_source_digest(), digest_size=16)
    digest.update(json_text(versions()).encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str} {part.shape} ".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(json_text(part).encode())
    return digest.hexdigest()


@cache
def _source_digest() -> bytes:
    """Digest of the program's source, which changes between releases too."""
    digest, package = blake2b(), Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.digest()


def remembered_arrays(name: str) -> dict[str, Any] | None:
    """Cached arrays under a name; None if there are none, or the file is damaged."""
    content = remembered(name + _ENDING)
    if content is None:
        return None
    with suppress(OSError):  # the oldest are those that were not used for the longest time
        os.utime(cache_folder() / (name + _ENDING))
    try:
        with np.load(BytesIO(content), allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, KeyError, NotImplementedError, BadZipFile, zlib.error):
        return None


def remember_arrays(
    name: str, arrays: Mapping[str, Any], most_bytes: int = MOST_CACHED_BYTES
) -> None:
    """Cache arrays under a name; the oldest are removed if all of them exceed ``most_bytes``."""
    stream = BytesIO()
    np.savez_compressed(stream, **arrays)
    remember(name + _ENDING, stream.getvalue())
    with suppress(OSError):
        files = sorted(
            ((path.stat(), path) for path in cache_folder().glob(f"*{_ENDING}")),
            key=lambda one: -one[0].st_mtime,
        )
        sizes = np.cumsum([state.st_size for state, _ in files])
        for (_, path), size in zip(files, sizes, strict=True):
            if size > most_bytes:
                path.unlink(missing_ok=True)
