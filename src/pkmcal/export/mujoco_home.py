"""The machine in its home pose, as the MuJoCo export draws it: where every joint is, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import CarrierGroup, limb_ends
from pkmcal.mechanisms.document import ActuatedLength, PassiveLength
from pkmcal.mechanisms.joints import Equation, equations
from pkmcal.mechanisms.kinematics import forward, inverse_result, on_manifold

SAME = 1e-9
"""Metres and radians by which two legs' common axis or hinge may differ: rounding."""
ALONG = 0.5
"""Sine of the angle between a leg and a first axis of its universal joint, below which another
axis is taken: at zero the two hinges of the joint would turn alike.
"""


@dataclass(frozen=True)
class HomeState:
    """A machine closed at home.

    T_base_platform : (4, 4). readings : (m,) m or rad. internal : (n,) the bars' hinges, rad.
    a, b : (L, 3) the limbs' ends, m, base frame; u : (L, 3) unit directions from a to b;
    distance : (L,) m. a_by_reading : (L, 3) how the base ends move with their readings.
    """

    machine: Machine
    T_base_platform: Array
    readings: Array
    internal: Array
    a: Array
    b: Array
    u: Array
    distance: Array
    a_by_reading: Array

    @property
    def rot(self) -> Array:
        """The platform's orientation, (3, 3)."""
        return self.T_base_platform[:3, :3]

    @property
    def size(self) -> float:
        """A length of the machine, m: its rods' mean."""
        return float(self.distance.mean())

    @property
    def radius(self) -> float:
        """The platform's size, m: root mean square distance of its joints from their middle."""
        spread = self.b - self.b.mean(axis=0)
        return float(np.sqrt(dot(spread, spread).mean())) or self.size / 4

    def leg(self, j: int) -> Any:
        """Leg j (from 0) as its file has it."""
        return self.machine.document.legs[j]

    def equations(self, j: int) -> frozenset[Equation]:
        """What the axes of leg j (from 0) add to the closure."""
        return frozenset(kind for leg, kind in equations(self.machine.document) if leg == j)

    def motor_legs(self, column: int) -> tuple[int, ...]:
        """The legs (from 0) that a reading moves."""
        return tuple(int(j) for j in np.flatnonzero(self.machine.layout.actuated == column))

    def reading_name(self, column: int) -> str:
        """``leg1`` where the reading moves one leg, as columns of joints.csv; else ``motor1``."""
        legs = self.motor_legs(column)
        return f"leg{legs[0] + 1}" if len(legs) == 1 else f"motor{column + 1}"


def home_state(machine: Machine) -> HomeState:
    """The machine at its home pose, or, where constant rods or axes forbid that, next to it.

    Raises GeometryError where it cannot be closed there.
    """
    layout, values = machine.layout, machine.values
    near = on_manifold(layout, values, machine.home()).T_base_platform
    readings, internal = inverse_result(layout, values, near)
    found = forward(layout, values, readings, near, internal) if _finite(readings) else None
    if found is None or not bool(found.converged):
        raise GeometryError(
            f"mechanism {machine.name!r} does not close at its home pose",
            found="no readings" if found is None else f"a gap of {float(found.error) * 1e3:.3g} mm",
            expected="a pose that all legs reach",
            next_step="give home: {position: [x, y, z]} in the mechanism file",
        )
    ends = limb_ends(layout, values, readings, found.T_base_platform, found.internal)
    line = ends.b - ends.a
    distance = np.sqrt(dot(line, line))
    return HomeState(
        machine,
        found.T_base_platform,
        readings,
        found.internal,
        np.array(ends.a),
        np.array(ends.b),
        line / distance[:, None],
        distance,
        np.broadcast_to(ends.a_by_reading, ends.a.shape),
    )


def _finite(readings: Array) -> bool:
    return bool(np.isfinite(readings).all())


def part_values(home: HomeState, side: str, j: int) -> dict[str, Array]:
    """A part's parameters by field, ``center`` and ``axis`` as (3,), others as (); m, rad."""
    group, row = _group_of(home, side, j)
    values = group.of(home.machine.values)[row]
    out: dict[str, Array] = {}
    for kind, value in zip(group.carrier.parameters, values, strict=True):
        field, _, axis = kind.path.partition(".")
        known = out.get(field, np.zeros(0))
        out[field] = np.append(known, value) if axis else np.array(value)
    return out


def joint_axis(home: HomeState, side: str, j: int) -> Array | None:
    """The unit axis (3,) of a joint in its body's frame: as calibrated where it is a parameter, as
    drawn where nothing depends on it; None where the joint has none.
    """
    machine = home.machine
    known = (machine.base_axes() if side == "base" else machine.platform_axes())[j]
    if np.isfinite(known).all():
        return known
    drawn = getattr(getattr(home.leg(j), side), "axis", None)
    axis = part_values(home, side, j).get("axis", drawn)
    return None if axis is None else unit(np.array(axis, dtype=float))


def universal_axes(home: HomeState, j: int) -> tuple[Array, Array]:
    """First and second hinge (3,) of leg j's universal joint on the base side, base frame.

    The second is square to the first and to the leg. Where a torsion depends on the first it is
    the file's; else the file's, or the crank's, as long as the leg does not lie along it; else the
    horizontal one square to the leg.
    """
    u, drawn = home.u[j], joint_axis(home, "base", j)
    slides = home.leg(j).base.joint == "slider"  # its axis is no hinge's
    least = SAME if "torsion" in home.equations(j) else ALONG
    if drawn is not None and not slides and np.linalg.norm(cross(drawn, u)) > least:
        first = drawn
    else:
        level = cross(np.array([0.0, 0.0, 1.0]), u)
        first = unit(level if np.linalg.norm(level) > ALONG / 5 else cross(np.eye(3)[1], u))
    return first, unit(cross(first, u))


def unit(v: Array) -> Array:
    """The direction (3,) of a vector."""
    return v / np.sqrt(dot(v, v))


def motor_axis(home: HomeState, column: int) -> tuple[Array, Array]:
    """A point (3,) on a motor's axis or guide, base frame, at home, and its unit direction (3,).

    Raises InputError where legs on one motor would need two axes.
    """
    legs = home.motor_legs(column)
    axes = [unit(part_values(home, "base", j)["axis"]) for j in legs]
    points = [_foot(home, j, v) for j, v in zip(legs, axes, strict=True)]
    for j, v, p in zip(legs, axes, points, strict=True):
        off = p - points[0]
        if home.machine.joint_units[column] == "m":
            off = np.zeros(3)  # a carriage has no line of its own
        if max(np.abs(v - axes[0]).max(), np.abs(cross(off, axes[0])).max()) > SAME:
            raise InputError(
                f"legs {legs[0] + 1} and {j + 1} are on one motor, but move about two axes, which "
                "one MuJoCo body cannot do",
                where=home.machine.name,
                next_step="give both cranks the same center, axis, radial and zero",
            )
    return points[0], axes[0]


def _foot(home: HomeState, j: int, v: Array) -> Array:
    """Where a crank's arm stands on its axis; of a slider the leg's end."""
    if home.machine.joint_units[int(home.machine.layout.actuated[j])] == "m":
        return home.a[j]
    # dA/dq = v x arm, so the arm is (v x arm) x v
    return home.a[j] - cross(home.a_by_reading[j], v)


def longest(home: HomeState, j: int) -> float:
    """The length (m) that leg j may have: by its range, or as at home."""
    column = int(home.machine.layout.actuated[j])
    if not isinstance(home.leg(j).length, ActuatedLength) or column < 0:
        return float(home.distance[j])
    high = float(home.machine.joint_ranges[column, 1])
    own = float(home.distance[j] - home.readings[column])
    return high + own if np.isfinite(high) else float(home.distance[j])


def gives_way(home: HomeState, j: int) -> bool:
    """Whether leg j's length changes, by its motor or because it is passive."""
    return isinstance(home.leg(j).length, ActuatedLength | PassiveLength)


def _group_of(home: HomeState, side: str, j: int) -> tuple[CarrierGroup, int]:
    """The carrier's group that a leg is in, and its row there."""
    layout = home.machine.layout
    groups = layout.base if side == "base" else layout.platform
    group = next(g for g in groups if j in g.legs)
    return group, int(np.flatnonzero(group.legs == j)[0])
