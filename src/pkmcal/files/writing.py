"""Outputs appear whole or not at all: written beside their place, then moved there."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.wording import listed


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
    probe = _beside(standing / "probe")
    try:
        probe.mkdir()
        probe.rmdir()
    except OSError as error:
        raise _unwritable(folder, error) from None


def check_own_folder(
    folder: Path, names: Collection[str], what: str, earlier: str | None = None
) -> None:
    """Raise `InputError` where a folder holds anything but our own files of these names.

    what : such as "a validation"; earlier : "an earlier validation" unless given.
    """
    check_writable(folder)
    entries = sorted(e.name for e in folder.iterdir()) if folder.is_dir() else []
    foreign = [name for name in entries if name not in names]
    if foreign:
        raise InputError(
            f"the output folder holds something other than {what}",
            where=str(folder),
            found=listed(foreign, 4),
            expected=f"a new or empty folder, or {earlier or what.replace('a ', 'an earlier ', 1)}"
            " to replace",
            next_step="Name another folder with -o, or move these files away",
        )


def write_folder(folder: Path, texts: Mapping[str, str | bytes]) -> None:
    """Write texts, or bytes, by their files' names, all of them or none."""
    with staged_folder(folder) as stage:
        for name, text in texts.items():
            content = text.encode("utf-8") if isinstance(text, str) else text
            (stage / name).write_bytes(content)


def write_text(path: Path | str, text: str) -> None:
    """Write a UTF-8 file with Unix line ends, whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path | str, content: bytes) -> None:
    """Write a file, whole or not at all; its folder is made where missing."""
    path = Path(path)
    part = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as stream:
            stream.write(content)
            stream.flush()
            # Without it, a power cut after the move can leave the new name on an empty file.
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        raise _unwritable(path, error) from None
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def staged_folder(folder: Path | str) -> Generator[Path]:
    """Give an empty folder to write into; on leaving without an error, move all of it to `folder`.

    A new folder appears in one step. In one that is there already the files are replaced one by
    one after all of them have been written, and others in it stay. On an error nothing changes.
    """
    folder = Path(folder)
    check_writable(folder)
    # Inside a folder that exists, because that may be a mount of its own, where moves would copy.
    stage = _beside(folder / "stage") if folder.is_dir() else _beside(folder)
    try:
        stage.mkdir(parents=True)
        yield stage
        _move(stage, folder)
    except OSError as error:
        raise _unwritable(folder, error) from None
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _move(stage: Path, folder: Path) -> None:
    """Move what was staged to its place."""
    if not folder.exists():
        stage.replace(folder)
        return
    files = [path for path in sorted(stage.rglob("*")) if not path.is_dir()]
    targets = [folder / path.relative_to(stage) for path in files]
    for target in targets:
        # Looked for before the first move, so that a clash leaves the folder as it was.
        if target.is_dir():
            raise IsADirectoryError(21, "a folder stands where a file should go", str(target))
    for path, target in zip(files, targets, strict=True):
        target.parent.mkdir(parents=True, exist_ok=True)
        path.replace(target)


def _beside(path: Path) -> Path:
    """A hidden, unused name in the same folder, so that moving to `path` is one step."""
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"cannot be written ({error.strerror or error})",
        where=str(path),
        next_step="Choose another folder, or change its permissions",
    )
