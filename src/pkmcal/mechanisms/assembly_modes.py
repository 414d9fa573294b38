"""All poses that close a machine at one set of readings: its assembly modes.

A search from random starts, continued until nothing new is likely to come. It proves nothing: what
it can say is how small the share of starts must be that lead to a mode that it did not find.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import from_quaternion, pose, pose_difference, rotation
from pkmcal.mechanisms.closure import base_ends, closure, platform_ends
from pkmcal.mechanisms.kinematics import (
    CONVERGED_CLOSURE_ERROR,
    Closed,
    close,
    scaled_rows,
    typical_reach,
)
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.velocities import assembly_sign, sign_of

STARTS_A_BATCH = 1000
"""Starts at a time."""
RAREST_MODE_FINDS = 10
"""Times that the rarest mode must have been found before the search ends. Were the next rarest
half as likely to be met, it would have been missed with a chance of exp(-5), 0.7 percent."""
MISSED_MODE_CHANCE = 1e-3
"""Chance left that a mode of the share :attr:`AssemblyModes.missing` was missed."""
SAME_MODE_DISTANCE = 1e-6
"""Poses (1 and m) nearer than this are one: where two modes merge, a closure that is right to
1e-14 m leaves 1e-7."""


@dataclass(frozen=True)
class AssemblyModes:
    """Poses (k, 4, 4) that close the machine, the nearest to home first.

    internal : (k, n) the hinges' turns of an articulated platform, rad.
    mode_numbers : (k,) how many starts led to each. sign : (k,) 1 where the Jacobian's determinant
    has
        home's sign, -1 where not: such a mode cannot be reached from home without crossing a
        singular pose; with home's sign it may be. 0 where there is no determinant.
    starts, closed : how many starts were tried, and how many of them led to any pose.
    missing : a mode that is not listed is met by less than this share of the starts that close the
        machine, with 99.9 percent probability; 1 where no start did.
    complete : every mode was found so often that another is unlikely; False where the search was
        stopped by the number of starts before.
    """

    poses: Array
    internal: Array
    mode_numbers: Integers
    sign: Integers
    starts: int
    closed: int
    missing: float
    complete: bool

    def __len__(self) -> int:
        return len(self.poses)


def assembly_modes(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    home: Array,
    rng: np.random.Generator,
    most: int = 100_000,
) -> AssemblyModes:
    """Distinct poses that close the machine at readings (m,); home (4, 4) has its assembly's sign.

    theta : (P,). most : the largest number of starts. Poses whose readings are those of two modes
    that merge, nearer than 1e-6, count as one.
    """
    modes, count = np.zeros((0, 12 + 2 * layout.n_internal)), np.zeros(0, dtype=int)
    starts = closed = 0
    complete = False
    while not complete and starts < most:
        begin, internal = _starts(layout, theta, readings, home, rng)
        at = np.broadcast_to(readings, (STARTS_A_BATCH, readings.shape[-1]))
        result = close(layout, theta, at, begin, internal)
        good = _coordinates(result)[result.error < CONVERGED_CLOSURE_ERROR]
        modes, count = _counted(modes, count, good)
        starts, closed = starts + STARTS_A_BATCH, closed + len(good)
        complete = bool(count.size) and bool(count.min() >= RAREST_MODE_FINDS)
        if not closed and starts >= most // 10:
            break
    poses, internal = _of_coordinates(modes)
    near = np.argsort(np.linalg.norm(pose_difference(poses, home), axis=-1), kind="stable")
    poses, internal, count = poses[near], internal[near], count[near]
    own = sign_of(scaled_rows(closure(layout, theta, readings, poses, internal)))
    sign = (own * assembly_sign(layout, theta, home)).astype(int)
    missing = 1 - MISSED_MODE_CHANCE ** (1 / closed) if closed else 1.0
    return AssemblyModes(poses, internal, count, sign, starts, closed, missing, complete)


def _starts(
    layout: LimbLayout, theta: Array, readings: Array, home: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Poses (n, 4, 4) anywhere that the motion allows, and any turns of the hinges (n, k).

    Turns are evenly spread; the platform's joints come to lie about the base's, at distances of
    about the rods' lengths.
    """
    free = layout.free
    if free[:3].all():
        turn = from_quaternion(rng.normal(size=(STARTS_A_BATCH, 4)))
    else:
        turn = rotation(rng.uniform(-np.pi, np.pi, (STARTS_A_BATCH, 3)) * free[:3])
    rot = turn @ home[:3, :3]
    a = base_ends(layout, theta, readings).a.mean(axis=-2)
    b = platform_ends(layout, theta, pose(rot, np.zeros(3))).b.mean(axis=-2)
    shift = rng.normal(size=(STARTS_A_BATCH, 3)) * typical_reach(layout, theta, readings)
    position = np.where(free[3:], a - b + shift, home[:3, 3])
    return pose(rot, position), rng.uniform(-np.pi, np.pi, (STARTS_A_BATCH, layout.n_internal))


def _coordinates(result: Closed) -> Array:
    """Numbers (n, 12 + 2 k) that are the same where the platform stands the same: the pose's, and
    the hinges' turns as cosines and sines.
    """
    phi = result.internal
    return np.concatenate([result.poses[:, :3].reshape(-1, 12), np.cos(phi), np.sin(phi)], axis=-1)


def _of_coordinates(modes: Array) -> tuple[Array, Array]:
    """Poses (k, 4, 4) and hinges' turns (k, n)."""
    matrix = modes[:, :12].reshape(-1, 3, 4)
    cos, sin = np.split(modes[:, 12:], 2, axis=1)
    return pose(matrix[..., :3], matrix[..., 3]), np.arctan2(sin, cos)


def _counted(modes: Array, value: Integers, more: Array) -> tuple[Array, Integers]:
    """Modes (k, c) and their counts (k,) with more coordinates (n, c) that close the machine."""
    remainder = more
    retained, counts = list(modes), list(value)
    k = 0
    while len(remainder):  # a loop over modes, not over starts
        if k == len(retained):
            retained.append(remainder[0])
            counts.append(0)
        same: Booleans = np.abs(remainder - retained[k]).max(axis=-1) < SAME_MODE_DISTANCE
        counts[k] += int(np.count_nonzero(same))
        remainder = remainder[~same]
        k += 1
    return np.array(retained).reshape(len(retained), modes.shape[1]), np.array(counts, dtype=int)
