"""An axis measured as direction and point, [A] Table 1, as two edges with their joint noise.

There is one measurement type for legs, the edge. An axis with its 4x4 covariance is the pair
of edges that a cylinder of the leg's radius around it would show: four numbers (two normals,
two tangent components each) that depend smoothly and invertibly on the axis's four. Whitening
the pair's four residuals together by ``chol(C)^-1 J^-1``, J the derivative of the four tangent
components by the axis's coordinates, makes it the same estimator as a residual on the axis up
to the second order of the noise (1e-3 rad here). The radius drops out; keep it fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.cylinders import edge_normal_jacobians, tangent_basis
from pkmcal.geometry.rigid import dot


@dataclass(frozen=True)
class AxisNoise:
    """Standard deviations of one measured axis: [A] Table 1, in degrees and millimetres.

    psi : direction in the image plane. theta : towards the viewer. x, z : the axis's point with
    y = 0, camera frame. Defaults are the paper's, rad and m; ``images`` are averaged.
    """

    psi: float = float(np.radians(0.05))
    theta: float = float(np.radians(0.06))
    x: float = 0.05e-3
    z: float = 0.1e-3
    images: int = 3

    def sigma(self) -> Array:
        """The four, after averaging the images."""
        return np.array([self.psi, self.theta, self.x, self.z]) / np.sqrt(self.images)


def to_coordinates(a: Array, b: Array) -> Array:
    """Axis coordinates (psi, theta, x, z) (..., 4) of the line from a to b, camera frame.

    u = (cos theta sin psi, -cos theta cos psi, sin theta): psi = 0 is up in the image, and a
    leg may not lie level in it ([A]'s point with y = 0 does not exist then; errata).
    """
    d = b - a
    u = d / np.sqrt(dot(d, d))[..., None]
    point = a - (a[..., 1] / u[..., 1])[..., None] * u
    psi, theta = np.arctan2(u[..., 0], -u[..., 1]), np.arcsin(u[..., 2])
    return np.stack([psi, theta, point[..., 0], point[..., 2]], axis=-1)


def from_coordinates(axis: Array) -> tuple[Array, Array, Array, Array]:
    """Direction u, point M (..., 3) and their derivatives (..., 3, 4) by the coordinates."""
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
    """The pair of edges of measured axes (..., 4) with standard deviations sigma (4,).

    Returns bases (..., 2, 3, 2) at the measured normals of sides 0 and 1, and the pair's
    whitening matrices (..., 4, 4), as measurements.edges.EdgeData wants them.
    """
    u, point, du, dpoint = from_coordinates(axis)
    side = np.broadcast_to([0, 1], (*u.shape[:-1], 2))
    other = point + 0.3 * u  # any second point of the axis
    e = edge_normal_jacobians(
        point[..., None, :], other[..., None, :], np.asarray(radius)[..., None], side
    )
    basis = tangent_basis(e.n, np.broadcast_to(point[..., None, :], e.n.shape))
    # a normal moves by by_a (n . da) + by_b (n . db)
    by_a, by_b = ((by[..., None, :] @ basis).mT for by in (e.by_a, e.by_b))
    along_a, along_b = (e.n @ end for end in (dpoint, dpoint + 0.3 * du))
    jac = by_a * along_a[..., None, :] + by_b * along_b[..., None, :]
    jac = jac.reshape(*u.shape[:-1], 4, 4)
    return basis, np.linalg.inv(jac) / sigma[:, None]
