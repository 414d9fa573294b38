"""Residuals of measured board poses and their exact Jacobians, in standard deviations.

A board's pose in a photograph is predicted as ``T_camera_base T_base_platform T_platform_board``,
or ``T_camera_base T_base_board`` for a board fixed to the base ([A] 3.3). Its error is the left
perturbation (omega, tau) that leads from the measured pose to the predicted one, whitened by the
measurement's own noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import dot, pose_difference, skew


@dataclass(frozen=True)
class PoseBlocks:
    """Where the poses are: K configurations of G poses, padded; the same for all runs.

    station, mount, camera : (K, G). present : (K, G) False for padding. on_platform : (M,) of the
    mounts.
    """

    station: Integers
    mount: Integers
    present: Booleans
    on_platform: Booleans
    camera: Integers

    @property
    def count(self) -> int:
        """Poses of a configuration, padding included."""
        return self.station.shape[1]

    @property
    def n_mounts(self) -> int:
        """Number of mounts, M."""
        return len(self.on_platform)


def no_poses() -> PoseBlocks:
    """A session without boards."""
    none = np.zeros((1, 0), dtype=int)
    return PoseBlocks(none, none, none.astype(bool), np.zeros(0, dtype=bool), none)


@dataclass(frozen=True)
class PoseData:
    """Numbers measured in each run; leading axis B, or 1 where all runs share them.

    T_station_target : (B, K, G, 4, 4). whiten : (B, K, G, 6, 6). weight : (B, K, G). optics :
    (B, K, G, 6, w) change of the error by the w unknowns of their camera, as the edges'.
    """

    T_station_target: Array = field(default_factory=lambda: np.zeros((1, 1, 0, 4, 4)))
    whiten: Array = field(default_factory=lambda: np.zeros((1, 1, 0, 6, 6)))
    weight: Array = field(default_factory=lambda: np.zeros((1, 1, 0)))
    optics: Array = field(default_factory=lambda: np.zeros((1, 1, 0, 6, 1)))


class PoseRows(NamedTuple):
    """Rows (B, K, 6G) and their derivatives: by the stations (..., 6), by the platform's pose
    (..., 6) and by the mounts (..., 6), each for its own, (B, K, G, 6, 6); by the camera's unknowns
    (B, K, G, 6, w).
    """

    value: Array
    by_station: Array
    by_own: Array
    by_mount: Array
    by_optics: Array


def pose_rows(
    blocks: PoseBlocks,
    data: PoseData,
    T_camera_base: Array,
    poses: Array,
    T_mount: Array,
    optics: Array,
) -> PoseRows:
    """Whitened errors of the predicted poses.

    T_camera_base (B, S, 4, 4), poses T_base_platform (B, K, 4, 4), T_mount (B, M, 4, 4), optics
    (B, C, w).
    """
    moving = blocks.on_platform[blocks.mount][..., None, None]
    camera = T_camera_base[:, blocks.station]
    body = np.where(moving, poses[:, :, None], np.eye(4))
    mount = T_mount[:, blocks.mount]
    rot_c, rot_b = camera[..., :3, :3], body[..., :3, :3]
    arm = rot_b @ mount[..., :3, 3:]
    place = rot_c @ (arm + body[..., :3, 3:])
    predicted = camera @ body @ mount
    error = pose_difference(predicted, data.T_station_target)
    weigh = np.sqrt(data.weight)[..., None, None] * data.whiten
    turn = turn_jacobian(error[..., :3])

    def rows(by_turn: Array, by_shift_turn: Array, by_shift: Array) -> Array:
        """Derivative by (omega, tau) from those of the pose's turn and place."""
        out = np.zeros((*np.broadcast_shapes(by_turn.shape, place.shape)[:-2], 6, 6))
        out[..., :3, :3], out[..., 3:, :3] = turn @ by_turn, by_shift_turn
        out[..., 3:, 3:] = by_shift
        return weigh @ out

    eye, by_optics = np.eye(3), weigh @ data.optics
    return PoseRows(
        (weigh @ error[..., None] + by_optics @ optics[:, blocks.camera, :, None])[..., 0],
        rows(eye, -skew(place[..., 0]), eye),
        np.where(moving, rows(rot_c, -rot_c @ skew(arm[..., 0]), rot_c), 0.0),
        rows(rot_c @ rot_b, np.zeros((3, 3)), rot_c @ rot_b),
        by_optics,
    )


def turn_jacobian(phi: Array) -> Array:
    """Change of a rotation vector (..., 3) by a further turn from the left, (..., 3, 3).

    The inverse left Jacobian of SO(3), with its series near zero.
    """
    angle2 = dot(phi, phi)[..., None, None]
    small = angle2 < 1e-6
    angle = np.sqrt(np.where(small, 1.0, angle2))
    exact = (1 - 0.5 * angle * np.cos(angle / 2) / np.sin(angle / 2)) / np.where(small, 1, angle2)
    k = skew(phi)
    return np.eye(3) - 0.5 * k + np.where(small, 1 / 12 + angle2 / 720, exact) * (k @ k)
