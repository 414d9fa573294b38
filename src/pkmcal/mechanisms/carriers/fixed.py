"""A joint centre fixed to the base: A does not move with the reading."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.mechanisms.carriers.contract import (
    BaseCarrier,
    Chain,
    Site,
    vectors,
)
from pkmcal.mechanisms.carriers.joint import JointDocument, check_joint, joint_axis_role

CENTER = vectors("center", "m", "center")


@final
class FixedPoint(BaseCarrier):
    """Spherical, universal or revolute joint on the base; ``center`` in metres, base frame."""

    joints: ClassVar = ("spherical", "universal", "revolute")
    schema: ClassVar = JointDocument
    parameters: ClassVar = CENTER
    axis_role = staticmethod(joint_axis_role)

    @classmethod
    def check(cls, node: JointDocument, site: Site) -> None:
        """An axis where the joint has one, and none where not."""
        check_joint(node, site)
        super().check(node, site)

    @staticmethod
    def place(parameters: Array, readings: Array) -> tuple[Array, Array]:
        """A is the centre itself, (..., 3), whatever the reading."""
        del readings
        return parameters, np.zeros_like(parameters)

    @classmethod
    def by_parameters(cls, parameters: Array, readings: Array) -> Array:
        """Identity."""
        shape = np.broadcast_shapes(parameters.shape[:-1], readings.shape)
        return np.broadcast_to(np.eye(3), (*shape, 3, 3))

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """The centre, without a joint."""
        none = np.zeros_like(parameters)
        return Chain("fixed", parameters, none, none)
