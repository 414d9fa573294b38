"""Ranges, choices and defaults of the options of the commands, which are those of the functions of
the same names.

Ranges of numbers in files are part of the files' schemas; ranges of the quantities that a study
varies are in :mod:`pkmcal.studies.sweep`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from numbers import Integral, Real
from types import MappingProxyType
from typing import Any, Literal

from pkmcal.errors import InputError

NO_LIMIT = 1e12
"""A larger limit of a range is none in words."""


@dataclass(frozen=True)
class Range:
    """Interval from ``least`` to ``most``. Both ends are included, but ``least`` is excluded with
    ``above``.

    whole : integers only. unit : of a number without one, where one may be written, as for
    :func:`pkmcal.files.quantities.read_with_unit`; empty for numbers that take no unit. default :
    value of the option that is not given; None if that is another rule than a number.
    """

    least: float
    most: float
    above: bool = False
    whole: bool = False
    default: float | None = None
    unit: str = ""

    @property
    def plain_unit(self) -> str:
        """Unit of a number without one in words, empty for shares and numbers that take no unit."""
        return {"share": "", "1/s": "per s"}.get(self.unit, self.unit)

    def text(self, factor: float = 1, unit: str | None = None) -> str:
        """The interval in words. factor, unit : of another unit, relative to the interval's, and
        its name.
        """
        name = self.plain_unit if unit is None else unit
        most = "or more" if self.most > NO_LIMIT else f"to {self.most / factor:g}"
        interval = f"{self.least / factor:g} {most} {name}"
        return f"{'over ' if self.above else ''}{interval}".rstrip()

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
            expected=f"{'a whole number, ' if self.whole else ''}{self.text()}",
        )


def _whole(least: int, most: int, default: int | None = None) -> Range:
    """Range of integers."""
    return Range(least, most, whole=True, default=default)


MOST_CONFIGURATIONS = 1000
"""Most configurations in a simulated session; more images are not taken in a day."""
MOST_PLANNED_CONFIGURATIONS = 200
"""Most configurations for each station of a plan; there are twenty times as many candidates, and
memory grows with their number."""
GOOD_ENCODER_SIGMA = 3e-6
"""Standard deviation of a reading of a good encoder, m or rad."""
FAMILY_DIMENSIONS = (
    "base_radius",
    "platform_radius",
    "leg",
    "arm",
    "base_spacing",
    "platform_spacing",
    "arm_angle",
    "travel",
    "tube_radius",
)
"""Numbers that nominal models of families are made of; described in
:mod:`pkmcal.starter.families`."""
_DIMENSION = Range(0, 50, above=True, unit="m")
_SEED = _whole(0, 2**63 - 1, 0)
RANGES: Mapping[str, Mapping[str, Range]] = MappingProxyType(
    {
        "calibrate": {"seed": _SEED, "holdout": _whole(0, 100_000, 0)},
        "camera": {"distance": Range(0, 1000, above=True, unit="m")},
        "check": {"seed": _SEED},
        "new": {
            "places": _whole(1, 20),
            **dict.fromkeys(FAMILY_DIMENSIONS, _DIMENSION),
            "arm_angle": Range(-pi, pi, unit="rad"),
        },
        "plan": {
            "configurations": _whole(2, MOST_PLANNED_CONFIGURATIONS, 15),
            "places": _whole(1, 12),
            "best_of": _whole(1, 100),
            # of painted legs and bare rods, by what shading leaves; polished legs are worse
            "edge_noise": Range(0, 100, above=True, default=0.1, unit="px"),
            "corner_noise": Range(0, 100, above=True, default=0.05, unit="px"),
            "tracker": Range(0, 1, above=True),
            "joint_noise": Range(0, 1, above=True, default=GOOD_ENCODER_SIGMA, unit="m or rad"),
            "reading_resolution": Range(0, 1, default=0.0, unit="m or rad"),
            "play": Range(0, 1, default=0.0, unit="m or rad"),
            "seed": _SEED,
        },
        "reproduce": {"runs": _whole(2, 100_000, 100), "seed": _SEED},
        "servo": {
            "runs": _whole(1, 1000, 60),
            "gain": Range(0, 1000, above=True, default=1.0, unit="1/s"),
            "rate": Range(0, 10_000, above=True, default=25.0, unit="1/s"),
            "delay": _whole(0, 50, 1),
            "noise": Range(0, 100, default=0.02, unit="px"),
            "joint_noise": Range(0, 1, default=GOOD_ENCODER_SIGMA, unit="m or rad"),
            "speed": Range(0, 1e6, above=True, unit="m/s or rad/s"),
            "duration": Range(0, 3600, above=True, unit="s"),
            "hand_position": Range(0, 100, default=0.03, unit="m"),
            "hand_rotation": Range(0, 180, default=3.0, unit="deg"),
            "seed": _SEED,
        },
        "show": {"port": _whole(0, 65_535, 0)},
        "simulate": {
            "stations": _whole(1, 100, 3),
            "configurations": _whole(2, MOST_CONFIGURATIONS, 15),
            "repeats": _whole(1, 100, 1),
            "tolerance": Range(0, 100, default=1.0),
            "joint_noise": Range(0, 1, above=True, unit="m or rad"),
            "noise": Range(0, 255, default=0.9),
            "blur": Range(0, 20, default=0.6, unit="px"),
            "rough_position": Range(0, 100),
            "rough_angle": Range(0, 3.2),
            "extreme": Range(0, 1),
            "breathing": Range(0, 1),
            "shake": Range(0, 1),
            "warming": Range(0, 200, default=0.0, unit="K"),
            "force": Range(0, 1e6, default=0.0),
            "seed": _SEED,
        },
        "study": {"runs": _whole(2, 1_000_000, 100), "seed": _SEED},
        "validate": {"regions": _whole(0, 1000, 0), "seed": _SEED},
        "view": {"port": _whole(0, 65_535, 0)},
        "watch": {"alpha": Range(1e-6, 0.2, default=0.01, unit="share"), "seed": _SEED},
    }
)
"""Ranges by command and option. Lengths in m, angles in the option's own unit, noise of images in
px or grey levels, speed in m/s or rad/s, rates in 1/s, durations in s."""


AlternativeMethod = Literal["four-step", "linear", "inverse-kinematic"]
CalibrationMethod = Literal["bundle", AlternativeMethod]
CameraFileFormat = Literal["opencv", "ros", "kalibr"]
CameraModelChoice = Literal[
    "auto", "pinhole", "rational", "fisheye", "unified", "extended_unified", "double_sphere"
]
Paper = Literal["a", "b", "c"]
ServoLaw = Literal["edges", "directions"]
Style = Literal["mixed", "matte", "dark", "metal"]
Light = Literal["usual", "soft", "hard"]


def default(command: str, name: str) -> Any:
    """Default of a numeric option."""
    return RANGES[command][name].default


def check_number(command: str, name: str, value: float | None, where: str | None = None) -> None:
    """Check a numeric option of a command; raise InputError outside its range. None passes.

    where : name of the option in the message, by default ``name``.
    """
    if value is not None:
        RANGES[command][name].check(value, where or name)
