"""``pkmcal camera``: calibration of a camera with images of a board."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import (
    argument,
    as_json,
    choice,
    choices,
    command,
    flag,
    number,
    option,
    out,
)
from pkmcal.ranges import CameraFileFormat, CameraModelChoice

EXAMPLES = """\
pkmcal camera my-machine
pkmcal camera boards --board board.yaml -o camera
pkmcal camera mirror --model unified --to opencv
"""


@command(
    EXAMPLES,
    argument(
        "images", "SESSION|IMAGES...", "Session whose stations observe a board; or images of one,"
        " or their folder.", Path, nargs=-1, required=True,
    ),
    option(
        "--board", "FILE", "Board file. [default: the session's, or board.yaml beside the images]",
        Path,
    ),
    choice("model", CameraModelChoice, "Camera model; unified is for mirrors."),
    number(
        "camera", "distance", "M", "Distance of the map of the projection's uncertainty.",
        usual="the boards'",
    ),
    flag("--bend", "Estimate the board's bend: two parabolas, along its columns and rows."),
    choices("to", CameraFileFormat, "Camera file of another program to write as well; repeatable."),
    out("camera"),
    as_json(),
)  # fmt: skip
def camera(images: tuple[Path, ...], out: Path | None, as_json: bool, **options: Any) -> int:
    """Calibrate a camera from images of a board."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.camera import CameraResult

        folder = console.output_folder(out, Path("camera"), CameraResult)
        result = pkmcal.camera(images, progress=progress.work, **options)
        return finish(result, folder, progress, as_json=as_json)
