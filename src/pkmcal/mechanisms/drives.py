"""Motors, guides and side bars of a machine, and the space that its legs' ends reach."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import joint_values, skeletons
from pkmcal.mechanisms.motors import bodies

MOTOR_STOP_MARGIN = 0.1
"""Share of its range that a motor keeps from its stops where the reach of a machine is computed."""
NO_RANGE = 0.25
"""Half length of a guide relative to the leg's length, where the file gives no joint range."""
BENT_GUIDE_PIECES = 16
"""Number of straight pieces that render a bent guide."""
STRAIGHT_GUIDE_DEVIATION = 1e-9
"""Deviation of a guide from the line between its ends, in metres, up to which it is one straight
piece."""


@dataclass(frozen=True)
class Drives:
    """Actuators of the legs' ends on the base, one row for each leg; base frame, m.

    arms, guides : (L,) whether an arm carries the leg's end, or a guide does; both are False for
        a fixed joint.
    foot : (L, 3) the fixed joint, the motor that holds the arm, or the middle of a guide.
    axis : (L, 3) unit axis of an arm's motor, or direction of a guide; zero for a fixed joint.
    arm : (L,) distance from the foot of an arm to the leg's end; zero for other legs.
    ways : L arrays (n, 3), path of the leg's end along its guide from one stop to the other,
        two points for a straight guide; for other legs the foot twice.
    away : (L, 3) unit vector square to a guide and away from the platform; zero for other legs.
    """

    arms: Booleans
    guides: Booleans
    foot: Array
    axis: Array
    arm: Array
    ways: tuple[Array, ...]
    away: Array

    @property
    def any(self) -> bool:
        """Whether any motor stands on the base."""
        return bool((self.arms | self.guides).any())

    @property
    def upright(self) -> Booleans:
        """(L,) whether a leg's guide is closer to the vertical than to the horizontal."""
        return self.guides & (np.abs(self.axis[:, 2]) > np.sqrt(0.5))

    @cached_property
    def ends(self) -> Array:
        """(L, 2, 3) both ends of each guide; for other legs the foot twice."""
        return np.stack([direction[[0, -1]] for direction in self.ways])


def drives_of(machine: Machine) -> Drives:
    """Actuators of a machine, derived from its carriers without reference to their kinds."""
    layout, zero = machine.layout, np.zeros(machine.n_legs)
    # arms and guides: a driven carrier with and without a link of its own
    chains = skeletons(layout, machine.values, zero)
    driven = np.zeros(machine.n_legs, dtype=bool)
    for g in layout.base:
        driven[g.legs] = g.carrier.driven and not g.winds
    several = np.array([len(chain) > 1 for chain in chains])
    arms, guides = driven & several, driven & ~several
    # arms: radius, and axis from the velocities at two joint values a quarter turn apart
    a, by_value = _placed(machine, zero)
    foot = np.array([chain[0] for chain in chains])
    arm = np.where(arms, np.sqrt(dot(a - foot, a - foot)), 0.0)
    turned = cross(by_value, _placed(machine, zero + np.pi / 2)[1])
    axis = np.where(arms[:, None], _unit(turned, a - foot), 0.0)
    # guides: path of the leg's end between its stops, and the direction in the middle
    ways = [np.stack([p, p]) for p in foot]
    low, high = _guide_ranges(machine, by_value).T
    for j in np.flatnonzero(guides):
        steps = np.linspace(low[j], high[j], BENT_GUIDE_PIECES + 1)[:, None]
        values = np.where(np.arange(machine.n_legs) == j, steps, 0.0)
        attempt, along = (x[:, j] for x in _placed(machine, values))
        ways[j] = attempt if _is_bent(attempt) else attempt[[0, -1]]
        foot[j] = attempt[BENT_GUIDE_PIECES // 2] if _is_bent(attempt) else ways[j].mean(axis=0)
        axis[j] = _unit(along[BENT_GUIDE_PIECES // 2], by_value[j])
    away = _away(machine, foot, axis, guides)
    return Drives(arms, guides, foot, axis, arm, tuple(ways), away)


def _placed(machine: Machine, joint_value: Array) -> tuple[Array, Array]:
    """Legs' ends on the base and their derivatives, (..., L, 3) each, at joint values (..., L)."""
    shape = (*joint_value.shape, 3)
    a, by_value = np.empty(shape), np.empty(shape)
    for g in machine.layout.base:
        own = g.of(machine.values), joint_value[..., g.legs]
        a[..., g.legs, :], by_value[..., g.legs, :] = g.carrier.place(*own)
    return a, by_value


def _is_bent(direction: Array) -> bool:
    """Whether a path (n, 3) deviates from the line between its ends."""
    u = (direction[-1] - direction[0]) / max(
        float(np.linalg.norm(direction[-1] - direction[0])), 1e-300
    )
    return (
        float(np.linalg.norm(np.cross(direction - direction[0], u), axis=1).max())
        > STRAIGHT_GUIDE_DEVIATION
    )


def _unit(v: Array, otherwise: Array) -> Array:
    """Unit vectors of v (..., 3); a direction square to `otherwise` where v vanishes."""
    lateral = np.cross(otherwise, np.eye(3)[np.abs(otherwise).argmin(axis=-1)])
    v = np.where(dot(v, v)[..., None] > 1e-12 * dot(otherwise, otherwise)[..., None], v, lateral)
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    # unit vectors are returned unchanged to the last digit
    return v / np.where(np.abs(size - 1) < 1e-12, 1.0, np.maximum(size, 1e-300))


def _guide_ranges(machine: Machine, by_value: Array) -> Array:
    """Range (L, 2) of each leg's joint value; an interval about home where the file gives none."""
    layout, home = machine.layout, machine.home()
    readings = machine.inverse(home[None])[0]
    ends = machine.ends_at(readings, home)
    speed = np.linalg.norm(by_value, axis=1)
    spare = NO_RANGE * np.linalg.norm(ends.b - ends.a, axis=1) / np.where(speed > 0, speed, 1.0)
    theta, ranges = machine.values, machine.joint_ranges
    middle = joint_values(layout, theta, readings)
    values = np.stack([joint_values(layout, theta, ranges[:, k]) for k in (0, 1)], axis=-1)
    guess = np.stack([middle - spare, middle + spare], axis=-1)
    return np.where(np.isfinite(values).all(axis=1, keepdims=True), values, guess)


def _away(machine: Machine, foot: Array, axis: Array, guides: Booleans) -> Array:
    """Unit directions (L, 3) in which guides stand back from their legs' ends.

    The platform's joints all lie on the other side, so that two carriages on one guide have the
    same direction.
    """
    home = machine.home()
    b = machine.ends_at(np.zeros(machine.n_joints), home).b
    back = foot - np.array(b).mean(axis=0)
    back = back - dot(back, axis)[:, None] * axis
    # a guide through the platform's middle may stand back in any direction square to it
    lateral = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    back = np.where((dot(back, back) > 1e-6)[:, None], back, lateral)
    size = np.linalg.norm(back, axis=1, keepdims=True)
    return np.where(guides[:, None], back / np.maximum(size, 1e-300), 0.0)


def reaches(machine: Machine) -> tuple[Array, Array]:
    """Legs' ends A and B (n, L, 3) that bound the machine's workspace; base frame, m.

    Rows: the home pose and, if motors stand on the base, the poses with all motors near either
    stop. A carriage or an arm takes its leg's end along, so the home pose alone does not bound the
    machine's workspace.
    """
    poses, readings = [machine.home()], [machine.inverse(machine.home()[None])[0]]
    ranges = machine.joint_ranges
    if any(g.carrier.driven for g in machine.layout.base) and np.isfinite(ranges).all():
        share = np.array([[MOTOR_STOP_MARGIN], [1 - MOTOR_STOP_MARGIN]])
        wanted = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        fk = machine.forward_result(wanted)
        poses += list(fk.T_base_platform[fk.converged])
        readings += list(wanted[fk.converged])
    ends = machine.ends_at(np.stack(readings), np.stack(poses))
    return np.array(ends.a), np.array(ends.b)


def legs_space(machine: Machine) -> Array:
    """Points (n, 3) that an image of the machine has to contain; base frame, m."""
    return np.concatenate([ends.reshape(-1, 3) for ends in reaches(machine)])


def ball_of(points: Array) -> tuple[Array, float]:
    """Centre (3,) and radius, in m, of a ball about the middle of the bounding box of points (n, 3)
    that contains them.
    """
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def side_bars(machine: Machine) -> tuple[Integers, ...]:
    """Legs of each body of an articulated platform, in the order of the bodies' numbers."""
    on = bodies(machine.document)
    return tuple(np.flatnonzero(on == body) for body in range(on.max(initial=-1) + 1))
