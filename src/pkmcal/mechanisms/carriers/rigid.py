"""A joint centre on a rigid platform: B moves with the platform's pose."""

from __future__ import annotations

from typing import final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.batches import turned
from pkmcal.mechanisms.carriers.contract import PlatformCarrier
from pkmcal.mechanisms.carriers.joint import JointEnd


@final
class RigidPlatform(JointEnd, PlatformCarrier):
    """Spherical, universal or revolute joint on a platform that is one rigid body."""

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
