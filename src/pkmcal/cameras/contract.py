"""Contract of a central camera model.

A central camera maps rays through one point to pixels. All other code works with rays, so that a
model is its projection, the inverse and their Jacobians, NaN outside the valid field. A model is
one file in this folder with one final subclass; :func:`camera_models` finds it, and the conformance
test runs over it.
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
from pkmcal.files import MOST_PIXELS, FieldError, Schema
from pkmcal.geometry.rigid import dot, of_components

PositivePair = tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
PositiveSize = tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]

LEAST_FOCAL = 0.05
"""Share of the image's width below which a focal length cannot be in pixels: a fisheye lens with
all of its 180 degrees in the image has a third, a mirror a fifth."""
MOST_FOCAL = 200.0
"""Image widths above which a focal length cannot be in pixels: the field of view would be below a
third of a degree."""
MOST_ASPECT = 3.0
"""Largest ratio of the two focal lengths; anamorphic lenses have up to two."""

FIELD_MARGIN = 1e-9
"""Margin, as a difference of cosines, between valid rays and the border of the field, where image
points go to infinity; for a bound of one of a model's own fields that the field does not reach, the
margin to this bound."""

FOCAL, CENTER, PIXEL_PARAMETERS = slice(0, 2), slice(2, 4), slice(0, 4)
"""Parameters of every model: the focal lengths, the principal point, and both, which are in
pixels."""


class CameraSchema(Schema):
    """Fields of every camera file; the schema of a model adds its own."""

    covariance: tuple[tuple[float, ...], ...] | None = Field(
        default=None, description="the parameters' covariance, one row a parameter"
    )
    image_size: PositiveSize = Field(description="[width, height] in pixels")
    focal: PositivePair = Field(description="[fx, fy] in pixels")
    center: tuple[float, float] = Field(description="[cx, cy] in pixels, pixel centres at integers")

    @field_validator("image_size")
    @classmethod
    def _of_some_pixels(cls, size: tuple[int, int]) -> tuple[int, int]:
        """Check the number of pixels."""
        if (pixels := size[0] * size[1]) > MOST_PIXELS:
            raise FieldError("too many pixels", found=pixels, expected=f"at most {MOST_PIXELS}")
        return size

    @field_validator("focal")
    @classmethod
    def _in_pixels(cls, focal: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        """Check that focal lengths are in pixels, by the field of view, and alike."""
        width = info.data.get("image_size", (0, 0))[0]
        if min(focal) < LEAST_FOCAL * width:
            raise FieldError(
                "the focal length looks like millimetres",
                found=list(focal),
                expected="pixels, which is millimetres divided by the size of a pixel in mm",
            )
        if width and max(focal) > MOST_FOCAL * width:
            raise FieldError(
                "no lens has this focal length",
                found=f"{max(focal):g}",
                expected=f"at most {MOST_FOCAL:g} times the image's width of {width}",
            )
        if max(focal) > MOST_ASPECT * min(focal):
            raise FieldError(
                "the two focal lengths differ too much",
                found=list(focal),
                expected=f"a ratio of at most {MOST_ASPECT:g}",
            )
        return focal

    @field_validator("center")
    @classmethod
    def _in_image(cls, center: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        """Check that the principal point lies in the image, where no covariance states how well it
        is determined.
        """
        size = info.data.get("image_size")
        if size is None or info.data.get("covariance") is not None:
            return center
        if all(-0.5 <= c <= n - 0.5 for c, n in zip(center, size, strict=True)):
            return center
        raise FieldError(
            "the principal point lies outside the image",
            found=list(center),
            expected=f"a point in {size[0]}x{size[1]} pixels, the size of the images that were"
            " calibrated",
        )


USUAL_FOCAL, USUAL_ASPECT, USUAL_CENTRE, USUAL_DISTORTION = 0.005, 0.001, 0.01, 0.05
"""Standard deviations for a camera whose file has no covariance: relative, of the focal lengths and
of their ratio; of the principal point, in image widths; of the first distortion coefficient. They
stand for a zoom ring turned by a hair, pixels square to a thousandth, a sensor off the lens's axis,
and the distortion of most lenses."""


class LensSearch(NamedTuple):
    """Starting values and sets of distortion coefficients by which a model is calibrated.

    focal_range : of the pixels per radian at the image's centre, as a share of its width.
    terms : sets of free distortion coefficients, from few to many; the first of equal ones wins.
    own : starting values of the model's own fields.
    """

    focal_range: tuple[float, float]
    terms: tuple[tuple[str, ...], ...]
    own: tuple[tuple[float, ...], ...] = ((),)


class LensViolation(NamedTuple):
    """Model violation of a camera file by k numbers, the amplitudes.

    columns : (n, k) change of the camera's parameters by the amplitudes. usual : their standard
    deviation for a camera that was not calibrated carefully. facts : of the finding, beside the
    estimates. code : last part of the finding's code.
    """

    code: str
    columns: Array
    usual: float
    facts: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Camera(ABC):
    """Intrinsics of a central camera.

    covariance : (n, n) of the parameters from the camera's calibration; None where unknown.
    image_size : (width, height) in pixels.
    parameters : (n,) intrinsics in the order of ``parameter_names``; pixels for focal and
        center, none for the rest. Pixel centres are at integers, as in OpenCV.
    own : fields of the model's file between ``center`` and ``distortion``. odd : names of the
        parameters whose sign changes when the image is rotated by 180 degrees. search : starting
        values for a calibration.
    """

    model: ClassVar[str]
    parameter_names: ClassVar[tuple[str, ...]]
    schema: ClassVar[type[CameraSchema]]
    own: ClassVar[tuple[str, ...]] = ()
    odd: ClassVar[tuple[str, ...]] = ()
    search: ClassVar[LensSearch]

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
        """:meth:`project` (..., 2) and its directional derivatives (..., 2), px per unit of the
        points, along each of some directions (..., 3).

        The inner loop of searches: a model may override it with a cheaper version in the precision
        of the points.
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

        From the implicit function project(ray) = pixel, so that no model has to implement them:
        with J = d project/d ray, a change of the pixel turns the ray by J's inverse on the ray's
        tangent plane, a change of the parameters by minus that times d project/d parameters.
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
        """The camera of a file's fields, validated by the model's ``schema``.

        Parameters are in the order of the fields: focal, center, the model's ``own``, distortion,
        which may be absent or shorter.
        """
        own = [getattr(document, name) for name in cls.own]
        k = np.zeros(len(cls.parameter_names) - 4 - len(own))
        k[: len(document.distortion)] = document.distortion
        return cls(document.image_size, np.concatenate([document.focal, document.center, own, k]))

    @classmethod
    def own_range(cls) -> Array:
        """Bounds (2, k) of the model's own fields, from its ``schema``."""
        bounds = np.array([[-np.inf], [np.inf]]).repeat(len(cls.own), axis=1)
        for k, name in enumerate(cls.own):
            for limit in cls.schema.model_fields[name].metadata:
                low, above = getattr(limit, "ge", -np.inf), getattr(limit, "gt", -np.inf)
                bounds[0, k] = max(bounds[0, k], low, above + FIELD_MARGIN)
                bounds[1, k] = min(bounds[1, k], getattr(limit, "le", np.inf))
        return bounds

    @property
    def focal(self) -> Array:
        """(2,) focal lengths, px."""
        return self.parameters[FOCAL]

    @property
    def center(self) -> Array:
        """(2,) principal point, px."""
        return self.parameters[CENTER]

    def shifted(self, offset: Array) -> Self:
        """The camera of images shifted by ``offset`` (2,), px: with another principal point."""
        parameters = self.parameters.copy()
        parameters[CENTER] += offset
        return replace(self, parameters=parameters)

    def resampled(self, factor: float, image_size: tuple[int, int]) -> Self:
        """The camera of images with ``factor`` pixels in place of one, of another size."""
        parameters = self.parameters.copy()
        parameters[PIXEL_PARAMETERS] *= factor
        # pixel centres are at integers, so the image's corner is at -0.5
        camera = replace(self, image_size=image_size, parameters=parameters, covariance=None)
        return camera.shifted(np.full(2, (factor - 1) / 2))

    @property
    def focal_part(self) -> Array:
        """(n,) change of the parameters when the focal lengths grow by their own size."""
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
        """The usual model violations: another focus, another aspect of pixels, an image cropped
        differently, distortion left out.
        """
        eye, lens = np.eye(len(self.parameters)), 4 + len(self.own)
        out = (
            LensViolation("focal", self.focal_part[:, None], USUAL_FOCAL),
            LensViolation("aspect", self.aspect_part[:, None], USUAL_ASPECT),
            LensViolation("centre", eye[:, CENTER], USUAL_CENTRE * self.image_size[0]),
        )
        if lens == len(self.parameters):
            return out  # a model without distortion
        facts = {"coefficient": self.parameter_names[lens], "stated": float(self.parameters[lens])}
        column = eye[:, lens : lens + 1]
        return (*out, LensViolation("distortion", column, USUAL_DISTORTION, facts))

    def usual_covariance(self) -> Array:
        """Covariance (n, n) of the parameters without a calibration, from the usual violations."""
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
        """The camera of images with ``count`` x ``count`` pixels averaged to one; incomplete bins
        at the ends of rows and columns are cut off.

        Its derivatives are by the binned parameters, of which PIXEL_PARAMETERS are smaller by
        ``count``.
        """
        if count == 1:
            return self
        width, height = self.image_size
        return self.resampled(1 / count, (width // count, height // count))

    def turned_by_half(self) -> Self:
        """The camera of images rotated by 180 degrees: the camera, rotated about its axis."""
        sign = np.where(np.isin(self.parameter_names, self.odd), -1.0, 1.0)
        sign[CENTER] = -1.0
        covariance = None if self.covariance is None else self.covariance * np.outer(sign, sign)
        reflected = replace(self, parameters=sign * self.parameters, covariance=covariance)
        return reflected.shifted(np.asarray(self.image_size) - 1.0)

    def in_image(self, pixels: Array, margin: float = 0.0) -> Booleans:
        """Whether pixels (..., 2) are in the image, ``margin`` px or more inside; (...)."""
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
