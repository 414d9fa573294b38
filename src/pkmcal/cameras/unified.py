"""Unified central camera model for mirrors and wide lenses ([B] eq. 1-2).

A point is projected onto the unit sphere, then by a pinhole camera whose centre is xi above the
sphere's centre, then distorted and scaled. xi = 0 is a pinhole camera, xi = 1 a parabolic mirror.
Rays more than 90 degrees from the axis have images; the field of view ends where two rays would
share one image point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import FIELD_MARGIN, Camera, CameraSchema, LensSearch
from pkmcal.cameras.pinhole import (
    before_image_fold,
    distort,
    distort_by_coefficients,
    in_pixels,
    moved_in_pixels,
    undistort,
)
from pkmcal.geometry.rigid import dot, of_components


class UnifiedSchema(CameraSchema):
    """File of a unified camera, ``model: unified``; ``distortion`` holds up to four coefficients k1
    k2 p1 p2 of OpenCV's omnidirectional model.
    """

    model: Literal["unified"]
    xi: Annotated[float, Field(ge=0)] = Field(description="the mirror's parameter, 0 or more")
    distortion: Annotated[tuple[float, ...], Field(max_length=4)] = ()


@final
@dataclass(frozen=True, repr=False)
class Unified(Camera):
    """Unified model, p = K distort(x / (z + xi r), y / (z + xi r)), with r the point's distance."""

    model: ClassVar[str] = "unified"
    schema: ClassVar[type[CameraSchema]] = UnifiedSchema
    own: ClassVar[tuple[str, ...]] = ("xi",)
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "xi", "k1", "k2", "p1", "p2",
    )  # fmt: skip
    odd: ClassVar[tuple[str, ...]] = ("p1", "p2")
    search: ClassVar[LensSearch] = LensSearch(
        focal_range=(0.12, 2.0),
        terms=((), ("p1", "p2"), ("k1",), ("k1", "k2"), ("k1", "k2", "p1", "p2")),
        own=((0.0,), (0.5,), (1.0,), (1.5,), (2.2,)),
    )

    @property
    def xi(self) -> float:
        """Distance of the centre of projection from the sphere's centre, in radii."""
        return float(self.parameters[4])

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN outside the field of view."""
        distorted, good = self._projection(points)[2:4]
        return in_pixels(self.parameters, good, distorted)

    def project_along(self, points: Array, *directions: Array) -> tuple[Array, ...]:
        """Pixels and directional derivatives from one evaluation of the distortion."""
        (distance, depth), xy, distorted, good, by_xy = self._projection(points)
        depth = np.where(good, depth, np.nan)
        bend = self.xi / distance
        derivatives: list[Array] = []
        for d in directions:
            # x / w changes by (dx - (x / w) dw) / w with w = z + xi r and dw = xi X / r . dX + dz
            dw = bend * dot(points, d) + d[..., 2]
            own = [(d[..., k] - xy[..., k] * dw) / depth for k in (0, 1)]
            derivatives.append(moved_in_pixels(self.parameters, own, by_xy))
        return in_pixels(self.parameters, good, distorted), *derivatives

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, 9).
        """
        (distance, depth), xy, distorted, good, by_xy = self._projection(points)
        by_xy = np.eye(2) if by_xy is None else by_xy
        focal = self.parameters[:2, None]
        # d(x / w) = (dx - (x / w) dw) / w with w = z + xi r and dw = (xi X / r + e_z) . dX
        slope = self.xi * points / distance[..., None]
        slope[..., 2] += 1.0
        dxy = -xy[..., :, None] * slope[..., None, :]
        dxy[..., 0, 0] += 1.0
        dxy[..., 1, 1] += 1.0
        dxy /= depth[..., None, None]
        by_parameters = np.zeros((*points.shape[:-1], 2, 9))
        by_parameters[..., 0, 0], by_parameters[..., 1, 1] = distorted[..., 0], distorted[..., 1]
        by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
        by_xi = -xy * (distance / depth)[..., None]
        by_parameters[..., 4] = (focal * (by_xy @ by_xi[..., None]))[..., 0]
        by_parameters[..., 5:] = focal * distort_by_coefficients(xy)[..., :4]
        bad = ~good[..., None, None]
        return (
            np.where(bad, np.nan, focal * (by_xy @ dxy)),
            np.where(bad, np.nan, by_parameters),
        )

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN outside the image of the mirror."""
        xy = undistort((pixels - self.center) / self.focal, self._five_coefficients())
        r2 = np.sum(xy * xy, axis=-1)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1 + (1 - self.xi**2) * r2)
        scale = (self.xi + root) / (1 + r2)
        # [B] eq. 2; z = scale - xi in a form without cancellation
        z = (root - self.xi * r2) / (1 + r2)
        return np.concatenate([scale[..., None] * xy, z[..., None]], axis=-1)

    def _five_coefficients(self) -> Array:
        """Distortion coefficients (5,) in the pinhole model's order, with k3 = 0."""
        return np.append(self.parameters[5:], 0.0)

    def _projection(
        self, points: Array
    ) -> tuple[tuple[Array, Array], Array, Array, Booleans, Array | None]:
        """Intermediate values of the projection of points (..., 3).

        Returns (r, depth z + xi r) (...), x and y divided by the depth (..., 2), their distorted
        values (..., 2), whether each point has an image (...), and the derivative of
        :func:`distort` (..., 2, 2), None without distortion.
        """
        distance = np.sqrt(dot(points, points))
        there = distance > 0
        distance = np.where(there, distance, 1.0)
        depth = points[..., 2] + self.xi * distance
        # Beyond cos = -1 / xi (or -xi) rays share pixels with rays inside the field.
        edge = -min(self.xi, 1 / self.xi) if self.xi > 0 else 0.0
        inside = there & (points[..., 2] > (edge + FIELD_MARGIN) * distance)
        depth = np.where(inside, depth, 1.0)
        xy = of_components(points[..., 0] / depth, points[..., 1] / depth)
        if not self.parameters[5:].any():
            return (distance, depth), xy, xy, inside & np.isfinite(xy[..., 0] + xy[..., 1]), None
        with np.errstate(over="ignore", invalid="ignore"):  # points at the border of the field
            distorted, by_xy = distort(xy, self._five_coefficients())
            good = inside & before_image_fold(xy, by_xy, self._five_coefficients())
        return (distance, depth), xy, distorted, good, by_xy
