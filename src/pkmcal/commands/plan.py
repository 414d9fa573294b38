"""``pkmcal plan``: the next configurations to measure, and the poses of the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.errors import InputError
from pkmcal.planning.defaults import PLANNED_IMAGE_SIZE
from pkmcal.ranges import default

EXAMPLES = """\
pkmcal plan my-machine
pkmcal plan gough-stewart -n 20 --places 3
pkmcal plan delta --tracker "20 um" --joint-noise "0.01 mm"
"""


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
    ] = default("plan", "configurations"),
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
        console.number_option(
            "plan", "best_of", "N", "Choose N of the session's stations.", group="For a SESSION"
        ),
    ] = None,
    after: Annotated[
        Path | None,
        typer.Option(
            metavar="CALIBRATION",
            help="Calibration to continue from.",
            rich_help_panel="For a SESSION",
        ),
    ] = None,
    from_drawing: Annotated[
        bool,
        typer.Option(
            "--from-drawing",
            help="Ignore the calibration in the session.",
            rich_help_panel="For a SESSION",
        ),
    ] = False,
    same_place: Annotated[
        bool,
        typer.Option(
            "--same-place",
            help="The cameras stand as they stood in the calibration.",
            rich_help_panel="For a SESSION",
        ),
    ] = False,
    together: Annotated[
        bool | None,
        typer.Option(
            "--together/--apart", help="All stations measure each configuration, or each its own."
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Camera file.", rich_help_panel="For a MACHINE"),
    ] = None,
    size: Annotated[
        str,
        typer.Option(
            metavar="WxH",
            help="Image size without a camera file.",
            rich_help_panel="For a MACHINE",
        ),
    ] = "{}x{}".format(*PLANNED_IMAGE_SIZE),
    board: Annotated[
        bool,
        typer.Option(
            "--board",
            help="Observe a board on the platform.",
            rich_help_panel="For a MACHINE",
        ),
    ] = False,
    tracker: Annotated[
        str | None,
        typer.Option(
            metavar="M[,RAD]",
            help="Noise of a tracker or probe used instead.",
            rich_help_panel="For a MACHINE",
        ),
    ] = None,
    edge_noise: Annotated[
        float,
        console.number_option(
            "plan", "edge_noise", "PX", "Noise of an edge, if no image determines it."
        ),
    ] = default("plan", "edge_noise"),
    corner_noise: Annotated[
        float,
        console.number_option(
            "plan", "corner_noise", "PX", "Noise of a board's corner, if no image determines it."
        ),
    ] = default("plan", "corner_noise"),
    joint_noise: Annotated[
        float,
        console.number_option(
            "plan",
            "joint_noise",
            "M",
            "Noise of a reading, m or rad.",
            group="For a MACHINE",
        ),
    ] = default("plan", "joint_noise"),
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """The next configurations worth measuring."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.plan import PlanResult
        from pkmcal.session.load import session_folder

        session = session_folder(subject)
        folder = console.output_folder(out, (session or Path()) / "plan", PlanResult)
        assumed = None if session is not None else console.parsed_size(size)
        result = pkmcal.plan(
            subject, count=configurations, index=index, places=places, best_of=best_of,
            after=after, from_drawing=from_drawing, same_place=same_place, together=together,
            camera=camera or assumed, board=board,
            tracker=None if tracker is None else _tracker(tracker), edge_noise=edge_noise,
            corner_noise=corner_noise, joint_noise=joint_noise, seed=seed, progress=progress.work,
        )  # fmt: skip
        return finish(result, folder, progress, as_json=as_json)


def _tracker(text: str) -> tuple[float, float | None]:
    """Noise of a tracker, m and rad, from a text such as 2e-5 or 20 um,0.005 deg."""
    from pkmcal.files.quantities import read_quantity

    parts = text.split(",")
    try:
        numbers = [read_quantity(*pair) for pair in zip(parts, ("m", "rad"), strict=False)]
    except ValueError:
        numbers = list[float]()
    if len(numbers) != len(parts) or not all(0 < x < 1 for x in numbers):
        raise InputError(
            "a tracker's noise cannot be this",
            where="--tracker",
            found=text,
            expected="metres, and radians where it measures turns: 2e-5 or 2e-5,1e-4, or with"
            " units: 20 um",
        )
    return numbers[0], numbers[1] if len(numbers) == 2 else None
