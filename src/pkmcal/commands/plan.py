"""``pkmcal plan``: the next configurations worth measuring, and where to put the camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish
from pkmcal.errors import InputError

PLAN_FILES = {
    "plan.html": PAGE_DESCRIPTION,
    "plan.csv": "the readings, in the order to be measured",
    "plan.json": NUMBERS_DESCRIPTION,
}
STATION_PLACES_FILES = {"stations.yaml": "the places, for session.yaml"}


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
    ] = 15,
    index: Annotated[
        Literal["tool", "D", "E", "O1"],
        typer.Option(help="What is to be small: the tool's variance, or D, E, O1."),
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
        typer.Option(metavar="CALIBRATION", help="What is known already: a calibrated machine."),
    ] = None,
    from_drawing: Annotated[
        bool, typer.Option("--from-drawing", help="As if nothing had been calibrated.")
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
        Path | None, typer.Option(metavar="FILE", help="Of a MACHINE: its camera's file.")
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Of a MACHINE: pixels, without a camera file.")
    ] = "1280x960",
    board: Annotated[
        bool, typer.Option("--board", help="Of a MACHINE: a board on its platform is seen.")
    ] = False,
    tracker: Annotated[
        str | None,
        typer.Option(
            metavar="M[,RAD]", help="Of a MACHINE: a tracker, or probe, of this noise instead."
        ),
    ] = None,
    edge_noise: Annotated[
        float,
        console.number_option("plan", "edge_noise", "PX", "Of an edge, where no photograph tells."),
    ] = 0.1,
    corner_noise: Annotated[
        float,
        console.number_option(
            "plan", "corner_noise", "PX", "Of a board's corner, where no photograph tells."
        ),
    ] = 0.05,
    joint_noise: Annotated[
        float,
        console.number_option(
            "plan", "joint_noise", "M", "Of a MACHINE: noise of a reading, m or rad."
        ),
    ] = 3e-6,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """The next configurations worth measuring."""
    from threadpoolctl import threadpool_limits

    from pkmcal.cameras import load_camera
    from pkmcal.commands.simulate import parsed_size
    from pkmcal.files import check_own_folder
    from pkmcal.mechanisms import load_mechanism
    from pkmcal.planning.plan import plan_measurements as run
    from pkmcal.planning.subject import as_it_stands, of_machine
    from pkmcal.report.plan import outcome_of
    from pkmcal.session.load import load_session, session_folder
    from pkmcal.simulation import board_for
    from pkmcal.simulation.demo import camera_of_size
    from pkmcal.simulation.placement import PANORAMIC_HALF_VIEW, view_angle

    session = session_folder(subject)
    folder = out or (Path("plan") if session is None else session / "plan")
    files = {**PLAN_FILES, **(STATION_PLACES_FILES if places or best_of else {})}
    over = check_own_folder(
        folder, {**PLAN_FILES, **STATION_PLACES_FILES}, "what plan writes", "an earlier plan"
    )
    with console.progress(as_json) as told, threadpool_limits(1, "blas"):
        told("Looking at what there is", 0.0)
        region = None
        if session is not None:
            _only_of("a machine", {"--camera": camera, "--board": board, "--tracker": tracker})
            measured = load_session(session, measured=False)
            region = measured.workspace
            source = as_it_stands(
                measured,
                after,
                from_drawing=from_drawing,
                same_place=same_place,
                anywhere=places is not None,
                edge=edge_noise,
                corner=corner_noise,
                seed=seed,
            )
        else:
            given = {"--after": after, "--same-place": same_place, "--best-of": best_of}
            _only_of("a session", given)
            machine = load_mechanism(subject, label=None)
            eye = load_camera(camera) if camera else camera_of_size(parsed_size(size))
            number = 1 if board or places or view_angle(eye) > PANORAMIC_HALF_VIEW else 3
            noise = None if tracker is None else _tracker(tracker)
            try:
                source = of_machine(
                    machine,
                    [eye] * number,
                    machine.joint_names,
                    board=board_for(machine, "platform") if board else None,
                    tracker=noise,
                    joint_noise=joint_noise,
                    edge=edge_noise,
                    corner=corner_noise,
                    seed=seed,
                )
            except InputError as error:
                raise error.located(subject) from None
        try:
            found = run(
                source,
                count=configurations,
                index=index,
                region=region,
                together=together,
                free_places=places,
                best_of=best_of,
                seed=seed,
                told=lambda share: told("Choosing configurations", 0.1 + 0.85 * share),
            )
        except InputError as error:
            if session is not None:
                raise
            raise error.located(str(camera or subject)) from None
    return finish(outcome_of(found), folder, files, over=over, as_json=as_json)


def _only_of(owner: str, given: Mapping[str, object]) -> None:
    """Raise `InputError` for options that mean nothing here."""
    for name, value in given.items():
        if value:
            raise InputError(f"this option is for {owner}", where=name, next_step="Leave it out")


def _tracker(text: str) -> tuple[float, float | None]:
    """A tracker's noise, m and rad, of a text such as 2e-5 or 2e-5,1e-4."""
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
