"""Platform pose from a measured board pose, and its components that the machine cannot move.

``T_base_platform = T_camera_base^-1 T_camera_board T_platform_board^-1``, [C] eq. 6. A machine with
fewer than six degrees of freedom cannot take that pose exactly: it is split into a pose that the
machine can take, and deviations (the tilt of an H4's nacelle, the rotation of a delta's platform)
that are due to noise and model errors. Perturbations are from the left, see
:mod:`pkmcal.geometry.rigid`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import pose, rotation, rotation_vector, skew
from pkmcal.measurements.poses import turn_jacobian


class MeasuredPlatform(NamedTuple):
    """Platform poses (..., 4, 4) and their derivatives.

    by_station, by_mount, by_measured : (..., 6, 6) by T_base_camera, by the mount's pose and by the
    measured pose.
    """

    pose: Array
    by_station: Array
    by_mount: Array
    by_measured: Array


class Taken(NamedTuple):
    """Pose split into a pose that the machine can take, and the deviations from it.

    pose : (..., 4, 4).
    off : (..., 6 - d) deviations.
    by, off_by : (..., 6, 6) and (..., 6 - d, 6), derivatives of both by the whole pose.
    """

    pose: Array
    off: Array
    by: Array
    off_by: Array


def measured_platform(
    T_camera_base: Array, T_camera_board: Array, T_platform_board: Array
) -> MeasuredPlatform:
    """[C] eq. 6 and its derivatives; (..., 4, 4) each, leading axes broadcast."""
    back = T_camera_base[..., :3, :3].mT
    rot = back @ T_camera_board[..., :3, :3] @ T_platform_board[..., :3, :3].mT
    board = (back @ (T_camera_board[..., :3, 3:] - T_camera_base[..., :3, 3:]))[..., 0]
    arm = (rot @ T_platform_board[..., :3, 3:])[..., 0]
    place, camera = board - arm, -(back @ T_camera_base[..., :3, 3:])[..., 0]

    def by(turn: Array, lever: Array) -> Array:
        """Derivative of the pose by a perturbation in a frame rotated by ``turn``, at a distance
        ``lever``.
        """
        out = np.zeros((*place.shape[:-1], 6, 6))
        out[..., :3, :3] = out[..., 3:, 3:] = turn
        out[..., 3:, :3] = skew(lever) @ turn
        return out

    return MeasuredPlatform(
        pose(rot, place), by(np.eye(3), camera - place), by(-rot, arm), by(back, arm)
    )


def taken(motion: Array, whole: Array) -> Taken:
    """Split of a pose for a machine with motion (6, d) of ``MOTION_DIRECTIONS``.

    Rotation, ``R = Exp(s) R_own``: R_own is about z for a machine that turns about z only
    (s is then horizontal), and the identity for one that does not turn. Translations that the
    machine cannot make are deviations as they are.
    """
    # rotation split, translation masked
    can: Booleans = np.any(motion != 0, axis=1)
    own, off, turn_by, off_turn_by = _turn_split(int(can[:3].sum()), whole[..., :3, :3])
    place = np.where(can[3:], whole[..., :3, 3], 0.0)
    missing = np.flatnonzero(~can[3:])
    shape = whole.shape[:-2]
    # derivatives by the whole pose
    by = np.zeros((*shape, 6, 6))
    by[..., :3, :3] = turn_by
    by[..., 3:, 3:] = np.diag(can[3:].astype(float))
    off_by = np.zeros((*shape, off.shape[-1] + len(missing), 6))
    off_by[..., : off.shape[-1], :3] = off_turn_by
    off_by[..., off.shape[-1] + np.arange(len(missing)), 3 + missing] = 1.0
    all_off = np.concatenate([off, whole[..., missing, 3]], axis=-1)
    return Taken(pose(own, place), all_off, by, off_by)


def _turn_split(freedoms: int, rot: Array) -> tuple[Array, Array, Array, Array]:
    """Own rotation (..., 3, 3), deviation (..., k), and their derivatives by the rotation."""
    shape = rot.shape[:-2]
    eye = np.broadcast_to(np.eye(3), (*shape, 3, 3))
    if freedoms == 3:
        return rot, np.zeros((*shape, 0)), eye, np.zeros((*shape, 0, 3))
    if freedoms == 0:
        off = rotation_vector(rot)
        return eye, off, np.zeros((*shape, 3, 3)), turn_jacobian(off)
    # the twist about z with the shortest remaining rotation, from the quaternion's scalar and z
    # parts
    angle = np.arctan2(rot[..., 1, 0] - rot[..., 0, 1], rot[..., 0, 0] + rot[..., 1, 1])
    own = rotation(angle[..., None] * np.array([0.0, 0.0, 1.0]))
    rest = rot @ own.mT
    s = rotation_vector(rest)
    # ds acts through the left Jacobian, dangle along the rotated axis
    columns = np.linalg.inv(turn_jacobian(s))
    basis = np.concatenate([columns[..., :2], rest[..., 2:]], axis=-1)
    back = np.linalg.inv(basis)
    own_by = np.zeros((*shape, 3, 3))
    own_by[..., 2, :] = back[..., 2, :]
    return own, s[..., :2], own_by, back[..., :2, :]
