"""Joint at a limb's end as stated in the file: a centre, possibly with an axis.

A spherical joint has a centre. A universal joint has its first axis, fixed to the body it is
mounted on, and may have its second axis at an offset from it. A revolute joint has one axis, about
which the limb rotates. The joint is on the base and not moved by the reading, or on a platform that
is one rigid body.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Metres, Point, Schema
from pkmcal.geometry.batches import turned
from pkmcal.mechanisms.carriers.contract import (
    AxisRole,
    BaseCarrier,
    Carrier,
    Chain,
    Direction,
    PlatformCarrier,
    Site,
    vectors,
)


class JointDocument(Schema):
    """Joint in a file, ``{joint: revolute, center: [x, y, z], axis: [x, y, z]}``: m, body frame."""

    joint: Literal["spherical", "universal", "revolute"]
    center: Point
    axis: Direction | None = None
    offset: (
        Annotated[
            Metres,
            Field(ge=-1, le=1, description="the distance of a universal joint's second axis from"
                  " its first one, such as 12 mm, positive towards the leg's other end"),
        ]
        | None
    ) = None  # fmt: skip


class JointEnd(Carrier):
    """Limb's end at a joint; ``center`` in metres, in the frame of its body."""

    joints: ClassVar = ("spherical", "universal", "revolute")
    schema: ClassVar = JointDocument
    parameters: ClassVar = vectors("center", "m", "center")

    @classmethod
    def check(cls, node: JointDocument, site: Site) -> None:
        """Refuse an axis on a spherical joint, and a revolute joint of a spatial machine without
        one.
        """
        if node.joint == "spherical" and node.axis is not None:
            raise InputError(
                f"leg {site.leg} has a spherical joint with an axis",
                where=site.where("axis"),
                expected="no axis, or joint: universal or revolute",
            )
        if node.joint == "revolute" and node.axis is None and not site.planar:
            raise InputError(
                f"leg {site.leg} has a revolute joint without an axis",
                where=site.where(),
                expected=f"axis: [x, y, z] in the {site.side} frame, the direction that it turns"
                " about",
            )
        if node.offset is not None and (node.joint != "universal" or node.axis is None):
            raise InputError(
                f"leg {site.leg} has an offset of a joint's axes, but no two axes",
                where=site.where("offset"),
                expected="joint: universal with axis: [x, y, z], its first one",
            )
        super().check(node, site)

    @staticmethod
    def axis_role(node: Any) -> AxisRole | None:
        """Square for a revolute joint, whose limb is orthogonal to the axis; twist for a universal
        joint with an axis and no offset.
        """
        if node.joint == "revolute":
            return "square"
        meets = node.joint == "universal" and node.axis is not None and node.offset is None
        return "twist" if meets else None

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """Fixed centre."""
        none = np.zeros_like(parameters)
        return Chain("fixed", parameters, none, none)


@final
class FixedPoint(JointEnd, BaseCarrier):
    """Spherical, universal or revolute joint on the base; ``center`` in metres, base frame."""

    @staticmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """A is the centre (..., 3), for any reading."""
        del readings
        return parameters, np.zeros_like(parameters)

    @classmethod
    def by_parameters(cls, parameters: Array, readings: Array) -> Array:
        """Identity."""
        shape = np.broadcast_shapes(parameters.shape[:-1], readings.shape)
        return np.broadcast_to(np.eye(3), (*shape, 3, 3))


@final
class RigidPlatform(JointEnd, PlatformCarrier):
    """Spherical, universal or revolute joint on a platform that is one rigid body."""

    @staticmethod
    def place(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> tuple[Array, Array]:
        """B = R b + t, with lever arm R b."""
        del internal
        arm = turned(T_base_platform[..., :3, :3], parameters)
        return arm + T_base_platform[..., :3, 3], arm

    @classmethod
    def by_parameters(
        cls, parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """Rotation R."""
        del internal
        shape = np.broadcast_shapes(parameters.shape[:-1], T_base_platform.shape[:-2])
        return np.broadcast_to(T_base_platform[..., :3, :3], (*shape, 3, 3))
