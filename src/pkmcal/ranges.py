"""Ranges of all numeric options of the commands and numeric arguments of the public functions.

Ranges of numbers in files are part of the files' schemas; ranges of the quantities that a study
varies are in :mod:`pkmcal.studies.sweep`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from types import MappingProxyType

from pkmcal.errors import InputError


@dataclass(frozen=True)
class Range:
    """Interval from ``least`` to ``most``. Both ends are included, but ``least`` is excluded with
    ``above``.

    whole : integers only.
    """

    least: float
    most: float
    above: bool = False
    whole: bool = False

    def __str__(self) -> str:
        return f"{'over ' if self.above else ''}{self.least:g} to {self.most:g}"

    def check(self, value: float, where: str) -> None:
        """Check a value; raise InputError unless it is a finite number (an integer with ``whole``)
        in the range.
        """
        number = isinstance(value, Integral if self.whole else Real) and not isinstance(value, bool)
        high_enough = number and (value > self.least or (value == self.least and not self.above))
        if high_enough and value <= self.most:
            return
        raise InputError(
            "this number cannot be used",
            where=where,
            found=f"{value:g}" if isinstance(value, float) else repr(value),
            expected=f"{'a whole number, ' if self.whole else ''}{self}",
        )


def _whole(least: int, most: int) -> Range:
    """Range of integers."""
    return Range(least, most, whole=True)


MOST_CONFIGURATIONS = 1000
"""Most configurations in a simulated session; more images are not taken in a day."""
MOST_PLANNED_CONFIGURATIONS = 200
"""Most configurations for each station of a plan; there are twenty times as many candidates, and
memory grows with their number."""
_SEED = _whole(0, 2**63 - 1)
_COUNT = _whole(1, 100)
_READING_NOISE = Range(0, 1, above=True)
_PIXEL_NOISE = Range(0, 100, above=True)
RANGES: Mapping[str, Mapping[str, Range]] = MappingProxyType(
    {
        "calibrate": {"seed": _SEED, "holdout": _whole(0, 100_000)},
        "check": {"seed": _SEED},
        "new": {"places": _whole(1, 20)},
        "plan": {
            "configurations": _whole(2, MOST_PLANNED_CONFIGURATIONS),
            "places": _whole(1, 12),
            "best_of": _COUNT,
            "edge_noise": _PIXEL_NOISE,
            "corner_noise": _PIXEL_NOISE,
            "joint_noise": _READING_NOISE,
            "seed": _SEED,
        },
        "reproduce": {"runs": _whole(2, 100_000), "seed": _SEED},
        "servo": {
            "runs": _whole(1, 1000),
            "gain": Range(0, 1000, above=True),
            "rate": Range(0, 10_000, above=True),
            "delay": _whole(0, 50),
            "noise": Range(0, 100),
            "joint_noise": Range(0, 1),
            "speed": Range(0, 1e6, above=True),
            "duration": Range(0, 3600, above=True),
            "hand_position": Range(0, 100),
            "hand_rotation": Range(0, 180),
            "seed": _SEED,
        },
        "simulate": {
            "stations": _COUNT,
            "configurations": _whole(2, MOST_CONFIGURATIONS),
            "repeats": _COUNT,
            "tolerance": Range(0, 100),
            "joint_noise": _READING_NOISE,
            "noise": Range(0, 255),
            "blur": Range(0, 20),
            "rough_position": Range(0, 100),
            "rough_angle": Range(0, 3.2),
            "extreme": Range(0, 1),
            "breathing": Range(0, 1),
            "shake": Range(0, 1),
            "seed": _SEED,
        },
        "study": {"runs": _whole(2, 1_000_000), "seed": _SEED},
        "validate": {"regions": _whole(0, 1000), "seed": _SEED},
        "show": {"port": _whole(0, 65_535)},
        "view": {"port": _whole(0, 65_535)},
        "watch": {"alpha": Range(1e-6, 0.2), "seed": _SEED},
    }
)
"""Ranges by command and option. Lengths in m, angles in the option's own unit, noise of images in
px or grey levels, speed in m/s or rad/s, rates in 1/s, durations in s."""


def check_number(command: str, name: str, value: float | None, where: str | None = None) -> None:
    """Check a numeric option of a command; raise InputError outside its range. None passes.

    where : name of the option in the message, by default ``name``.
    """
    if value is not None:
        RANGES[command][name].check(value, where or name)
