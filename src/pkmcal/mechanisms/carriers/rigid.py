"""A joint centre on a rigid platform: B moves with the platform's pose."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import skew
from pkmcal.mechanisms.carriers.contract import CarriedPoint, PlatformCarrier
from pkmcal.mechanisms.carriers.fixed import CENTER
from pkmcal.mechanisms.joints import JointDocument


@final
class RigidPlatform(PlatformCarrier):
    """Spherical, universal or revolute joint on a platform that is one rigid body."""

    joints: ClassVar = ("spherical", "universal", "revolute")
    schema: ClassVar = JointDocument
    parameters: ClassVar = CENTER

    @staticmethod
    def point(parameters: Array, T_base_platform: Array) -> CarriedPoint:
        """B = R b + t; by the pose's left perturbation, dB = -[R b]x omega + tau."""
        rot = T_base_platform[..., :3, :3]
        turned = (rot @ parameters[..., None])[..., 0]
        by_pose = np.zeros((*turned.shape, 6))
        by_pose[..., :3] = -skew(turned)
        by_pose[..., 3:] = np.eye(3)
        by_parameters = np.broadcast_to(rot, (*turned.shape, 3))
        return CarriedPoint(turned + T_base_platform[..., :3, 3], by_pose, by_parameters)
