"""``pkmcal camera``: calibration of a camera with images of a board."""

from __future__ import annotations

import glob
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import PAGE_DESCRIPTION, finish

CAMERA_FILES = {
    "camera.html": PAGE_DESCRIPTION,
    "camera.yaml": "the camera, for a session's cameras/",
    "camera.json": "everything, with covariances",
}
CAMERA_FOLDER = Path("camera")
OTHER_CAMERA_FILES = {
    "opencv": "camera.opencv.yaml",
    "ros": "camera.ros.yaml",
    "kalibr": "camera.kalibr.yaml",
}


class CameraFileForm(StrEnum):
    """Formats of other programs' camera files."""

    OPENCV = "opencv"
    ROS = "ros"
    KALIBR = "kalibr"


def camera(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION|IMAGES...",
            help="A session whose stations observe a board, or images, or their folder.",
        ),
    ],
    board: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The board's file; board.yaml beside them unless given."),
    ] = None,
    model: Annotated[
        Literal["auto", "pinhole", "fisheye", "unified"],
        typer.Option(metavar="NAME", help="auto, pinhole, fisheye, or unified (mirrors)."),
    ] = "auto",
    out: Annotated[Path, console.folder("Where the results go.")] = CAMERA_FOLDER,
    to: Annotated[
        list[CameraFileForm] | None,
        typer.Option(metavar="NAME", help="Write it for opencv, ros or kalibr as well."),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Calibrate a camera from images of a board."""
    from dataclasses import replace

    from pkmcal.boards.board import load_board
    from pkmcal.camera_calibration.calibrate import calibrate_images
    from pkmcal.files import check_writable, default_output
    from pkmcal.report.camera import outcome_of

    if len(images) == 1 and (images[0] / "session.yaml").is_file():
        paths, there = session_board_images(images[0])
    else:
        paths, there = image_files(images), board or board_file_of(images)
    described = load_board(board or there)
    check_writable(default_output(out) if out == CAMERA_FOLDER else out)
    others = [(OTHER_CAMERA_FILES[form.value], form.value) for form in to or []]
    with console.progress(as_json) as progress:
        progress(f"Looking for the board in {len(paths)} images", 0.1)
        calibration = calibrate_images(paths, described, model)
        progress("Writing the report", 0.9)
        outcome = outcome_of(calibration, paths, others)
    files = {**CAMERA_FILES, **{name: "for that program" for name, _ in others}}
    outcome = replace(outcome, summary={**outcome.document, "files": list(files)})
    return finish(outcome, out, files, as_json=as_json)


def session_board_images(folder: Path) -> tuple[list[Path], Path]:
    """Image files of a session's board, all of one camera, and the board's file.

    Raises InputError if no station observes a board, several cameras do, or there are no files.
    """
    from pkmcal.errors import InputError
    from pkmcal.files import read_yaml, validated_document, wanted_file
    from pkmcal.session.schema import session_schema
    from pkmcal.wording import listed

    session = read_yaml(folder / "session.yaml")
    schema = validated_document(session, session_schema())
    observers = [schema.cameras[name] for name in schema.observers("board")]
    if not observers or schema.board is None:
        raise InputError(
            "no station of this session observes a board",
            where=session.where("stations"),
            expected="observe: board on a station, and board: board.yaml",
            next_step="Name the board's images instead: pkmcal camera IMAGES... --board FILE",
        )
    board = folder / schema.board.file
    if not board.exists():
        raise InputError(
            "there is no such file",
            where=session.where("board"),
            found=schema.board.file,
            expected=wanted_file(board),
        )
    cameras = sorted({station.camera for station in observers})
    if len(cameras) > 1:
        raise InputError(
            "the session's boards are seen by several cameras",
            where=session.where("stations"),
            found=listed(cameras),
            expected="one camera at a time",
            next_step="Name one camera's photographs: pkmcal camera IMAGES... --board FILE",
        )
    patterns = [glob.escape(station.images) for station in observers]
    wild = [p.replace("{configuration}", "*").replace("{repeat}", "*") for p in patterns]
    paths = sorted({folder / name for text in wild for name in glob.glob(text, root_dir=folder)})
    if not paths:
        raise InputError("no images found", where=session.where("stations"), found=wild[0])
    return paths, board


def image_files(images: list[Path]) -> list[Path]:
    """Image files of the arguments in the order of their names, with folders replaced by their
    content.
    """
    from pkmcal.errors import InputError
    from pkmcal.files import IMAGE_FILE_ENDINGS

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
                )
            out += inside
        elif path.is_file():
            out.append(path)
        else:
            raise InputError("there is no such image or folder", where=str(path))
    return list(dict.fromkeys(out))


def board_file_of(images: list[Path]) -> Path:
    """board.yaml in the folder of the images, or in the folder above; InputError without it."""
    from pkmcal.errors import InputError
    from pkmcal.files import resolved

    first = images[0] if images[0].is_dir() else images[0].parent
    for folder in (first, resolved(first).parent):
        if (folder / "board.yaml").is_file():
            return folder / "board.yaml"
    raise InputError(
        "the board is not described",
        where=str(first),
        expected="a file board.yaml here or above, or --board FILE",
    )
