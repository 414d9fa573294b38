"""``pkmcal servo``: control by the legs in the image, simulated with the calibrated machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkmcal.commands import console
from pkmcal.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.control.study import Plan
    from pkmcal.outcome import Table
    from pkmcal.report.servo_page import Servo

WHAT = {
    "servo.html": "open it in a browser",
    "servo.json": "everything, for programs",
}


def servo(
    machine: Annotated[
        str,
        typer.Argument(
            metavar="CALIBRATION|MACHINE",
            help="The folder that calibrate wrote; or a mechanism file, or a built-in machine.",
        ),
    ],
    session: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="The session, for its cameras, where it is not found."),
    ] = None,
    station: Annotated[
        str | None, typer.Option(metavar="NAME", help="The camera that controls; the first.")
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Another camera file than the station's.")
    ] = None,
    law: Annotated[
        str, typer.Option(metavar="LAW", help="edges or directions of the legs.")
    ] = "edges",
    legs: Annotated[
        str | None, typer.Option(metavar="1,2,3", help="Legs that the camera sees; all.")
    ] = None,
    runs: Annotated[
        int, typer.Option(metavar="N", min=1, max=1000, help="Ways to go, of every estimate.")
    ] = 60,
    gain: Annotated[
        float, typer.Option(metavar="G", help="Part of the error corrected in a second.")
    ] = 1.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Images a second.")] = 25.0,
    delay: Annotated[
        int, typer.Option(metavar="N", min=0, max=50, help="Images from exposure to motion.")
    ] = 1,
    noise: Annotated[
        float, typer.Option(metavar="PX", min=0, help="Noise of an edge, shift and tilt.")
    ] = 0.02,
    joint_noise: Annotated[
        float, typer.Option(metavar="M", min=0, help="Noise of a reading, m or rad.")
    ] = 3e-6,
    speed: Annotated[
        float | None, typer.Option(metavar="V", help="Fastest drive, m/s or rad/s; no limit.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="Seconds of a run; 10 / gain.")
    ] = None,
    hand_position: Annotated[
        float, typer.Option(metavar="M", min=0, help="Error of the camera's place by hand, m.")
    ] = 0.03,
    hand_rotation: Annotated[
        float, typer.Option(metavar="DEG", min=0, max=180, help="And of its direction, degrees.")
    ] = 3.0,
    start: Annotated[
        str | None, typer.Option(metavar="POSE", help="x,y,z,rx,ry,rz of every run (m, rad).")
    ] = None,
    goal: Annotated[
        str | None, typer.Option(metavar="POSE", help="The same of every run's goal.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="servo unless given.")
    ] = None,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Simulate control by the legs in the image."""
    from pkmcal.control.source import controlled, legs_of
    from pkmcal.files import check_own_folder
    from pkmcal.report.servo_page import servo_of

    plan = _plan(
        law=law, runs=runs, gain=gain, rate=rate, delay=delay, noise=noise,
        joint_noise=joint_noise, speed=speed, duration=duration, seed=seed,
        hand=(hand_position, hand_rotation), ends=(start, goal),
    )  # fmt: skip
    folder = out or Path("servo")
    check_own_folder(folder, WHAT, "a study of servoing", "an earlier study")
    numbers = None if legs is None else legs_of(legs)
    subject = controlled(
        machine, session=session, station=station, camera=camera, legs=numbers, seed=seed
    )
    with console.progress(as_json) as told:
        found = servo_of(subject, plan, told)
        told("Writing the report", 0.97)
        save(found, folder)
    if as_json:
        console.print_json(summary(found, folder))
    else:
        tell(console.out(), found, folder)
    return exit_code(found)


def _plan(
    *,
    law: str,
    runs: int,
    gain: float,
    rate: float,
    delay: int,
    noise: float,
    joint_noise: float,
    speed: float | None,
    duration: float | None,
    seed: int,
    hand: tuple[float, float],
    ends: tuple[str | None, str | None],
) -> Plan:
    """The options as one plan."""
    import numpy as np

    from pkmcal.control.laws import law_named
    from pkmcal.control.simulation import Loop
    from pkmcal.control.source import pose_of
    from pkmcal.control.study import Plan
    from pkmcal.simulation.edges import EdgeNoise

    law_named(law)
    _positive("--gain", gain, 1000)
    _positive("--rate", rate, 10000)
    _positive("--speed", 1.0 if speed is None else speed, 1e6)
    _positive("--duration", 1.0 if duration is None else duration, 3600)
    loop = Loop(
        law=law,
        gain=gain,
        rate=rate,
        delay=delay,
        noise=EdgeNoise(shift=noise, tilt=noise),
        joint_noise=joint_noise,
        speed=None if speed is None else np.array([speed]),
        duration=10 / gain if duration is None else duration,
    )
    if loop.samples > MOST_SAMPLES:
        raise InputError(
            "the runs would have too many samples", where="--duration",
            found=str(loop.samples), expected=f"at most {MOST_SAMPLES}, a rate times a duration",
        )  # fmt: skip
    start, goal = (
        None if text is None else pose_of(text, where)
        for text, where in zip(ends, ("--start", "--goal"), strict=True)
    )
    return Plan(loop, runs, seed, hand[0], float(np.deg2rad(hand[1])), start, goal)


MOST_SAMPLES = 5000
"""Samples of a run; more take minutes and hundreds of megabytes."""


def _positive(where: str, value: float, most: float) -> None:
    if not 0 < value <= most:
        raise InputError(
            "a loop cannot have this", where=where, found=f"{value:g}",
            expected=f"more than 0 and at most {most:g}",
        )  # fmt: skip


def exit_code(found: Servo) -> int:
    """1 where the control must not be used."""
    return 0 if found.judgement.usable else 1


def save(found: Servo, folder: Path) -> None:
    """Write both files, whole or not at all."""
    from pkmcal.files import json_text, write_folder
    from pkmcal.report.servo_page import servo_html

    texts = {"servo.html": servo_html(found), "servo.json": json_text(found.document())}
    write_folder(folder, texts)


def summary(found: Servo, folder: Path) -> dict[str, Any]:
    """What the command says, for programs."""
    document = found.document()
    document.pop("curves")
    files = {name: str(folder / name) for name in WHAT}
    return {"exit_code": exit_code(found), **document, "files": files}


def tell(out: Console, found: Servo, folder: Path) -> None:
    """What the command says, for people."""
    from pkmcal.report.servo_page import outcome_table

    j = found.judgement
    console.print_points(out, [("", found.subject.origin)])
    out.print()
    console.print_points(out, [(console.MARKS["good" if j.usable else "wrong"], j.headline)])
    console.print_points(out, [("  [red]•[/]", reason) for reason in j.reasons])
    out.print()
    _table(out, outcome_table(found))
    console.print_points(out, [("", found.stillness)])
    points = [(console.MARKS["doubtful"], note) for note in found.warnings]
    points += [("[cyan]→[/]", advice) for advice in j.advice]
    if points:
        out.print()
        console.print_points(out, points)
    out.print()
    console.print_files(out, [(str(folder / name), what) for name, what in WHAT.items()])


def _table(out: Console, table: Table) -> None:
    from rich.table import Table as Rich

    shown = Rich(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for place, heading in enumerate(table.columns):
        right = "right" if place else "left"
        shown.add_column(heading, justify=right, no_wrap=not place)
    for row in table.rows:
        shown.add_row(console.escaped(row.name), *row.cells)
    out.print(shown)
