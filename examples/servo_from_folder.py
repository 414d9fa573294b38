"""What control by the legs would do in every image of a session, in a table.

    python examples/servo_from_folder.py SESSION CALIBRATION [--station NAME] [--goal CONFIGURATION]

The goal is the pose that the calibration found for one configuration of the session. Nothing
moves: each image is one sample, and its line says which way the motors would go.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pkmcal.calibration.saved_calibration import load
from pkmcal.control.loop import VisualServo
from pkmcal.errors import InputError, PkmcalError
from pkmcal.observe.images import decode
from pkmcal.session.load import load_session


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("calibration", type=Path)
    parser.add_argument("--station", help="whose images; the first unless given")
    parser.add_argument("--goal", help="configuration to go to; the station's last unless given")
    parser.add_argument("--law", default="edges", help="edges (the default) or directions")
    parser.add_argument("--gain", type=float, default=1.0, help="1/s (default 1)")
    return parser.parse_args()


def main() -> None:
    options = arguments()
    session, saved = load_session(options.session), load(options.calibration)
    names = [station.name for station in session.stations]
    name = options.station or names[0]
    if name not in names:
        raise InputError("no such station", found=name, expected=" or ".join(names))
    station = session.stations[names.index(name)]
    rows = [entry.configuration for entry in station.images]
    goal = options.goal or session.configurations[rows[-1]]
    if goal not in saved.configurations:
        raise InputError("no such configuration in the calibration", found=goal)
    T_base_platform = saved.T_base_platform[saved.configurations.index(goal)]
    servo = VisualServo.from_calibration(
        options.calibration, name, T_base_platform,
        session=options.session, law=options.law, gain=options.gain,
    )  # fmt: skip
    unit = {"m": ("mm/s", 1e3), "rad": ("mrad/s", 1e3)}[session.machine.joint_units[0]]
    print(f"{name}, towards {goal}, joint velocities in {unit[0]}, error in mrad")
    for entry in station.images:
        image = decode(entry.path, station.camera.image_size, entry.path.name)
        step = servo.step_image(image, session.joints[entry.configuration])
        velocities = "".join(f"{v * unit[1]:9.3f}" for v in step.joint_velocities)
        label = session.configurations[entry.configuration]
        print(f"{label:>8}{velocities}{step.error * 1e3:9.2f}  {step.sentence}")
        for warning in step.warnings:
            print(f"{'':8}{warning}")


if __name__ == "__main__":
    try:
        main()
    except PkmcalError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
