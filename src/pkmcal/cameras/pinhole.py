"""Pinhole camera with OpenCV's five distortion parameters k1 k2 p1 p2 k3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import Camera, CameraSchema
from pkmcal.geometry.rigid import dot, of_components

_NEWTON_STEPS = 20
_TABLE = 513
"""Radii of the table that Newton starts from: its steps are a thousandth of the picture."""


def distort(xy: Array, k: Array) -> tuple[Array, Array]:
    """OpenCV's radial and tangential distortion of normalised image points.

    xy : (..., 2); k : (5,) k1 k2 p1 p2 k3.
    Returns the distorted points (..., 2) and their derivatives by xy (..., 2, 2).
    """
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, p1, p2, k3 = k.tolist()
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))  # d radial = slope * (x dx + y dy)
    out = of_components(
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    by_xy = np.empty((2, 2, *x.shape), dtype=xy.dtype)
    by_xy[0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    by_xy[0, 1] = by_xy[1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    by_xy[1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return out, np.moveaxis(by_xy, (0, 1), (-2, -1))


def distort_by_coefficients(xy: Array) -> Array:
    """Derivatives (..., 2, 5) of :func:`distort` by k1 k2 p1 p2 k3, which it is linear in."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    by_k = np.empty((*xy.shape, 5))
    for row, (own, other) in enumerate(((x, y), (y, x))):
        by_k[..., row, 0] = own * r2
        by_k[..., row, 1] = own * r2 * r2
        by_k[..., row, 2 + row] = 2 * own * other
        by_k[..., row, 3 - row] = r2 + 2 * own * own
        by_k[..., row, 4] = own * r2 * r2 * r2
    return by_k


def undistort(target: Array, k: Array) -> Array:
    """Newton's inverse of :func:`distort`, (..., 2); NaN where it has none in the field."""
    if not np.any(k):
        return np.array(target, dtype=float)
    xy = _undistort_radially(target, k)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            value, slope = distort(xy, k)
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
        value, slope = distort(xy, k)
        good = (np.max(np.abs(value - target), axis=-1) < 1e-11) & before_image_fold(xy, slope, k)
    return np.where(good[..., None], xy, np.nan)


def in_pixels(parameters: Array, good: Booleans, distorted: Array) -> Array:
    """Pixels (..., 2) of what :func:`distort` gives, NaN where it is not good (...); parameters :
    of a camera whose focal lengths and centre come first.
    """
    focal, center = parameters[:2].tolist(), parameters[2:4].tolist()
    with np.errstate(over="ignore"):  # of a focal length beyond all sense: far away is far away
        return of_components(
            *(np.where(good, focal[i] * distorted[..., i] + center[i], np.nan) for i in (0, 1))
        )


def moved_in_pixels(parameters: Array, shifted: Sequence[Array], by_xy: Array | None) -> Array:
    """How pixels move (..., 2) as the undistorted x and y (...) do; by_xy : the derivative of
    :func:`distort` there, None where the lens has none.
    """
    x, y = shifted
    if by_xy is not None:
        x, y = (by_xy[..., k, 0] * shifted[0] + by_xy[..., k, 1] * shifted[1] for k in (0, 1))
    focal = parameters[:2].tolist()
    return of_components(focal[0] * x, focal[1] * y)


def before_image_fold(xy: Array, by_xy: Array, k: Array) -> Booleans:
    """True before the place where the lens model folds the image back.

    xy : (..., 2) undistorted; by_xy : (..., 2, 2) derivative of :func:`distort` there. The radial
    polynomial tells the sheets apart; the tangential terms move the fold, where the derivative is
    singular, a little nearer on one side.
    """
    det = by_xy[..., 0, 0] * by_xy[..., 1, 1] - by_xy[..., 0, 1] * by_xy[..., 1, 0]
    return (det > 0) & (dot(xy, xy) < _fold(k))


def _undistort_radially(target: Array, k: Array) -> Array:
    """A start for Newton, (..., 2): the inverse of the radial terms alone, from a table.

    Newton from the target itself leaps over the fold of a strong lens, and finds nothing.
    """
    distance = np.sqrt(np.sum(np.square(target, dtype=float), axis=-1))
    farthest, fold = float(np.nanmax(distance, initial=0.0)), np.sqrt(_fold(k))
    last = farthest
    while last < fold and last * _radial(last**2, k) < farthest:
        last *= 2
    radius = np.linspace(0.0, min(last, fold), _TABLE)
    values = np.interp(distance, radius * _radial(radius**2, k), radius)
    scale = np.where(distance > 0, values / np.where(distance > 0, distance, 1.0), 1.0)
    return target * scale[..., None]


def _radial(r2: Any, k: Array) -> Any:
    return 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))


def _fold(k: Array) -> float:
    """Square of the radius where the radial polynomial stops growing; inf where it never does."""
    return _radial_fold(float(k[0]), float(k[1]), float(k[4]))


@lru_cache(maxsize=64)  # a camera asks with every projection
def _radial_fold(k1: float, k2: float, k3: float) -> float:
    if k1 >= 0 and k2 >= 0 and k3 >= 0:
        return np.inf
    # first zero of d(r radial)/dr = 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 with s = r^2
    roots = np.roots(np.trim_zeros([7 * k3, 5 * k2, 3 * k1, 1.0], "f"))
    real = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
    return float(real.min()) if real.size else np.inf


class PinholeSchema(CameraSchema):
    """``model: pinhole``; ``distortion`` is OpenCV's k1 k2 p1 p2 k3, or fewer, or absent."""

    model: Literal["pinhole"]
    distortion: Annotated[tuple[float, ...], Field(max_length=5)] = ()


@final
@dataclass(frozen=True, repr=False)
class Pinhole(Camera):
    """Perspective camera: p = K distort(x / z, y / z), OpenCV's model."""

    model: ClassVar[str] = "pinhole"
    schema: ClassVar[type[CameraSchema]] = PinholeSchema
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "k1", "k2", "p1", "p2", "k3",
    )  # fmt: skip
    odd: ClassVar[tuple[str, ...]] = ("p1", "p2")

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN behind the camera and beyond the fold."""
        good, _, _, distorted, _ = self._imaged(points)
        return in_pixels(self.parameters, good, distorted)

    def project_along(self, points: Array, *directions: Array) -> tuple[Array, ...]:
        """All from one pass through the lens, if there is one."""
        good, z, xy, distorted, by_xy = self._imaged(points)
        z = np.where(good, z, np.nan)
        shifted: list[Array] = []
        for d in directions:
            # x/z and y/z move by (dx - x/z dz) / z
            own = [(d[..., k] - xy[..., k] * d[..., 2]) / z for k in (0, 1)]
            shifted.append(moved_in_pixels(self.parameters, own, by_xy))
        return in_pixels(self.parameters, good, distorted), *shifted

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and parameters (..., 2, 9)."""
        good, z, xy, distorted, by_xy = self._imaged(points)
        by_parameters = np.zeros((*points.shape[:-1], 2, 9))
        by_parameters[..., 0, 0], by_parameters[..., 1, 1] = distorted[..., 0], distorted[..., 1]
        by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
        by_parameters[..., 4:] = self.parameters[:2, None] * distort_by_coefficients(xy)
        return (
            self._by_point(np.where(good, z, np.nan), xy, by_xy),
            np.where(good[..., None, None], by_parameters, np.nan),
        )

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2)."""
        xy = undistort((pixels - self.center) / self.focal, self.parameters[4:])
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def _by_point(self, z: Array, xy: Array, by_xy: Array | None) -> Array:
        """Derivatives (..., 2, 3): x/z and y/z have 1/z by x and by y, and -(x/z, y/z)/z by z."""
        if by_xy is None:
            by_xy = np.broadcast_to(np.eye(2), (*z.shape, 2, 2))
        out = np.empty((2, 3, *z.shape))
        for row, own, focal in zip(out, (0, 1), self.focal, strict=True):
            scale = focal / z
            row[0] = scale * by_xy[..., own, 0]
            row[1] = scale * by_xy[..., own, 1]
            row[2] = scale * -dot(by_xy[..., own, :], xy)
        return np.moveaxis(out, (0, 1), (-2, -1))

    def _imaged(self, points: Array) -> tuple[Booleans, Array, Array, Array, Array | None]:
        """Where points have an image, and z there (...); x/z and y/z (..., 2); :func:`distort` of
        these, which leaves them as they are, without a derivative, where the lens has none.
        """
        z = points[..., 2]
        front = z > 1e-9
        z = np.where(front, z, 1.0)
        xy = of_components(points[..., 0] / z, points[..., 1] / z)
        lens = self.parameters[4:]
        if not lens.any():
            # what is no number, or infinitely far aside, has no image
            return front & np.isfinite(xy[..., 0] + xy[..., 1]), z, xy, xy, None
        with np.errstate(over="ignore", invalid="ignore"):  # of points almost beside the camera
            distorted, by_xy = distort(xy, lens)
            return front & before_image_fold(xy, by_xy, lens), z, xy, distorted, by_xy
