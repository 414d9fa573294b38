"""``pkmcal plan``: the next configurations to measure, and the poses of the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish
from pkmcal.errors import InputError
from pkmcal.planning.defaults import (
    CONFIGURATIONS_A_CAPTURE,
    NOMINAL_CORNER_SIGMA,
    NOMINAL_EDGE_SIGMA,
    PLANNED_IMAGE_SIZE,
    UNTOLD_READING_NOISE,
)

PLAN_FILES = {
    "plan.html": PAGE_DESCRIPTION,
    "plan.csv": "the readings, in the order to be measured",
    "plan.json": NUMBERS_DESCRIPTION,
}
STATION_POSES_FILES = {"stations.yaml": "the places, for session.yaml"}


def plan(
    subject: Annotated[
        str,
        typer.Argument(
            metavar="SESSION|MACHINE", help="A session, or a built-in machine or its file."
        ),
    ],
    out: Annotated[Path | None, console.folder("SESSION/plan, or plan, unless given.")] = None,
    configurations: Annotated[
        int,
        console.number_option(
            "plan",
            "configurations",
            "N",
            "Configurations from each place.",
            "-n",
            "--configurations",
        ),
    ] = CONFIGURATIONS_A_CAPTURE,
    index: Annotated[
        Literal["tool", "D", "E", "O1"],
        typer.Option(help="Criterion to minimize: the tool's variance, or D, E, O1."),
    ] = "tool",
    places: Annotated[
        int | None,
        console.number_option("plan", "places", "N", "Choose N places of the camera as well."),
    ] = None,
    best_of: Annotated[
        int | None,
        console.number_option("plan", "best_of", "N", "Choose N of the session's stations."),
    ] = None,
    after: Annotated[
        Path | None,
        typer.Option(metavar="CALIBRATION", help="Calibration to continue from."),
    ] = None,
    from_drawing: Annotated[
        bool, typer.Option("--from-drawing", help="Ignore the calibration in the session.")
    ] = False,
    same_place: Annotated[
        bool,
        typer.Option("--same-place", help="The cameras stand as they stood in the calibration."),
    ] = False,
    together: Annotated[
        bool | None,
        typer.Option(
            "--together/--apart", help="All stations measure each configuration, or each its own."
        ),
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Camera file, for a MACHINE.")
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Image size without a camera file, for a MACHINE.")
    ] = "{}x{}".format(*PLANNED_IMAGE_SIZE),
    board: Annotated[
        bool, typer.Option("--board", help="Observe a board on the platform, for a MACHINE.")
    ] = False,
    tracker: Annotated[
        str | None,
        typer.Option(
            metavar="M[,RAD]", help="Noise of a tracker or probe used instead, for a MACHINE."
        ),
    ] = None,
    edge_noise: Annotated[
        float,
        console.number_option(
            "plan", "edge_noise", "PX", "Noise of an edge, if no image determines it."
        ),
    ] = NOMINAL_EDGE_SIGMA,
    corner_noise: Annotated[
        float,
        console.number_option(
            "plan", "corner_noise", "PX", "Noise of a board's corner, if no image determines it."
        ),
    ] = NOMINAL_CORNER_SIGMA,
    joint_noise: Annotated[
        float,
        console.number_option(
            "plan", "joint_noise", "M", "Noise of a reading, m or rad, for a MACHINE."
        ),
    ] = UNTOLD_READING_NOISE,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """The next configurations worth measuring."""
    from pkmcal.api.plan import plan as run
    from pkmcal.commands.simulate import parsed_size
    from pkmcal.files import check_own_folder, default_output
    from pkmcal.placement.default_camera import camera_of_size
    from pkmcal.report.plan import outcome_of
    from pkmcal.session.load import session_folder

    session = session_folder(subject)
    folder = out or default_output((session or Path()) / "plan")
    files = {**PLAN_FILES, **(STATION_POSES_FILES if places or best_of else {})}
    over = check_own_folder(
        folder, {**PLAN_FILES, **STATION_POSES_FILES}, "what plan writes", "an earlier plan"
    )
    sized = None if session is not None or camera else camera_of_size(parsed_size(size))
    with console.progress(as_json) as progress:
        progress("Looking at what there is", 0.0)
        planned = run(
            subject,
            count=configurations,
            index=index,
            places=places,
            best_of=best_of,
            after=after,
            from_drawing=from_drawing,
            same_place=same_place,
            together=together,
            camera=camera or sized,
            board=board,
            tracker=None if tracker is None else _tracker(tracker),
            edge_noise=edge_noise,
            corner_noise=corner_noise,
            joint_noise=joint_noise,
            seed=seed,
            progress=lambda share: progress("Choosing configurations", 0.1 + 0.85 * share),
        )
    return finish(outcome_of(planned), folder, files, over=over, as_json=as_json)


def _tracker(text: str) -> tuple[float, float | None]:
    """Noise of a tracker, m and rad, from a text such as 2e-5 or 2e-5,1e-4."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = list[float]()
    if len(numbers) not in (1, 2) or not all(0 < x < 1 for x in numbers):
        raise InputError(
            "a tracker's noise cannot be this",
            where="--tracker",
            found=text,
            expected="metres, and radians where it measures turns: 2e-5 or 2e-5,1e-4",
        )
    return numbers[0], numbers[1] if len(numbers) == 2 else None
