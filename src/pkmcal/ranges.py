"""What every numeric option of a command, and every numeric argument of the public functions, may
be: one table.

Numbers in files have their ranges in the files' schemas; what a study varies, in
:mod:`pkmcal.studies.sweep`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from types import MappingProxyType

from pkmcal.errors import InputError


@dataclass(frozen=True)
class Range:
    """From ``least`` to ``most``, both included, but for ``least`` where ``above``. whole : without
    fractions.
    """

    least: float
    most: float
    above: bool = False
    whole: bool = False

    def __str__(self) -> str:
        return f"{'over ' if self.above else ''}{self.least:g} to {self.most:g}"

    def check(self, value: float, where: str) -> None:
        """Raise InputError for what is no number, not finite, or out of the range."""
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
    return Range(least, most, whole=True)


MOST_CONFIGURATIONS = 1000
"""Of a simulation: nobody photographs more in a day."""
MOST_PLANNED_CONFIGURATIONS = 200
"""Configurations from each place that a plan may choose; candidates are twenty times as many, and
memory grows with them."""
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
        "view": {"port": _whole(0, 65_535)},
        "watch": {"alpha": Range(1e-6, 0.2), "seed": _SEED},
    }
)
"""By command and by the option's name; lengths in m, angles as the option has them, noise of images
in px or grey levels, speed in m/s or rad/s, rates in 1/s, durations in s."""


def check_number(command: str, name: str, value: float | None, where: str | None = None) -> None:
    """Raise InputError for a number that a command's option may not be; None is no number.

    where : its name in the message; ``name`` unless given.
    """
    if value is not None:
        RANGES[command][name].check(value, where or name)
