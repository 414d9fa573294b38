"""Uncertainty of a calibrated camera's projection.

A point stands still relative to the boards of all views. A calibration from other images of the
same kind has other intrinsics and sees the boards, and the point, elsewhere in the camera frame.
The change of the point's place is the mean of what the boards' changes make of it; the uncertainty
of the projection is that of its pixel. What a rotation or translation of the camera frame undoes
does not count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.contract import Camera
from pkmcal.geometry.rigid import skew


class BoardMotion(NamedTuple):
    """Mean motion of the views' boards in the camera frame, when the data change by their noise.

    A motion is a rotation about the camera's centre (rad) and a translation (m). by_intrinsics :
    (6, n) derivative by the intrinsics. covariance : (6, 6) of what is independent of these.
    """

    by_intrinsics: Array
    covariance: Array


def board_motion(
    T_camera_board: Array, pose_covariance: Array, by_intrinsics: Array, covariance: Array
) -> BoardMotion:
    """Mean motion of V boards.

    T_camera_board : (V, 4, 4). pose_covariance : (V, 6, 6), left perturbation, with the
    intrinsics' uncertainty. by_intrinsics : (V, 6, n) of the poses. covariance : (n, n) of the
    intrinsics.
    """
    n_views = len(T_camera_board)
    # A pose turns about the board's origin t: at the camera's centre it moves by t x omega more.
    at_centre = np.broadcast_to(np.eye(6), (n_views, 6, 6)).copy()
    at_centre[:, 3:, :3] = skew(T_camera_board[:, :3, 3])
    alone = pose_covariance - by_intrinsics @ covariance @ by_intrinsics.mT
    return BoardMotion(
        (at_centre @ by_intrinsics).mean(axis=0),
        (at_centre @ alone @ at_centre.mT).sum(axis=0) / n_views**2,
    )


def projection_covariance(
    camera: Camera, covariance: Array, motion: BoardMotion, pixels: Array, distance: float = np.inf
) -> Array:
    """Covariance (..., 2, 2) px^2 of the pixels of fixed points; NaN for pixels without a ray.

    covariance : (n, n) of the intrinsics. pixels : (..., 2). distance : m, of the points from the
    camera's centre; at infinity only rotations matter.
    """
    rays = camera.ray(pixels)
    points = rays * (distance if np.isfinite(distance) else 1.0)
    by_point, by_intrinsics = camera.project_jacobians(points)
    by_motion = np.concatenate([-by_point @ skew(points), by_point], axis=-1)
    if not np.isfinite(distance):
        by_motion[..., 3:] = 0.0
    whole = by_intrinsics + by_motion @ motion.by_intrinsics
    return whole @ covariance @ whole.mT + by_motion @ motion.covariance @ by_motion.mT


def largest_sigma(covariance: Array) -> Array:
    """Standard deviation (...) in the worst direction, of covariances (..., 2, 2)."""
    a, b, c = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b))


def pixel_grid(image_size: tuple[int, int], cells: tuple[int, int]) -> Array:
    """Middles (rows, columns, 2) of an image's cells, px. cells : columns and rows."""
    x, y = (
        (np.arange(n) + 0.5) * size / n - 0.5 for n, size in zip(cells, image_size, strict=True)
    )
    return np.stack(np.meshgrid(x, y), axis=-1)
