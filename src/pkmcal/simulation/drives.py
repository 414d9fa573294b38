"""Where motors, guides and side bars of a machine are, and how far its legs' ends go.

A drawing without any visible cylinder, as of machines known from boards alone, gets one a rod.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import cross, dot
from pkmcal.mechanisms import Machine, machine_from_document
from pkmcal.mechanisms.closure import joint_values, skeletons
from pkmcal.mechanisms.document import Tube
from pkmcal.mechanisms.motors import bodies

MOTOR_STOP_MARGIN = 0.1
"""Share of its range that a motor stays from its stops where reaches are compared."""
NO_RANGE = 0.25
"""Length of a guide on either side, in the leg's length, where the file gives no range."""
BENT_GUIDE_PIECES = 16
"""Straight pieces that a bent guide is drawn with."""
STRAIGHT_GUIDE_DEVIATION = 1e-9
"""A guide's way off the line between its ends, m, below which it is one piece."""
ROD_RADIUS = 0.02
"""Of a rod, in its length: 10 mm for half a metre, as carbon tubes of such machines have."""
ROD_MARGIN = 0.07
"""Share of the rod's length at either end that fork and joint hide."""


@dataclass(frozen=True)
class Drives:
    """What moves the legs' ends on the base; base frame, m, one row a leg.

    arms, guides : (L,) whether an arm carries the leg's end, or it runs along a guide; neither is
        a joint that stands still.
    foot : (L, 3) the joint, where the motor holds the arm, or the middle of a guide.
    axis : (L, 3) unit axis of an arm's motor, or direction of a guide; zero where there is none.
    arm : (L,) how far the leg's end is from the foot of its arm, zero elsewhere.
    ways : L arrays (n, 3), the leg's end along its guide from one stop to the other, two points of
        a straight one; elsewhere the foot twice.
    away : (L, 3) unit, square to a guide and away from the platform; zero elsewhere.
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
        """Whether there is a motor on the base at all."""
        return bool((self.arms | self.guides).any())

    @property
    def upright(self) -> Booleans:
        """(L,) guides that stand rather than lie."""
        return self.guides & (np.abs(self.axis[:, 2]) > np.sqrt(0.5))

    @cached_property
    def ends(self) -> Array:
        """(L, 2, 3) the leg's end at both ends of a guide; elsewhere the foot twice."""
        return np.stack([direction[[0, -1]] for direction in self.ways])


def drives_of(machine: Machine) -> Drives:
    """The machine's motors, from its carriers: none is known by its name here."""
    layout, zero = machine.layout, np.zeros(machine.n_legs)
    chains = skeletons(layout, machine.values, zero)
    driven = np.zeros(machine.n_legs, dtype=bool)
    for g in layout.base:
        driven[g.legs] = g.carrier.driven
    several = np.array([len(chain) > 1 for chain in chains])
    arms, guides = driven & several, driven & ~several
    a, by_value = _placed(machine, zero)
    foot = np.array([chain[0] for chain in chains])
    arm = np.where(arms, np.sqrt(dot(a - foot, a - foot)), 0.0)
    turned = cross(by_value, _placed(machine, zero + np.pi / 2)[1])
    axis = np.where(arms[:, None], _unit(turned, a - foot), 0.0)
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
    """Legs' ends on the base and their derivatives, (..., L, 3) each, by joint values (..., L)."""
    shape = (*joint_value.shape, 3)
    a, by_value = np.empty(shape), np.empty(shape)
    for g in machine.layout.base:
        own = g.of(machine.values), joint_value[..., g.legs]
        a[..., g.legs, :], by_value[..., g.legs, :] = g.carrier.place(*own)
    return a, by_value


def _is_bent(direction: Array) -> bool:
    """Whether a way (n, 3) leaves the line between its ends."""
    u = (direction[-1] - direction[0]) / max(
        float(np.linalg.norm(direction[-1] - direction[0])), 1e-300
    )
    return (
        float(np.linalg.norm(np.cross(direction - direction[0], u), axis=1).max())
        > STRAIGHT_GUIDE_DEVIATION
    )


def _unit(v: Array, otherwise: Array) -> Array:
    """Vectors (..., 3) of length one; where they are none, some direction square to another."""
    lateral = np.cross(otherwise, np.eye(3)[np.abs(otherwise).argmin(axis=-1)])
    v = np.where(dot(v, v)[..., None] > 1e-12 * dot(otherwise, otherwise)[..., None], v, lateral)
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    # what is a unit vector stays what it is, to the last digit
    return v / np.where(np.abs(size - 1) < 1e-12, 1.0, np.maximum(size, 1e-300))


def _guide_ranges(machine: Machine, by_value: Array) -> Array:
    """Least and largest value of each leg's joint, (L, 2); about home's if the file is silent."""
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
    """Where guides stand back from their legs' ends: the platform's joints lie on the other side,
    all of them, so that two carriages on one guide agree about it.
    """
    home = machine.home()
    b = machine.ends_at(np.zeros(machine.n_joints), home).b
    back = foot - np.array(b).mean(axis=0)
    back = back - dot(back, axis)[:, None] * axis
    # a guide through the platform's middle may stand back to any side
    lateral = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    back = np.where((dot(back, back) > 1e-6)[:, None], back, lateral)
    size = np.linalg.norm(back, axis=1, keepdims=True)
    return np.where(guides[:, None], back / np.maximum(size, 1e-300), 0.0)


def reaches(machine: Machine) -> tuple[Array, Array]:
    """Legs' ends A and B (n, L, 3), base frame, m: with the platform at home, and, where motors
    stand on the base, with all of them near either stop.

    A carriage or an arm takes its leg's end along, so that home alone says little of the space
    that the machine needs.
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
    """Points (n, 3) that a picture of the machine has to hold, base frame, m."""
    return np.concatenate([ends.reshape(-1, 3) for ends in reaches(machine)])


def ball_of(points: Array) -> tuple[Array, float]:
    """Centre (3,) and radius, m, of the ball about the middle of points (n, 3) that holds them."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def side_bars(machine: Machine) -> tuple[Integers, ...]:
    """Legs of each body of an articulated platform, in the order of their numbers."""
    on = bodies(machine.document)
    return tuple(np.flatnonzero(on == body) for body in range(on.max(initial=-1) + 1))


def to_simulate(drawing: Machine, where: str) -> Machine:
    """The drawing :func:`with_forearms`, if it can be put together at home; else InputError, with
    where the drawing is from.
    """
    try:
        machine = with_forearms(drawing)
        machine.home()
    except PkmcalError as error:
        raise error.as_input(where) from None
    return machine


def with_forearms(machine: Machine) -> Machine:
    """The machine with one cylinder a rod where its drawing gives no leg any; else unchanged.

    A forearm is two rods where it is a parallelogram; here it is the one that stands for them.
    Raises InputError where a limb does not reach the platform at home.
    """
    document = machine.document
    if any(leg.tubes for leg in document.legs):
        return machine
    home = machine.home()
    readings = machine.inverse(home[None])[0]
    if not np.isfinite(readings).all():
        joint = int(np.flatnonzero(~np.isfinite(readings))[0]) + 1
        raise InputError(
            f"mechanism {machine.name!r} cannot take its home pose: joint {joint} cannot reach it",
            expected="arms and rods that reach the platform at home",
            next_step="Check the drawing's lengths and centres, and home",
        )
    ends = machine.ends_at(readings, home)
    lengths = np.linalg.norm(ends.b - ends.a, axis=1)
    legs = tuple(
        leg.model_copy(update={"tubes": (_tube(float(length)),)})
        for leg, length in zip(document.legs, lengths, strict=True)
    )
    return machine_from_document(document.model_copy(update={"legs": legs}))


def _tube(length: float) -> Tube:
    """A rod's, in whole millimetres and half ones of the radius."""
    return Tube.model_validate(
        {
            "radius": max(round(2000 * ROD_RADIUS * length) / 2000, 0.001),
            "from": round(ROD_MARGIN * length, 3),
            "to": round((1 - ROD_MARGIN) * length, 3),
        }
    )
