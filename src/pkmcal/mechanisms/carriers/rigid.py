"""A joint centre on a rigid platform: B moves with the platform's pose."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import skew
from pkmcal.mechanisms.carriers.contract import (
    CarriedPoint,
    PlatformCarrier,
    moved_point,
    point_by_frame,
    turned_blocks,
)
from pkmcal.mechanisms.carriers.fixed import CENTER
from pkmcal.mechanisms.joints import JointDocument


@final
class RigidPlatform(PlatformCarrier):
    """Spherical, universal or revolute joint on a platform that is one rigid body."""

    joints: ClassVar = ("spherical", "universal", "revolute")
    schema: ClassVar = JointDocument
    parameters: ClassVar = CENTER

    @staticmethod
    def point(
        parameters: Array, T_base_platform: Array, internal: Array | None = None
    ) -> CarriedPoint:
        """B = R b + t; by the pose's left perturbation, dB = -[R b]x omega + tau."""
        del internal
        rot = T_base_platform[..., :3, :3]
        turned = (rot @ parameters[..., None])[..., 0]
        by_parameters = np.broadcast_to(rot, (*turned.shape, 3))
        return CarriedPoint(turned + T_base_platform[..., :3, 3], by_pose(turned), by_parameters)

    @staticmethod
    def moved(parameters: Array, e: Array, f: Array) -> Array:
        """The centre moves with the platform frame."""
        del e
        return moved_point(parameters, f)

    @staticmethod
    def by_frames(parameters: Array) -> Array:
        """F's columns alone."""
        own = point_by_frame(parameters)
        return np.concatenate([np.zeros_like(own), own], axis=-1)

    @staticmethod
    def carried(parameters: Array, e: Array, f: Array) -> Array:
        """A turn."""
        del parameters, e
        return turned_blocks(3, (0, f))


def by_pose(turned: Array) -> Array:
    """Change (..., 3, 6) of a platform's point by the pose, its turned arm (..., 3) given."""
    out = np.zeros((*turned.shape, 6))
    out[..., :3] = -skew(turned)
    out[..., 3:] = np.eye(3)
    return out
