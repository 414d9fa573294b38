"""``pkmcal check``: what is wrong with a session, before any work is spent."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from pkmcal.check.check import JointCheck, SessionCheck, StationCheck

LAST_WORDS = {
    0: "Nothing is wrong. Next: pkmcal calibrate {}",
    1: "It can be calibrated, but the marked points will cost accuracy.",
    2: "It cannot be calibrated yet.",
}
STATION_LEGEND = """\
   Mismatch: of drawing and pictures, 0 perfect, below 0.34 recognised.
   Moved: from the pose by hand to the one found. Legs: found in a photograph.
   White, black: of the legs' pixels. Blur: of the sharpest edges."""
BOARD_LEGEND = """\
   Seen: photographs that show it. Off: corners from their predicted places.
   Wander: of the board on the base between photographs; a still one stays below 0.1 px."""
KINEMATICS = (
    "The drawing's machine closes at all readings, {0.singularity:.2f} from a singular pose (0 is"
    " singular, 1 far). These lengths allow {0.assemblies} assemblies; the one at home is taken."
)


def check(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session's folder.")],
    repeat: Annotated[
        bool,
        typer.Option("--repeat", help="Measure the accuracy by repeated photographs as well."),
    ] = False,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Find what is wrong with a session before any work is spent."""
    from pkmcal.check.check import check_session

    with console.progress() as told:
        found = check_session(session, seed=seed, progress=told)
    study = None
    if repeat and found.exit_code < 2:
        from pkmcal.check.repeats import study_repeats

        with console.progress() as told:
            study = study_repeats(session, seed=seed, progress=told)
    exit_code = max(found.exit_code, study.exit_code if study else 0)
    if as_json:
        told_of_repeats = {"repeats": study and study.as_dict()} if repeat else {}
        console.print_json({**found.as_dict(), "exit_code": exit_code, **told_of_repeats})
        return exit_code
    tell(console.out(), found)
    if study:
        from pkmcal.commands.repeats import tell_repeats

        tell_repeats(console.out(), study)
    return exit_code


def tell(out: Console, found: SessionCheck) -> None:
    """Tables of what was looked at, then what is wrong, then what to do."""
    if found.machine:
        photographs = sum(station.photographs for station in found.stations)
        title = (
            f"{found.folder}: {found.machine}, {found.n_legs} legs,"
            f" {found.configurations} configurations, {photographs} photographs"
        )
        console.print_points(out, [("", title)])
        out.print()
        out.print(_stations(found))
        out.print(STATION_LEGEND, style="dim")
        out.print()
        if any(station.board for station in found.stations):
            out.print(_boards(found))
            out.print(BOARD_LEGEND, style="dim")
            out.print()
        out.print(_joints(found.joints))
        out.print()
    points: list[tuple[str, str]] = []
    if math.isfinite(found.singularity):
        points.append((console.MARKS["good"], KINEMATICS.format(found)))
    points += [(console.MARKS[f.level], f.text) for f in found.findings]
    console.print_points(out, points)
    if points:
        out.print()
    words = LAST_WORDS[found.exit_code].format(shlex.quote(found.folder))
    mark = console.MARKS[("good", "doubtful", "wrong")[found.exit_code]]
    console.print_points(out, [(mark, words)])


def _stations(found: SessionCheck) -> Table:
    table = console.plain_table(
        "", "Station", "Photos", "Mismatch", "Moved", "Legs", "White", "Black", "Blur"
    )
    for station in found.stations:
        table.add_row(*_station(station, found))
    return table


def _station(station: StationCheck, found: SessionCheck) -> list[str]:
    levels = [f.level for f in found.findings if f.station == station.name]
    worst = "wrong" if "wrong" in levels or not station.recognised else min(levels, default="good")
    moved = ""
    if math.isfinite(station.moved):
        moved = f"{station.moved * 1e3:.0f} mm, {math.degrees(station.turned):.1f}°"
    return [
        console.MARKS[worst],
        console.escaped(station.name),
        str(station.photographs),
        _number(station.mismatch, "{:.2f}"),
        moved or "–",
        f"{station.legs:.1f}/{found.n_legs}"
        if station.recognised and math.isfinite(station.legs)
        else "–",
        _number(station.saturated, "{:.0%}"),
        _number(station.black, "{:.0%}"),
        _number(station.blur, "{:.1f} px"),
    ]


def _boards(found: SessionCheck) -> Table:
    table = console.plain_table("", "Board", "Seen", "Corners", "Off", "Wander", "Distance")
    for station in found.stations:
        board = station.board
        if board is None:
            continue
        table.add_row(
            console.MARKS["good"],
            console.escaped(station.name),
            f"{board.found} of {station.photographs}",
            f"{board.corners:.0f}/{board.corners_of}",
            f"{board.rms:.3f} px",
            _number(board.scatter, "{:.3f} px"),
            f"{board.distance:.2f} m",
        )
    return table


def _joints(joints: tuple[JointCheck, ...]) -> Table:
    table = console.plain_table("", "Joint", "Lowest", "Highest", "Of its range", "Near the ends")
    from pkmcal.check.check import LITTLE_USED

    for joint in joints:
        known = math.isfinite(joint.used)
        table.add_row(
            console.MARKS["good" if not known or joint.used >= LITTLE_USED else "note"],
            console.escaped(joint.name),
            f"{joint.low:.4f}",
            f"{joint.high:.4f}",
            _number(joint.used, "{:.0%}"),
            f"{joint.ends[0]} + {joint.ends[1]}" if known else "–",
        )
    return table


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"
