"""The platform's pose out of a measured board's, and what of it the machine cannot move.

``T_base_platform = T_camera_base^-1 T_camera_board T_platform_board^-1``, [C] eq. 6. A machine with
fewer than six freedoms cannot take that pose exactly: it is told as a pose that it can take, and as
what is *off* (the tilt of an H4's nacelle, the turn of a delta's platform), which only noise and a
wrong model explain. Perturbations are from the left, see :mod:`pkmcal.geometry.rigid`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import pose, rotation, rotation_vector, skew
from pkmcal.measurements.poses import turn_jacobian


class MeasuredPlatform(NamedTuple):
    """Platform poses (..., 4, 4) and their change (..., 6, 6) by T_base_camera, by the mount's pose
    and by the measured one.
    """

    pose: Array
    by_station: Array
    by_mount: Array
    by_measured: Array


class Taken(NamedTuple):
    """A pose split: what the machine can take (..., 4, 4), what is off (..., 6 - d), and the
    change of both by the whole pose's, (..., 6, 6) and (..., 6 - d, 6).
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
        """The pose's change where what is perturbed turns and shifts it by ``turn``."""
        out = np.zeros((*place.shape[:-1], 6, 6))
        out[..., :3, :3] = out[..., 3:, 3:] = turn
        out[..., 3:, :3] = skew(lever) @ turn
        return out

    return MeasuredPlatform(
        pose(rot, place), by(np.eye(3), camera - place), by(-rot, arm), by(back, arm)
    )


def taken(motion: Array, whole: Array) -> Taken:
    """A pose as the machine can take it; motion (6, d) of ``MOTION_DIRECTIONS``.

    Of the turn, ``R = Exp(s) R_own``: R_own about z where the machine turns about z alone (s is
    then horizontal), none where it does not turn. Places that it cannot take are off as they are.
    """
    can: Booleans = np.any(motion != 0, axis=1)
    own, off, turn_by, off_turn_by = _turn_split(int(can[:3].sum()), whole[..., :3, :3])
    place = np.where(can[3:], whole[..., :3, 3], 0.0)
    missing = np.flatnonzero(~can[3:])
    shape = whole.shape[:-2]
    by = np.zeros((*shape, 6, 6))
    by[..., :3, :3] = turn_by
    by[..., 3:, 3:] = np.diag(can[3:].astype(float))
    off_by = np.zeros((*shape, off.shape[-1] + len(missing), 6))
    off_by[..., : off.shape[-1], :3] = off_turn_by
    off_by[..., off.shape[-1] + np.arange(len(missing)), 3 + missing] = 1.0
    all_off = np.concatenate([off, whole[..., missing, 3]], axis=-1)
    return Taken(pose(own, place), all_off, by, off_by)


def _turn_split(freedoms: int, rot: Array) -> tuple[Array, Array, Array, Array]:
    """Own turn (..., 3, 3), what is off (..., k), and their changes by the turn's."""
    shape = rot.shape[:-2]
    eye = np.broadcast_to(np.eye(3), (*shape, 3, 3))
    if freedoms == 3:
        return rot, np.zeros((*shape, 0)), eye, np.zeros((*shape, 0, 3))
    if freedoms == 0:
        off = rotation_vector(rot)
        return eye, off, np.zeros((*shape, 3, 3)), turn_jacobian(off)
    # the twist about z that leaves the shortest turn, by the quaternion's scalar and z parts
    angle = np.arctan2(rot[..., 1, 0] - rot[..., 0, 1], rot[..., 0, 0] + rot[..., 1, 1])
    own = rotation(angle[..., None] * np.array([0.0, 0.0, 1.0]))
    rest = rot @ own.mT
    s = rotation_vector(rest)
    # a change of s turns by the left Jacobian, a change of the angle by the axis carried along
    columns = np.linalg.inv(turn_jacobian(s))
    basis = np.concatenate([columns[..., :2], rest[..., 2:]], axis=-1)
    back = np.linalg.inv(basis)
    own_by = np.zeros((*shape, 3, 3))
    own_by[..., 2, :] = back[..., 2, :]
    return own, s[..., :2], own_by, back[..., :2, :]
