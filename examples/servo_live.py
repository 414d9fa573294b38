"""Control by the legs with a live camera.

    python examples/servo_live.py CALIBRATION STATION --goal CONFIGURATION [--source 0] [--send]

Without --send nothing moves: the velocities are printed. The source is a camera's number, a film,
or numbered pictures such as images/%04d.png. Two functions are yours to write, marked HERE.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from pkmcal.calibration.saved_calibration import SavedCalibration, load
from pkmcal.control.loop import VisualServo
from pkmcal.errors import InputError, PkmcalError


def read_encoders(frame: int, saved: SavedCalibration) -> np.ndarray:
    """The motors' readings (m,), m or rad, taken at the same moment as the frame."""
    # HERE: read your controller. Until then, the readings of the calibration, one after the other.
    return saved.joints[frame % len(saved.joints)]


def send(velocities: np.ndarray) -> None:
    """Velocities (m,) per second to the motors."""
    # HERE: command your controller. It must stop by itself when no new velocities arrive in time.
    raise InputError(
        "there is no controller to send velocities to",
        found=f"{len(velocities)} velocities",
        next_step="fill in send() in this file, or leave --send away",
    )


def opened(source: str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(int(source)) if source.isdigit() else cv2.VideoCapture(source)
    if not capture.isOpened():
        raise InputError(
            "the source of pictures cannot be opened", found=source,
            expected="the number of a camera that is plugged in, a film, or images/%04d.png",
        )  # fmt: skip
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest image, not one that waited
    return capture


def loop(
    capture: cv2.VideoCapture, servo: VisualServo, saved: SavedCalibration, live: bool
) -> None:
    frame = 0
    while (got := capture.read())[0]:
        begin, readings = time.perf_counter(), read_encoders(frame, saved)
        grey = cv2.cvtColor(got[1], cv2.COLOR_BGR2GRAY) if got[1].ndim == 3 else got[1]
        step = servo.step_image(grey, readings)
        if live:
            send(step.joint_velocities)
        took = 1e3 * (time.perf_counter() - begin)
        speed = " ".join(f"{1e3 * v:8.3f}" for v in step.joint_velocities)
        print(f"{frame:5} {speed}  {took:5.1f} ms  {'; '.join((step.sentence, *step.warnings))}")
        frame += 1
    print(f"{frame} frames; the source gives no more")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("calibration", type=Path)
    parser.add_argument("station")
    parser.add_argument("--goal", required=True, help="configuration of the calibration to go to")
    parser.add_argument(
        "--source", default="0", help="camera, film or images/%%04d.png (default 0)"
    )
    parser.add_argument("--session", type=Path, help="where the camera's file is")
    parser.add_argument("--send", action="store_true", help="send velocities: the machine moves")
    options = parser.parse_args()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    saved = load(options.calibration)
    if options.goal not in saved.configurations:
        raise InputError("no such configuration", found=options.goal)
    servo = VisualServo.from_calibration(
        options.calibration, options.station, session=options.session, rate_limits=0.02,
        goal=saved.T_base_platform[saved.configurations.index(options.goal)],
    )  # fmt: skip
    loop(opened(options.source), servo, saved, options.send)


if __name__ == "__main__":
    try:
        main()
    except PkmcalError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
