"""``pkmcal camera``: calibration of a camera with images of a board."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish

CAMERA_FOLDER = Path("camera")


class CameraFileForm(StrEnum):
    """Formats of other programs' camera files."""

    OPENCV = "opencv"
    ROS = "ros"
    KALIBR = "kalibr"


EXAMPLES = """\
pkmcal camera my-machine
pkmcal camera boards --board board.yaml -o camera
pkmcal camera mirror --model unified --to opencv
"""


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
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.camera import CameraResult

        folder = console.output_folder(
            None if out == CAMERA_FOLDER else out, CAMERA_FOLDER, CameraResult
        )
        result = pkmcal.camera(
            images, board=board, model=model, to=[form.value for form in to or ()],
            progress=progress.work,
        )  # fmt: skip
        return finish(result, folder, progress, as_json=as_json)
