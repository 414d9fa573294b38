"""Registration of measured poses to a machine by its legs' lengths, without forward kinematics.

Legs that do not hold the platform, such as four cables of a spatial one, have no pose at given
readings. Where whole poses T were measured, each leg alone determines its joint a in the station's
frame and its joint b in the target's. With the length l by the nominal model, off by a constant o,
``|R b + t - a| = l + o`` is linear in a, b, o and their products ([A] 13, squared)::

    t.t - l^2 = 2 a.t - 2 (R^T t).b + 2 R : a b^T + 2 l o + c,   c = o^2 - a.a - b.b

The nominal joints registered to all a and all b give the station's and the mount's pose, which the
closure at the measured poses refines by Gauss-Newton.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import dot, inverse, perturb, register, skew
from pkmcal.measurements import PoseSet
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import Closure, base_ends, closure

LEG_UNKNOWNS = 17
"""Unknowns of a leg's linear equations: a, b, the nine products, the length's error, a constant."""
REFINING_STEPS = 8
"""Gauss-Newton steps; from the linear solution the second one leaves the poses' noise."""


class Registered(NamedTuple):
    """Poses T_camera_base and T_mount (N, 4, 4), and the mean squares (N, n) of the closure's
    residuals at each measured pose, in their standard deviations; infinite where there are none.
    """

    T_camera_base: Array
    T_mount: Array
    squares: Array


def determines_legs(poses: PoseSet) -> bool:
    """Whether poses are whole, of one station and mount, and enough to determine each leg alone."""
    one = np.ptp(poses.station) == 0 and np.ptp(poses.mount) == 0 if len(poses) else False
    return bool(one) and len(poses) > LEG_UNKNOWNS and bool((poses.rows == 6).all())


def register_by_lengths(
    machine: Machine, joints: Array, observed: Array, whiten: Array, joint_noise: float
) -> Registered:
    """Registration of N runs of n poses of one station and one mount.

    joints : (N, n, m) readings.
    observed : (N, n, 4, 4) T_station_target, n > LEG_UNKNOWNS.
    whiten : (n, 6, 6) whitening of the poses' noise.
    """
    base, target = _start(machine, joints, observed)
    noise = np.linalg.inv(whiten)
    best = np.full(observed.shape[:2], np.inf)
    pair = base, target
    for _ in range(REFINING_STEPS):
        poses = base[:, None] @ observed @ target[:, None]
        c = closure(machine.layout, machine.values, joints, poses)
        sigma = _sigma(c, base, target, observed, noise, joint_noise)
        value = c.rows.value / sigma
        squares = np.mean(value**2, axis=-1)
        better = np.sum(squares, axis=1) < np.sum(best, axis=1)
        best = np.where(better[:, None], squares, best)
        pair = tuple(
            np.where(better[:, None, None], new, old)
            for new, old in zip((base, target), pair, strict=True)
        )
        rows = np.nan_to_num(_by_frames(c, base, observed) / sigma[..., None])
        rows = rows.reshape(len(rows), -1, 12)
        step = np.linalg.pinv(rows) @ np.nan_to_num(value).reshape(len(rows), -1, 1)
        base = perturb(base, -step[:, :6, 0])
        target = perturb(target, -step[:, 6:, 0])
    return Registered(inverse(pair[0]), inverse(pair[1]), best)


def _start(machine: Machine, joints: Array, observed: Array) -> tuple[Array, Array]:
    """Poses T_base_station and T_target_platform (N, 4, 4) by the legs' linear equations."""
    length = base_ends(machine.layout, machine.values, joints).length
    rot, t = observed[..., :3, :3], observed[..., :3, 3]
    own = (rot.mT @ t[..., None])[..., 0]
    common = np.concatenate([2 * t, -2 * own, 2 * rot.reshape(*t.shape[:-1], 9)], axis=-1)
    ends = list[Array]()
    for leg in range(machine.n_legs):
        one = length[..., leg, None]
        matrix = np.concatenate([common, 2 * one, np.ones_like(one)], axis=-1)
        right = dot(t, t)[..., None] - one**2
        ends.append((np.linalg.pinv(matrix) @ right)[..., :6, 0])
    a, b = np.split(np.stack(ends, axis=-2), 2, axis=-1)
    base = register(a, np.broadcast_to(machine.base_centers(), a.shape))
    return base, register(np.broadcast_to(machine.platform_centers(), b.shape), b)


def _by_frames(c: Closure, base: Array, observed: Array) -> Array:
    """Derivatives (N, n, E, 12) of the closure by T_base_station and T_target_platform."""
    turned = (base[:, None] @ observed)[..., :3, :3]
    arm = c.poses[..., :3, 3] - base[:, None, :3, 3]
    by_turn, by_shift = np.split(c.rows.by_pose, 2, axis=-1)
    of_target = (by @ turned for by in (by_turn, by_shift))
    return np.concatenate([by_turn - by_shift @ skew(arm), by_shift, *of_target], axis=-1)


def _sigma(
    c: Closure, base: Array, target: Array, observed: Array, noise: Array, joint_noise: float
) -> Array:
    """Standard deviations (N, n, E) of the closure's rows, m, by readings and measured poses.

    noise : (n, 6, 6) square root of the poses' covariance.
    """
    rot = base[:, None, :3, :3]
    arm = (observed[..., :3, :3] @ target[:, None, :3, 3, None])[..., 0]
    by_turn, by_shift = np.split(c.rows.by_pose, 2, axis=-1)
    by_shift = by_shift @ rot
    by = np.concatenate([by_turn @ rot - by_shift @ skew(arm), by_shift], axis=-1) @ noise
    return np.sqrt(np.sum(by**2, axis=-1) + (joint_noise * c.by_reading) ** 2)
