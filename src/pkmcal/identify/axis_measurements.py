"""Axis measured as direction and point, [A] Table 1, as two edges with their joint noise.

Legs have one kind of measurement, the edge. An axis with its 4x4 covariance is equivalent to the
pair of edges of a cylinder of the leg's radius around it: four numbers (two normals with two
tangent components each) that are a smooth, invertible function of the axis's four coordinates.
Whitening the pair's four residuals together by ``chol(C)^-1 J^-1``, with J the derivative of the
four tangent components by the axis's coordinates, gives the same estimator as a residual on the
axis up to the second order of the noise (1e-3 rad here). The radius has no influence and must be
fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import dot


@dataclass(frozen=True)
class AxisNoise:
    """Standard deviations of one measured axis, with the values of [A] Table 1 as defaults.

    psi : direction in the image plane, rad.
    theta : direction towards the viewer, rad.
    x, z : the axis's point with y = 0, camera frame, m.
    images : number of images that are averaged.
    """

    psi: float = float(np.radians(0.05))
    theta: float = float(np.radians(0.06))
    x: float = 0.05e-3
    z: float = 0.1e-3
    images: int = 3

    def sigma(self) -> Array:
        """Standard deviations (4,) of the mean over the images."""
        return np.array([self.psi, self.theta, self.x, self.z]) / np.sqrt(self.images)


def to_coordinates(a: Array, b: Array) -> Array:
    """Axis coordinates (psi, theta, x, z) (..., 4) of the line from a to b, camera frame.

    u = (cos theta sin psi, -cos theta cos psi, sin theta): psi = 0 is up in the image. A leg must
    not be level in the image, because [A]'s point with y = 0 does not exist then (errata).
    """
    d = b - a
    u = d / np.sqrt(dot(d, d))[..., None]
    point = a - (a[..., 1] / u[..., 1])[..., None] * u
    psi, theta = np.arctan2(u[..., 0], -u[..., 1]), np.arcsin(u[..., 2])
    return np.stack([psi, theta, point[..., 0], point[..., 2]], axis=-1)


def from_coordinates(axis: Array) -> tuple[Array, Array, Array, Array]:
    """Direction u and point M (..., 3) of axis coordinates, and their derivatives (..., 3, 4)."""
    psi, theta = axis[..., 0], axis[..., 1]
    cp, sp, ct, st = np.cos(psi), np.sin(psi), np.cos(theta), np.sin(theta)
    u = np.stack([ct * sp, -ct * cp, st], axis=-1)
    point = np.zeros_like(u)
    point[..., 0], point[..., 2] = axis[..., 2], axis[..., 3]
    du, dpoint = np.zeros((*u.shape, 4)), np.zeros((*u.shape, 4))
    du[..., 0] = np.stack([ct * cp, ct * sp, 0 * ct], axis=-1)
    du[..., 1] = np.stack([-st * sp, st * cp, ct], axis=-1)
    dpoint[..., 0, 2] = dpoint[..., 2, 3] = 1.0
    return u, point, du, dpoint


def as_edges(axis: Array, sigma: Array, radius: Array) -> tuple[Array, Array]:
    """Pair of edges of measured axes (..., 4) with standard deviations sigma (4,).

    Returns bases (..., 2, 3, 2) at the measured normals of sides 0 and 1, and the pair's whitening
    matrices (..., 4, 4), as in measurements.edges.EdgeData.
    """
    u, point, du, dpoint = from_coordinates(axis)
    side = np.broadcast_to([0, 1], (*u.shape[:-1], 2))
    other = point + 0.3 * u  # any second point of the axis
    e = edge_normal_jacobians(
        point[..., None, :], other[..., None, :], np.asarray(radius)[..., None], side
    )
    basis = tangent_basis(e.n, np.broadcast_to(point[..., None, :], e.n.shape))
    # derivative of a normal: by_a (n . da) + by_b (n . db)
    by_a, by_b = ((by[..., None, :] @ basis).mT for by in (e.by_a, e.by_b))
    along_a, along_b = (e.n @ end for end in (dpoint, dpoint + 0.3 * du))
    jac = by_a * along_a[..., None, :] + by_b * along_b[..., None, :]
    jac = jac.reshape(*u.shape[:-1], 4, 4)
    return basis, np.linalg.inv(jac) / sigma[:, None]
