"""``pkmcal.servo``: simulated visual servoing by the legs in the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from pkmcal.api.result import FolderResult, page_and_numbers
from pkmcal.arrays import Array
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.control.laws import law_named
from pkmcal.control.simulation import LoopSettings
from pkmcal.control.source import load_plant
from pkmcal.control.study import HAND_ROTATION, Plan, Study, study_servoing
from pkmcal.errors import InputError
from pkmcal.files.quantities import in_joint_units
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.placement.edges import EdgeNoise
from pkmcal.ranges import ServoLaw, check_number, default
from pkmcal.report.servo import outcome_of

MOST_SAMPLES = 5000
"""Maximum number of samples of a run; more take minutes and hundreds of megabytes."""


@dataclass(frozen=True, repr=False, eq=False)
class ServoResult(FolderResult, Study):
    """Study of servoing, with its files: ``outcomes``, ``visibility``."""

    own_files = page_and_numbers("servo")
    kind = ("a study of servoing", "an earlier study")

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        return outcome_of(self)


def servo(
    machine: SavedCalibration | Machine | Path | str,
    *,
    session: Path | str | None = None,
    station: str | None = None,
    camera: Path | str | None = None,
    law: ServoLaw = "edges",
    legs: Sequence[int] | None = None,
    runs: int = default("servo", "runs"),
    gain: float = default("servo", "gain"),
    rate: float = default("servo", "rate"),
    delay: int = default("servo", "delay"),
    noise: float = default("servo", "noise"),
    joint_noise: float | str = default("servo", "joint_noise"),
    speed: float | str | None = None,
    duration: float | None = None,
    hand_position: float = default("servo", "hand_position"),
    hand_rotation: float = HAND_ROTATION,
    start: Array | None = None,
    goal: Array | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> ServoResult:
    """Simulate visual servoing by a machine's legs, without writing files.

    Parameters
    ----------
    machine :
        A calibration's folder, a calibration loaded by :func:`pkmcal.load_result`, a machine, a
        mechanism file, or the name of a built-in machine.
    session :
        The calibration's session, for its cameras, where it is not found around the folder.
    station :
        Name of the station whose camera controls; by default the first.
    camera :
        Another camera file than the station's.
    law :
        Control by the ``edges`` or the ``directions`` of the legs.
    legs :
        Numbers of the legs that the camera sees, from 1; by default all.
    runs :
        Number of motions for each estimate of the geometry.
    gain :
        Part of the error that is corrected in a second, 1/s.
    rate :
        Images a second.
    delay :
        Images from the exposure to the motion.
    noise :
        Standard deviation of an edge's shift and tilt, px.
    joint_noise :
        Standard deviation of a reading, m or rad, or a text with its unit, such as "3 um".
    speed :
        Largest speed of a drive, m/s or rad/s, or a text with its unit; by default unlimited.
    duration :
        Duration of a run, s; by default 10 / gain.
    hand_position, hand_rotation :
        Errors of a hand-measured camera pose, m and rad.
    start, goal :
        T_base_platform (4, 4) of every run; by default random.
    seed :
        Seed for all random numbers.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    ServoResult
        ``outcomes``, one for each estimate; ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The loop would be unstable, a pose cannot be reached, or the camera does not see the legs.

    """
    numbers = {
        "runs": runs, "gain": gain, "rate": rate, "delay": delay, "noise": noise,
        "duration": duration, "hand_position": hand_position,
        "hand_rotation": np.rad2deg(hand_rotation), "seed": seed,
    }  # fmt: skip
    for name, value in numbers.items():
        check_number("servo", name, value)
    law_named(law)
    for name, given in (("start", start), ("goal", goal)):
        if given is not None and np.shape(given) != (4, 4):
            raise InputError(
                "this is not a platform pose",
                where=name,
                found=f"an array of shape {np.shape(given)}",
                expected="T_base_platform (4, 4), m",
            )
    loop = LoopSettings(
        law=law,
        gain=gain,
        rate=rate,
        delay=delay,
        noise=EdgeNoise(shift=noise, tilt=noise),
        duration=10 / gain if duration is None else duration,
    )
    if loop.samples > MOST_SAMPLES:
        raise InputError(
            "the runs would have too many samples", where="--duration",
            found=str(loop.samples), expected=f"at most {MOST_SAMPLES}, a rate times a duration",
        )  # fmt: skip
    with whole(progress, "Reading the machine") as report:
        plant = load_plant(
            machine,
            session=None if session is None else Path(session),
            station=station,
            camera=None if camera is None else Path(camera),
            legs=None if legs is None else tuple(int(number) - 1 for number in np.ravel(legs)),
            seed=seed,
        )
        # the machine determines whether its joints have the units of these
        units = plant.machine.joint_units
        reading = in_joint_units(joint_noise, "m or rad", units, "--joint-noise")
        check_number("servo", "joint_noise", reading)
        loop = replace(loop, joint_noise=reading)
        if speed is not None:
            fastest = in_joint_units(speed, "m/s or rad/s", units, "--speed")
            check_number("servo", "speed", fastest)
            loop = replace(loop, speed=np.array([fastest]))
        ends = [None if one is None else np.asarray(one, dtype=float) for one in (start, goal)]
        plan = Plan(loop, runs, seed, hand_position, hand_rotation, *ends)
        try:
            return ServoResult.of(study_servoing(plant, plan, report))
        except (
            InputError
        ) as error:  # located at the camera's file, which determines what is in view
            raise error if error.where or camera is None else error.located(str(camera)) from None
