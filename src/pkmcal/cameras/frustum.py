"""Field of a camera as lines in space."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.contract import Camera
from pkmcal.geometry.rigid import apply

FRUSTUM_POINTS_A_SIDE = 6
"""Points on each side of the image border in a drawn frustum."""


def frustum(camera: Camera, T_base_camera: Array, depth: float) -> list[Array]:
    """Lines (n, 3), m, base frame: border of the image at a depth, and rays to its four corners.

    Where the lens or mirror has no ray at the border, the limit of its field along the line to the
    image's centre. For fields too wide for a plane at that depth, ``depth`` is the distance along
    the rays.
    """
    right, bottom = camera.image_size[0] - 0.5, camera.image_size[1] - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    at = np.arange(4 * FRUSTUM_POINTS_A_SIDE + 1) / FRUSTUM_POINTS_A_SIDE
    # along each ray from the border to the centre take the first that the camera model has
    border = np.stack([np.interp(at, np.arange(5), corners[:, c]) for c in (0, 1)], axis=-1)
    centre = (border.max(axis=0) + border.min(axis=0)) / 2
    share = np.linspace(1, 0, 41)[:, None, None]
    rays = camera.ray(centre + share * (border - centre))
    first = np.argmax(np.isfinite(rays).all(axis=-1), axis=0)
    rays = rays[first, np.arange(len(border))]
    if not np.isfinite(rays).all():
        return []
    deep = rays[:, 2].min()
    points = rays * depth / (rays[:, 2:] if deep > 0.3 else 1.0)
    border_points = apply(T_base_camera, points)
    eye = T_base_camera[:3, 3]
    return [
        border_points,
        *(np.stack([eye, border_points[k * FRUSTUM_POINTS_A_SIDE]]) for k in range(4)),
    ]
