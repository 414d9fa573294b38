"""Outputs appear whole or not at all: written beside their place, then moved there. Of processes
that work in one folder, one at a time may where that is asked for.
"""

from __future__ import annotations

import errno
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from pkmcal.errors import InputError
from pkmcal.wording import listed

COMMITTED_FOLDER = ".pkmcal-replacing"
"""Inside a folder: all that was written for it, complete, on the way to its place."""
WRITING_STAGE_NAME, WRITING_PROBE_NAME = "stage", "probe"
_NEW, _GONE = "new", "gone"
"""In a stage: the files as they will stand, and empty ones that name those which go."""
_HELD = "held"
"""In a stage, beside them: a file that its process has locked for as long as it lives."""
FOLDER_LOCK_FILE = "lock"
"""An empty file in a folder in which one process at a time works; it stays there."""
_LEFT_OVER = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{12}\.part")
"""Names of `_beside`."""


def check_writable(folder: Path | str) -> None:
    """Raise `InputError` where `folder` could not be made or written to; leaves no trace.

    Call it before the work whose result goes there. A real attempt is the only sound test:
    permission bits do not tell about read-only and full file systems.
    """
    folder = Path(folder)
    standing = folder
    while not standing.exists() and standing != standing.parent:
        standing = standing.parent
    if not standing.is_dir():
        raise InputError(
            "outputs cannot go here", where=str(folder), found=f"{standing} is a file",
            expected="a folder",
        )  # fmt: skip
    probe = _beside(standing / WRITING_PROBE_NAME)
    try:
        probe.mkdir()
        probe.rmdir()
    except OSError as error:
        raise _unwritable(folder, error) from None


def check_own_folder(
    folder: Path, names: Collection[str], what: str, earlier: str | None = None
) -> list[str]:
    """Raise `InputError` where a folder holds anything but our own files of these names.

    what : such as "a validation"; earlier : "an earlier validation" unless given.
    Returns what it holds.
    """
    check_writable(folder)
    standing = entries(folder)
    foreign = [name for name in standing if name not in names]
    if foreign:
        raise InputError(
            f"the output folder holds something other than {what}",
            where=str(folder),
            found=listed(foreign, 4),
            expected=f"a new or empty folder, or {earlier or what.replace('a ', 'an earlier ', 1)}"
            " to replace",
            next_step="Name another folder with -o, or move these files away",
        )
    return standing


def entries(folder: Path) -> list[str]:
    """Sorted names in a folder, none where there is no folder; what a run that was killed left
    there is none of them.
    """
    if not folder.is_dir():
        return []
    finish_replacement(folder)
    return sorted(e.name for e in folder.iterdir() if not _LEFT_OVER.fullmatch(e.name))


def write_folder(
    folder: Path, texts: Mapping[str, str | bytes], over: Collection[str] = ()
) -> None:
    """Write texts, or bytes, by their files' names, all of them or none.

    over : files of an earlier result, of which none is to stay.
    """
    with staged_folder(folder, over) as stage:
        for name, text in texts.items():
            content = text.encode("utf-8") if isinstance(text, str) else text
            (stage / name).write_bytes(content)


def write_text(path: Path | str, text: str) -> None:
    """Write a UTF-8 file with Unix line ends, whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write a file, whole or not at all; its folder is made where missing."""
    with staged_file(path) as part:
        part.write_bytes(content)


@contextmanager
def staged_file(path: Path | str) -> Generator[Path]:
    """Give a name to write to; on leaving without an error, that file is at `path`. The folder is
    made where missing.
    """
    path = Path(path)
    part = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        _to_disk(part)
        part.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from None
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def staged_folder(folder: Path | str, over: Collection[str] = ()) -> Generator[Path]:
    """Give an empty folder to write into; on leaving without an error, all of it is in `folder`.

    over : names of files in `folder` that go, unless they were written again. Others stay.
    A new folder appears in one step. What is to go into one that is there already is put into it
    under the name COMMITTED_FOLDER, in one step, and moved to its place from there. A run that is
    killed leaves the old files before that step, and after it COMMITTED_FOLDER, from which
    `finish_replacement` goes on: the next time that anything here is read or written. On an error
    nothing changes.
    """
    folder = Path(folder)
    check_writable(folder)
    finish_replacement(folder)
    # Inside a folder that exists, because that may be a mount of its own, where moves would copy.
    stage = _beside(folder / WRITING_STAGE_NAME) if folder.is_dir() else _beside(folder)
    new, gone = stage / _NEW, stage / _GONE
    for place in {stage.parent, folder.parent}:
        _clear_abandoned(place)
    held: BinaryIO | None = None
    try:
        new.mkdir(parents=True)
        gone.mkdir()
        held = _hold(stage)
        yield new
        written = _files(new)
        for path in written:
            _to_disk(path)
        if folder.exists():
            _check_clash(new, folder)
            for name in over:
                if new / name not in written and (folder / name).is_file():
                    (gone / name).touch()
            held.close()
            (stage / _HELD).unlink()
            stage.replace(folder / COMMITTED_FOLDER)
            finish_replacement(folder)
        else:
            new.replace(folder)
        _sweep(folder)
    except OSError as error:
        raise _unwritable(folder, error) from None
    finally:
        if held is not None:
            held.close()
        shutil.rmtree(stage, ignore_errors=True)


@contextmanager
def alone_in(folder: Path, what: str) -> Generator[None]:
    """Work in a folder, made where missing, while no other process that asks for it may.

    what : what works there, such as "study". Raises InputError where another one does.
    """
    check_writable(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / FOLDER_LOCK_FILE).open("ab") as stream:
        if _lock(stream.fileno()) is False:
            raise InputError(
                f"another {what} works in this folder",
                where=str(folder),
                next_step="Wait until it has ended, or name another folder with -o",
            )
        yield


def remove_folder(folder: Path) -> None:
    """Remove a folder in one step, so that no part of it is ever taken for the whole."""
    left = _beside(folder)
    folder.replace(left)
    shutil.rmtree(left)


def finish_replacement(folder: Path) -> None:
    """Finish a replacement of files in `folder` in which a run was killed, if there is one.

    Several processes may do so at once, and it may be killed as well: what is moved is moved.
    Raises `InputError` where that is not allowed here.
    """
    committed = folder / COMMITTED_FOLDER
    if not committed.is_dir():
        return
    new, gone = committed / _NEW, committed / _GONE
    try:
        for mark in _files(gone):
            (folder / mark.relative_to(gone)).unlink(missing_ok=True)
            mark.unlink(missing_ok=True)
        for path in _files(new):
            target = folder / path.relative_to(new)
            target.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):  # another process was faster
                path.replace(target)
    except OSError as error:
        raise InputError(
            f"new files cannot be moved to their place ({error.strerror or error})",
            where=str(folder),
            found=f"what a run that was cut short left in {COMMITTED_FOLDER}",
            next_step="Close programs that hold these files, make the folder writable, and run"
            " this again",
        ) from None
    # Folder by folder, so that files which another process commits meanwhile are safe.
    for path in sorted(committed.rglob("*"), reverse=True):
        with suppress(OSError):
            path.rmdir()
    with suppress(OSError):
        committed.rmdir()


def _files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if not path.is_dir()]


def _to_disk(path: Path) -> None:
    """Without it, a power cut after a move can leave the new name on an empty file."""
    with path.open("r+b") as stream:
        os.fsync(stream.fileno())


def _check_clash(new: Path, folder: Path) -> None:
    """Look for what would stop a move before the first, so that the folder stays as it was."""
    for path in new.rglob("*"):
        target = folder / path.relative_to(new)
        if path.is_dir() and target.exists() and not target.is_dir():
            raise NotADirectoryError(20, "a file stands where a folder should go", str(target))
        if target.is_dir() and not path.is_dir():
            raise IsADirectoryError(21, "a folder stands where a file should go", str(target))


def _sweep(folder: Path) -> None:
    """Remove what runs that were killed left of their attempts; of two that work at once, the
    first to finish wins.
    """
    for place, names in (
        (folder, (WRITING_STAGE_NAME, WRITING_PROBE_NAME)),
        (folder.parent, (folder.name, WRITING_PROBE_NAME)),
    ):
        for path in list(place.iterdir()):
            left = _LEFT_OVER.fullmatch(path.name)
            if left and left["name"] in names and path.is_dir():
                shutil.rmtree(path, ignore_errors=True)


def _hold(stage: Path) -> BinaryIO:
    """A stage's file, locked, and the computer's name written into it when it is."""
    held = (stage / _HELD).open("wb", buffering=0)
    _lock(held.fileno())
    held.write(_computer())
    return held


def _lock(file: int) -> bool | None:
    """Lock an open file, by its descriptor, for as long as this process lives, however it ends;
    False where another process has it.

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


def _computer() -> bytes:
    """Not all file systems of a network tell one computer what another has locked."""
    return platform.node().encode() or b"?"


def _clear_abandoned(place: Path) -> None:
    """Remove stages in a folder whose process has ended before it was done, whatever they were
    for: an hour's photographs may lie in one. Those of which that is not certain stay.
    """
    stages: list[Path] = []
    with suppress(OSError):  # no such folder yet, or one whose names may not be listed
        stages = [path for path in place.iterdir() if _LEFT_OVER.fullmatch(path.name)]
    for stage in stages:
        with suppress(OSError):  # no stage, or one that another process removes
            with (stage / _HELD).open("r+b") as held:  # empty: not locked yet
                ours = held.read() == _computer() and held.seek(0) == 0
                abandoned = ours and _lock(held.fileno())
            if abandoned:
                shutil.rmtree(stage, ignore_errors=True)


def _beside(path: Path) -> Path:
    """A hidden, unused name in the same folder, so that moving to `path` is one step."""
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot be written ({error.strerror or error})",
        where=str(path),
        next_step="Choose another folder, or change its permissions",
    )
