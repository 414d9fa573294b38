"""Contract of all central cameras, whatever their lens or mirror.

A central camera maps rays through one point to pixels. Everything outside this package works with
rays, so a camera model consists of three functions (projection, its Jacobians, its inverse), which
also define its field of view by returning NaN outside. A model is one file in this folder with one
final subclass of :class:`Camera`. :func:`camera_models` finds it and the conformance test runs over
it; no other file is edited.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from pkmcal.arrays import Array, Booleans
from pkmcal.files import MOST_PIXELS, Schema
from pkmcal.geometry.rigid import dot, of_components

PositivePair = tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
PositiveSize = tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]

LEAST_FOCAL = 0.05
"""Shortest focal length in pixels, as a share of the image's width. A fisheye lens with a field of
180 degrees inside the image has a third, a mirror a fifth; below that the file is likely in
millimetres."""


class CameraSchema(Schema):
    """Fields common to all camera files; the schema of each model adds its own."""

    covariance: tuple[tuple[float, ...], ...] | None = Field(
        default=None, description="the parameters' covariance, one row a parameter"
    )
    image_size: PositiveSize = Field(description="[width, height] in pixels")
    focal: PositivePair = Field(description="[fx, fy] in pixels")
    center: tuple[float, float] = Field(description="[cx, cy] in pixels, pixel centres at integers")

    @field_validator("image_size")
    @classmethod
    def _of_some_pixels(cls, size: tuple[int, int]) -> tuple[int, int]:
        """Refuse images with more than MOST_PIXELS pixels."""
        if (pixels := size[0] * size[1]) > MOST_PIXELS:
            raise ValueError(f"too many pixels; found {pixels}, expected at most {MOST_PIXELS}")
        return size

    @field_validator("focal")
    @classmethod
    def _in_pixels(cls, focal: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        """Refuse focal lengths below LEAST_FOCAL of the width, which are likely millimetres."""
        width = info.data.get("image_size", (0, 0))[0]
        if min(focal) < LEAST_FOCAL * width:
            raise ValueError(
                f"the focal length {list(focal)} looks like millimetres; it is wanted in pixels, "
                "which is millimetres divided by the size of a pixel in mm"
            )
        return focal


USUAL_FOCAL, USUAL_ASPECT, USUAL_CENTRE, USUAL_DISTORTION = 0.005, 0.001, 0.01, 0.05
"""Prior sigmas of a camera whose file has no covariance: of the focal lengths (relative), of their
ratio, of the centre (share of the image's width), and of the first distortion coefficient. They
stand for a zoom ring turned slightly, pixels square to a thousandth, a sensor not centred behind
its lens, and the distortion of most lenses."""


class LensViolation(NamedTuple):
    """Deviation of a camera's parameters from its file, along k directions.

    code : last part of the finding's code.
    columns : (n, k) derivative of the parameters by the k numbers.
    usual : prior sigma of these numbers for a camera that was not calibrated carefully.
    facts : facts of the finding besides the estimates.
    """

    code: str
    columns: Array
    usual: float
    facts: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Camera(ABC):
    """Intrinsics of a central camera.

    image_size : (width, height) in pixels.
    parameters : (n,) intrinsics in the order of ``parameter_names``; pixels for focal and center,
        dimensionless otherwise. Pixel centres are at integers, as in OpenCV.
    covariance : (n, n) of the parameters from the camera's calibration, or None.
    own : fields of the model's file between ``center`` and ``distortion``.
    odd : names of the parameters that change sign when the image is rotated by 180 degrees.
    """

    model: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]
    schema: ClassVar[type[CameraSchema]]
    own: ClassVar[tuple[str, ...]] = ()
    odd: ClassVar[tuple[str, ...]] = ()

    image_size: tuple[int, int]
    parameters: Array
    covariance: Array | None = None

    def __repr__(self) -> str:
        width, height = self.image_size
        values = zip(self.parameter_names, self.parameters.tolist(), strict=True)
        numbers = ", ".join(f"{name} {value:.6g}" for name, value in values if value)
        return f"<{type(self).__name__} {width} × {height}: {numbers}>"

    @abstractmethod
    def project(self, points: Array) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera frame; NaN outside the field of view."""

    @abstractmethod
    def project_jacobians(self, points: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`project` by the point (..., 2, 3) and by the parameters
        (..., 2, n).
        """

    def project_along(self, points: Array, *directions: Array) -> tuple[Array, ...]:
        """Pixels (..., 2) of points and their directional derivatives (..., 2) along directions
        (..., 3), px per unit of the points.

        Searches call this function thousands of times. A model may override it with a cheaper
        version, in the precision of the points.
        """
        by_point = self.project_jacobians(points)[0]
        derivatives = (
            of_components(*(dot(by_point[..., k, :], d) for k in (0, 1))) for d in directions
        )
        return self.project(points), *derivatives

    @abstractmethod
    def ray(self, pixels: Array) -> Array:
        """Unit viewing rays (..., 3) of pixels (..., 2); NaN for pixels that no ray maps to."""

    def ray_jacobians(self, pixels: Array) -> tuple[Array, Array]:
        """Derivatives of :meth:`ray` by the pixel (..., 3, 2) and by the parameters (..., 3, n).

        They follow from the implicit function project(ray) = pixel, so models do not implement
        them. Let J = d project / d ray. The derivative by the pixel is the inverse of J on the
        ray's tangent plane; the derivative by the parameters is minus this inverse times d project
        / d parameters.
        """
        rays = self.ray(pixels)
        by_point, by_parameters = self.project_jacobians(rays)
        # Solve J d = e in the tangent plane, ray . d = 0: a 3x3 system.
        system = np.concatenate([by_point, rays[..., None, :]], axis=-2)
        bad: Booleans = ~np.all(np.isfinite(system), axis=(-1, -2))
        system = np.where(bad[..., None, None], np.eye(3), system)
        inverse = np.linalg.inv(system)[..., :, :2]
        inverse = np.where(bad[..., None, None], np.nan, inverse)
        return inverse, -inverse @ by_parameters

    @classmethod
    def from_document(cls, document: Any) -> Self:
        """Camera from the fields of a file that the model's ``schema`` has validated.

        The parameters are in the order of the fields: focal, center, the model's ``own``,
        distortion. Distortion may be absent or shorter than the model's; missing coefficients are
        zero.
        """
        own = [getattr(document, name) for name in cls.own]
        k = np.zeros(len(cls.parameter_names) - 4 - len(own))
        k[: len(document.distortion)] = document.distortion
        return cls(document.image_size, np.concatenate([document.focal, document.center, own, k]))

    @property
    def focal_part(self) -> Array:
        """Parameters (n,) with all but the focal lengths set to zero: the derivative by the
        relative change of both focal lengths.
        """
        focal = [name.startswith("focal.") for name in self.parameter_names]
        return np.where(focal, self.parameters, 0.0)

    @property
    def aspect_part(self) -> Array:
        """Derivative (n,) of the parameters by the relative change of fx / fy at constant geometric
        mean.
        """
        direction = [
            {"focal.x": 0.5, "focal.y": -0.5}.get(name, 0.0) for name in self.parameter_names
        ]
        return np.array(direction) * self.parameters

    def violations(self) -> tuple[LensViolation, ...]:
        """Likely deviations of the camera from its file: focal length (focus), aspect ratio of the
        pixels, centre (cropped images), first distortion coefficient (distortion left out).
        """
        eye, lens = np.eye(len(self.parameters)), 4 + len(self.own)
        name, before = self.parameter_names[lens], float(self.parameters[lens])
        return (
            LensViolation("focal", self.focal_part[:, None], USUAL_FOCAL),
            LensViolation("aspect", self.aspect_part[:, None], USUAL_ASPECT),
            LensViolation("centre", eye[:, 2:4], USUAL_CENTRE * self.image_size[0]),
            LensViolation(
                "distortion",
                eye[:, lens : lens + 1],
                USUAL_DISTORTION,
                {"coefficient": name, "stated": before},
            ),
        )

    def usual_covariance(self) -> Array:
        """Prior covariance (n, n) of the parameters of a camera without a stated one, from
        :meth:`violations`.
        """
        parts = [part.usual * part.columns for part in self.violations()]
        columns = np.concatenate(parts, axis=1)
        return columns @ columns.T

    def document(self) -> dict[str, Any]:
        """Fields of the camera's file, the inverse of :meth:`from_document`."""
        p = self.parameters.tolist()
        own = dict(zip(self.own, p[4:], strict=False))
        return {
            "model": self.model,
            "image_size": list(self.image_size),
            "focal": p[:2],
            "center": p[2:4],
            **own,
            "distortion": p[4 + len(own) :],
        }

    def binned(self, count: int) -> Self:
        """Camera of images in which ``count`` x ``count`` pixels are averaged to one; incomplete
        blocks at the ends of rows and columns are dropped.

        Its parameters, and derivatives by them, are those of the binned image: focal lengths and
        centre, always the first four parameters, are smaller.
        """
        if count == 1:
            return self
        parameters = self.parameters.copy()
        parameters[:4] /= count
        parameters[2:4] += (1 / count - 1) / 2  # pixel centres are at integers
        size = self.image_size[0] // count, self.image_size[1] // count
        return replace(self, image_size=size, parameters=parameters, covariance=None)

    def turned_by_half(self) -> Self:
        """Camera of the images rotated by 180 degrees, itself rotated by 180 degrees about its
        optical axis.
        """
        sign = np.where(np.isin(self.parameter_names, self.odd), -1.0, 1.0)
        sign[2:4] = -1.0
        parameters = sign * self.parameters
        parameters[2:4] += np.asarray(self.image_size) - 1.0
        covariance = None if self.covariance is None else self.covariance * np.outer(sign, sign)
        return replace(self, parameters=parameters, covariance=covariance)

    def in_image(self, pixels: Array, margin: float = 0.0) -> Booleans:
        """Whether pixels (..., 2) are inside the image, at least ``margin`` px from its border;
        (...).
        """
        limit = np.asarray(self.image_size) - 1.0 - margin
        with np.errstate(invalid="ignore"):
            return np.all((pixels >= margin) & (pixels <= limit), axis=-1)


@cache
def camera_models() -> dict[str, type[Camera]]:
    """All camera models of this folder, by their names in camera files."""
    package = __name__.rpartition(".")[0]
    path = importlib.import_module(package).__path__
    for module in pkgutil.iter_modules(path):
        importlib.import_module(f"{package}.{module.name}")
    return {cls.model: cls for cls in Camera.__subclasses__()}
