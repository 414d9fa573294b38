"""Side bars of the H4's nacelle, hinged on a rotating centre bar ([C] fig. 3).

With ideal parallelograms as forearms the side bars keep their direction: ``bar``. With each rod
modelled on its own, they rotate slightly about their hinges: ``hinged-bar``.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Point, Schema
from pkmcal.geometry.batches import turned
from pkmcal.geometry.rigid import axial, cross, dot, rotation, skew
from pkmcal.mechanisms.carriers.contract import (
    Chain,
    Direction,
    PlatformCarrier,
    Site,
    direction_by_frame,
    moved_direction,
    moved_point,
    point_by_frame,
    turned_blocks,
    vectors,
)

BarNumber = Annotated[int, Field(ge=1, description="the number of the side bar, from 1")]
Centre = Annotated[Point, Field(description="a point [x, y, z] in metres")]


FOLDED_BARS_CLAUSE = "its side bars lie on each other"
"""Obstacle to a rotation of the platform by a right angle."""


class BarDocument(Schema):
    """Bar in a file, ``{joint: bar, center: [0, 0.06, 0], hinge: [0.06, 0, 0], bar: 1}``: m."""

    joint: Literal["bar"]
    center: Centre
    hinge: Centre
    bar: BarNumber


class HingedBarDocument(Schema):
    """Hinged bar in a file, ``{joint: hinged-bar, center: [...], hinge: [...], axis: [0, 0, 1],
    bar: 1}``: metres.
    """

    joint: Literal["hinged-bar"]
    center: Centre
    hinge: Centre
    axis: Annotated[Direction, Field(description="the direction [x, y, z] of the hinge")]
    bar: BarNumber


@final
class Bar(PlatformCarrier):
    """Joint on a bar of constant direction, ``B = t + R hinge + center``: the hinge rotates with
    the platform, the bar does not.

    hinge : platform frame.
    center : from the hinge to the joint, along the base frame's axes.

    [C] fig. 3: hinge (s h, 0, 0), center (0, t d, 0).
    """

    body: ClassVar = "bar"
    floats: ClassVar = True
    most_turn: ClassVar = np.pi / 2
    obstacle: ClassVar = FOLDED_BARS_CLAUSE
    joints: ClassVar = ("bar",)
    schema: ClassVar = BarDocument
    shared: ClassVar = ("hinge",)
    called: ClassVar = "side bars' joints (half a bar's width)"
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *vectors("hinge", "m", "center", label="hinge", part="hinge"),
    )

    @classmethod
    def check(cls, node: BarDocument, site: Site) -> None:
        """Refuse spatial motion: bars keep their direction only if the platform does not tilt."""
        super().check(node, site)
        if site.motion == "spatial":
            raise InputError(
                f"leg {site.leg} ends on a bar that keeps its direction, on a platform that may "
                "tilt",
                where=site.where("joint"),
                expected="motion: schoenflies, or joint: hinged-bar with an axis and two rods a "
                "motor",
            )

    @staticmethod
    def place(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> tuple[Array, Array]:
        """B, with the rotated hinge as lever arm: the bar does not rotate."""
        del internal
        arm = turned(T_base_platform[..., :3, :3], parameters[..., 3:])
        return arm + T_base_platform[..., :3, 3] + parameters[..., :3], arm

    @classmethod
    def by_parameters(
        cls, parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """Identity for the bar, R for the hinge."""
        del internal
        shape = np.broadcast_shapes(parameters.shape[:-1], T_base_platform.shape[:-2])
        out = np.zeros((*shape, 3, 6))
        out[..., :3], out[..., 3:] = np.eye(3), T_base_platform[..., :3, :3]
        return out

    @classmethod
    def reframed(cls, parameters: Array, e: Array, f: Array) -> Array:
        """Parameters in new frames: the bar rotates with the base frame, the hinge moves with the
        platform frame.
        """
        parts = moved_direction(parameters[..., :3], e), moved_point(parameters[..., 3:], f)
        return np.concatenate(parts, axis=-1)

    @classmethod
    def by_frames(cls, parameters: Array) -> Array:
        """Derivatives by E for the bar, by F for the hinge."""
        bar = direction_by_frame(parameters[..., :3])
        hinge = point_by_frame(parameters[..., 3:])
        none = np.zeros_like(bar)
        return np.concatenate(
            [np.concatenate([bar, none], axis=-1), np.concatenate([none, hinge], axis=-1)], axis=-2
        )

    @classmethod
    def carried(cls, parameters: Array, e: Array, f: Array) -> Array:
        """Rotations of both."""
        del parameters
        return turned_blocks(6, (0, e), (3, f))

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """Floating arm from the hinge, along the base frame's axes."""
        center, hinge = parameters[..., :3], parameters[..., 3:]
        return Chain("float", hinge, np.zeros_like(center), center)


@final
class HingedBar(PlatformCarrier):
    """Joint on a hinged bar, ``B = t + R (hinge + Exp(phi w) center)``, with the hinge's unit axis
    w, all in the platform frame; phi is the bar's internal coordinate (errata, [C] "Rods").
    """

    body: ClassVar = "bar"
    ways: ClassVar = ("center",)
    turns: ClassVar = True
    most_turn: ClassVar = np.pi / 2
    obstacle: ClassVar = FOLDED_BARS_CLAUSE
    joints: ClassVar = ("hinged-bar",)
    schema: ClassVar = HingedBarDocument
    shared: ClassVar = ("hinge", "axis")
    called: ClassVar = "side bars' joints"
    parameters: ClassVar = (
        *vectors("center", "m", "center"),
        *vectors("hinge", "m", "center", label="hinge", part="hinge"),
        *vectors("axis", "1", "axis"),
    )

    @classmethod
    def check(cls, node: HingedBarDocument, site: Site) -> None:
        """Refuse motions other than spatial: a bar that rotates freely lets the platform tilt."""
        super().check(node, site)
        if site.motion != "spatial":
            raise InputError(
                f"leg {site.leg} ends on a bar that turns about a hinge, which tilts the platform",
                where=site.where("joint"),
                expected="motion: spatial, or joint: bar",
            )

    @staticmethod
    def place(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> tuple[Array, Array]:
        """B, with B - t as lever arm."""
        center, axis = parameters[..., :3], parameters[..., 6:]
        w = axis / np.sqrt(dot(axis, axis))[..., None]
        cos, sin = _cos_sin(internal)
        swung = cos * center + sin * cross(w, center) + (1 - cos) * dot(w, center)[..., None] * w
        arm = turned(T_base_platform[..., :3, :3], parameters[..., 3:6] + swung)
        return arm + T_base_platform[..., :3, 3], arm

    @classmethod
    def by_parameters(
        cls, parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """Derivatives in the parameters' order: center, hinge, axis."""
        rot = T_base_platform[..., :3, :3]
        center, axis = parameters[..., :3], parameters[..., 6:]
        size = np.sqrt(dot(axis, axis))[..., None]
        w = axis / size
        cos, sin = _cos_sin(internal)
        high = dot(w, center)[..., None]
        eye = np.eye(3)
        outer = w[..., :, None] * w[..., None, :]
        c, s = cos[..., None], sin[..., None]
        by_center = c * eye + s * skew(w) + (1 - c) * outer
        by_w = -s * skew(center)
        by_w = by_w + (1 - c) * (high[..., None] * eye + w[..., :, None] * center[..., None, :])
        by_axis = by_w @ (eye - outer) / size[..., None]
        by_center, by_axis = rot @ by_center, rot @ by_axis
        out = np.zeros((*np.broadcast_shapes(by_center.shape, by_axis.shape)[:-1], 9))
        out[..., :3], out[..., 3:6], out[..., 6:] = by_center, rot, by_axis
        return out

    @staticmethod
    def upright(parameters: Array, T_base_platform: Array) -> Array:
        """Minus the platform's rotation about the hinge: the part about w of the rotation's
        quaternion.
        """
        axis, rot = parameters[..., 6:], T_base_platform[..., :3, :3]
        along = dot(axial(rot), axis) / np.sqrt(dot(axis, axis))
        return -2 * np.arctan2(along, 1 + np.trace(rot, axis1=-2, axis2=-1))

    @staticmethod
    def by_internal(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """``R (w x Exp(phi w) center)``."""
        center, axis = parameters[..., :3], parameters[..., 6:]
        w = axis / np.sqrt(dot(axis, axis))[..., None]
        cos, sin = _cos_sin(internal)
        side = cross(w, center)
        ahead = cos * side + sin * cross(w, side)
        return turned(T_base_platform[..., :3, :3], ahead)

    @staticmethod
    def slid(parameters: Array, shift: Array, turn: Array) -> Array:
        """Same bar with the hinge's point moved along the axis, and the zero of phi rotated.

        parameters : (..., n).
        shift : (...,) m.
        turn : (...,) rad; internal coordinates decrease by it.
        """
        axis = parameters[..., 6:]
        w = axis / np.sqrt(dot(axis, axis))[..., None]
        along, out = shift[..., None] * w, parameters.copy()
        swung = (rotation(turn[..., None] * w) @ parameters[..., :3, None])[..., 0]
        out[..., :3], out[..., 3:6] = swung - along, parameters[..., 3:6] + along
        return out

    @staticmethod
    def by_slide(parameters: Array) -> Array:
        """Derivatives (..., n, 2) of :meth:`slid` by shift and turn."""
        axis = parameters[..., 6:]
        w = axis / np.sqrt(dot(axis, axis))[..., None]
        out = np.zeros((*parameters.shape, 2))
        out[..., :3, 0], out[..., 3:6, 0] = -w, w
        out[..., :3, 1] = cross(w, parameters[..., :3])
        return out

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """Rotation about w through the hinge's point on the platform."""
        axis = parameters[..., 6:]
        w = axis / np.sqrt(dot(axis, axis))[..., None]
        return Chain("turn", parameters[..., 3:6], w, parameters[..., :3])


def _cos_sin(internal: Array | None) -> tuple[Array, Array]:
    """Cosine and sine (..., 1) of the internal coordinate, which is zero by default."""
    phi = np.zeros(1) if internal is None else internal[..., None]
    return np.cos(phi), np.sin(phi)
