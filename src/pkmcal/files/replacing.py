"""Transactional replacement of files in a folder that already holds others.

A replacement is committed by one rename: a complete folder of new files, with a journal of the
files to be moved and removed, becomes COMMITTED_FOLDER of the output. From then on it has to be
finished: by the same process, or after a kill by the next process that writes to the same output.
Reading finishes nothing.

The output may be part of a session that somebody else made, with a COMMITTED_FOLDER that would
overwrite any file. Therefore a journal is accepted only if it is signed with a key in this user's
cache folder and names the output's place; files are moved only if they have the digests in the
journal, and nothing is moved or removed through a link.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from pkmcal.errors import InputError
from pkmcal.files.cache import remember, remembered
from pkmcal.files.locks import LOCK_ATTEMPT_INTERVAL, output_busy, output_lock
from pkmcal.files.refusals import next_step_after

COMMITTED_FOLDER = ".pkmcal-replacing"
"""Folder inside an output with the new files that are to be moved, and the journal."""
NEW_FILES_FOLDER = "new"
JOURNAL_FILE = "journal"
LARGEST_JOURNAL = 2**24
"""Largest size of a journal in bytes, that of a hundred thousand files."""
JOURNAL_KEY_NAME, JOURNAL_KEY_BYTES = "journal-key", 32
LONGEST_WAIT_FOR_MOVES = 10.0
"""Seconds that a reader waits while another process moves files, which takes milliseconds."""


class _Journal(NamedTuple):
    """Plan of a replacement. digests : by the names of new files. gone : names to be removed."""

    digests: Mapping[str, str]
    gone: Sequence[str]


def check_replaced(folder: Path) -> None:
    """Raise `InputError` where files in a folder may be partly new and partly old."""
    end = time.monotonic() + LONGEST_WAIT_FOR_MOVES
    while _unfinished(folder):
        waiting = output_busy(folder) and time.monotonic() < end
        if not waiting and _unfinished(folder):
            raise InputError(
                "files were being replaced here when a run was cut short, and some may be of an"
                " earlier result",
                where=str(folder),
                found=COMMITTED_FOLDER,
                next_step="Run the command that wrote here again, which finishes this; or, to keep"
                f" what is there, remove {COMMITTED_FOLDER}, which holds the rest of the new files",
            )
        time.sleep(LOCK_ATTEMPT_INTERVAL)


def commit_replacement(stage: Path, folder: Path, gone: Sequence[str]) -> None:
    """Replace files in `folder` by all files in `stage`/NEW_FILES_FOLDER, on the same file system.

    gone : names of files in `folder` to be removed. Raises OSError, before anything changes, where
    a file or a link is in a folder's place, or a folder in a file's.
    """
    new = stage / NEW_FILES_FOLDER
    names = [path.relative_to(new).as_posix() for path in files_below(new)]
    for name in (*names, *gone):
        _check_target(folder, name)
    journal = _Journal({name: _digest(new / name) for name in names}, gone)
    payload = json.dumps([os.path.realpath(folder), *journal]).encode()
    with (stage / JOURNAL_FILE).open("xb") as stream:
        stream.write(_signature(payload) + b"\n" + payload)
        stream.flush()
        os.fsync(stream.fileno())
    stage.replace(folder / COMMITTED_FOLDER)
    _move(folder, journal)


def finish_replacement(folder: Path) -> None:
    """Finish a replacement in `folder`, an output, in which a process of this user was killed.

    Raises `InputError` for a replacement that this user did not begin there, and where files cannot
    be moved.
    """
    if not _unfinished(folder):
        return
    with output_lock(folder):
        if not _unfinished(folder):  # another process was faster
            return
        journal = _signed_journal(folder)
        if journal is None:
            raise InputError(
                "files were being replaced here when a run was cut short, and not by you in this"
                " place",
                where=str(folder),
                found=COMMITTED_FOLDER,
                next_step="Name another output folder; or move what you want to keep out of"
                f" {COMMITTED_FOLDER}, and remove it",
            )
        _move(folder, journal)


def files_below(folder: Path) -> list[Path]:
    """All files in a folder and its subfolders."""
    return [path for path in sorted(folder.rglob("*")) if not path.is_dir()]


def _unfinished(folder: Path) -> bool:
    """Whether COMMITTED_FOLDER exists and is not empty; an empty one is left by a finished
    replacement.
    """
    place = folder / COMMITTED_FOLDER
    if not os.path.lexists(place):
        return False
    try:
        return place.is_symlink() or any(place.iterdir())
    except FileNotFoundError:  # finished just now
        return False
    except OSError:
        return True


def _signed_journal(folder: Path) -> _Journal | None:
    """Journal of a replacement that this user began in this folder; None for any other.

    The new files that are present are checked against their digests, and their targets for links.
    """
    place = folder / COMMITTED_FOLDER
    try:
        path = place / JOURNAL_FILE
        if place.is_symlink() or not path.is_file() or path.stat().st_size > LARGEST_JOURNAL:
            return None
        signature, _, payload = path.read_bytes().partition(b"\n")
        if not hmac.compare_digest(signature, _signature(payload)):
            return None
        where, digests, gone = json.loads(payload)
        if where != os.path.realpath(folder):
            return None
        for name, digest in digests.items():
            _check_target(folder, name)
            _check_target(place / NEW_FILES_FOLDER, name)
            source = place / NEW_FILES_FOLDER / name
            # a file that no longer exists here was moved already
            if os.path.lexists(source):
                regular = source.is_file() and not source.is_symlink()
                if not regular or _digest(source) != digest:
                    return None
        for name in gone:
            _check_target(folder, name)
    except OSError:
        return None
    return _Journal(digests, gone)


def _move(folder: Path, journal: _Journal) -> None:
    """Move the files that remain to be moved; a rename replaces a link and does not follow it."""
    place = folder / COMMITTED_FOLDER
    try:
        for name in journal.gone:
            (folder / name).unlink(missing_ok=True)
        for name in journal.digests:
            for part in _folders_above(folder, name):
                part.mkdir(exist_ok=True)
            with suppress(FileNotFoundError):
                (place / NEW_FILES_FOLDER / name).replace(folder / name)
    except OSError as error:
        raise InputError(
            f"new files cannot be moved to their place ({error.strerror or error})",
            where=str(folder),
            found=f"the rest of them in {COMMITTED_FOLDER}",
            next_step=f"{next_step_after(error)}; then run this again, which finishes it",
            code="file.unwritable",
        ) from None
    # The journal last: without it, no process could determine that all files have been moved.
    new = place / NEW_FILES_FOLDER
    for path in (*sorted(new.rglob("*"), reverse=True), new):
        with suppress(OSError):
            path.rmdir()
    with suppress(OSError):
        (place / JOURNAL_FILE).unlink()
        place.rmdir()


def _folders_above(folder: Path, name: str) -> Iterator[Path]:
    """Folders between `folder` and a file below it, from the top."""
    for part in reversed(Path(name).parents[:-1]):
        yield folder / part


def _check_target(folder: Path, name: str) -> None:
    """Raise OSError where a file cannot be moved to its place below `folder`, or would leave it."""
    for part in _folders_above(folder, name):
        if part.is_symlink():
            raise NotADirectoryError(20, "a link stands where a folder should go", str(part))
        if part.exists() and not part.is_dir():
            raise NotADirectoryError(20, "a file stands where a folder should go", str(part))
    target = folder / name
    if target.is_dir() and not target.is_symlink():
        raise IsADirectoryError(21, "a folder stands where a file should go", str(target))


def _signature(payload: bytes) -> bytes:
    """Signature of a journal with this user's key, which is made when first needed.

    Where no key can be stored, each signature has a key of its own, and no replacement can be
    finished later.
    """
    key = remembered(JOURNAL_KEY_NAME)
    if key is None or len(key) != JOURNAL_KEY_BYTES:
        key = secrets.token_bytes(JOURNAL_KEY_BYTES)
        remember(JOURNAL_KEY_NAME, key)
    return hmac.digest(key, payload, "sha256").hex().encode()


def _digest(path: Path) -> str:
    """SHA-256 digest of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
