"""Candidate configurations of the machine and candidate poses of a camera, from which a plan
chooses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.drives import ball_of, legs_space
from pkmcal.mechanisms.kinematics import on_manifold
from pkmcal.placement.configurations import READING_RANGE_SHARES, draw_configurations, usable
from pkmcal.placement.stations import PANORAMIC_HALF_VIEW, StationPose, fitting_distance, view_angle
from pkmcal.session.schema import BoardBody

CAMERA_RING_HEIGHTS = np.deg2rad([5.0, 22.0, 40.0, 60.0])
"""Elevations of the rings: angles of the line of sight above the ground, rad."""
NEIGHBOUR_RANGE_SHARE = 0.12
"""Maximum change of a reading, relative to the motor's range, by which a configuration is
varied.
"""
NEIGHBOURS_TRIED_EACH = 6
"""Number of variations of each chosen configuration."""


class Configurations(NamedTuple):
    """Configurations of a machine: readings joints (K, m), poses T_base_platform (K, 4, 4)."""

    joints: Array
    T_base_platform: Array


def configurations(machine: Machine, count: int, rng: np.random.Generator) -> Configurations:
    """Draw about ``count`` feasible configurations, spread over the ranges of the joints.

    Half of them have every motor near an end of its range, where offsets and centres are determined
    best; the others lie between. All are in range, closed, in the assembly mode of the home pose,
    away from singular poses, and their legs do not touch. Raises InputError if there are too few.
    """
    parts = [
        draw_configurations(machine, max(count // 2, 1), extreme, rng)[0][: max(count // 2, 1)]
        for extreme in (1.0, 0.0)
    ]
    poses = np.concatenate(parts)
    return Configurations(machine.inverse(poses), poses)


def neighbours(
    machine: Machine, chosen: Configurations, rng: np.random.Generator
) -> Configurations:
    """Feasible variations of the chosen configurations.

    Readings are varied if all motors have finite ranges, else poses are varied within the machine's
    motion; as many of NEIGHBOURS_TRIED_EACH variations as are feasible remain.
    """
    joints = np.repeat(chosen.joints, NEIGHBOURS_TRIED_EACH, axis=0)
    poses = np.repeat(chosen.T_base_platform, NEIGHBOURS_TRIED_EACH, axis=0)
    low, high = machine.joint_ranges.T
    if np.isfinite(machine.joint_ranges).all():
        # vary the readings within the ranges
        step = NEIGHBOUR_RANGE_SHARE * (high - low)
        ends = [low + share * (high - low) for share in READING_RANGE_SHARES]
        wanted = np.clip(joints + rng.uniform(-1, 1, joints.shape) * step, *ends)
        fk = machine.forward_result(wanted, poses)
        poses = fk.T_base_platform[fk.converged]
    else:
        # vary the poses within the machine's motion
        size = float(np.ptp(chosen.T_base_platform[:, :3, 3], axis=0).max())
        unit = np.array([NEIGHBOUR_RANGE_SHARE] * 3 + [NEIGHBOUR_RANGE_SHARE * size] * 3)
        motion = machine.layout.motion
        delta = rng.uniform(-1, 1, (len(poses), 6)) * unit @ motion @ motion.T
        projected = on_manifold(machine.layout, machine.values, perturb(poses, delta))
        poses = projected.T_base_platform[projected.converged]
    joints = machine.inverse(poses)
    finite = np.isfinite(joints).all(axis=-1)
    poses, joints = poses[finite], joints[finite]
    good = usable(machine, poses, joints)
    return Configurations(joints[good], poses[good])


def camera_ring_poses(
    machine: Machine, camera: Camera, poses_a_ring: int, board: BoardBody | None = None
) -> tuple[StationPose, ...]:
    """Poses of a camera on a sphere around the machine, at the distance at which it fills the
    image.

    board : body that carries a board, for which there must be room; None without a board. Raises
    InputError for a panoramic camera, whose best pose is between the legs.
    """
    if view_angle(camera) > PANORAMIC_HALF_VIEW:
        raise InputError(
            what="an omnidirectional camera belongs in the middle of the legs, so no station around"
            " the machine is planned",
            where="--places",
            next_step="give its pose in session.yaml, between the legs",
        )
    centre, radius = ball_of(legs_space(machine))
    away = fitting_distance(machine, camera, board) * radius
    out: list[StationPose] = []
    for k, height in enumerate(CAMERA_RING_HEIGHTS):
        for azimuth in 2 * np.pi * (np.arange(poses_a_ring) + 0.5 * (k % 2)) / poses_a_ring:
            level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            direction = np.cos(height) * level + np.array([0.0, 0.0, np.sin(height)])
            out.append(StationPose(_tuple(centre + away * direction), _tuple(centre)))
    return tuple(out)


def _tuple(v: Array) -> tuple[float, float, float]:
    x, y, z = (round(float(c), 3) for c in v)
    return x, y, z
