"""Planes through the camera's centre fitted to edge points: four ways, one to use.

An edge's viewing rays lie on a great circle of the unit sphere. :func:`weighted` is the maximum
likelihood fit to pixel noise and what to use; the others are what one meets in the literature.
All take N edges of n points at once.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.conics import line_conic, normal_from_conic
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot

ROUNDS = 6


def plain(rays: Array, leg_ray: Array) -> Array:
    """Least squares of n . s over rays (..., n, 3): the smallest singular vector, (..., 3).

    leg_ray : (..., 3) decides the sign, normals point away from the leg.
    """
    normal = np.linalg.svd(np.swapaxes(rays, -1, -2) @ rays)[2][..., -1, :]
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
        moved = np.swapaxes(rows * weight[..., None], -1, -2)
        information = moved @ rows
        misfit = dot(rays, normal[..., None, :])
        turn = -np.linalg.solve(information, moved @ misfit[..., None])[..., 0]
        normal = normal + (basis @ turn[..., None])[..., 0]
        normal = normal / np.sqrt(dot(normal, normal))[..., None]
    return normal, np.linalg.inv(information)


def free_conic(plane: Array, leg_ray: Array) -> Array:
    """[B] eq. 10 from a conic fitted freely to points (..., n, 2) of the normalised plane.

    Unusable on the short arc that a leg shows: six numbers are asked where two are there.
    """
    x, y = plane[..., 0], plane[..., 1]
    rows = np.stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones_like(x)], axis=-1)
    c = np.linalg.svd(np.swapaxes(rows, -1, -2) @ rows)[2][..., -1, :]
    upper = [[c[..., 0], c[..., 1], c[..., 3]], [c[..., 1], c[..., 2], c[..., 4]]]
    upper.append([c[..., 3], c[..., 4], c[..., 5]])
    conic = np.stack([np.stack(row, axis=-1) for row in upper], axis=-2)
    return normal_from_conic(conic, leg_ray)


def constrained_conic(plane: Array, xi: float, start: Array) -> Array:
    """The conic of a line, [B] eq. 1, fitted to points (..., n, 2) with Sampson's weights.

    Gauss-Newton on the normal's two freedoms from ``start`` (..., 3); the same answer as
    :func:`weighted` to second order in the noise.
    """
    point = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
    normal = start
    towards = np.broadcast_to(np.array([0.3, 0.4, 1.0]), normal.shape)
    for _ in range(ROUNDS):
        basis = tangent_basis(normal, towards)
        value, size = _sampson(point, line_conic(normal, xi))
        step = 1e-6
        jac = np.stack(
            [
                (_sampson(point, line_conic(normal + step * basis[..., k], xi))[0] - value) / step
                for k in range(2)
            ],
            axis=-1,
        )
        rows = jac / size[..., None]
        normal_matrix = np.swapaxes(rows, -1, -2) @ rows
        gradient = np.swapaxes(rows, -1, -2) @ (value / size)[..., None]
        turn = -np.linalg.solve(normal_matrix, gradient)[..., 0]
        normal = normal + (basis @ turn[..., None])[..., 0]
        normal = normal / np.sqrt(dot(normal, normal))[..., None]
    return normal


def _sampson(point: Array, conic: Array) -> tuple[Array, Array]:
    """x^T Omega x and the length of its gradient by the point, (..., n)."""
    product = point @ conic
    gradient = 2 * product[..., :2]
    return dot(product, point), np.sqrt(dot(gradient, gradient))
