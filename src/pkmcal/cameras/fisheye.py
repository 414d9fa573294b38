"""Fisheye camera with OpenCV's four coefficients: r = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8).

t is the angle from the optical axis. The model is valid beyond 90 degrees; its field of view ends
where r stops increasing with t, or at 180 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import Camera, CameraSchema, LensSearch

_POWERS = np.array([3, 5, 7, 9])
"""Powers of the angle in the terms of k1 to k4."""
_NEWTON_STEPS = 30
"""Most Newton steps for a viewing ray."""
_TABLE = 513
"""Size of the table of angles from which Newton's method starts; their spacing is at most a third
of a degree."""
_ON_AXIS = 1e-12
"""Tangent of the angle from the axis below which r / sqrt(x^2 + y^2) is replaced by its limit, 1 /
z."""


class FisheyeSchema(CameraSchema):
    """File of a fisheye camera, ``model: fisheye``; ``distortion`` holds up to four coefficients k1
    k2 k3 k4 of OpenCV's model.
    """

    model: Literal["fisheye"]
    distortion: Annotated[tuple[float, ...], Field(max_length=4)] = ()


@final
@dataclass(frozen=True, repr=False)
class Fisheye(Camera):
    """OpenCV's fisheye model, p = K r(t) (x, y) / sqrt(x^2 + y^2)."""

    model: ClassVar[str] = "fisheye"
    schema: ClassVar[type[CameraSchema]] = FisheyeSchema
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "k1", "k2", "k3", "k4",
    )  # fmt: skip
    search: ClassVar[LensSearch] = LensSearch(
        focal_range=(0.12, 2.0),
        terms=((), ("k1",), ("k1", "k2"), ("k1", "k2", "k3"), ("k1", "k2", "k3", "k4")),
    )

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN outside the field of view."""
        angle, across = _angle(points)
        ratio = _radius_ratio(self._radius(angle), across, points)
        good = self._in_field(angle, points)[..., None]
        return np.where(
            good, self.focal * (points[..., :2] * ratio[..., None]) + self.center, np.nan
        )

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, 8).
        """
        angle, across = _angle(points)
        ratio = _radius_ratio(self._radius(angle), across, points)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        s2 = across**2
        far = np.where(s2 + z**2 > 0, s2 + z**2, 1.0)
        # Image point r(t) (x, y) / s: changes by r' dt along the image radius, by r / s across it.
        slope = self._slope(angle)
        along = np.where(s2 > 0, (slope * z / far - ratio) / np.where(s2 > 0, s2, 1.0), 0.0)
        by_point = np.empty((*points.shape[:-1], 2, 3))
        by_point[..., 0, 0], by_point[..., 1, 1] = ratio + along * x * x, ratio + along * y * y
        by_point[..., 0, 1] = by_point[..., 1, 0] = along * x * y
        by_point[..., 0, 2], by_point[..., 1, 2] = -slope * x / far, -slope * y / far
        focal = self.focal
        by_parameters = np.zeros((*points.shape[:-1], 2, 8))
        by_parameters[..., 0, 0], by_parameters[..., 1, 1] = ratio * x, ratio * y
        by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
        unit = points[..., :2] / np.where(across > 0, across, 1.0)[..., None]
        powers = angle[..., None] ** _POWERS
        by_parameters[..., 4:] = (focal * unit)[..., :, None] * powers[..., None, :]
        bad = ~self._in_field(angle, points)[..., None, None]
        return (
            np.where(bad, np.nan, focal[:, None] * by_point),
            np.where(bad, np.nan, by_parameters),
        )

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2), by Newton's method; NaN outside the image
        circle.
        """
        xy = (pixels - self.center) / self.focal
        radius = np.sqrt(np.sum(xy * xy, axis=-1))
        limit = self._limit()
        table = np.linspace(0.0, limit, _TABLE)
        angle = np.interp(radius, self._radius(table), table)
        with np.errstate(invalid="ignore"):
            for _ in range(_NEWTON_STEPS):
                # At the border of the field the slope vanishes; the bound keeps the step finite.
                step = (self._radius(angle) - radius) / np.maximum(self._slope(angle), 1e-9)
                angle = np.clip(angle - step, 0.0, limit)
                if np.nanmax(np.abs(step), initial=0.0) < 1e-15:
                    break
            good = (np.abs(self._radius(angle) - radius) < 1e-11) & (angle < limit)
        unit = xy / np.where(radius > 0, radius, 1.0)[..., None]
        rays = np.concatenate([np.sin(angle)[..., None] * unit, np.cos(angle)[..., None]], axis=-1)
        return np.where(good[..., None], rays, np.nan)

    def _in_field(self, angle: Array, points: Array) -> Booleans:
        """Whether points with these angles from the axis are inside the field of view; (...)."""
        return (angle < self._limit()) & np.any(points != 0, axis=-1)

    def _radius(self, angle: Array) -> Array:
        """Image radius on the normalised plane, (...)."""
        s, k = angle * angle, self.parameters[4:]
        return angle * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))

    def _slope(self, angle: Array) -> Array:
        """Derivative of the image radius by the angle, (...)."""
        s, k = angle * angle, _POWERS * self.parameters[4:]
        return 1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))

    def _limit(self) -> float:
        """Angle (rad) of the border of the field: the first zero of the slope, at most pi."""
        k = _POWERS * self.parameters[4:]
        if np.all(k >= 0):
            return float(np.pi)
        roots = np.roots(np.trim_zeros([k[3], k[2], k[1], k[0], 1.0], "f"))
        real = roots[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)].real
        return float(min(np.sqrt(real.min()), np.pi)) if real.size else float(np.pi)


def _angle(points: Array) -> tuple[Array, Array]:
    """Angle from the optical axis (rad) and distance from it, both (...)."""
    across = np.sqrt(points[..., 0] ** 2 + points[..., 1] ** 2)
    return np.arctan2(across, points[..., 2]), across


def _radius_ratio(radius: Array, across: Array, points: Array) -> Array:
    """Ratio of image radius to distance from the axis, (...), with its limit 1 / z on the axis."""
    z = points[..., 2]
    on_axis = across <= _ON_AXIS * np.abs(z)
    limit = 1 / np.where(on_axis & (z != 0), z, 1.0)
    return np.where(on_axis, limit, radius / np.where(on_axis, 1.0, across))
