"""``pkmcal servo``: simulated visual servoing by the legs in the image, with a calibrated
machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.ranges import default

EXAMPLES = """\
pkmcal servo gough-stewart
pkmcal servo out --law directions --legs 1,3,5
pkmcal servo out --gain 2 --rate 50 --hand-rotation "1 deg"
"""


def servo(
    machine: Annotated[
        str,
        typer.Argument(
            metavar="CALIBRATION|MACHINE",
            help="The folder that calibrate wrote; or a mechanism file, or a built-in machine.",
        ),
    ],
    session: console.CamerasOf = None,
    station: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="The camera that controls; the first.", rich_help_panel="Camera"
        ),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Another camera file than the station's.", rich_help_panel="Camera"
        ),
    ] = None,
    law: Annotated[
        str,
        typer.Option(
            metavar="LAW", help="edges or directions of the legs.", rich_help_panel="Loop"
        ),
    ] = "edges",
    legs: Annotated[
        str | None,
        typer.Option(
            metavar="1,2,3", help="Legs that the camera sees; all.", rich_help_panel="Camera"
        ),
    ] = None,
    runs: Annotated[
        int, console.number_option("servo", "runs", "N", "Number of motions, for every estimate.")
    ] = default("servo", "runs"),
    gain: Annotated[
        float,
        console.number_option(
            "servo", "gain", "G", "Part of the error that is corrected in a second.", group="Loop"
        ),
    ] = default("servo", "gain"),
    rate: Annotated[
        float, console.number_option("servo", "rate", "HZ", "Images a second.", group="Loop")
    ] = default("servo", "rate"),
    delay: Annotated[
        int,
        console.number_option(
            "servo", "delay", "N", "Images from exposure to motion.", group="Loop"
        ),
    ] = default("servo", "delay"),
    noise: Annotated[
        float,
        console.number_option(
            "servo", "noise", "PX", "Noise of an edge, shift and tilt.", group="Loop"
        ),
    ] = default("servo", "noise"),
    joint_noise: Annotated[
        float,
        console.number_option(
            "servo", "joint_noise", "M", "Noise of a reading, m or rad.", group="Loop"
        ),
    ] = default("servo", "joint_noise"),
    speed: Annotated[
        float | None,
        console.number_option("servo", "speed", "V", "Fastest drive, m/s or rad/s.", group="Loop"),
    ] = None,
    duration: Annotated[
        float | None,
        console.number_option("servo", "duration", "S", "Seconds of a run; 10 / gain."),
    ] = None,
    hand_position: Annotated[
        float,
        console.number_option(
            "servo", "hand_position", "M", "Error of the hand-placed camera, m.", group="Camera"
        ),
    ] = default("servo", "hand_position"),
    hand_rotation: Annotated[
        float,
        console.number_option(
            "servo",
            "hand_rotation",
            "DEG",
            "Error of the hand-placed camera's direction, degrees.",
            group="Camera",
        ),
    ] = default("servo", "hand_rotation"),
    start: Annotated[
        str | None,
        typer.Option(metavar="POSE", help="Start of every run: x,y,z,rx,ry,rz (m, rad)."),
    ] = None,
    goal: Annotated[
        str | None, typer.Option(metavar="POSE", help="Goal of every run, in the same form.")
    ] = None,
    out: Annotated[Path | None, console.folder("servo unless given.")] = None,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Simulate control by the legs in the image."""
    from math import radians

    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.servo import ServoResult
        from pkmcal.control.source import legs_of_text, pose_of_text

        folder = console.output_folder(out, Path("servo"), ServoResult)
        result = pkmcal.servo(
            machine, session=session, station=station, camera=camera, law=law,
            legs=None if legs is None else legs_of_text(legs), runs=runs, gain=gain, rate=rate,
            delay=delay, noise=noise, joint_noise=joint_noise, speed=speed, duration=duration,
            hand_position=hand_position, hand_rotation=radians(hand_rotation),
            start=None if start is None else pose_of_text(start, "--start"),
            goal=None if goal is None else pose_of_text(goal, "--goal"), seed=seed,
            progress=progress.work,
        )  # fmt: skip
        return finish(result, folder, progress, as_json=as_json)
