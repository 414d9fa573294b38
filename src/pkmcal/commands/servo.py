"""``pkmcal servo``: simulated visual servoing by the legs in the image, with a calibrated
machine.
"""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import (
    argument,
    as_json,
    cameras_session,
    choice,
    command,
    number,
    option,
    out,
    seed,
)
from pkmcal.ranges import ServoLaw

EXAMPLES = """\
pkmcal servo gough-stewart
pkmcal servo out --law directions --legs 1,3,5
pkmcal servo out --gain 2 --rate 50 --hand-rotation "1 deg"
"""


CAMERA, LOOP = "Camera", "Loop"


@command(
    EXAMPLES,
    argument(
        "machine", "CALIBRATION|MACHINE", "Folder that calibrate wrote; or mechanism file, or name"
        " of a built-in machine.",
    ),
    cameras_session(),
    number("servo", "runs", "N", "Motions for each estimate of the geometry."),
    number("servo", "duration", "S", "Duration of a run.", usual="10 / gain"),
    option("--start", "POSE", "Start of every run, x,y,z,rx,ry,rz in m and rad or with units."
        " [default: random]"),
    option("--goal", "POSE", "Goal of every run, likewise. [default: random]"),
    seed("servo"),
    option(
        "--station", "NAME", "Station whose camera controls. [default: the first]", group=CAMERA
    ),
    option(
        "--camera", "FILE", "Camera file. [default: the station's, or a usual one]", Path,
        group=CAMERA,
    ),
    option("--legs", "1,2,3", "Legs that the camera observes. [default: all]", group=CAMERA),
    number(
        "servo", "hand_position", "M", "Position error of the hand-placed camera.", group=CAMERA
    ),
    number(
        "servo", "hand_rotation", "DEG", "Orientation error of the hand-placed camera.",
        group=CAMERA,
    ),
    choice("law", ServoLaw, "Control by the legs' edges or directions.", group=LOOP),
    number("servo", "gain", "G", "Share of the error corrected in a second.", group=LOOP),
    number("servo", "rate", "HZ", "Images per second.", group=LOOP),
    number("servo", "delay", "N", "Delay from exposure to motion, in images.", group=LOOP),
    number("servo", "noise", "PX", "Sigma of an edge's shift and tilt.", group=LOOP),
    number("servo", "joint_noise", "M", "Sigma of a joint reading.", group=LOOP),
    number(
        "servo", "speed", "V", "Largest speed of a drive.", usual="unlimited",
        group=LOOP,
    ),
    out("servo"),
    as_json(),
)  # fmt: skip
def servo(
    machine: str, legs: str | None, hand_rotation: float, start: str | None, goal: str | None,
    out: Path | None, as_json: bool, **options: Any,
) -> int:  # fmt: skip
    """Simulate visual servoing by a machine's legs."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.servo import ServoResult
        from pkmcal.control.source import legs_of_text, pose_of_text

        folder = console.output_folder(out, Path("servo"), ServoResult)
        result = pkmcal.servo(
            machine,
            legs=None if legs is None else legs_of_text(legs),
            hand_rotation=radians(hand_rotation),
            start=None if start is None else pose_of_text(start, "--start"),
            goal=None if goal is None else pose_of_text(goal, "--goal"),
            progress=progress.work,
            **options,
        )
        return finish(result, folder, progress, as_json=as_json)
