"""A machine closed at home, limb by limb: what models of bodies and joints are drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError
from pkmcal.export.limbs import SLIDE_CARRIER, TELESCOPE_ROD, TURN_CARRIER, Limbs, all_limbs
from pkmcal.geometry.rigid import cross, dot, inverse
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.joints import Equation, equations
from pkmcal.mechanisms.kinematics import forward, inverse_result, on_manifold

SAME_HINGE_DIFFERENCE = 1e-9
"""Metres and radians by which two legs' common axis or hinge may differ: rounding."""
LEAST_SINE_TO_LEG = 0.5
"""Sine of the angle between a leg and a first axis of its universal joint, below which another
axis is taken: at zero the two hinges of the joint would turn alike.
"""
BASE_FRAME_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class HomeState:
    """A machine closed at home.

    T_base_platform : (4, 4). readings : (m,) m or rad. internal : (n,) the bars' hinges, rad.
    a, b : (L, 3) the limbs' ends, m, base frame; u : (L, 3) unit directions from a to b;
    distance : (L,) m. equations : what the axes of each leg add to the closure.
    """

    machine: Machine
    limbs: Limbs
    T_base_platform: Array
    readings: Array
    internal: Array
    a: Array
    b: Array
    u: Array
    distance: Array
    equations: tuple[frozenset[Equation], ...]

    @property
    def rot(self) -> Array:
        """The platform's orientation, (3, 3)."""
        return self.T_base_platform[:3, :3]

    @property
    def size(self) -> float:
        """A length of the machine, m: its rods' mean."""
        return float(self.distance.mean())

    @property
    def middle(self) -> Array:
        """The mean of the platform's joints (3,), platform frame."""
        T_platform_base = inverse(self.T_base_platform)
        return T_platform_base[:3, :3] @ self.b.mean(axis=0) + T_platform_base[:3, 3]

    def leg(self, j: int) -> Any:
        """Leg j (from 0) as its file has it."""
        return self.machine.document.legs[j]

    def column(self, j: int) -> int:
        """The reading of leg j, -1 without."""
        return int(self.limbs.joint[j])

    def motor_legs(self, column: int) -> tuple[int, ...]:
        """The legs (from 0) that a reading moves."""
        return tuple(int(j) for j in np.flatnonzero(self.limbs.joint == column))

    def reading_name(self, column: int) -> str:
        """``leg1`` where the reading moves one leg, as columns of joints.csv; else ``motor1``."""
        legs = self.motor_legs(column)
        return f"leg{legs[0] + 1}" if len(legs) == 1 else f"motor{column + 1}"

    def scale(self, column: int) -> float:
        """What the motor moves is scale * reading."""
        return float(self.limbs.scale[self.motor_legs(column)[0]])

    def values(self, column: int) -> Array:
        """What a motor has moved at home and at both ends of its range, (3,) m or rad."""
        reading = self.readings[column]
        return self.scale(column) * np.append(reading, self.machine.joint_ranges[column])

    def lever(self, column: int) -> float:
        """What makes a motor's stiffness that of a slide: 1, or a turning arm, m."""
        j = self.motor_legs(column)[0]
        return (
            float(np.linalg.norm(self.limbs.arm[j])) if self.limbs.drive[j] == TURN_CARRIER else 1.0
        )

    def length_varies(self, j: int) -> bool:
        """Whether leg j's length changes, by its motor or because it is passive."""
        return self.limbs.drive[j] == TELESCOPE_ROD or not np.isfinite(self.limbs.length[j])


def home_state(machine: Machine) -> HomeState:
    """The machine at its home pose, or, where constant rods or axes forbid that, next to it.

    Raises GeometryError where it cannot be closed there.
    """
    layout, values = machine.layout, machine.values
    near = on_manifold(layout, values, machine.home()).T_base_platform
    readings, internal = inverse_result(layout, values, near)
    reached = bool(np.isfinite(readings).all())
    fk = forward(layout, values, readings, near, internal) if reached else None
    if fk is None or not bool(fk.converged):
        raise GeometryError(
            f"mechanism {machine.name!r} does not close at its home pose",
            found="no readings" if fk is None else f"a gap of {float(fk.error) * 1e3:.3g} mm",
            expected="a pose that all legs reach",
            next_step="give home: {position: [x, y, z]} in the mechanism file",
        )
    ends = limb_ends(layout, values, readings, fk.T_base_platform, fk.internal)
    line = ends.b - ends.a
    distance = np.sqrt(dot(line, line))
    reference = equations(machine.document)
    return HomeState(
        machine,
        all_limbs(machine),
        fk.T_base_platform,
        readings,
        fk.internal,
        np.array(ends.a),
        np.array(ends.b),
        line / distance[:, None],
        distance,
        tuple(
            frozenset(kind for leg, kind in reference if leg == j) for j in range(machine.n_legs)
        ),
    )


def joint_axis(home: HomeState, side: str, j: int) -> Array | None:
    """The unit axis (3,) of a joint in its body's frame: as calibrated where it is a parameter, as
    drawn where nothing depends on it; None where the joint has none.
    """
    machine = home.machine
    finite = (machine.base_axes() if side == "base" else machine.platform_axes())[j]
    if np.isfinite(finite).all():
        return finite
    drawn = getattr(getattr(home.leg(j), side), "axis", None)
    return None if drawn is None else _unit(np.array(drawn, dtype=float))


def universal_hinges(home: HomeState, j: int) -> tuple[Array, Array]:
    """First and second hinge (3,) of leg j's universal joint on the base side, base frame.

    The second is square to the first and to the leg. Where a torsion depends on the first it is
    the file's; else the file's, or the motor's that the leg turns with, as long as the leg does not
    lie along it; else the horizontal one square to the leg.
    """
    u, drive = home.u[j], home.limbs.drive[j]
    drawn = home.limbs.axis[j] if drive == TURN_CARRIER else joint_axis(home, "base", j)
    least = SAME_HINGE_DIFFERENCE if "torsion" in home.equations[j] else LEAST_SINE_TO_LEG
    # the axis of a slide is no hinge's
    if drawn is not None and drive != SLIDE_CARRIER and np.linalg.norm(cross(drawn, u)) > least:
        first = drawn
    else:
        level = cross(BASE_FRAME_UP, u)
        first = _unit(
            level if np.linalg.norm(level) > LEAST_SINE_TO_LEG / 5 else cross(np.eye(3)[1], u)
        )
    return first, _unit(cross(first, u))


def _unit(v: Array) -> Array:
    return v / np.sqrt(dot(v, v))
