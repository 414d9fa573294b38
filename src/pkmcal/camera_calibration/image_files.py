"""Images of a board by the arguments of ``pkmcal camera``: files, folders or a session."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

from pkmcal.errors import InputError
from pkmcal.files import IMAGE_FILE_ENDINGS, read_yaml, resolved, validated_document, wanted_file
from pkmcal.session.schema import session_schema
from pkmcal.wording import listed


def session_board_images(folder: Path) -> tuple[list[Path], Path]:
    """Image files of a session's board, all of one camera, and the board's file.

    Raises InputError if no station observes a board, several cameras do, or there are no files.
    """
    session = read_yaml(folder / "session.yaml")
    schema = validated_document(session, session_schema())
    observers = [schema.cameras[name] for name in schema.observers("board")]
    if not observers or schema.board is None:
        raise InputError(
            "no station of this session observes a board",
            where=session.where("stations"),
            expected="observe: board on a station, and board: board.yaml",
            next_step="Name the board's images instead: pkmcal camera IMAGES... --board FILE",
            code="session.no_board",
        )
    board = folder / schema.board.file
    if not board.exists():
        raise InputError(
            "there is no such file",
            where=session.where("board"),
            found=schema.board.file,
            expected=wanted_file(board),
            code="file.missing",
        )
    cameras = sorted({station.camera for station in observers})
    if len(cameras) > 1:
        raise InputError(
            "the session's boards are seen by several cameras",
            where=session.where("stations"),
            found=listed(cameras),
            expected="one camera at a time",
            next_step="Name one camera's images: pkmcal camera IMAGES... --board FILE",
        )
    patterns = [glob.escape(station.images) for station in observers]
    wild = [p.replace("{configuration}", "*").replace("{repeat}", "*") for p in patterns]
    paths = sorted({folder / name for text in wild for name in glob.glob(text, root_dir=folder)})
    if not paths:
        raise InputError(
            "no images found", where=session.where("stations"), found=wild[0], code="images.none"
        )
    return paths, board


def image_files(images: Sequence[Path]) -> list[Path]:
    """Image files of the arguments in the order of their names, with folders replaced by their
    content.
    """
    out: list[Path] = []
    for path in images:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_FILE_ENDINGS)
            if not inside:
                raise InputError(
                    "the folder holds no images",
                    where=str(path),
                    expected=f"some in it ({', '.join(sorted(IMAGE_FILE_ENDINGS))}), or a"
                    " session.yaml that names them",
                    code="images.none",
                )
            out += inside
        elif path.is_file():
            out.append(path)
        else:
            raise InputError(
                "there is no such image or folder", where=str(path), code="file.missing"
            )
    return list(dict.fromkeys(out))


def board_file_of(images: Sequence[Path]) -> Path:
    """board.yaml in the folder of the images, or in the folder above; InputError without it."""
    if not images:
        raise InputError(
            "no image is named", expected="images, or a folder of them", code="images.none"
        )
    first = images[0] if images[0].is_dir() else images[0].parent
    for folder in (first, resolved(first).parent):
        if (folder / "board.yaml").is_file():
            return folder / "board.yaml"
    raise InputError(
        "the board is not described",
        where=str(first),
        expected="a file board.yaml here or above, or --board FILE",
    )
