"""A joint centre on a rigid platform: B moves with the platform's pose."""

from __future__ import annotations

from typing import ClassVar, Literal, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.files import Schema
from pkmcal.geometry.rigid import skew
from pkmcal.mechanisms.carriers.contract import CarriedPoint, PlatformCarrier
from pkmcal.mechanisms.carriers.fixed import CENTER


class RigidDocument(Schema):
    """``platform: {joint: spherical, center: [x, y, z]}``, metres, platform frame."""

    joint: Literal["spherical", "universal"]
    center: tuple[float, float, float]


@final
class RigidPlatform(PlatformCarrier):
    """Spherical or universal joint on a platform that is one rigid body."""

    joints: ClassVar = ("spherical", "universal")
    schema: ClassVar = RigidDocument
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
