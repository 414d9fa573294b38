"""Machine closed at its home pose, limb by limb: the basis of multibody models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError
from pkmcal.exporters.limbs import SLIDE_CARRIER, TELESCOPE_ROD, TURN_CARRIER, Limbs, all_limbs
from pkmcal.geometry.rigid import cross, dot, inverse
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.joints import Equation, equations, joint_offsets
from pkmcal.mechanisms.kinematics import (
    closure_at,
    forward,
    inverse_result,
    on_manifold,
    undriven,
)

SAME_HINGE_DIFFERENCE = 1e-9
"""Tolerance, m and rad, between a common axis or hinge of two legs: rounding."""
LEAST_SINE_TO_LEG = 0.5
"""Least sine of the angle between a leg and the first axis of its universal joint.

Below it another axis is taken: at zero both hinges of the joint would be parallel in effect. Any
value moves the platform alike, for both axes of the joint lead through the leg's end and only the
leg's rotation about itself differs; where that matters, the axis is the file's.
"""
BASE_FRAME_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class HomeState:
    """Machine closed at home.

    T_base_platform : (4, 4).
    readings : (m,) m or rad.
    internal : (n,) angles of the bars' hinges, rad.
    a, b : (L, 3) ends of the limbs, base frame, m.
    rods : (2, L, 3) ends of the rods on base and platform: a and b, except where a joint's axes do
        not meet.
    u : (L, 3) unit directions of the rods.
    distance : (L,) lengths of the rods, m.
    equations : closure equations of each leg's axes.
    """

    machine: Machine
    limbs: Limbs
    T_base_platform: Array
    readings: Array
    internal: Array
    a: Array
    b: Array
    rods: Array
    u: Array
    distance: Array
    equations: tuple[frozenset[Equation], ...]

    @property
    def rot(self) -> Array:
        """Orientation of the platform, (3, 3)."""
        return self.T_base_platform[:3, :3]

    @property
    def size(self) -> float:
        """Characteristic length of the machine, m: the mean of its rods."""
        return float(self.distance.mean())

    @property
    def middle(self) -> Array:
        """Mean of the platform's joint centres (3,), platform frame, m."""
        T_platform_base = inverse(self.T_base_platform)
        return T_platform_base[:3, :3] @ self.b.mean(axis=0) + T_platform_base[:3, 3]

    def leg(self, j: int) -> Any:
        """Leg j (from 0) of the mechanism file."""
        return self.machine.document.legs[j]

    def column(self, j: int) -> int:
        """Column of leg j's reading, -1 without."""
        return int(self.limbs.joint[j])

    def motor_legs(self, column: int) -> tuple[int, ...]:
        """Legs (from 0) that a reading drives."""
        return tuple(int(j) for j in np.flatnonzero(self.limbs.joint == column))

    def reading_name(self, column: int) -> str:
        """Name of a reading: ``leg1`` if it drives one leg, as in joints.csv, else ``motor1``."""
        legs = self.motor_legs(column)
        return f"leg{legs[0] + 1}" if len(legs) == 1 else f"motor{column + 1}"

    def scale(self, column: int) -> float:
        """Scale of a reading: displacement = scale * reading."""
        return float(self.limbs.scale[self.motor_legs(column)[0]])

    def values(self, column: int) -> Array:
        """Displacement of a motor at home and at both ends of its range, (3,) m or rad."""
        reading = self.readings[column]
        return self.scale(column) * np.append(reading, self.machine.joint_ranges[column])

    def lever(self, column: int) -> float:
        """Lever that converts a motor's stiffness to that of a slide.

        An arm's length in m for a crank, 1 for a slide.
        """
        j = self.motor_legs(column)[0]
        return (
            float(np.linalg.norm(self.limbs.arm[j])) if self.limbs.drive[j] == TURN_CARRIER else 1.0
        )

    def length_varies(self, j: int) -> bool:
        """Whether the length of leg j changes, driven or passively."""
        return self.limbs.drive[j] == TELESCOPE_ROD or not np.isfinite(self.limbs.length[j])


def home_state(machine: Machine) -> HomeState:
    """Machine at its home pose, or at the nearest pose that constant rods and axes allow.

    Raises GeometryError if it cannot be closed there.
    """
    layout, values = machine.layout, machine.values
    # closest pose on the manifold of constant rods and axes, then readings, then closure by Newton
    near = on_manifold(layout, values, machine.home()).T_base_platform
    readings, internal = inverse_result(layout, values, near)
    reached = bool(np.isfinite(readings).all())
    fk = forward(layout, values, readings, near, internal) if reached else None
    if fk is None or not bool(fk.converged):
        gap = float(np.abs(undriven(closure_at(layout, values, machine.home()))[0]).max(initial=0))
        raise GeometryError(
            f"mechanism {machine.name!r} does not close at its home pose, and at none near it",
            found=f"a gap of {gap * 1e3:.3g} mm at home" if np.isfinite(gap) else "no readings",
            expected="a pose that all legs reach",
            next_step="give home: {position: [x, y, z]} in the mechanism file",
            code="mechanism.home_not_closed",
        )
    ends = limb_ends(layout, values, readings, fk.T_base_platform, fk.internal)
    rods = np.stack(ends.rods)
    line = rods[1] - rods[0]
    distance = np.sqrt(dot(line, line))
    closure = equations(machine.document)
    return HomeState(
        machine,
        all_limbs(machine),
        fk.T_base_platform,
        readings,
        fk.internal,
        np.array(ends.a),
        np.array(ends.b),
        rods,
        line / distance[:, None],
        distance,
        tuple(frozenset(kind for leg, kind in closure if leg == j) for j in range(machine.n_legs)),
    )


def joint_axis(home: HomeState, side: str, j: int) -> Array | None:
    """Unit axis (3,) of a joint in its body's frame; None for a joint without one.

    The parameter's value if the axis is a parameter, else the nominal one, on which nothing
    depends.
    """
    machine = home.machine
    finite = (machine.base_axes() if side == "base" else machine.platform_axes())[j]
    if np.isfinite(finite).all():
        return finite
    drawn = getattr(getattr(home.leg(j), side), "axis", None)
    return None if drawn is None else _unit(np.array(drawn, dtype=float))


def universal_hinges(home: HomeState, j: int) -> tuple[Array, Array]:
    """First and second hinge axis (3,) of leg j's universal joint on the base side, base frame.

    The second is perpendicular to the first and to the leg. If a torsion equation or an offset
    depends on the first, it is the file's. Otherwise it is the file's axis, or that of the motor
    that turns the leg, unless the leg is nearly parallel; then the horizontal axis perpendicular to
    the leg.
    """
    u, drive = home.u[j], home.limbs.drive[j]
    drawn = home.limbs.axis[j] if drive == TURN_CARRIER else joint_axis(home, "base", j)
    least = SAME_HINGE_DIFFERENCE if "torsion" in home.equations[j] else LEAST_SINE_TO_LEG
    # the axis of a slide is not a hinge
    if j in joint_offsets(home.machine.document):
        least = SAME_HINGE_DIFFERENCE
    if drawn is not None and drive != SLIDE_CARRIER and np.linalg.norm(cross(drawn, u)) > least:
        first = drawn
    else:
        level = cross(BASE_FRAME_UP, u)
        first = _unit(
            level if np.linalg.norm(level) > LEAST_SINE_TO_LEG / 5 else cross(np.eye(3)[1], u)
        )
    return first, _unit(cross(first, u))


def _unit(v: Array) -> Array:
    """Vector of length one."""
    return v / np.sqrt(dot(v, v))
