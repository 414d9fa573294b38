"""Slider on the base, moved by a motor: A moves along a guide (linear delta, hexaglide)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Point, Schema
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.carriers.contract import (
    IN_PLANE,
    BaseCarrier,
    Chain,
    Direction,
    NamedMotion,
    Site,
    Stroke,
    vectors,
)


class SliderDocument(Schema):
    """Slider in a file, ``{joint: slider, center: [x, y, z], axis: [x, y, z]}``: metres, base
    frame.
    """

    joint: Literal["slider"]
    center: Annotated[
        Point,
        Field(description="the joint's place [x, y, z] at reading zero, metres, base frame"),
    ]
    axis: Annotated[Direction, Field(description="the direction [x, y, z] of a growing reading")]
    motor: Annotated[int, Field(ge=1)] | None = None
    range: Stroke | None = None


@final
class Slider(BaseCarrier):
    """Joint on a carriage, ``A = center + reading * v``, with the unit axis v."""

    driven: ClassVar = True
    joints: ClassVar = ("slider",)
    schema: ClassVar = SliderDocument
    shared: ClassVar = ("axis",)
    held_in_plane: ClassVar = ("axis.z",)
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *vectors("axis", "1", "axis"),
    )

    @classmethod
    def check(cls, node: SliderDocument, site: Site) -> None:
        """Refuse guides that leave the plane of a planar machine."""
        if site.planar and abs(node.axis[2]) > IN_PLANE:
            raise InputError(
                f"the slider of leg {site.leg} leaves the plane of a planar machine",
                where=site.where("axis"),
                expected="[x, y, 0]: a planar machine moves in the base frame's x-y plane",
            )

    @staticmethod
    def motions(parameters: Array, readings: Array) -> tuple[NamedMotion, ...]:
        """Tilt of the guide about the mean position of its carriage."""
        del parameters
        lean = np.zeros((6, 3))
        lean[3:] = np.eye(3)
        lean[:3] = -np.nanmean(readings) * np.eye(3)
        return (
            NamedMotion(
                lean,
                one="the tilt of the guide of {legs} cannot be separated from its position{better}",
                several="the tilts of the guides of {legs} cannot be separated from their positions"
                "{better}",
                together="the tilts of the guides of {legs} to each other cannot be separated from"
                " their positions{better} {ways}{mostly}",
            ),
        )

    @staticmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """A, and its derivative v."""
        axis = parameters[..., 3:]
        v = axis / np.sqrt(dot(axis, axis))[..., None]
        return parameters[..., :3] + readings[..., None] * v, v

    @classmethod
    def by_parameters(cls, parameters: Array, readings: Array) -> Array:
        """Identity for the centre; rotation only for the axis, whose length has no effect."""
        axis = parameters[..., 3:]
        size = np.sqrt(dot(axis, axis))[..., None]
        v, q = axis / size, readings[..., None]
        shape = np.broadcast_shapes(parameters.shape[:-1], readings.shape)
        out = np.zeros((*shape, 3, 6))
        out[..., :3] = np.eye(3)
        across = np.eye(3) - v[..., :, None] * v[..., None, :]
        out[..., 3:] = (q / size)[..., None] * across
        return out

    @classmethod
    def reading(cls, parameters: Array, point_b: Array, length: Array, near: Array) -> Array:
        """Readings ``q = d . v -+ sqrt(length^2 - |d|^2 + (d . v)^2)`` in closed form, with d = B -
        center and v the unit axis.
        """
        axis = parameters[..., 3:]
        v = axis / np.sqrt(dot(axis, axis))[..., None]
        d = point_b - parameters[..., :3]
        middle = dot(d, v)
        square = length**2 - dot(d, d) + middle**2
        half = np.sqrt(np.where(square >= 0, square, np.nan))
        first, second = middle + half, middle - half
        return np.where(np.abs(first - near) <= np.abs(second - near), first, second)

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """Slide from the centre along v."""
        center, axis = parameters[..., :3], parameters[..., 3:]
        return Chain(
            "slide", center, axis / np.sqrt(dot(axis, axis))[..., None], np.zeros_like(center)
        )
