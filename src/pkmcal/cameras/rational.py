"""Pinhole camera with OpenCV's long distortion model: rational, thin prism and tilted sensor.

With s = x^2 + y^2 of the normalised image point, the radial factor is the ratio of two cubics in s;
the thin prism adds s1 s + s2 s^2 and s3 s + s4 s^2; the tilted sensor is a homography of the
distorted point (OpenCV's calib3d, detailed description).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import FIELD_MARGIN, Camera, CameraSchema, LensSearch
from pkmcal.cameras.pinhole import (
    PINHOLE_TERMS,
    before_fold,
    distort_by_coefficients,
    in_pixels,
    inverse_distort,
)
from pkmcal.geometry.rigid import of_components


class RationalSchema(CameraSchema):
    """File of a camera with OpenCV's long distortion model, ``model: rational``; ``distortion``
    holds up to fourteen coefficients k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y.
    """

    model: Literal["rational"]
    distortion: Annotated[tuple[float, ...], Field(max_length=14)] = ()


@final
@dataclass(frozen=True, repr=False)
class Rational(Camera):
    """OpenCV's perspective camera with all of its distortion terms, p = K distort(x / z, y / z)."""

    model: ClassVar[str] = "rational"
    schema: ClassVar[type[CameraSchema]] = RationalSchema
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y",
        "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau.x", "tau.y",
    )  # fmt: skip
    odd: ClassVar[tuple[str, ...]] = ("p1", "p2", "s1", "s2", "s3", "s4", "tau.x", "tau.y")
    search: ClassVar[LensSearch] = LensSearch(
        focal_range=(0.3, 6.0),
        terms=(
            ("k1", "k4"), ("k1", "k2", "p1", "p2", "k4"), ("k1", "k2", "p1", "p2", "k4", "k5"),
            ("k1", "k2", "p1", "p2", "k4", "tau.x", "tau.y"),
            ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
            ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
        ),
    )  # fmt: skip

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN behind the camera and beyond the fold of the
        distortion.
        """
        good, _, _, distorted, _ = self._projection(points)
        return in_pixels(self.parameters, good, _tilted(distorted, self._tilt()[0])[0])

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, 18).
        """
        good, z, xy, distorted, by_xy = self._projection(points)
        tilt, *tilt_by_angles = self._tilt()
        out, by_distorted, scale = _tilted(distorted, tilt)
        focal = self.parameters[:2, None]
        # x / z and y / z change by (dx - x / z dz) / z
        quotient = np.zeros((*points.shape[:-1], 2, 3))
        quotient[..., 0, 0] = quotient[..., 1, 1] = 1 / z
        quotient[..., 2] = -xy / z[..., None]
        by_parameters = np.zeros((*points.shape[:-1], 2, 18))
        by_parameters[..., 0, 0], by_parameters[..., 1, 1] = out[..., 0], out[..., 1]
        by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
        lens = _distort_by_coefficients(xy, self.parameters[4:16])
        by_parameters[..., 4:16] = focal * (by_distorted @ lens)
        for column, change in zip((16, 17), tilt_by_angles, strict=True):
            v = distorted @ change[:, :2].T + change[:, 2]
            by_parameters[..., column] = (
                self.focal * (v[..., :2] - out * v[..., 2:]) / scale[..., None]
            )
        bad = ~good[..., None, None]
        return (
            np.where(bad, np.nan, focal * (by_distorted @ by_xy @ quotient)),
            np.where(bad, np.nan, by_parameters),
        )

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN beyond the fold of the distortion."""
        k = self.parameters[4:16]
        untilted, _, scale = _tilted(
            (pixels - self.center) / self.focal, np.linalg.inv(self._tilt()[0])
        )
        target = np.where(scale[..., None] > 0, untilted, np.nan)
        xy = inverse_distort(
            target, lambda xy: _distort(xy, k), lambda s: _radial(s, k), _radial_fold(*k.tolist())
        )
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def _tilt(self) -> tuple[Array, Array, Array]:
        """Homography (3, 3) of the tilted sensor, and its derivatives by both angles."""
        return _tilt_homography(*self.parameters[16:].tolist())

    def _projection(self, points: Array) -> tuple[Booleans, Array, Array, Array, Array]:
        """Intermediate values of the projection of points (..., 3).

        Returns whether each point has an image (...), z with 1 for points behind the camera (...),
        x/z and y/z (..., 2), their distorted values (..., 2) before the tilt, and the derivative of
        :func:`_distort` (..., 2, 2).
        """
        z = points[..., 2]
        front = z > FIELD_MARGIN
        z = np.where(front, z, 1.0)
        xy = of_components(points[..., 0] / z, points[..., 1] / z)
        k = self.parameters[4:16]
        with np.errstate(over="ignore", invalid="ignore"):  # points almost beside the camera
            distorted, by_xy = _distort(xy, k)
            good = front & before_fold(xy, by_xy, _radial_fold(*k.tolist()))
            good &= _tilted(distorted, self._tilt()[0])[2] > 0
        distorted = np.where(good[..., None], distorted, 0.0)
        return good, z, xy, distorted, np.where(good[..., None, None], by_xy, 0.0)


def _ratio(s: Array, k: Array) -> tuple[Array, Array, Array, Array]:
    """Cubics N and D of the radial factor N / D at squared radii s, and their derivatives by s."""
    k1, k2, k3, k4, k5, k6 = k[[0, 1, 4, 5, 6, 7]].tolist()
    return (
        1 + s * (k1 + s * (k2 + s * k3)),
        1 + s * (k4 + s * (k5 + s * k6)),
        k1 + s * (2 * k2 + s * 3 * k3),
        k4 + s * (2 * k5 + s * 3 * k6),
    )


def _radial(s: Array, k: Array) -> Array:
    """Radial factor of the distortion at squared radii s."""
    top, bottom, _, _ = _ratio(s, k)
    return top / bottom


def _distort(xy: Array, k: Array) -> tuple[Array, Array]:
    """OpenCV's rational, tangential and thin prism distortion of normalised image points.

    xy : (..., 2). k : (12,) k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4.
    Returns the distorted points (..., 2) and their derivatives by xy (..., 2, 2).
    """
    x, y = xy[..., 0], xy[..., 1]
    _, _, p1, p2, *_, s1, s2, s3, s4 = k.tolist()
    s = x * x + y * y
    top, bottom, top_slope, bottom_slope = _ratio(s, k)
    radial = top / bottom
    slope = 2 * (top_slope - radial * bottom_slope) / bottom  # d radial = slope (x dx + y dy)
    out = of_components(
        x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x) + s * (s1 + s * s2),
        y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y + s * (s3 + s * s4),
    )
    prism_x, prism_y = 2 * s1 + 4 * s * s2, 2 * s3 + 4 * s * s4
    by_xy = np.empty((2, 2, *x.shape), dtype=xy.dtype)
    by_xy[0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_x * x
    by_xy[0, 1] = x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_x * y
    by_xy[1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_y * x
    by_xy[1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x + prism_y * y
    return out, np.moveaxis(by_xy, (0, 1), (-2, -1))


def _distort_by_coefficients(xy: Array, k: Array) -> Array:
    """Derivatives (..., 2, 12) of :func:`_distort` by its coefficients."""
    s = np.sum(xy * xy, axis=-1)
    top, bottom, _, _ = _ratio(s, k)
    by_k = np.zeros((*xy.shape, 12))
    by_k[..., :PINHOLE_TERMS] = distort_by_coefficients(xy)
    by_k[..., [0, 1, 4]] /= bottom[..., None, None]
    by_k[..., 5:8] = -by_k[..., [0, 1, 4]] * (top / bottom)[..., None, None]
    by_k[..., 0, 8] = by_k[..., 1, 10] = s
    by_k[..., 0, 9] = by_k[..., 1, 11] = s * s
    return by_k


@lru_cache(maxsize=64)  # evaluated with every projection
def _radial_fold(*k: float) -> float:
    """Squared radius where the distorted radius stops increasing, or its pole; inf without one."""
    # cubics in s with the highest power first; a constant term of one, so that neither is zero
    N, D = np.array([k[4], k[1], k[0], 1.0]), np.array([k[7], k[6], k[5], 1.0])
    # d(r N / D)/dr = (N D + 2 s (N' D - N D')) / D^2, with the coefficients of 2 s N' in front
    powers = np.array([6.0, 4.0, 2.0, 0.0])
    slope = np.convolve(N, D) + np.convolve(powers * N, D) - np.convolve(N, powers * D)
    roots = np.concatenate([np.roots(slope), np.roots(D)])
    real = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
    return float(real.min()) if real.size else np.inf


@lru_cache(maxsize=64)
def _tilt_homography(x: float, y: float) -> tuple[Array, Array, Array]:
    """Homography (3, 3) of a sensor tilted by the angles x and y (rad), and its derivatives by
    both: the rotation R = R_y R_x, then the projection along z onto the plane z = 1.
    """
    cx, sx, cy, sy = np.cos(x), np.sin(x), np.cos(y), np.sin(y)
    rot_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    rot_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    by_x = np.array([[0, 0, 0], [0, -sx, cx], [0, -cx, -sx]])
    by_y = np.array([[-sy, 0, -cy], [0, 0, 0], [cy, 0, -sy]])

    def along_z(R: Array, corner: float) -> Array:
        return np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, corner]])

    R = rot_y @ rot_x
    changes = (rot_y @ by_x, by_y @ rot_x)
    derivatives = [along_z(dR, 0.0) @ R + along_z(R, 1.0) @ dR for dR in changes]
    return along_z(R, 1.0) @ R, derivatives[0], derivatives[1]


def _tilted(xy: Array, tilt: Array) -> tuple[Array, Array, Array]:
    """Points (..., 2) under a homography (3, 3), their derivative by xy (..., 2, 2), and the third
    homogeneous coordinate (...).
    """
    h = xy @ tilt[:, :2].T + tilt[:, 2]
    scale = h[..., 2]
    divisor = np.where(scale != 0, scale, np.nan)
    out = h[..., :2] / divisor[..., None]
    by_xy = (tilt[:2, :2] - out[..., :, None] * tilt[2, :2]) / divisor[..., None, None]
    return out, by_xy, scale
