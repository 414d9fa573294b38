"""A joint at a limb's end as it stands in the file: a centre, and perhaps an axis.

A spherical joint has a centre. A universal joint has its first axis, fixed to the body that it
stands on; a revolute joint has one axis, and the limb turns about it.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import Point, Schema
from pkmcal.mechanisms.carriers.contract import AxisRole, Carrier, Chain, Direction, Site, vectors


class JointDocument(Schema):
    """``{joint: revolute, center: [x, y, z], axis: [x, y, z]}``: metres, the body's frame."""

    joint: Literal["spherical", "universal", "revolute"]
    center: Point
    axis: Direction | None = None


class JointEnd(Carrier):
    """A limb's end at such a joint; ``center`` in metres, in the frame of what it stands on."""

    joints: ClassVar = ("spherical", "universal", "revolute")
    schema: ClassVar = JointDocument
    parameters: ClassVar = vectors("center", "m", "center")

    @classmethod
    def check(cls, node: JointDocument, site: Site) -> None:
        """An axis where the joint has one, and none where not."""
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
        super().check(node, site)

    @staticmethod
    def axis_role(node: Any) -> AxisRole | None:
        """A revolute joint's limb is square to its axis; a universal joint with an axis holds
        twist.
        """
        if node.joint == "revolute":
            return "square"
        return "twist" if node.joint == "universal" and node.axis is not None else None

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """The centre, without a joint that a motor moves."""
        none = np.zeros_like(parameters)
        return Chain("fixed", parameters, none, none)
