"""Joints at the ends of a limb: what stands in the file, and which equation their axes add.

A spherical joint has a centre. A universal joint has its first axis, fixed to the body that it
stands on; a revolute joint has one axis, and the limb turns about it. On a spatial machine these
axes add equations between the limb's line and the two bodies:

- revolute: the limb is square to the axis, ([A] eq. 7);
- universal at both ends: the limb does not twist, so the two first axes and the limb's line lie
  in one plane (errata, 3-UPU).

Planar and translational machines move as their file says, whatever the axes: there they add none.
"""

from __future__ import annotations

from math import hypot
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator

from pkmcal.files import Schema
from pkmcal.mechanisms.carriers.contract import ParameterKind

if TYPE_CHECKING:
    from pkmcal.mechanisms.schema import Leg, MechanismDocument

SHORTEST = 1e-6
"""An axis shorter than this is a row of zeros, not a direction."""
AXIS = tuple(ParameterKind(f"axis.{axis}", "1", "axis") for axis in "xyz")

Equation = Literal["revolute base", "revolute platform", "torsion"]


def _direction(axis: tuple[float, float, float]) -> tuple[float, float, float]:
    length = hypot(*axis)
    if length < SHORTEST:
        raise ValueError("an axis of length zero is no direction; write one such as [0, 0, 1]")
    if abs(length - 1) < 1e-12:  # read back what was written, to the last digit
        return axis
    x, y, z = (c / length for c in axis)
    return x, y, z


Direction = Annotated[tuple[float, float, float], AfterValidator(_direction)]


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise ValueError("should be two increasing readings [min, max]")
    return value


Interval = Annotated[tuple[float, float], AfterValidator(_rising)]
"""Smallest and largest reading of a motor."""


class JointDocument(Schema):
    """``{joint: revolute, center: [x, y, z], axis: [x, y, z]}``: metres, the body's frame."""

    joint: Literal["spherical", "universal", "revolute"]
    center: tuple[float, float, float]
    axis: Direction | None = None


def equations(document: MechanismDocument) -> tuple[tuple[int, Equation], ...]:
    """The angle equations of a machine, (leg from 0, which), in the order of the legs."""
    if document.motion != "spatial":
        return ()
    return tuple((j, e) for j, leg in enumerate(document.legs) for e in _equations(leg))


def _equations(leg: Leg) -> list[Equation]:
    found: list[Equation] = []
    if leg.base.joint == "revolute":
        found.append("revolute base")
    if leg.platform.joint == "revolute":
        found.append("revolute platform")
    ends = (leg.base, leg.platform)
    if all(end.joint == "universal" and end.axis is not None for end in ends):
        found.append("torsion")
    return found


def axes_in_use(document: MechanismDocument) -> set[tuple[int, str]]:
    """Ends (leg from 0, side) whose axis takes part in an equation, so is a parameter."""
    sides: dict[Equation, tuple[str, ...]] = {
        "revolute base": ("base",),
        "revolute platform": ("platform",),
        "torsion": ("base", "platform"),
    }
    return {(j, side) for j, which in equations(document) for side in sides[which]}
