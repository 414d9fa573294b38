"""Pinhole camera with OpenCV's five distortion coefficients k1 k2 p1 p2 k3."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import FIELD_MARGIN, Camera, CameraSchema, LensSearch
from pkmcal.geometry.rigid import dot, of_components

PINHOLE_TERMS = 5
"""Coefficients k1 k2 p1 p2 k3, the first of OpenCV's model."""
_NEWTON_STEPS = 20
"""Most Newton steps for an undistorted point."""
_TABLE = 513
"""Size of the table of radii from which Newton's method starts; their spacing is a thousandth of
the image."""


def distort(xy: Array, k: Array) -> tuple[Array, Array]:
    """OpenCV's radial and tangential distortion of normalised image points.

    xy : (..., 2).
    k : (5,) k1 k2 p1 p2 k3.
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
    """Derivatives (..., 2, 5) of :func:`distort` by k1 k2 p1 p2 k3, in which it is linear."""
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
    """Inverse of :func:`distort` by Newton's method, (..., 2); NaN outside the field of view."""
    if not np.any(k):
        return np.array(target, dtype=float)
    return inverse_distort(target, lambda xy: distort(xy, k), lambda s: _radial(s, k), _fold(k))


def inverse_distort(
    target: Array,
    distorted: Callable[[Array], tuple[Array, Array]],
    radial: Callable[[Array], Array],
    fold: float,
) -> Array:
    """Inverse of a distortion by Newton's method, (..., 2); NaN outside the field of view.

    target : (..., 2) distorted normalised points. distorted : function of points (..., 2) that
        returns their distorted values and the derivatives (..., 2, 2). radial : its radial factor
        at squared radii. fold : squared radius where the radial terms stop increasing.
    """
    xy = _undistort_radially(target, radial, fold)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            # Newton step with the inverse of the 2x2 derivative written out.
            value, slope = distorted(xy)
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
        value, slope = distorted(xy)
        good = (np.max(np.abs(value - target), axis=-1) < 1e-11) & before_fold(xy, slope, fold)
    return np.where(good[..., None], xy, np.nan)


def in_pixels(parameters: Array, good: Booleans, distorted: Array) -> Array:
    """Pixels (..., 2) of distorted normalised points (..., 2); NaN where ``good`` (...) is false.

    parameters : (n,) of a camera, focal lengths and centre first.
    """
    focal, center = parameters[:2].tolist(), parameters[2:4].tolist()
    with np.errstate(over="ignore"):  # absurd focal lengths give infinite pixels
        return of_components(
            *(np.where(good, focal[i] * distorted[..., i] + center[i], np.nan) for i in (0, 1))
        )


def moved_in_pixels(parameters: Array, change: Sequence[Array], by_xy: Array | None) -> Array:
    """Changes of pixels (..., 2) from changes of the undistorted x and y, each (...).

    by_xy : (..., 2, 2) derivative of :func:`distort` at the points, None without distortion.
    """
    x, y = change
    if by_xy is not None:
        x, y = (by_xy[..., k, 0] * change[0] + by_xy[..., k, 1] * change[1] for k in (0, 1))
    focal = parameters[:2].tolist()
    return of_components(focal[0] * x, focal[1] * y)


def before_image_fold(xy: Array, by_xy: Array, k: Array) -> Booleans:
    """Whether normalised points are inside the radius where the distortion model folds the image
    back; (...).

    xy : (..., 2) undistorted.
    by_xy : (..., 2, 2) derivative of :func:`distort` at xy.
    """
    return before_fold(xy, by_xy, _fold(k))


def before_fold(xy: Array, by_xy: Array, fold: float) -> Booleans:
    """Whether points (..., 2) are inside the squared radius ``fold``, where the derivative
    ``by_xy`` (..., 2, 2) of the distortion keeps the image's orientation; (...).

    The radial polynomial separates the sheets. The tangential terms move the fold, where the
    derivative is singular, slightly nearer on one side; the determinant detects this.
    """
    det = by_xy[..., 0, 0] * by_xy[..., 1, 1] - by_xy[..., 0, 1] * by_xy[..., 1, 0]
    return (det > 0) & (dot(xy, xy) < fold)


def _undistort_radially(target: Array, radial: Callable[[Array], Array], fold: float) -> Array:
    """Starting points (..., 2) for Newton's method: the inverse of the radial terms alone, from a
    table.

    Started from the target itself, Newton's method jumps over the fold of a strongly distorting
    lens and does not converge.
    """
    distance = np.sqrt(np.sum(np.square(target, dtype=float), axis=-1))
    farthest, largest = float(np.nanmax(distance, initial=0.0)), np.sqrt(fold)
    last = farthest
    while last < largest and last * radial(np.asarray(last**2)) < farthest:
        last *= 2
    radius = np.linspace(0.0, min(last, largest), _TABLE)
    values = np.interp(distance, radius * radial(radius**2), radius)
    scale = np.where(distance > 0, values / np.where(distance > 0, distance, 1.0), 1.0)
    return target * scale[..., None]


def _radial(r2: Any, k: Array) -> Any:
    """Radial factor of the distortion at squared radii r2."""
    return 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))


def _fold(k: Array) -> float:
    """Squared radius where the radial polynomial stops increasing; inf if it never does."""
    return _radial_fold(float(k[0]), float(k[1]), float(k[4]))


@lru_cache(maxsize=64)  # evaluated with every projection
def _radial_fold(k1: float, k2: float, k3: float) -> float:
    """Cached computation of :func:`_fold`."""
    if k1 >= 0 and k2 >= 0 and k3 >= 0:
        return np.inf
    # First zero of d(r radial)/dr = 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3, with s = r^2.
    roots = np.roots(np.trim_zeros([7 * k3, 5 * k2, 3 * k1, 1.0], "f"))
    real = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
    return float(real.min()) if real.size else np.inf


class PinholeSchema(CameraSchema):
    """File of a pinhole camera, ``model: pinhole``; ``distortion`` holds up to five coefficients k1
    k2 p1 p2 k3 of OpenCV's model.
    """

    model: Literal["pinhole"]
    distortion: Annotated[tuple[float, ...], Field(max_length=PINHOLE_TERMS)] = ()


@final
@dataclass(frozen=True, repr=False)
class Pinhole(Camera):
    """OpenCV's perspective camera, p = K distort(x / z, y / z)."""

    model: ClassVar[str] = "pinhole"
    schema: ClassVar[type[CameraSchema]] = PinholeSchema
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "k1", "k2", "p1", "p2", "k3",
    )  # fmt: skip
    odd: ClassVar[tuple[str, ...]] = ("p1", "p2")
    search: ClassVar[LensSearch] = LensSearch(
        focal_range=(0.3, 6.0),
        terms=(
            (), ("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2"), ("k1", "k2", "p1", "p2", "k3"),
        ),
    )  # fmt: skip

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN behind the camera and beyond the fold of the
        distortion.
        """
        good, _, _, distorted, _ = self._projection(points)
        return in_pixels(self.parameters, good, distorted)

    def project_along(self, points: Array, *directions: Array) -> tuple[Array, ...]:
        """Pixels and directional derivatives from one evaluation of the distortion."""
        good, z, xy, distorted, by_xy = self._projection(points)
        z = np.where(good, z, np.nan)
        derivatives: list[Array] = []
        for d in directions:
            # x/z and y/z change by (dx - x/z dz) / z
            own = [(d[..., k] - xy[..., k] * d[..., 2]) / z for k in (0, 1)]
            derivatives.append(moved_in_pixels(self.parameters, own, by_xy))
        return in_pixels(self.parameters, good, distorted), *derivatives

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, 9).
        """
        good, z, xy, distorted, by_xy = self._projection(points)
        by_parameters = np.zeros((*points.shape[:-1], 2, 9))
        by_parameters[..., 0, 0], by_parameters[..., 1, 1] = distorted[..., 0], distorted[..., 1]
        by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
        by_parameters[..., 4:] = self.parameters[:2, None] * distort_by_coefficients(xy)
        return (
            self._by_point(np.where(good, z, np.nan), xy, by_xy),
            np.where(good[..., None, None], by_parameters, np.nan),
        )

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN beyond the fold of the distortion."""
        xy = undistort((pixels - self.center) / self.focal, self.parameters[4:])
        rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def _by_point(self, z: Array, xy: Array, by_xy: Array | None) -> Array:
        """Derivatives (..., 2, 3) of pixels by points: 1/z by x and y, -(x/z, y/z)/z by z, times
        the distortion's derivative and the focal lengths.
        """
        if by_xy is None:
            by_xy = np.broadcast_to(np.eye(2), (*z.shape, 2, 2))
        out = np.empty((2, 3, *z.shape))
        for row, own, focal in zip(out, (0, 1), self.focal, strict=True):
            scale = focal / z
            row[0] = scale * by_xy[..., own, 0]
            row[1] = scale * by_xy[..., own, 1]
            row[2] = scale * -dot(by_xy[..., own, :], xy)
        return np.moveaxis(out, (0, 1), (-2, -1))

    def _projection(self, points: Array) -> tuple[Booleans, Array, Array, Array, Array | None]:
        """Intermediate values of the projection of points (..., 3).

        Returns whether each point has an image (...), z with 1 for points behind the camera (...),
        x/z and y/z (..., 2), their distorted values (..., 2), and the derivative of :func:`distort`
        (..., 2, 2), None without distortion.
        """
        z = points[..., 2]
        front = z > FIELD_MARGIN
        z = np.where(front, z, 1.0)
        xy = of_components(points[..., 0] / z, points[..., 1] / z)
        lens = self.parameters[4:]
        if not lens.any():
            # NaN and infinite points have no image
            return front & np.isfinite(xy[..., 0] + xy[..., 1]), z, xy, xy, None
        with np.errstate(over="ignore", invalid="ignore"):  # points almost beside the camera
            distorted, by_xy = distort(xy, lens)
            return front & before_image_fold(xy, by_xy, lens), z, xy, distorted, by_xy
