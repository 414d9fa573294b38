"""What a mechanism file's schema cannot say: whether its legs can be those of its motion."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files import listed
from pkmcal.files.documents import field_path
from pkmcal.mechanisms.carriers.contract import base_carriers, platform_carriers
from pkmcal.mechanisms.document import (
    MOTIONS,
    ConstantLength,
    Leg,
    MechanismDocument,
    PassiveLength,
)
from pkmcal.mechanisms.joints import equations
from pkmcal.mechanisms.motors import motor_columns, sharing

IN_PLANE = 1e-6
"""Metres out of the plane, and radians off its normal, that rounding in a file explains."""

Where = Callable[..., str]


def check_drawing(document: MechanismDocument, where: Where | None = None) -> None:
    """Raise InputError for a drawing whose joints and rods cannot make its motion.

    where : names a field's place in the file by its keys.
    """
    place = where or (lambda *keys: field_path(keys))
    for j, leg in enumerate(document.legs):
        for side in ("base", "platform"):
            _check_axis(document, j, side, place)
        if document.motion == "planar":
            _check_plane(document, j, leg, place)
        if document.motion == "translation":
            _check_parallel(j, leg, place)
    check_driven(document, place)
    _check_equations(document, place)


def _check_axis(document: MechanismDocument, j: int, side: str, place: Where) -> None:
    node = getattr(document.legs[j], side)
    axis = getattr(node, "axis", None)
    if node.joint == "spherical" and axis is not None:
        raise InputError(
            f"leg {j + 1} has a spherical joint with an axis",
            where=place("legs", j, side, "axis"),
            expected="no axis, or joint: universal or revolute",
        )
    if node.joint == "revolute" and axis is None and document.motion != "planar":
        raise InputError(
            f"leg {j + 1} has a revolute joint without an axis",
            where=place("legs", j, side),
            expected=f"axis: [x, y, z] in the {side} frame, the direction that it turns about",
        )


def _check_plane(document: MechanismDocument, j: int, leg: Leg, place: Where) -> None:
    """A planar machine's legs lie in planes z = const, their axes along z, guides across it."""
    for side in ("base", "platform"):
        axis = getattr(getattr(leg, side), "axis", None)
        if getattr(leg, side).joint == "slider":
            _check_guide(j, leg, place)
        elif axis is not None and np.hypot(axis[0], axis[1]) > IN_PLANE:
            raise InputError(
                f"leg {j + 1} of a planar machine turns about an axis that is not the plane's",
                where=place("legs", j, side, "axis"),
                found=f"[{axis[0]:g}, {axis[1]:g}, {axis[2]:g}]",
                expected="[0, 0, 1]: a planar machine moves in the base frame's x-y plane",
            )
    if document.home and np.hypot(*document.home.rotation_vector[:2]) > IN_PLANE:
        raise InputError(
            "the home pose of a planar machine is turned out of its plane",
            where=place("home", "rotation_vector"),
            expected="[0, 0, angle]",
        )
    gap = leg.platform.center[2] + _rise(document) - leg.base.center[2]
    if abs(gap) > IN_PLANE:
        raise InputError(
            f"leg {j + 1} of a planar machine leaves its plane",
            where=place("legs", j, "platform", "center"),
            found=f"its platform joint {gap * 1e3:+.4g} mm above its base joint",
            expected="the same height (z) for both ends of a leg, at the home pose",
            next_step="Draw the leg in its plane, or write motion: spatial",
        )


def _check_guide(j: int, leg: Leg, place: Where) -> None:
    if abs(leg.base.axis[2]) > IN_PLANE:
        raise InputError(
            f"the slider of leg {j + 1} leaves the plane of a planar machine",
            where=place("legs", j, "base", "axis"),
            expected="[x, y, 0]: a planar machine moves in the base frame's x-y plane",
        )


def _rise(document: MechanismDocument) -> float:
    """Height of the platform frame above the base frame, m; by most legs where no home is given."""
    if document.home is not None:
        return document.home.position[2]
    heights = [leg.base.center[2] - leg.platform.center[2] for leg in document.legs]
    return median(heights)


def _check_parallel(j: int, leg: Leg, place: Where) -> None:
    """A platform that only translates keeps axes parallel; unequal ones would turn it."""
    first, second = (getattr(end, "axis", None) for end in (leg.base, leg.platform))
    if leg.base.joint != "universal" or leg.platform.joint != "universal":
        return
    if first is None or second is None:
        return
    if np.linalg.norm(np.cross(first, second)) > IN_PLANE:
        raise InputError(
            f"the universal joints of leg {j + 1} have axes that are not parallel, so they would "
            "turn the platform",
            where=place("legs", j, "platform", "axis"),
            expected="the axis of its base joint",
            next_step="Write motion: spatial, and the turn will be computed",
        )


def _hinges(document: MechanismDocument) -> int:
    """Bars that turn on their own."""
    carriers = platform_carriers()
    nodes = [leg.platform for leg in document.legs]
    return len({node.bar for node in nodes if carriers[node.joint].turns})


def _check_equations(document: MechanismDocument, place: Where) -> None:
    passive = [
        j + 1 for j, leg in enumerate(document.legs) if isinstance(leg.length, PassiveLength)
    ]
    count = len(document.legs) - len(passive) + len(equations(document))
    freedoms = MOTIONS[document.motion].shape[1] + _hinges(document)
    if count >= freedoms:
        return
    why = ""
    if passive:
        one = len(passive) == 1
        why = f"; {'leg' if one else 'legs'} {listed([str(j) for j in passive])}, passive, "
        why += "holds nothing" if one else "hold nothing"
    raise InputError(
        f"the legs do not hold the platform: {count} equations for {freedoms} freedoms{why}",
        where=place("legs"),
        expected="one equation a leg with a length, one a revolute joint, one a pair of universal "
        f"joints with axes; {freedoms} for motion: {document.motion}"
        f"{' and its hinged bars' if _hinges(document) else ''}",
        next_step="Add legs or axes, or correct motion",
    )


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
