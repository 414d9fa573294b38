"""Configurations of a machine for a session: within the joints' ranges, reachable, and away from
singular poses.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import InputError
from pkmcal.geometry.cylinders import segment_distance
from pkmcal.geometry.rigid import dot, perturb, pose_difference
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure
from pkmcal.mechanisms.drives import drives_of, reaches
from pkmcal.mechanisms.kinematics import on_manifold, scaled_rows, singularity_of
from pkmcal.mechanisms.velocities import sign_of
from pkmcal.wording import listed

FARTHEST_TILT = np.deg2rad(35)
"""Largest tilt of the platform, in rad; more than the universal joints of such machines allow."""
FARTHEST_TURN = 7 / 9
"""Largest turn of an articulated platform about z, relative to the turn at which its parts collide.
"""
LEAST_SINGULAR = 0.12
"""Smallest singular value of the scaled inverse Jacobian; here a reading's error grows by eight."""
GUIDE_SIDE_ROOM = 4.0
"""Clearance beside a guide for rail and carriage, in radii of the leg on it."""
SIDE_BY_SIDE = 0.9
"""Cosine of the angle between two guides' backs above which the guides lie side by side."""
LEG_MIDDLE = (0.06, 0.97)
"""Part of a leg, from A to B, that is compared with other legs and guides."""
GUIDE_SAMPLES = 24
"""Points of a leg that are compared with a guide."""
READING_RANGE_SHARES = (0.03, 0.97)
"""Shares of a joint's range between which readings are drawn, away from the stops."""


def check_drawable(machine: Machine) -> None:
    """Raise `InputError` for a machine whose parts' positions do not follow from the pose and
    readings.
    """
    layout, legs = machine.layout, machine.document.legs
    hinged = {legs[j].platform.joint for j in np.flatnonzero(layout.internal >= 0)}
    if hinged:
        raise InputError(
            what=f"mechanism {machine.name!r} has side bars that turn on hinges, and how far they"
            " turn is not known where it is drawn",
            expected=f"platform joints other than {listed(sorted(hinged))}",
            next_step="take the machine with one rod a forearm, such as h4",
        )


def draw_configurations(
    machine: Machine, count: int, extreme: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Usable poses (n, 4, 4) with their exact readings (n, m), n >= count.

    extreme : share of configurations with every leg near an end of its range, which determine
    offsets best; the others are spread evenly over the ranges. Raises InputError if too few
    candidates are usable.
    """
    value, tried = 0, 0
    for attempt in range(6):
        tried = 8 * count * 3**attempt + 60
        poses, joints = _candidates(machine, tried, extreme, rng)
        keep = usable(machine, poses, joints)
        value = int(np.count_nonzero(keep))
        if value >= count:
            return poses[keep], joints[keep]
        if attempt and not value:  # a thousand candidates failed: more only make the user wait
            break
    raise InputError(
        what=f"mechanism {machine.name!r} has too few usable configurations in its joint ranges",
        found=f"{value} of {tried} tried",
        expected=f"{count}",
        next_step="check the ranges and centres in the mechanism file",
        code="mechanism.few_configurations",
    )


def usable(machine: Machine, T_base_platform: Array, joints: Array) -> Booleans:
    """(n,) True where closed, in home's assembly mode, not singular, not tilted far, and legs are
    apart.
    """
    layout, values, home = machine.layout, machine.values, machine.home()
    c = closure(layout, values, joints, T_base_platform)
    at_home = closure(layout, values, machine.inverse(home[None])[0], home)
    rows, home_rows = scaled_rows(c), scaled_rows(at_home)
    good = np.abs(c.rows.value).max(axis=-1) < 1e-9
    # a machine that is close to singular at home is so everywhere, and is not refused for that
    good &= singularity_of(rows) > min(LEAST_SINGULAR, 0.4 * float(singularity_of(home_rows)))
    good &= sign_of(rows) == sign_of(home_rows)
    good &= T_base_platform[..., 2, 2] * np.sign(home[2, 2]) > np.cos(FARTHEST_TILT)
    good &= platform_unfolded(machine, T_base_platform)
    return good & _legs_apart(machine, T_base_platform, joints)


def platform_unfolded(machine: Machine, T_base_platform: Array) -> Booleans:
    """(n,) True where the parts of an articulated platform do not collide; True for a rigid
    platform.
    """
    turn = np.arctan2(T_base_platform[..., 1, 0], T_base_platform[..., 0, 0])
    return np.abs(turn) < FARTHEST_TURN * machine.most_turn[0]


def _candidates(
    machine: Machine, n: int, extreme: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Poses and readings that satisfy the closure equations, usable or not."""
    ranges = machine.joint_ranges
    share = rng.uniform(*READING_RANGE_SHARES, (n, machine.n_joints))
    ends = np.where(rng.random(share.shape) < 0.5, *READING_RANGE_SHARES)
    if not machine.layout.overdetermined:  # else no pose has every leg near an end
        share = np.where(rng.random((n, 1)) < extreme, ends, share)
    if ranges.size and np.isfinite(ranges).all():
        wanted = ranges[:, 0] + share * (ranges[:, 1] - ranges[:, 0])
        fk = machine.forward_result(wanted)
        # readings of a redundantly driven machine cannot be chosen freely: take the nearest pose
        near = fk.converged | machine.layout.overdetermined
        poses = fk.T_base_platform[near]
    else:
        poses = _around_home(machine, n, rng)
    joints = machine.inverse(poses)
    finite = np.isfinite(joints).all(axis=-1)
    if machine.layout.overdetermined:
        # the nearest poses may be beyond the ranges, or in an assembly mode that is not home's
        finite &= ~((joints < ranges[:, 0]) | (joints > ranges[:, 1])).any(axis=-1)
        # the nearest pose to random lengths may be turned so far that cables would cross
        finite &= same_mode(poses, machine.home())
        poses, joints = poses[finite], joints[finite]
        finite = same_mode(machine.forward_result(joints).T_base_platform, poses)
    return poses[finite], joints[finite]


def same_mode(T_base_platform: Array, near: Array) -> Booleans:
    """(n,) True where two poses (n, 4, 4) are turned to each other by less than another assembly
    mode of a machine with extra rods would be.
    """
    turn = np.linalg.norm(pose_difference(T_base_platform, near)[..., :3], axis=-1)
    return np.asarray(turn < FARTHEST_TILT)


def _around_home(machine: Machine, n: int, rng: np.random.Generator) -> Array:
    """Poses near home for machines without joint ranges.

    Within 15 degrees and an eighth of the machine's size; only poses that constant rods and joint
    axes allow.
    """
    a, b = (ends[0] for ends in reaches(machine))
    size = float(np.linalg.norm(np.concatenate([a, b]) - a.mean(axis=0), axis=1).max())
    scale = np.array([0.26, 0.26, 0.26, *np.full(3, 0.125 * size)])
    motion = machine.layout.motion
    delta = rng.uniform(-1, 1, (n, 6)) * scale @ motion @ motion.T
    value = on_manifold(machine.layout, machine.values, perturb(machine.home(), delta))
    return value.T_base_platform[value.converged]


def leg_distances(ends: tuple[Array, Array]) -> Array:
    """Smallest distances (n, L, L), m, between the axes of legs j < i without their ends; infinite
    elsewhere.

    ends : points A and B (n, L, 3) of the rods.
    """
    start, stop = ((1 - share) * ends[0] + share * ends[1] for share in LEG_MIDDLE)
    nearest = np.full((*start.shape[:2], start.shape[1]), np.inf)
    for i, j in zip(*np.tril_indices(start.shape[1], -1), strict=True):
        nearest[:, i, j] = segment_distance(start[:, i], stop[:, i], start[:, j], stop[:, j])
    return nearest


def touching_legs(ends: tuple[Array, Array], nearest: Array, radii: Array) -> Booleans:
    """(n, L, L) True where legs j < i touch, but for legs with a common joint.

    nearest : :func:`leg_distances`. radii : (L,) of the legs, m.
    """
    thick = radii[:, None] + radii
    meet = np.zeros(nearest.shape, dtype=bool)
    for end in ends:
        gap = end[:, :, None] - end[:, None]
        meet |= np.linalg.norm(gap, axis=-1) < thick
    return (nearest <= thick) & ~meet


def _legs_apart(machine: Machine, T_base_platform: Array, joints: Array) -> Booleans:
    """(n,) True where no two legs come nearer than their radii, nor a leg near another leg's guide.

    Legs with a common joint are exempt, as in nominal models that reduce the platform to a point:
    such legs come near each other nowhere else.
    """
    ends = machine.ends_at(joints, T_base_platform).rods
    along = np.linspace(*LEG_MIDDLE, GUIDE_SAMPLES)[:, None]
    points = ends[0][..., None, :] * (1 - along) + ends[1][..., None, :] * along
    widths = np.array([r.max() if len(r) else 0.0 for r in machine.radii()])
    drives = drives_of(machine)
    touching = touching_legs(ends, leg_distances(ends), widths)
    apart: Booleans = ~np.asarray(touching.any(axis=(-1, -2)))
    for i, j in np.ndindex(machine.n_legs, machine.n_legs):
        # the legs of carriages side by side on one guide are beside that guide
        if j != i and drives.guides[j] and drives.away[i] @ drives.away[j] <= SIDE_BY_SIDE:
            for start, stop in pairwise(drives.ways[j]):
                axis = (stop - start) / np.linalg.norm(stop - start)
                s = np.clip((points[:, i] - start) @ axis, 0, (stop - start) @ axis)
                gap = points[:, i] - start - s[..., None] * axis
                apart &= (
                    np.sqrt(dot(gap, gap).min(axis=-1)) > widths[i] + GUIDE_SIDE_ROOM * widths[j]
                )
    return apart
