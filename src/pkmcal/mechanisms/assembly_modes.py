"""Assembly modes: all poses that close a machine at one set of readings.

The search uses random starts and stops when further modes are unlikely. It is no proof; the result
states a bound on the share of starts that lead to a mode not found.
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


@dataclass(frozen=True)
class AssemblyModeOptions:
    """Constants of the search for assembly modes."""

    # random starts in one batch
    batch: int = 1000
    # number of times that each mode must be found before the search ends: a mode half as likely as
    # the rarest one would have been missed with probability exp(-5), 0.7 percent (statistical)
    finds: int = 10
    # probability that a mode with the share ``missing`` was missed (statistical)
    missed: float = 0.001
    # largest difference of coordinates (1 and m) of one mode. Where two modes merge, a closure
    # error of 1e-14 m leaves an uncertainty of 1e-7 (numerical)
    same: float = 1e-6


ASSEMBLY_MODE_OPTIONS = AssemblyModeOptions()


@dataclass(frozen=True)
class AssemblyModes:
    """Poses (k, 4, 4) that close the machine, in the order of their distance from home.

    internal : (k, n) hinge angles of an articulated platform, rad.
    mode_numbers : (k,) number of starts that led to each mode.
    sign : (k,) 1 if the Jacobian's determinant has the sign it has at home, -1 if not: such a mode
        cannot be reached from home without crossing a singular pose, others may be. 0 without a
        determinant.
    starts, closed : number of starts, and of those that led to any pose.
    missing : upper bound of the share of closed starts that lead to a mode not listed, exceeded
        with the probability ``missed`` of the options; 1 if no start closed.
    complete : whether each mode was found often enough; False if the number of starts
        ended the search.
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
    options: AssemblyModeOptions = ASSEMBLY_MODE_OPTIONS,
) -> AssemblyModes:
    """Distinct poses that close the machine at readings (m,).

    theta : (P,).
    home : (4, 4) pose of the assembly that defines the sign.
    most : largest number of starts.

    Modes that nearly merge, nearer than the options allow, count as one.
    """
    modes, count = np.zeros((0, 12 + 2 * layout.n_internal)), np.zeros(0, dtype=int)
    starts = closed = 0
    complete = False
    while not complete and starts < most:
        begin, internal = _random_starts(layout, theta, readings, home, rng, options)
        at = np.broadcast_to(readings, (options.batch, readings.shape[-1]))
        result = close(layout, theta, at, begin, internal)
        good = _coordinates(result)[result.error < CONVERGED_CLOSURE_ERROR]
        modes, count = _count_by_mode(modes, count, good, options)
        starts, closed = starts + options.batch, closed + len(good)
        complete = bool(count.size) and bool(count.min() >= options.finds)
        if not closed and starts >= most // 10:
            break
    poses, internal = _poses_of_coordinates(modes)
    near = np.argsort(np.linalg.norm(pose_difference(poses, home), axis=-1), kind="stable")
    poses, internal, count = poses[near], internal[near], count[near]
    own = sign_of(scaled_rows(closure(layout, theta, readings, poses, internal)))
    sign = (own * assembly_sign(layout, theta, home)).astype(int)
    missing = 1 - options.missed ** (1 / closed) if closed else 1.0
    return AssemblyModes(poses, internal, count, sign, starts, closed, missing, complete)


def _random_starts(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    home: Array,
    rng: np.random.Generator,
    options: AssemblyModeOptions,
) -> tuple[Array, Array]:
    """Random poses (n, 4, 4) in the motion's freedoms, and random hinge angles (n, k).

    Rotations are uniform. Positions put the platform's joints around the base's, at distances of
    about the rods' lengths.
    """
    free = layout.free
    if free[:3].all():
        turn = from_quaternion(rng.normal(size=(options.batch, 4)))
    else:
        turn = rotation(rng.uniform(-np.pi, np.pi, (options.batch, 3)) * free[:3])
    rot = turn @ home[:3, :3]
    a = base_ends(layout, theta, readings).a.mean(axis=-2)
    b = platform_ends(layout, theta, pose(rot, np.zeros(3))).b.mean(axis=-2)
    shift = rng.normal(size=(options.batch, 3)) * typical_reach(layout, theta, readings)
    position = np.where(free[3:], a - b + shift, home[:3, 3])
    return pose(rot, position), rng.uniform(-np.pi, np.pi, (options.batch, layout.n_internal))


def _coordinates(result: Closed) -> Array:
    """Coordinates (n, 12 + 2 k) that are unique to a configuration of the platform: rows of the
    pose, cosines and sines of the hinge angles.
    """
    phi = result.internal
    return np.concatenate([result.poses[:, :3].reshape(-1, 12), np.cos(phi), np.sin(phi)], axis=-1)


def _poses_of_coordinates(modes: Array) -> tuple[Array, Array]:
    """Poses (k, 4, 4) and hinge angles (k, n) of :func:`_coordinates`."""
    matrix = modes[:, :12].reshape(-1, 3, 4)
    cos, sin = np.split(modes[:, 12:], 2, axis=1)
    return pose(matrix[..., :3], matrix[..., 3]), np.arctan2(sin, cos)


def _count_by_mode(
    modes: Array, count: Integers, closed: Array, options: AssemblyModeOptions
) -> tuple[Array, Integers]:
    """Modes (k, c) and their counts (k,), updated with the coordinates (n, c) of further closed
    starts.
    """
    unassigned = closed
    distinct, counts = list(modes), list(count)
    k = 0
    while len(unassigned):  # one round for each mode, not for each start
        if k == len(distinct):
            distinct.append(unassigned[0])
            counts.append(0)
        same: Booleans = np.abs(unassigned - distinct[k]).max(axis=-1) < options.same
        counts[k] += int(np.count_nonzero(same))
        unassigned = unassigned[~same]
        k += 1
    return np.array(distinct).reshape(len(distinct), modes.shape[1]), np.array(counts, dtype=int)
