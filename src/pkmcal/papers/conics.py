"""Images of lines and cylinders in the unified camera model, as conics, [B] eq. 1-3, 10-11.

A line's image is the conic x^T Omega x = 0 on the model's normalised plane, x = (x, y, 1); in
pixels, K^-T Omega K^-1. Lens distortion is not part of a conic: where a camera has any, points
are undistorted first. The estimators do not need these; they are the papers' own description, for
comparison and for drawing. An edge's viewing rays lie on a great circle of the unit sphere, whose
plane is what the estimators use: :func:`weighted` fits it.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.cylinders import edge_normals, tangent_basis
from pkmcal.geometry.rigid import cross, dot

ROUNDS = 6
"""Gauss-Newton steps of the weighted fit."""


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


def plain(rays: Array, leg_ray: Array) -> Array:
    """Least squares of n . s over rays (..., n, 3): the smallest singular vector, (..., 3).

    leg_ray : (..., 3) decides the sign, normals point away from the leg.
    """
    normal = np.linalg.svd(rays.mT @ rays)[2][..., -1, :]
    return -normal * np.sign(dot(normal, leg_ray))[..., None]


def weighted(rays: Array, by_pixel: Array, leg_ray: Array) -> tuple[Array, Array]:
    """Maximum likelihood plane of rays with equal noise in pixels, and its covariance.

    rays : (..., n, 3). by_pixel : (..., n, 3, 2) derivative of the ray by the pixel.
    Returns the normal (..., 3) and the covariance (..., 2, 2) in its
    :func:`~pkmcal.geometry.cylinders.tangent_basis` at the mean ray, for noise of 1 px.
    Gauss-Newton with weights 1 / (n^T J J^T n), the misfit's variance at the present normal.
    """
    normal = plain(rays, leg_ray)
    middle = rays.mean(axis=-2)
    information = np.zeros((*normal.shape[:-1], 2, 2))
    for _ in range(ROUNDS):
        basis = tangent_basis(normal, middle)
        slope = (normal[..., None, None, :] @ by_pixel)[..., 0, :]
        weight = 1 / dot(slope, slope)
        rows = rays @ basis
        moved = (rows * weight[..., None]).mT
        information = moved @ rows
        misfit = dot(rays, normal[..., None, :])
        turn = -np.linalg.solve(information, moved @ misfit[..., None])[..., 0]
        normal = normal + (basis @ turn[..., None])[..., 0]
        normal = normal / np.sqrt(dot(normal, normal))[..., None]
    return normal, np.linalg.inv(information)


def free_conic(plane: Array, leg_ray: Array) -> Array:
    """[B] eq. 10, as printed, from a conic fitted freely to points (..., n, 2) of the normalised
    plane.

    Unusable on the short arc that a leg shows: six numbers are asked where two are there.
    """
    x, y = plane[..., 0], plane[..., 1]
    rows = np.stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones_like(x)], axis=-1)
    c = np.linalg.svd(rows.mT @ rows)[2][..., -1, :]
    upper = [[c[..., 0], c[..., 1], c[..., 3]], [c[..., 1], c[..., 2], c[..., 4]]]
    upper.append([c[..., 3], c[..., 4], c[..., 5]])
    conic = np.stack([np.stack(row, axis=-1) for row in upper], axis=-2)
    return normal_from_conic(conic, leg_ray)
