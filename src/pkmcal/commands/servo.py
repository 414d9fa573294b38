"""``pkmcal servo``: simulated visual servoing by the legs in the image, with a calibrated
machine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish
from pkmcal.errors import InputError

SERVO_FILES = {"servo.html": PAGE_DESCRIPTION, "servo.json": NUMBERS_DESCRIPTION}
MOST_SAMPLES = 5000
"""Maximum number of samples of a run; more take minutes and hundreds of megabytes."""


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
        int, console.number_option("servo", "runs", "N", "Number of motions, for every estimate.")
    ] = 60,
    gain: Annotated[
        float,
        console.number_option(
            "servo", "gain", "G", "Part of the error that is corrected in a second."
        ),
    ] = 1.0,
    rate: Annotated[float, console.number_option("servo", "rate", "HZ", "Images a second.")] = 25.0,
    delay: Annotated[
        int, console.number_option("servo", "delay", "N", "Images from exposure to motion.")
    ] = 1,
    noise: Annotated[
        float, console.number_option("servo", "noise", "PX", "Noise of an edge, shift and tilt.")
    ] = 0.02,
    joint_noise: Annotated[
        float, console.number_option("servo", "joint_noise", "M", "Noise of a reading, m or rad.")
    ] = 3e-6,
    speed: Annotated[
        float | None,
        console.number_option("servo", "speed", "V", "Fastest drive, m/s or rad/s."),
    ] = None,
    duration: Annotated[
        float | None,
        console.number_option("servo", "duration", "S", "Seconds of a run; 10 / gain."),
    ] = None,
    hand_position: Annotated[
        float,
        console.number_option("servo", "hand_position", "M", "Error of the hand-placed camera, m."),
    ] = 0.03,
    hand_rotation: Annotated[
        float,
        console.number_option(
            "servo", "hand_rotation", "DEG", "Error of the hand-placed camera's direction, degrees."
        ),
    ] = 3.0,
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
    import numpy as np

    from pkmcal.control.laws import law_named
    from pkmcal.control.simulation import LoopSettings
    from pkmcal.control.source import legs_of_text, load_plant, pose_of_text
    from pkmcal.control.study import Plan, study_servoing
    from pkmcal.files import check_own_folder, default_output
    from pkmcal.placement.edges import EdgeNoise
    from pkmcal.report.servo import outcome_of

    law_named(law)
    loop = LoopSettings(
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
    first, last = (
        None if text is None else pose_of_text(text, where)
        for text, where in ((start, "--start"), (goal, "--goal"))
    )
    plan = Plan(loop, runs, seed, hand_position, float(np.deg2rad(hand_rotation)), first, last)
    folder = out or default_output(Path("servo"))
    check_own_folder(folder, SERVO_FILES, "a study of servoing", "an earlier study")
    numbers = None if legs is None else legs_of_text(legs)
    scene = load_plant(
        machine, session=session, station=station, camera=camera, legs=numbers, seed=seed
    )
    try:
        with console.progress(as_json) as progress:
            outcome = outcome_of(study_servoing(scene, plan, progress))
    except InputError as error:  # located at the camera's file, which determines what is in view
        raise error if error.where or camera is None else error.located(str(camera)) from None
    return finish(outcome, folder, SERVO_FILES, as_json=as_json)
