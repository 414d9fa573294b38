"""Poses of boards and targets: the measurements of all such kinds, and their rows.

Six rows each, of which a kind may measure a part: predicted as ``T_camera_base T_base_platform
T_platform_board``, or ``T_camera_base T_base_board`` for a board fixed to the base ([A] 3.3). The
error is the left perturbation (omega, tau) that leads from the measured pose to the predicted one,
whitened by the measurement's own noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr, with_zero
from pkmcal.geometry.rigid import dot, perturb, pose_difference, skew
from pkmcal.measurements.rows import among


@dataclass(frozen=True)
class PoseSet:
    """N measured poses.

    station : (N,) index into the session's stations.
    configuration : (N,) row of the readings.
    mount : (N,) number of the target's mount.
    T_station_target : (N, 4, 4) target to station (camera or tracker) coordinates, m.
    whiten : (N, 6, 6) for the left perturbation (omega, tau) of T_station_target, rad and m: whiten
        @ error has unit covariance. Rows of numbers that are not measured (the rotation of a point)
        are zero.
    by_intrinsics : (N, 6, n) derivative of that perturbation by the camera's parameters, with the
        corners' pixels fixed; n = 0 where it is not needed.
    by_focal : (N, 6) derivative by the relative excess of the focal lengths, where these differ
        between images; otherwise zero.
    """

    station: Integers
    configuration: Integers
    mount: Integers
    T_station_target: Array
    whiten: Array
    by_intrinsics: Array = field(default_factory=lambda: np.zeros((0, 6, 0)))
    by_focal: Array = field(default_factory=lambda: np.zeros((0, 6)))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Set absent derivatives to empty or zero ones of the right length."""
        if len(self.by_intrinsics) != len(self.station):
            object.__setattr__(self, "by_intrinsics", np.zeros((len(self.station), 6, 0)))
        if len(self.by_focal) != len(self.station):
            object.__setattr__(self, "by_focal", np.zeros((len(self.station), 6)))

    @classmethod
    def empty(cls) -> PoseSet:
        """A set without poses."""
        none = np.zeros(0, dtype=int)
        return cls(none, none, none, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))

    def __len__(self) -> int:
        return len(self.station)

    @property
    def rows(self) -> Integers:
        """Number (N,) of measured components of each pose, of six."""
        return np.any(self.whiten != 0, axis=-1).sum(axis=-1)

    def select(self, mask: Booleans | Integers) -> PoseSet:
        """The poses selected by a mask or by positions."""
        return PoseSet(*(getattr(self, f.name)[mask] for f in fields(self)))

    def transform(self, change: Array) -> PoseSet:
        """Poses as measured by cameras with other parameters; change : (S, n) of each station's
        camera.

        To first order: a camera's calibration is accurate to a thousandth, so the remainder is a
        millionth.
        """
        n = self.by_intrinsics.shape[-1]
        delta = (self.by_intrinsics @ change[self.station, :n, None])[..., 0]
        return replace(self, T_station_target=perturb(self.T_station_target, delta))


@dataclass(frozen=True)
class PoseBlocks:
    """Positions of the poses: K configurations of G poses, padded; the same for all runs.

    station, mount : (K, G).
    present : (K, G) False for padding.
    on_platform : (M,) whether each mount is on the platform.
    column : (K, G, w) numbers of the unknown effects that change each pose, -1 for none.
    """

    station: Integers
    mount: Integers
    present: Booleans
    on_platform: Booleans
    column: Integers

    def among(self, configurations: slice) -> PoseBlocks:
        """The blocks of some configurations."""
        return replace(among(self, configurations, 0), on_platform=self.on_platform)


@dataclass(frozen=True)
class PoseData:
    """Measured values of each run; leading axis B, or 1 where all runs share them.

    T_station_target : (B, K, G, 4, 4).
    whiten : (B, K, G, 6, 6).
    weight : (B, K, G).
    columns : (B, K, G, 6, w) derivatives of the error, before whitening, by the effects in
        ``PoseBlocks.column``.
    """

    T_station_target: Array
    whiten: Array
    weight: Array
    columns: Array

    def among(self, configurations: slice) -> PoseData:
        """The data of some configurations."""
        return among(self, configurations, 1)


class PoseRows(NamedTuple):
    """Rows (B, K, G, 6) and their derivatives, (B, K, G, 6, 6) each: by their station, by the
    platform's pose and by their mount; by their columns (B, K, G, 6, w).
    """

    value: Array
    by_station: Array
    by_platform: Array
    by_mount: Array
    by_columns: Array


def pose_rows(
    blocks: PoseBlocks,
    data: PoseData,
    T_camera_base: Array,
    poses: Array,
    T_mount: Array,
    columns: Array,
) -> PoseRows:
    """Whitened errors of the predicted poses.

    T_camera_base : (B, S, 4, 4).
    poses : T_base_platform (B, K, 4, 4).
    T_mount : (B, M, 4, 4).
    columns : (B, n) numbers of the effects.
    """
    if not blocks.present.size:
        none = np.zeros((*poses.shape[:2], 0, 6, 6))
        return PoseRows(none[..., 0], none, none, none, none[..., :0])
    moving = blocks.on_platform[blocks.mount][..., None, None]
    camera = T_camera_base[:, blocks.station]
    body = np.where(moving, poses[:, :, None], np.eye(4))
    mount = T_mount[:, blocks.mount]
    # error of the predicted pose, and the inverse left Jacobian of its rotation vector
    rot_c, rot_b = camera[..., :3, :3], body[..., :3, :3]
    arm = rot_b @ mount[..., :3, 3:]
    place = rot_c @ (arm + body[..., :3, 3:])
    predicted = camera @ body @ mount
    error = pose_difference(predicted, data.T_station_target)
    weigh = np.sqrt(data.weight)[..., None, None] * data.whiten
    turn = turn_jacobian(error[..., :3])

    def rows(by_turn: Array, by_shift_turn: Array, by_shift: Array) -> Array:
        """Derivative by (omega, tau) from those of the rotation and the translation."""
        out = np.zeros((*np.broadcast_shapes(by_turn.shape, place.shape)[:-2], 6, 6))
        out[..., :3, :3], out[..., 3:, :3] = turn @ by_turn, by_shift_turn
        out[..., 3:, 3:] = by_shift
        return weigh @ out

    # effects, and derivatives by station, platform and mount
    eye, by_columns = np.eye(3), weigh @ data.columns
    numbers = with_zero(columns)[:, blocks.column]  # the last one is for padding
    value = (weigh @ error[..., None] + by_columns @ numbers[..., None])[..., 0]
    return PoseRows(
        value,
        rows(eye, -skew(place[..., 0]), eye),
        np.where(moving, rows(rot_c, -rot_c @ skew(arm[..., 0]), rot_c), 0.0),
        rows(rot_c @ rot_b, np.zeros((3, 3)), rot_c @ rot_b),
        by_columns,
    )


def turn_jacobian(phi: Array) -> Array:
    """Derivative of a rotation vector (..., 3) by a further rotation from the left, (..., 3, 3).

    The inverse left Jacobian of SO(3), with its series near zero.
    """
    angle2 = dot(phi, phi)[..., None, None]
    small = angle2 < 1e-6
    angle = np.sqrt(np.where(small, 1.0, angle2))
    exact = (1 - 0.5 * angle * np.cos(angle / 2) / np.sin(angle / 2)) / np.where(small, 1, angle2)
    k = skew(phi)
    return np.eye(3) - 0.5 * k + np.where(small, 1 / 12 + angle2 / 720, exact) * (k @ k)
