"""Images of lines and cylinders in the unified camera model, as conics, [B] eq. 1-3, 10-11.

A line's image is the conic x^T Omega x = 0 on the model's normalised plane, x = (x, y, 1); in
pixels, K^-T Omega K^-1. Lens distortion is not part of a conic: where a camera has any, points
are undistorted first. The estimators do not need these; they are the papers' own description, for
comparison and for drawing.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.cylinders import edge_normals
from pkmcal.geometry.rigid import cross, dot


def line_conic(normal: Array, xi: float) -> Array:
    """Omega (..., 3, 3) of a line in the plane with unit ``normal`` (..., 3); [B] eq. 1."""
    x, y, z = (normal[..., k] for k in range(3))
    flat = 1 - xi**2
    rows = [
        [flat * x * x - (z * xi) ** 2, flat * x * y, x * z],
        [flat * x * y, flat * y * y - (z * xi) ** 2, y * z],
        [x * z, y * z, z * z],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def cylinder_conics(a_camera: Array, u_camera: Array, radius: Array, xi: float) -> Array:
    """Both edges' conics (..., 2, 3, 3) of a cylinder; [B] eq. 3 and 1.

    a_camera, u_camera : (..., 3) point on the axis (m) and unit direction. radius : (...,) m.
    """
    return line_conic(edge_normals(a_camera, u_camera, radius), xi)


def to_pixels(conic: Array, focal: Array, center: Array) -> Array:
    """Conics in pixels, K^-T Omega K^-1, (..., 3, 3); [B] eq. 2. focal, center : (2,) px."""
    inverse = _inverse_intrinsics(focal, center)
    return inverse.T @ conic @ inverse


def from_pixels(conic: Array, focal: Array, center: Array) -> Array:
    """The inverse of :func:`to_pixels`."""
    intrinsics = np.linalg.inv(_inverse_intrinsics(focal, center))
    return intrinsics.T @ conic @ intrinsics


def _inverse_intrinsics(focal: Array, center: Array) -> Array:
    fx, fy = focal
    return np.array([[1 / fx, 0, -center[0] / fx], [0, 1 / fy, -center[1] / fy], [0, 0, 1.0]])


def normal_from_conic(conic: Array, leg_ray: Array) -> Array:
    """Unit normals (..., 3) of the planes whose images are conics; [B] eq. 10 corrected.

    Omega's third column is n_z n, so as printed half of the normals come out reversed. ``leg_ray``
    (..., 3), the mean viewing ray of the leg, decides: normals point away from the leg. A plane
    that holds the camera's axis has n_z = 0, its column vanishes and the answer is NaN.
    """
    column = conic[..., :, 2]
    length = np.sqrt(dot(column, column))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = column / np.where(length > 1e-12, length, np.nan)[..., None]
    return normal * -np.sign(dot(normal, leg_ray))[..., None]


def direction_from_normals(n0: Array, n1: Array) -> Array:
    """Unit direction (..., 3) of a cylinder from its edges' normals, sides 0 and 1; [B] eq. 11.

    The order n1 x n0 makes it point from base to platform, as the sides are defined here.
    """
    u = cross(n1, n0)
    return u / np.sqrt(dot(u, u))[..., None]


def on_plane(rays: Array, xi: float) -> Array:
    """Points (..., 2) of viewing rays on the unified model's normalised plane, no distortion."""
    length = np.sqrt(dot(rays, rays))
    return rays[..., :2] / (rays[..., 2] + xi * length)[..., None]
