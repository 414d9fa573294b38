"""Configurations to photograph: within the joints' ranges, reachable, away from singularities."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import dot, perturb
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure, limb_ends
from pkmcal.mechanisms.kinematics import on_manifold, singularity
from pkmcal.simulation.drives import drives_of, reaches

FARTHEST_TILT = np.deg2rad(35)
"""More than universal joints of this kind allow."""
FARTHEST_TURN = 7 / 9
"""Of an articulated platform about z, in the turn at which its own parts are in the way."""
LEAST_SINGULAR = 0.12
"""Smallest singular value of the scaled inverse Jacobian: a reading's error grows by eight."""
GUIDE = 4.0
"""What a guide and its carriage need on the side of the leg, in radii of the leg on it."""
BESIDE = 0.9
"""Cosine of the angle between two guides' backs above which they lie side by side."""
_INSIDE = (0.03, 0.97)


def draw_configurations(
    machine: Machine, count: int, extreme: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Usable poses (n, 4, 4) with their exact readings (n, m), n >= count where possible.

    extreme : share with every leg near one of its ends, which measure offsets best; the other
    configurations are spread evenly over the ranges.
    """
    found, tried = 0, 0
    for attempt in range(6):
        tried = 8 * count * 3**attempt + 60
        poses, joints = _candidates(machine, tried, extreme, rng)
        keep = usable(machine, poses, joints)
        found = int(np.count_nonzero(keep))
        if found >= count:
            return poses[keep], joints[keep]
        if attempt and not found:  # a thousand in vain: more would only keep the user waiting
            break
    raise InputError(
        what=f"mechanism {machine.name!r} has too few usable configurations in its joint ranges",
        found=f"{found} of {tried} tried",
        expected=f"{count}",
        next_step="check the ranges and centres in the mechanism file",
    )


def usable(machine: Machine, T_base_platform: Array, joints: Array) -> Booleans:
    """(n,) True where closed, in the home's assembly, not tilted far, legs clear of each other."""
    layout, values, home = machine.layout, machine.values, machine.home()
    at_home = closure(layout, values, machine.inverse(home[None])[0], home)
    c = closure(layout, values, joints, T_base_platform)
    jac, home_jac = (x.by_pose @ layout.motion for x in (c, at_home))
    good = np.abs(c.value).max(axis=-1) < 1e-9
    # a machine that is weak at home is weak everywhere; it is not refused for that
    least = min(LEAST_SINGULAR, 0.4 * float(singularity(layout, values, at_home.by_pose)))
    good &= singularity(layout, values, c.by_pose) > least
    if jac.shape[-1] == jac.shape[-2]:
        good &= np.sign(np.linalg.det(jac)) == np.sign(np.linalg.det(home_jac))
    good &= T_base_platform[..., 2, 2] * np.sign(home[2, 2]) > np.cos(FARTHEST_TILT)
    good &= unfolded(machine, T_base_platform)
    return good & _legs_apart(machine, T_base_platform, joints)


def unfolded(machine: Machine, T_base_platform: Array) -> Booleans:
    """(n,) True where the parts of an articulated platform, if it is one, stand apart."""
    turn = np.arctan2(T_base_platform[..., 1, 0], T_base_platform[..., 0, 0])
    return np.abs(turn) < FARTHEST_TURN * machine.most_turn[0]


def _candidates(
    machine: Machine, n: int, extreme: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Poses and readings that close the machine, usable or not."""
    ranges = machine.joint_ranges
    # three percent inside the range: a drive that stands at its stop reads nothing new
    share = rng.uniform(*_INSIDE, (n, machine.n_joints))
    ends = np.where(rng.random(share.shape) < 0.5, *_INSIDE)
    share = np.where(rng.random((n, 1)) < extreme, ends, share)
    if ranges.size and np.isfinite(ranges).all():
        wanted = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        found = machine.forward_result(wanted)
        poses = found.T_base_platform[found.converged]
    else:
        poses = _around_home(machine, n, rng)
    joints = machine.inverse(poses)
    finite = np.isfinite(joints).all(axis=-1)
    return poses[finite], joints[finite]


def _around_home(machine: Machine, n: int, rng: np.random.Generator) -> Array:
    """Poses near home, for machines whose file gives no ranges: 15 degrees, an eighth of size.

    Only those that constant rods and joints' axes allow.
    """
    a, b = (ends[0] for ends in reaches(machine))
    size = float(np.linalg.norm(np.concatenate([a, b]) - a.mean(axis=0), axis=1).max())
    scale = np.array([0.26, 0.26, 0.26, *np.full(3, 0.125 * size)])
    motion = machine.layout.motion
    delta = rng.uniform(-1, 1, (n, 6)) * scale @ motion @ motion.T
    found = on_manifold(machine.layout, machine.values, perturb(machine.home(), delta))
    return found.T_base_platform[found.converged]


def _legs_apart(machine: Machine, T_base_platform: Array, joints: Array) -> Booleans:
    """(n,) True where no two legs come nearer than their tubes are thick, nor a leg to a guide of
    another.
    """
    ends = limb_ends(machine.layout, machine.values, joints, T_base_platform)
    along = np.linspace(0.06, 0.97, 24)[:, None]
    points = ends.a[..., None, :] * (1 - along) + ends.b[..., None, :] * along
    widths = np.array([r.max() if len(r) else 0.0 for r in machine.radii()])
    drives = drives_of(machine)
    apart = np.ones(T_base_platform.shape[0], dtype=bool)
    for i, j in np.ndindex(machine.n_legs, machine.n_legs):
        if j < i:
            gap = points[:, i, :, None] - points[:, j, None, :]
            apart &= np.sqrt(dot(gap, gap).min(axis=(-1, -2))) > widths[i] + widths[j]
        # carriages side by side on one guide have their own legs beside it
        if j != i and drives.guides[j] and drives.away[i] @ drives.away[j] <= BESIDE:
            for start, stop in pairwise(drives.ways[j]):
                axis = (stop - start) / np.linalg.norm(stop - start)
                s = np.clip((points[:, i] - start) @ axis, 0, (stop - start) @ axis)
                gap = points[:, i] - start - s[..., None] * axis
                apart &= np.sqrt(dot(gap, gap).min(axis=-1)) > widths[i] + GUIDE * widths[j]
    return apart
