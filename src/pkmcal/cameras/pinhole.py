"""Pinhole camera with OpenCV's five distortion parameters k1 k2 p1 p2 k3."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.cameras.contract import Camera, CameraSchema
from pkmcal.files import Schema
from pkmcal.arrays import Array, Booleans

_NEWTON_STEPS = 20


def distort(xy: Array, k: Array) -> tuple[Array, Array, Array]:
    """OpenCV's radial and tangential distortion of normalised image points.

    xy : (..., 2); k : (5,) k1 k2 p1 p2 k3.
    Returns the distorted points (..., 2), their derivatives by xy (..., 2, 2) and by k
    (..., 2, 5).
    """
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial = slope * (x dx + y dy)
    out = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    by_xy = np.empty((*xy.shape, 2))
    by_xy[..., 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_xy[..., 0, 1] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_xy[..., 1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_xy[..., 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    zero = np.zeros_like(x)
    by_k = np.stack(
        [
            np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=-1),
            np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=-1),
        ],
        axis=-2,
    )
    return out, by_xy, by_k + zero[..., None, None]


def undistort(target: Array, k: Array) -> Array:
    """Newton's inverse of :func:`distort`, (..., 2); NaN where it has none in the field."""
    if not np.any(k):
        return np.array(target, dtype=float)
    xy = np.array(target, dtype=float)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            value, slope, _ = distort(xy, k)
            error = value - target
            det = slope[..., 0, 0] * slope[..., 1, 1] - slope[..., 0, 1] * slope[..., 1, 0]
            step = np.stack(
                [
                    slope[..., 1, 1] * error[..., 0] - slope[..., 0, 1] * error[..., 1],
                    slope[..., 0, 0] * error[..., 1] - slope[..., 1, 0] * error[..., 0],
                ],
                axis=-1,
            )
            xy = xy - step / det[..., None]
            if np.nanmax(np.abs(error), initial=0.0) < 1e-14:
                break
        good = np.max(np.abs(distort(xy, k)[0] - target), axis=-1) < 1e-11
        good &= _monotonic(np.sum(xy * xy, axis=-1), k)
    return np.where(good[..., None], xy, np.nan)


def _monotonic(r2: Array, k: Array) -> Booleans:
    """True where the radial polynomial still grows: beyond, the model folds the image back."""
    k1, k2, k3 = k[0], k[1], k[4]
    if k1 >= 0 and k2 >= 0 and k3 >= 0:
        return np.ones(np.shape(r2), dtype=bool)
    # first zero of d(r radial)/dr = 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 with s = r^2
    roots = np.roots(np.trim_zeros([7 * k3, 5 * k2, 3 * k1, 1.0], "f"))
    real = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
    return r2 < (real.min() if real.size else np.inf)


class PinholeSchema(CameraSchema):
    """``model: pinhole``; ``distortion`` is OpenCV's k1 k2 p1 p2 k3, shorter or absent for zeros."""

    model: Literal["pinhole"]
    distortion: Annotated[tuple[float, ...], Field(max_length=5)] = ()


@final
@dataclass(frozen=True)
class Pinhole(Camera):
    """Perspective camera: p = K distort(x / z, y / z), OpenCV's model."""

    model: ClassVar[str] = "pinhole"
    schema: ClassVar[type[Schema]] = PinholeSchema
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "k1", "k2", "p1", "p2", "k3",
    )  # fmt: skip

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN behind the camera and beyond the fold."""
        xy, good = self._normalised(points)
        distorted = distort(xy, self.parameters[4:])[0]
        return np.where(good[..., None], self.parameters[:2] * distorted, np.nan) + (
            self.parameters[2:4]
        )

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and parameters (..., 2, 9)."""
        xy, good = self._normalised(points)
        distorted, by_xy, by_k = distort(xy, self.parameters[4:])
        focal = self.parameters[:2, None]
        z = np.where(good, points[..., 2], 1.0)
        dxy = np.zeros((*points.shape[:-1], 2, 3))
        dxy[..., 0, 0] = dxy[..., 1, 1] = 1 / z
        dxy[..., :, 2] = -xy / z[..., None]
        by_parameters = np.zeros((*points.shape[:-1], 2, 9))
        by_parameters[..., 0, 0], by_parameters[..., 1, 1] = distorted[..., 0], distorted[..., 1]
        by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
        by_parameters[..., 4:] = focal * by_k
        bad = ~good[..., None, None]
        return (
            np.where(bad, np.nan, focal * (by_xy @ dxy)),
            np.where(bad, np.nan, by_parameters),
        )

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2)."""
        xy = undistort((pixels - self.parameters[2:4]) / self.parameters[:2], self.parameters[4:])
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def in_field(self, points: Array) -> Booleans:
        """In front of the camera, and before the lens polynomial folds back; (...)."""
        return self._normalised(points)[1]

    def _normalised(self, points: Array) -> tuple[Array, Booleans]:
        """x/z and y/z (..., 2), and where they are valid (...)."""
        z = points[..., 2]
        front = z > 1e-9
        xy = points[..., :2] / np.where(front, z, 1.0)[..., None]
        return xy, front & _monotonic(np.sum(xy * xy, axis=-1), self.parameters[4:])

    @classmethod
    def from_document(cls, document: PinholeSchema) -> Pinhole:
        """From a camera file's checked fields; distortion may be absent or shorter."""
        k = np.zeros(5)
        k[: len(document.distortion)] = document.distortion
        return cls(document.image_size, np.concatenate([document.focal, document.center, k]))

    def document(self) -> dict[str, Any]:
        """The fields of a camera file."""
        p = self.parameters.tolist()
        return {
            "model": self.model,
            "image_size": list(self.image_size),
            "focal": p[:2],
            "center": p[2:4],
            "distortion": p[4:],
        }
