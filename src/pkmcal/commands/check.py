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

    from pkmcal.check import JointCheck, SessionCheck, StationCheck

LAST_WORDS = {
    0: "Nothing is wrong. Next: pkmcal calibrate {}",
    1: "It can be calibrated, but the marked points will cost accuracy.",
    2: "It cannot be calibrated yet.",
}


def check(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session's folder.")],
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Find what is wrong with a session before any work is spent."""
    from pkmcal.check import check_session

    with console.progress() as told:
        found = check_session(session, seed=seed, progress=told)
    if as_json:
        console.print_json(found.as_dict())
    else:
        tell(console.out(), found)
    return found.exit_code


def tell(out: Console, found: SessionCheck) -> None:
    """Tables of what was looked at, then what is wrong, then what to do."""
    if found.machine:
        photographs = sum(station.photographs for station in found.stations)
        out.print(
            f"[bold]{console.escaped(found.folder)}[/]: {console.escaped(found.machine)},"
            f" {found.n_legs} legs, {found.configurations} configurations,"
            f" {photographs} photographs\n"
        )
        out.print(_stations(found))
        out.print()
        out.print(_joints(found.joints))
        out.print()
    if math.isfinite(found.singularity):
        out.print(
            f"The drawing's machine closes at all readings. Distance to a singular pose:"
            f" {found.singularity:.2f} (1 is far, 0 singular). Assemblies at these lengths:"
            f" {found.assemblies}; the one at home is taken.\n"
        )
    marks = {"wrong": "wrong", "doubtful": "doubtful", "note": "note"}
    console.print_points(out, [(console.MARKS[marks[f.level]], f.text) for f in found.findings])
    if found.findings:
        out.print()
    words = LAST_WORDS[found.exit_code].format(shlex.quote(found.folder))
    mark = console.MARKS[("good", "doubtful", "wrong")[found.exit_code]]
    console.print_points(out, [(mark, words)])


def _stations(found: SessionCheck) -> Table:
    table = console.plain_table(show_header=True, header_style="dim")
    table.add_column("")
    table.add_column("Station", overflow="fold")
    for heading in ("Photos", "Mismatch", "Moved", "Legs", "White", "Black", "Blur"):
        table.add_column(heading, justify="right", no_wrap=True)
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
        f"{station.legs:.1f}/{found.n_legs}" if station.recognised else "–",
        _number(station.saturated, "{:.0%}"),
        _number(station.black, "{:.0%}"),
        _number(station.blur, "{:.1f} px"),
    ]


def _joints(joints: tuple[JointCheck, ...]) -> Table:
    table = console.plain_table(show_header=True, header_style="dim")
    table.add_column("")
    table.add_column("Joint", overflow="fold")
    for heading in ("Lowest", "Highest", "Of its range", "Near the ends"):
        table.add_column(heading, justify="right", no_wrap=True)
    for joint in joints:
        known = math.isfinite(joint.used)
        table.add_row(
            console.MARKS["good" if not known or joint.used >= 0.5 else "doubtful"],
            console.escaped(joint.name),
            f"{joint.low:.4f}",
            f"{joint.high:.4f}",
            _number(joint.used, "{:.0%}"),
            f"{joint.ends[0]} + {joint.ends[1]}" if known else "–",
        )
    return table


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"
