"""A joint centre on a rigid platform: B moves with the platform's pose."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.batches import turned
from pkmcal.mechanisms.carriers.contract import (
    Chain,
    PlatformCarrier,
    Site,
)
from pkmcal.mechanisms.carriers.fixed import CENTER
from pkmcal.mechanisms.carriers.joint import JointDocument, check_joint, joint_axis_role


@final
class RigidPlatform(PlatformCarrier):
    """Spherical, universal or revolute joint on a platform that is one rigid body."""

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
    def place(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> tuple[Array, Array]:
        """B = R b + t, the arm R b."""
        del internal
        arm = turned(T_base_platform[..., :3, :3], parameters)
        return arm + T_base_platform[..., :3, 3], arm

    @classmethod
    def by_parameters(
        cls, parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> Array:
        """R."""
        del internal
        shape = np.broadcast_shapes(parameters.shape[:-1], T_base_platform.shape[:-2])
        return np.broadcast_to(T_base_platform[..., :3, :3], (*shape, 3, 3))

    @staticmethod
    def chain(parameters: Array) -> Chain:
        """The centre, without a joint."""
        none = np.zeros_like(parameters)
        return Chain("fixed", parameters, none, none)
