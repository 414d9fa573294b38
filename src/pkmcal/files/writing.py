"""Atomic output: files are written in a stage beside their place, then moved there.

A stage is a hidden folder of one process. Nothing is written through a link inside an output.
"""

from __future__ import annotations

import os
import platform
import re
import secrets
import shutil
from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager, suppress
from hashlib import blake2b
from pathlib import Path, PurePath

from pkmcal.errors import InputError
from pkmcal.files.locks import FOLDER_LOCK_FILE, NO_FOLLOW, lock, output_lock
from pkmcal.files.refusals import next_step_after
from pkmcal.files.replacing import (
    COMMITTED_FOLDER,
    NEW_FILES_FOLDER,
    commit_replacement,
    files_below,
    finish_replacement,
)
from pkmcal.wording import listed

WRITING_STAGE_NAME, WRITING_PROBE_NAME = "stage", "probe"
_COMPLETE = "complete"
"""Folder in a stage that becomes COMMITTED_FOLDER."""
_TEMPORARY_NAME = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{12}\.part")
"""Pattern of the names that `_beside` makes."""


def check_writable(folder: Path | str) -> None:
    """Raise `InputError` where `folder` cannot be made or written to; leaves no trace.

    Call it before the work whose result goes there. Only a real attempt is a sound test: permission
    bits do not reveal read-only and full file systems.
    """
    folder = Path(folder)
    standing = folder
    while not standing.exists() and standing != standing.parent:
        if standing.is_symlink():
            raise InputError(
                "outputs cannot go here: this is a link to what is not there",
                where=str(standing),
                found=str(standing.readlink()),
                expected="a folder",
            )
        standing = standing.parent
    if not standing.is_dir():
        raise InputError(
            "outputs cannot go here", where=str(folder), found=f"{standing} is a file",
            expected="a folder",
        )  # fmt: skip
    probe = _beside(standing / WRITING_PROBE_NAME)
    try:
        probe.mkdir()
        with suppress(FileNotFoundError):  # cleared away by another process
            probe.rmdir()
    except OSError as error:
        raise _unwritable(folder, error) from None


def default_output(folder: Path) -> Path:
    """`folder`, the default place of results.

    Raises `InputError` where it is a link: it may be part of somebody else's session, and then
    leads to any place of this computer.
    """
    if folder.is_symlink():
        raise InputError(
            "the folder for results is a link, which is followed only where you name it",
            where=str(folder),
            found=f"a link to {folder.readlink()}",
            next_step="Name the folder to write to with -o",
        )
    return folder


def check_own_folder(
    folder: Path, names: Collection[str], what: str, earlier: str | None = None
) -> list[str]:
    """Names in a folder. Raises `InputError` where it holds anything but files of ``names``.

    what : such as "a validation".
    earlier : by default, for example, "an earlier validation".
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
            code="output.foreign_files",
        )
    return standing


def entries(folder: Path) -> list[str]:
    """Sorted names in an output folder before it is written to, none where there is no folder.

    Finishes a replacement in which a process of this user was killed. Stages are not among the
    names.
    """
    if not folder.is_dir():
        return []
    finish_replacement(folder)
    return sorted(
        entry.name
        for entry in folder.iterdir()
        if entry.name != COMMITTED_FOLDER and not _TEMPORARY_NAME.fullmatch(entry.name)
    )


def write_folder(
    folder: Path, texts: Mapping[str, str | bytes], over: Collection[str] = ()
) -> None:
    """Write texts, or bytes, by the names of their files, all of them or none.

    over : files of an earlier result, all of which are replaced or removed.
    """
    with staged_folder(folder, over) as stage:
        for name, text in texts.items():
            content = text.encode("utf-8") if isinstance(text, str) else text
            path = place_below(stage, name, folder)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def place_below(stage: Path, name: str, folder: Path) -> Path:
    """Path of a file in a folder's stage, by a name that may contain words of a session.

    Raises `InputError` at ``folder`` where it would be outside.
    """
    if PurePath(name).is_absolute() or ".." in PurePath(name).parts or not PurePath(name).name:
        raise InputError(
            "no file can have this name", where=str(folder), found=name, code="file.impossible_name"
        )
    return stage / name


def write_text(path: Path | str, text: str) -> None:
    """Write a UTF-8 file with Unix line ends, as a whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write a file, as a whole or not at all; its folder is made where missing."""
    with staged_file(path) as part:
        part.write_bytes(content)


@contextmanager
def staged_file(path: Path | str) -> Generator[Path]:
    """Context with a path to write to; on exit without an error, that file is moved to `path`.

    The folder is made where missing, and a link at `path` is replaced.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _stage(path) as stage:
            part = stage / path.name
            yield part
            _to_disk(part)
            part.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from None


@contextmanager
def staged_folder(folder: Path | str, over: Collection[str] = ()) -> Generator[Path]:
    """Context with an empty folder; on exit without an error, its files are in `folder`.

    A new folder appears in one step. Files for an existing folder are committed in one step
    (:mod:`pkmcal.files.replacing`), and moved to their places from there. On an error nothing
    changes.

    over : names of files in `folder` that are removed unless they were written again; others stay.
    """
    folder = Path(folder)
    check_writable(folder)
    finish_replacement(folder)
    # Inside a folder that exists, because that may be a mount of its own, where moves would copy.
    beside = folder / WRITING_STAGE_NAME if folder.is_dir() else folder
    try:
        beside.parent.mkdir(parents=True, exist_ok=True)
        _clear_abandoned(folder.parent)
        with _stage(beside) as stage:
            new = stage / _COMPLETE / NEW_FILES_FOLDER
            new.mkdir(parents=True)
            yield new
            # the caller has written all files: flush them, then move them
            written = files_below(new)
            for path in written:
                _to_disk(path)
            with output_lock(folder):
                finish_replacement(folder)
                if folder.exists():
                    gone = [n for n in over if new / n not in written and (folder / n).is_file()]
                    commit_replacement(stage / _COMPLETE, folder, gone)
                else:
                    new.replace(folder)
    except OSError as error:
        raise _unwritable(folder, error) from None


@contextmanager
def alone_in(folder: Path, what: str) -> Generator[None]:
    """Context in which this process alone works in a folder, which is made where missing.

    what : the work, such as "study". Raises InputError where another process holds the folder.
    """
    check_writable(default_output(folder))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FOLDER_LOCK_FILE
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | NO_FOLLOW, 0o666)
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        if lock(file) is False:
            raise InputError(
                f"another {what} works in this folder",
                where=str(folder),
                next_step="Wait until it has ended, or name another folder with -o",
                code="output.in_use",
            )
        yield
    finally:
        os.close(file)


def remove_folder(folder: Path) -> None:
    """Remove a folder in one step, so that no part of it is ever taken for the whole; of a link,
    remove only the link.
    """
    if folder.is_symlink():
        folder.unlink()
        return
    with _stage(folder) as stage:
        folder.replace(stage / _COMPLETE)


def _to_disk(path: Path) -> None:
    """Flush a file to disk: without it, a power cut after a move can leave the new name on an empty
    file.
    """
    if path.is_symlink():
        return
    with path.open("r+b") as stream:
        os.fsync(stream.fileno())


@contextmanager
def _stage(path: Path) -> Generator[Path]:
    """Context with a new folder beside `path`, which is removed with its content on exit.

    A file in it is locked as long as this process lives, so that other processes recognise it.
    """
    _clear_abandoned(path.parent)
    stage, held = _locked_stage(path)
    try:
        yield stage
    finally:
        os.close(held)
        _remove_stage(stage)


def _locked_stage(path: Path) -> tuple[Path, int]:
    """New folder beside `path`, and the descriptor of the locked file in it."""
    while True:
        stage = _beside(path)
        stage.mkdir()
        # Until its file is locked, another process may take the stage for an abandoned one.
        try:
            held = os.open(stage / _lock_file(), os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        except FileNotFoundError:
            continue
        except OSError:
            stage.rmdir()
            raise
        if lock(held) is not False and (stage / _lock_file()).exists():
            return stage, held
        os.close(held)


def _remove_stage(stage: Path) -> None:
    """Remove a stage, its locked file last, so that the remains after a kill are still
    recognised.
    """
    with suppress(OSError):
        for path in stage.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            elif path.name != _lock_file():
                path.unlink()
        (stage / _lock_file()).unlink()
        stage.rmdir()


def _clear_abandoned(place: Path) -> None:
    """Remove all stages in a folder whose processes were killed, since an hour's images may lie in
    one. A stage stays where that is not certain.
    """
    try:
        match = [entry for entry in os.scandir(place) if _TEMPORARY_NAME.fullmatch(entry.name)]
    except OSError:  # no such folder yet, or one whose names may not be listed
        return
    for stage in (Path(entry.path) for entry in match if entry.is_dir(follow_symlinks=False)):
        with suppress(OSError):
            stage.rmdir()  # with nothing in it, as a probe
        with suppress(OSError):  # no stage, or one that another process removes
            held = os.open(stage / _lock_file(), os.O_RDWR | NO_FOLLOW)
            try:
                abandoned = lock(held)
            finally:
                os.close(held)
            if abandoned:
                _remove_stage(stage)


def _lock_file() -> str:
    """Name of a stage's locked file. It contains this computer's identity, because not all network
    file systems show the locks of another computer.
    """
    return f"locked-by-{blake2b(platform.node().encode(), digest_size=6).hexdigest()}"


def _beside(path: Path) -> Path:
    """Hidden, unused name in the same folder, so that moving to `path` is one step."""
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")


def _unwritable(path: Path, error: OSError) -> InputError:
    """Error about a path that the operating system refuses to write."""
    return InputError(
        f"cannot be written ({error.strerror or error})",
        where=str(path),
        next_step=next_step_after(error),
        code="file.unwritable",
    )
