"""Where a board sits on its body, to begin with: the mean of what the photographs say."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import inverse, pose
from pkmcal.identify.problem import Measurements


def start_mounts(measurements: Measurements, T_camera_base: Array, poses: Array) -> Array:
    """T_mount (M, 4, 4) from the measured poses, the stations' and the platform's.

    T_camera_base : (S, 4, 4). poses : T_base_platform (K, 4, 4).
    """
    seen, on_platform = measurements.poses, measurements.on_platform
    body = T_camera_base[seen.station]
    body = np.where(on_platform[seen.mount][:, None, None], body @ poses[seen.configuration], body)
    each = inverse(body) @ seen.T_station_target
    mounts = [mean_pose(each[seen.mount == m]) for m in range(len(measurements.mounts))]
    return np.array(mounts).reshape(-1, 4, 4)


def mean_pose(poses: Array) -> Array:
    """The pose (4, 4) nearest to poses (n, 4, 4); the identity of none."""
    if not len(poses):
        return np.eye(4)
    u, _, vt = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    rot = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return pose(rot, np.median(poses[:, :3, 3], axis=0))
