"""Where motors, guides and side bars of a machine are, and how far its legs' ends go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import leg_readings, limb_ends

INSET = 0.1
"""Share of its range that a motor stays from its stops where reaches are compared."""
NO_RANGE = 0.25
"""Length of a guide on either side, in the leg's length, where the file gives no range."""


@dataclass(frozen=True)
class Drives:
    """What moves the legs' ends on the base; base frame, m, one row a leg.

    crank, slider : (L,) which it is; neither is a joint that stands still.
    foot : (L, 3) the joint, a crank's axis beside its arm, or the middle of a guide.
    axis : (L, 3) unit axis of a crank, or direction of a guide; zero where there is none.
    arm : (L,) length of a crank's arm, zero elsewhere.
    ends : (L, 2, 3) the leg's end at both ends of a guide; elsewhere the foot twice.
    away : (L, 3) unit, square to a guide and away from the platform; zero elsewhere.
    """

    crank: Booleans
    slider: Booleans
    foot: Array
    axis: Array
    arm: Array
    ends: Array
    away: Array

    @property
    def any(self) -> bool:
        """Whether there is a motor on the base at all."""
        return bool((self.crank | self.slider).any())

    @property
    def upright(self) -> Booleans:
        """(L,) guides that stand rather than lie."""
        return self.slider & (np.abs(self.axis[:, 2]) > np.sqrt(0.5))


def drives_of(machine: Machine) -> Drives:
    """The machine's motors, from its closure: no carrier's formula is repeated here."""
    joints = [leg.base.joint for leg in machine.document.legs]
    crank, slider = (np.array([j == kind for j in joints]) for kind in ("crank", "slider"))
    zero = np.zeros(machine.n_joints)
    ends = limb_ends(machine.layout, machine.values, zero, np.eye(4))
    a, by_reading = np.array(ends.a), np.broadcast_to(ends.a_by_reading, ends.a.shape)
    half_turn = limb_ends(machine.layout, machine.values, zero + np.pi, np.eye(4)).a
    foot = np.where(crank[:, None], (a + half_turn) / 2, a)
    arm = a - foot
    turned = np.cross(arm, by_reading) / np.maximum(dot(arm, arm), 1e-300)[:, None]
    axis = np.where(crank[:, None], turned, np.where(slider[:, None], by_reading, 0.0))
    low, high = _guide_ranges(machine).T
    both = np.stack([a + low[:, None] * by_reading, a + high[:, None] * by_reading], axis=1)
    both = np.where(slider[:, None, None], both, foot[:, None])
    foot = np.where(slider[:, None], both.mean(axis=1), foot)
    size = np.where(crank, np.sqrt(dot(arm, arm)), 0.0)
    return Drives(crank, slider, foot, axis, size, both, _away(machine, foot, axis, slider))


def _guide_ranges(machine: Machine) -> Array:
    """Least and largest reading of each leg, (L, 2); about home's where the file is silent."""
    layout, home = machine.layout, machine.home()
    readings = machine.inverse(home[None])[0]
    ends = limb_ends(layout, machine.values, readings, home)
    spare = NO_RANGE * np.linalg.norm(ends.b - ends.a, axis=1)
    middle = leg_readings(layout, readings)
    ranges = machine.joint_ranges
    told = np.stack([leg_readings(layout, ranges[:, k]) for k in (0, 1)], axis=-1)
    guess = np.stack([middle - spare, middle + spare], axis=-1)
    return np.where(np.isfinite(told).all(axis=1, keepdims=True), told, guess)


def _away(machine: Machine, foot: Array, axis: Array, slider: Booleans) -> Array:
    """Where guides stand back from their legs' ends: the platform's joints lie on the other side,
    all of them, so that two carriages on one guide agree about it.
    """
    home = machine.home()
    b = limb_ends(machine.layout, machine.values, np.zeros(machine.n_joints), home).b
    back = foot - np.array(b).mean(axis=0)
    back = back - dot(back, axis)[:, None] * axis
    # a guide through the platform's middle may stand back to any side
    aside = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    back = np.where((dot(back, back) > 1e-6)[:, None], back, aside)
    size = np.linalg.norm(back, axis=1, keepdims=True)
    return np.where(slider[:, None], back / np.maximum(size, 1e-300), 0.0)


def reaches(machine: Machine) -> tuple[Array, Array]:
    """Legs' ends A and B (n, L, 3), base frame, m: with the platform at home, and, where motors
    stand on the base, with all of them near either stop.

    A carriage or an arm takes its leg's end along, so that home alone says little of the space
    that the machine needs.
    """
    poses, readings = [machine.home()], [machine.inverse(machine.home()[None])[0]]
    joints = {leg.base.joint for leg in machine.document.legs}
    ranges = machine.joint_ranges
    if joints & {"crank", "slider"} and np.isfinite(ranges).all():
        share = np.array([[INSET], [1 - INSET]])
        wanted = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        found = machine.forward_result(wanted)
        poses += list(found.T_base_platform[found.converged])
        readings += list(wanted[found.converged])
    ends = limb_ends(machine.layout, machine.values, np.stack(readings), np.stack(poses))
    return np.array(ends.a), np.array(ends.b)


def side_bars(machine: Machine) -> tuple[Integers, ...]:
    """Legs of each side bar of an articulated platform, in the order of the bars."""
    bars = [getattr(leg.platform, "bar", None) for leg in machine.document.legs]
    known = sorted({bar for bar in bars if bar is not None})
    return tuple(np.flatnonzero([bar == one for bar in bars]) for one in known)
