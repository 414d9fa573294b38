"""Extended unified camera model for wide lenses (Khomutenko, Garcia, Martinet 2016), Kalibr's
``eucm``.

A point is projected onto an ellipsoid of revolution, then by a pinhole camera displaced along the
axis. beta = 1 is the unified model with xi = alpha / (1 - alpha).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import FIELD_MARGIN, Camera, CameraSchema, LensSearch
from pkmcal.cameras.quotient import field_cosine, quotient_jacobians, quotient_pixels


class ExtendedUnifiedSchema(CameraSchema):
    """File of an extended unified camera, ``model: extended_unified``; it has no ``distortion``."""

    model: Literal["extended_unified"]
    alpha: Annotated[float, Field(ge=0, le=1)] = Field(
        description="weight of the ellipsoid, 0 to 1"
    )
    beta: Annotated[float, Field(gt=0)] = Field(description="shape of the ellipsoid, above 0")
    distortion: Annotated[tuple[float, ...], Field(max_length=0)] = ()


@final
@dataclass(frozen=True, repr=False)
class ExtendedUnified(Camera):
    """Extended unified model, p = K (x, y) / (alpha d + (1 - alpha) z), with
    d = sqrt(beta (x^2 + y^2) + z^2).
    """

    model: ClassVar[str] = "extended_unified"
    schema: ClassVar[type[CameraSchema]] = ExtendedUnifiedSchema
    own: ClassVar[tuple[str, ...]] = ("alpha", "beta")
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "alpha", "beta",
    )  # fmt: skip
    search: ClassVar[LensSearch] = LensSearch(
        focal_range=(0.12, 2.0),
        terms=((),),
        own=((0.2, 1.0), (0.5, 1.0), (0.6, 1.0), (0.6, 1.5), (0.7, 1.0)),
    )

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN outside the field of view."""
        _, _, depth, good = self._depth(points)
        return quotient_pixels(self, points, depth, good)

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, 6).
        """
        alpha, beta = self.parameters[4:].tolist()
        s, d, depth, good = self._depth(points)
        by_point = alpha * points * [beta, beta, 1.0] / d[..., None]
        by_point[..., 2] += 1 - alpha
        by_own = np.stack([d - points[..., 2], alpha * s / (2 * d)], axis=-1)
        return quotient_jacobians(self, points, depth, by_point, by_own, good)

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN outside the image circle."""
        alpha, beta = self.parameters[4:].tolist()
        m = (pixels - self.center) / self.focal
        r2 = beta * np.sum(m * m, axis=-1)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1 - (2 * alpha - 1) * r2)
            z = (1 - alpha**2 * r2) / (alpha * root + 1 - alpha)
        rays = np.concatenate([m, z[..., None]], axis=-1)
        inside = z > (FIELD_MARGIN - field_cosine(alpha)) * np.sqrt(r2 + z * z)
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.where(inside[..., None], rays, np.nan)

    def _depth(self, points: Array) -> tuple[Array, Array, Array, Booleans]:
        """x^2 + y^2, d and the depth of points (..., 3), and whether they have an image; all (...).

        Points without an image have the values of a point on the axis.
        """
        alpha, beta = self.parameters[4:].tolist()
        s, z = points[..., 0] ** 2 + points[..., 1] ** 2, points[..., 2]
        d = np.sqrt(beta * s + z * z)
        good = (d > 0) & (z > (FIELD_MARGIN - field_cosine(alpha)) * d)
        d = np.where(good, d, 1.0)
        return s, d, np.where(good, alpha * d + (1 - alpha) * z, 1.0), good
