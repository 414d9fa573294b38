"""What a mechanism file's schema cannot say of motors and bars."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files import listed
from pkmcal.mechanisms.carriers.contract import base_carriers
from pkmcal.mechanisms.motors import motor_columns
from pkmcal.mechanisms.rods import ConstantLength
from pkmcal.mechanisms.schema import Leg, MechanismDocument
from pkmcal.mechanisms.ties import sharing

SAME = 1e-9
"""Metres, or parts of a direction, by which equal numbers of a file differ when written."""
SLANTED = 1e-3
"""A direction nearer to the axis than this (rad) shows no angle about it."""

Where = Callable[..., str]


def check_driven(document: MechanismDocument, place: Where) -> None:
    """Raise InputError for cranks, sliders and bars that cannot be a machine's."""
    for j, leg in enumerate(document.legs):
        if base_carriers()[leg.base.joint].driven:
            _check_rod(j, leg, place)
        if leg.base.joint == "crank":
            _check_zero(j, leg.base, place)
        _check_bar(document, j, leg, place)
    _check_motors(document, place)
    for side, legs, fields in sharing(document):
        for field in fields:
            _check_equal(document, side, legs, field, place)


def _check_rod(j: int, leg: Leg, place: Where) -> None:
    if not isinstance(leg.length, ConstantLength):
        raise InputError(
            f"leg {j + 1} is moved by its {leg.base.joint}, so its rod has one length",
            where=place("legs", j, "length"),
            expected="length: {actuated: false, constant: the rod's length in metres}",
        )


def _check_zero(j: int, node: Any, place: Where) -> None:
    """The direction from which the crank's angle counts."""
    direction = node.zero if node.zero is not None else (0.0, 0.0, 1.0)
    if np.linalg.norm(np.cross(direction, node.axis)) > SLANTED:
        return
    if node.zero is None:
        raise InputError(
            f"the crank of leg {j + 1} turns about a vertical axis, so no horizontal direction "
            "square to it is the first",
            where=place("legs", j, "base", "axis"),
            expected="zero: [x, y, z], the arm's direction at angle 0",
        )
    raise InputError(
        f"the crank of leg {j + 1} has its zero direction along its axis",
        where=place("legs", j, "base", "zero"),
        expected="the arm's direction at angle 0, across the axis",
    )


def _check_bar(document: MechanismDocument, j: int, leg: Leg, place: Where) -> None:
    """Bars keep their direction where the platform only turns with them, else they are hinged."""
    joint = leg.platform.joint
    if joint == "bar" and document.motion == "spatial":
        raise InputError(
            f"leg {j + 1} ends on a bar that keeps its direction, on a platform that may tilt",
            where=place("legs", j, "platform", "joint"),
            expected="motion: schoenflies, or joint: hinged-bar with an axis and two rods a motor",
        )
    if joint == "hinged-bar" and document.motion != "spatial":
        raise InputError(
            f"leg {j + 1} ends on a bar that turns about a hinge, which tilts the platform",
            where=place("legs", j, "platform", "joint"),
            expected="motion: spatial, or joint: bar",
        )


def _check_motors(document: MechanismDocument, place: Where) -> None:
    used = {int(c) + 1 for c in motor_columns(document) if c >= 0}
    missing = sorted(set(range(1, max(used, default=0) + 1)) - used)
    if missing:
        raise InputError(
            f"motor{'s' if len(missing) > 1 else ''} {listed([str(m) for m in missing])} "
            "of the readings moves no leg",
            where=place("legs"),
            expected="motors numbered from 1 in the order of the readings' columns",
        )


def _check_equal(
    document: MechanismDocument, side: str, legs: tuple[int, ...], field: str, place: Where
) -> None:
    """Legs on one motor or bar are drawn with the same axis or hinge."""
    nodes = [getattr(document.legs[j], side) for j in legs]
    values = [getattr(node, field) for node in nodes]
    for j, value in zip(legs[1:], values[1:], strict=True):
        if (value is None) != (values[0] is None) or (
            value is not None and np.abs(np.subtract(value, values[0])).max() > SAME
        ):
            what = "motor" if side == "base" else "bar"
            raise InputError(
                f"legs {legs[0] + 1} and {j + 1} are on one {what}, but differ in {field}",
                where=place("legs", j, side, field),
                found=str(value),
                expected=str(values[0]),
            )
