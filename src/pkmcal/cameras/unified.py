"""Unified central camera: mirrors, and wide lenses that behave like one ([B] eq. 1-2).

A point is projected on the unit sphere, seen from a point xi above the sphere's centre by a
pinhole camera, then distorted and scaled. xi = 0 is a pinhole, xi = 1 a parabolic mirror. Rays
more than 90 degrees from the axis have images; the field ends where two rays would share one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import Camera, CameraSchema
from pkmcal.cameras.pinhole import (
    before_image_fold,
    distort,
    distort_by_coefficients,
    in_pixels,
    moved_in_pixels,
    undistort,
)
from pkmcal.geometry.rigid import dot, of_components

_LEAST = 1e-9
"""Cosine by which a ray must lie inside the field's border, where the image runs to infinity."""


class UnifiedSchema(CameraSchema):
    """``model: unified``; ``distortion`` is OpenCV's omnidirectional k1 k2 p1 p2."""

    model: Literal["unified"]
    xi: Annotated[float, Field(ge=0)] = Field(description="the mirror's parameter, 0 or more")
    distortion: Annotated[tuple[float, ...], Field(max_length=4)] = ()


@final
@dataclass(frozen=True, repr=False)
class Unified(Camera):
    """p = K distort(x / (z + xi r), y / (z + xi r)) with r the point's distance."""

    model: ClassVar[str] = "unified"
    schema: ClassVar[type[CameraSchema]] = UnifiedSchema
    own: ClassVar[tuple[str, ...]] = ("xi",)
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "xi", "k1", "k2", "p1", "p2",
    )  # fmt: skip
    odd: ClassVar[tuple[str, ...]] = ("p1", "p2")

    @property
    def xi(self) -> float:
        """Distance of the projection's centre from the sphere's."""
        return float(self.parameters[4])

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN outside the field."""
        distorted, good = self._imaged(points)[2:4]
        return in_pixels(self.parameters, good, distorted)

    def project_along(self, points: Array, *directions: Array) -> tuple[Array, ...]:
        """All from one pass through the lens, if there is one."""
        (distance, depth), xy, distorted, good, by_xy = self._imaged(points)
        depth = np.where(good, depth, np.nan)
        bend = self.xi / distance
        shifted: list[Array] = []
        for d in directions:
            # x / w moves by (dx - (x / w) dw) / w with w = z + xi r and dw = xi X / r . dX + dz
            dw = bend * dot(points, d) + d[..., 2]
            own = [(d[..., k] - xy[..., k] * dw) / depth for k in (0, 1)]
            shifted.append(moved_in_pixels(self.parameters, own, by_xy))
        return in_pixels(self.parameters, good, distorted), *shifted

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and parameters (..., 2, 9)."""
        (distance, depth), xy, distorted, good, by_xy = self._imaged(points)
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
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN outside the mirror's image."""
        xy = undistort((pixels - self.center) / self.focal, self._five())
        r2 = np.sum(xy * xy, axis=-1)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1 + (1 - self.xi**2) * r2)
        scale = (self.xi + root) / (1 + r2)
        # [B] eq. 2; z = scale - xi, written without its cancellation
        z = (root - self.xi * r2) / (1 + r2)
        return np.concatenate([scale[..., None] * xy, z[..., None]], axis=-1)

    def _five(self) -> Array:
        """Distortion in the pinhole's order, without a third radial term."""
        return np.append(self.parameters[5:], 0.0)

    def _imaged(
        self, points: Array
    ) -> tuple[tuple[Array, Array], Array, Array, Booleans, Array | None]:
        """Distance r and depth z + xi r (...); x and y over the depth (..., 2); :func:`distort`
        of these, which leaves them as they are, without a derivative, where the lens has none;
        where they have an image (...); the distortion's derivative by these.
        """
        distance = np.sqrt(dot(points, points))
        there = distance > 0
        distance = np.where(there, distance, 1.0)
        depth = points[..., 2] + self.xi * distance
        # Beyond cos = -1 / xi (or -xi) rays come back to pixels that have one already.
        edge = -min(self.xi, 1 / self.xi) if self.xi > 0 else 0.0
        inside = there & (points[..., 2] > (edge + _LEAST) * distance)
        depth = np.where(inside, depth, 1.0)
        xy = of_components(points[..., 0] / depth, points[..., 1] / depth)
        if not self.parameters[5:].any():
            return (distance, depth), xy, xy, inside & np.isfinite(xy[..., 0] + xy[..., 1]), None
        with np.errstate(over="ignore", invalid="ignore"):  # of points at the field's border
            distorted, by_xy = distort(xy, self._five())
            good = inside & before_image_fold(xy, by_xy, self._five())
        return (distance, depth), xy, distorted, good, by_xy
