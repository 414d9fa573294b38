"""Double sphere camera model for wide lenses (Usenko, Demmel, Cremers 2018), Kalibr's ``ds``.

A point is projected onto a unit sphere, then onto a second one whose centre is xi ahead, then by a
pinhole camera displaced by alpha / (1 - alpha).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import FIELD_MARGIN, Camera, CameraSchema, LensSearch
from pkmcal.cameras.quotient import field_cosine, quotient_jacobians, quotient_pixels
from pkmcal.geometry.rigid import dot


class DoubleSphereSchema(CameraSchema):
    """File of a double sphere camera, ``model: double_sphere``; it has no ``distortion``."""

    model: Literal["double_sphere"]
    xi: Annotated[float, Field(gt=-1, le=1)] = Field(
        description="distance of the spheres' centres, above -1 and up to 1"
    )
    alpha: Annotated[float, Field(ge=0, le=1)] = Field(
        description="weight of the second sphere, 0 to 1"
    )
    distortion: Annotated[tuple[float, ...], Field(max_length=0)] = ()


@final
@dataclass(frozen=True, repr=False)
class DoubleSphere(Camera):
    """Double sphere model, p = K (x, y) / (alpha d2 + (1 - alpha) z1), with z1 = xi d1 + z, d1 the
    point's distance and d2 = sqrt(x^2 + y^2 + z1^2).
    """

    model: ClassVar[str] = "double_sphere"
    schema: ClassVar[type[CameraSchema]] = DoubleSphereSchema
    own: ClassVar[tuple[str, ...]] = ("xi", "alpha")
    parameter_names: ClassVar[tuple[str, ...]] = (
        "focal.x", "focal.y", "center.x", "center.y", "xi", "alpha",
    )  # fmt: skip
    search: ClassVar[LensSearch] = LensSearch(
        focal_range=(0.12, 2.0),
        terms=((),),
        own=((-0.2, 0.5), (-0.2, 0.6), (0.2, 0.6), (0.6, 0.6), (0.9, 0.5), (0.9, 0.1)),
    )

    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3); NaN outside the field of view."""
        _, _, _, depth, good = self._depth(points)
        return quotient_pixels(self, points, depth, good)

    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, 6).
        """
        xi, alpha = self.parameters[4:].tolist()
        d1, z1, d2, depth, good = self._depth(points)
        by_z1 = alpha * z1 / d2 + 1 - alpha
        by_point = by_z1[..., None] * xi * points / d1[..., None]
        by_point[..., 2] += by_z1
        by_point[..., :2] += alpha * points[..., :2] / d2[..., None]
        by_own = np.stack([by_z1 * d1, d2 - z1], axis=-1)
        return quotient_jacobians(self, points, depth, by_point, by_own, good)

    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN outside the image circle."""
        xi, alpha = self.parameters[4:].tolist()
        m = (pixels - self.center) / self.focal
        r2 = np.sum(m * m, axis=-1)
        with np.errstate(invalid="ignore"):
            z = (1 - alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
            scale = (z * xi + np.sqrt(z * z + (1 - xi**2) * r2)) / (z * z + r2)
        rays = np.concatenate([scale[..., None] * m, (scale * z - xi)[..., None]], axis=-1)
        inside = rays[..., 2] > (FIELD_MARGIN - self._border())
        return np.where(inside[..., None], rays, np.nan)

    def _border(self) -> float:
        """Cosine between the negative axis and the rays at the border of the field."""
        xi, alpha = self.parameters[4:].tolist()
        w = field_cosine(alpha)
        return float((w + xi) / np.sqrt(2 * w * xi + xi**2 + 1))

    def _depth(self, points: Array) -> tuple[Array, Array, Array, Array, Booleans]:
        """d1, z1, d2 and the depth of points (..., 3), and whether they have an image; all (...).

        Points without an image have the values of a point on the axis.
        """
        xi, alpha = self.parameters[4:].tolist()
        d1 = np.sqrt(dot(points, points))
        good = (d1 > 0) & (points[..., 2] > (FIELD_MARGIN - self._border()) * d1)
        d1 = np.where(good, d1, 1.0)
        z1 = np.where(good, xi * d1 + points[..., 2], 1.0)
        d2 = np.sqrt(np.where(good, points[..., 0] ** 2 + points[..., 1] ** 2, 0.0) + z1 * z1)
        d2 = np.where(d2 > 0, d2, 1.0)
        return d1, z1, d2, alpha * d2 + (1 - alpha) * z1, good
