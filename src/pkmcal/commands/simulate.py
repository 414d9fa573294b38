"""``pkmcal simulate``: a simulated session with known truth."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.errors import InputError, legible

if TYPE_CHECKING:
    from pkmcal.cameras import Camera

SMALLEST_PICTURE_SIDE, LARGEST_PICTURE_SIDE = 64, 8192
"""Limits of an image's width and height in px: below, legs are too narrow to have edges; above,
memory does not suffice.
"""


def simulate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.")],
    mechanism: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="A built-in machine, or a mechanism file.")
    ] = "gough-stewart",
    camera: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A camera file, instead of --size.")
    ] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Pixels of an image.")] = "800x600",
    stations: Annotated[
        int, console.number_option("simulate", "stations", "N", "Places of the camera.")
    ] = 3,
    configurations: Annotated[
        int,
        console.number_option("simulate", "configurations", "N", "Images from each place."),
    ] = 15,
    shared: Annotated[
        bool, typer.Option("--shared", help="The same configurations from all places.")
    ] = False,
    repeats: Annotated[
        int, console.number_option("simulate", "repeats", "N", "Images of each configuration.")
    ] = 1,
    tolerance: Annotated[
        float,
        console.number_option(
            "simulate", "tolerance", "X", "True values' deviation, in tolerances."
        ),
    ] = 1.0,
    joint_noise: Annotated[
        float,
        console.number_option("simulate", "joint_noise", "M", "Noise of a reading, m or rad."),
    ] = 3e-6,
    noise: Annotated[
        float, console.number_option("simulate", "noise", "GREY", "Noise of a pixel, grey levels.")
    ] = 0.9,
    blur: Annotated[
        float, console.number_option("simulate", "blur", "PX", "Blur of the lens, pixels.")
    ] = 0.6,
    board: Annotated[
        bool, typer.Option("--board", help="A board on the base, which joins the stations.")
    ] = False,
    on_platform: Annotated[
        bool, typer.Option("--on-platform", help="The board on the platform instead.")
    ] = False,
    finish: Annotated[
        Literal["mixed", "matte", "dark", "metal"],
        typer.Option(help="Surface of the legs; metal is polished."),
    ] = "mixed",
    light: Annotated[
        Literal["usual", "soft", "hard"], typer.Option(help="From all sides, or hard.")
    ] = "usual",
    as_built: Annotated[
        bool, typer.Option("--as-built", help="Motors, rings and cables on the legs.")
    ] = False,
    handheld: Annotated[
        bool,
        typer.Option(
            "--handheld", help="Each image from its own place, --repeats of a configuration."
        ),
    ] = False,
    plan: Annotated[
        Path | None,
        typer.Option(metavar="PLAN", help="What pkmcal plan asked for, with its machine."),
    ] = None,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Simulate a session with images and known truth."""
    from pkmcal.cameras import load_camera
    from pkmcal.mechanisms import load_mechanism
    from pkmcal.placement.default_camera import camera_of_size
    from pkmcal.simulation import Sensor, Settings, board_for, simulate_session, to_simulate
    from pkmcal.simulation.rehearsal import rehearsal_of

    eye = load_camera(camera) if camera else camera_of_size(parsed_size(size))
    planned = rehearsal_of(plan) if plan else None
    nominal = planned.machine if planned else load_mechanism(mechanism, label=None)
    machine = to_simulate(nominal, str(plan or mechanism))
    place = "platform" if on_platform else "base"
    settings = Settings(
        stations=stations,
        configurations=configurations,
        shared=shared,
        tolerance=tolerance,
        joint_noise=joint_noise,
        sensor=Sensor(blur=blur, read_noise=noise),
        board=board_for(machine, place) if board or on_platform else None,
        board_on=place,
        repeats=repeats,
        finish=finish,
        light=light,
        as_built=as_built,
        handheld=handheld,
    )
    cameras: Camera | tuple[Camera, ...] = eye
    if planned:
        cameras = planned.cameras
        settings = replace(settings, stations=planned.places, asked=planned.requested)
        if planned.board:
            settings = replace(settings, board=planned.board, board_on="platform")
    with console.progress(as_json) as progress:
        truth = simulate_session(
            folder, machine, cameras, settings, seed=seed, progress=console.counted(progress)
        )
    count = len(truth.images) * truth.repeats
    if as_json:
        console.print_json(
            {"folder": str(folder), "photographs": count, "stations": truth.stations, "seed": seed}
        )
        return 0
    out = console.out()
    places = "1 place" if len(truth.stations) == 1 else f"{len(truth.stations)} places"
    points = [
        (
            console.MARK_SIGNS["good"],
            f"{count} images of {machine.name} from {places} in {folder}; the"
            " truth is in its truth.json, which no calibration reads.",
        )
    ]
    if machine is not nominal:
        points.append(
            (
                console.MARK_SIGNS["note"],
                f"The nominal model of {machine.name} gives its rods no visible cylinders, so"
                " they are drawn as such; see tubes in the session's mechanism.yaml.",
            )
        )
    console.print_points(out, points)
    out.print(f"\nNext: pkmcal calibrate {legible(shlex.quote(str(folder)))}", markup=False)
    return 0


def parsed_size(text: str) -> tuple[int, int]:
    """(width, height) from a text such as 800x600."""
    match = re.fullmatch(r"(\d{1,6})[x×](\d{1,6})", text.strip())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(size) < SMALLEST_PICTURE_SIDE or max(size) > LARGEST_PICTURE_SIDE:
        raise InputError(
            "no size of an image",
            where="--size",
            found=text,
            expected=f"width x height, each {SMALLEST_PICTURE_SIDE} to {LARGEST_PICTURE_SIDE},"
            f" such as 800x600",
        )
    return size
