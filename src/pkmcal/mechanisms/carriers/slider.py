"""A slider on the base, moved by a motor: A runs along a guide (linear delta, hexaglide)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.files import Schema
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.carriers.contract import (
    BaseCarrier,
    CarriedPoint,
    direction_by_frame,
    moved_direction,
    moved_point,
    point_by_frame,
    turned_blocks,
    vectors,
)
from pkmcal.mechanisms.joints import Direction, Interval


class SliderDocument(Schema):
    """``{joint: slider, center: [x, y, z], axis: [x, y, z]}``: metres, base frame."""

    joint: Literal["slider"]
    center: Annotated[
        tuple[float, float, float],
        Field(description="the joint's place [x, y, z] at reading zero, metres, base frame"),
    ]
    axis: Annotated[Direction, Field(description="the direction [x, y, z] of a growing reading")]
    motor: Annotated[int, Field(ge=1)] | None = None
    range: Interval | None = None


@final
class Slider(BaseCarrier):
    """``A = center + reading * v``, v the unit axis."""

    driven: ClassVar = True
    joints: ClassVar = ("slider",)
    schema: ClassVar = SliderDocument
    shared: ClassVar = ("axis",)
    parameters: ClassVar = (*vectors("center", "m", "center"), *vectors("axis", "1", "axis"))

    @staticmethod
    def point(parameters: Array, readings: Array) -> CarriedPoint:
        """A, its derivatives by reading and parameters."""
        axis = parameters[..., 3:]
        size = np.sqrt(dot(axis, axis))[..., None]
        v, q = axis / size, readings[..., None]
        value = parameters[..., :3] + q * v
        by_parameters = np.zeros((*value.shape, 6))
        by_parameters[..., :3] = np.eye(3)
        across = np.eye(3) - v[..., :, None] * v[..., None, :]
        by_parameters[..., 3:] = (q / size)[..., None] * across
        return CarriedPoint(value, np.broadcast_to(v, value.shape), by_parameters)

    @staticmethod
    def reading(parameters: Array, point_b: Array, length: Array, near: Array) -> Array:
        """``q = d . v -+ sqrt(length^2 - |d|^2 + (d . v)^2)``, d = B - center."""
        axis = parameters[..., 3:]
        v = axis / np.sqrt(dot(axis, axis))[..., None]
        d = point_b - parameters[..., :3]
        middle = dot(d, v)
        square = length**2 - dot(d, d) + middle**2
        half = np.sqrt(np.where(square >= 0, square, np.nan))
        first, second = middle + half, middle - half
        return np.where(np.abs(first - near) <= np.abs(second - near), first, second)

    @staticmethod
    def moved(parameters: Array, e: Array, f: Array) -> Array:
        """Centre and axis move with the base frame."""
        del f
        parts = moved_point(parameters[..., :3], e), moved_direction(parameters[..., 3:], e)
        return np.concatenate(parts, axis=-1)

    @staticmethod
    def by_frames(parameters: Array) -> Array:
        """E's columns alone."""
        own = np.concatenate(
            [point_by_frame(parameters[..., :3]), direction_by_frame(parameters[..., 3:])], axis=-2
        )
        return np.concatenate([own, np.zeros_like(own)], axis=-1)

    @staticmethod
    def carried(parameters: Array, e: Array, f: Array) -> Array:
        """Turns."""
        del parameters, f
        return turned_blocks(6, (0, e), (3, e))
