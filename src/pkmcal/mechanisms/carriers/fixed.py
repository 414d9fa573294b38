"""A joint centre fixed to the base: A does not move with the reading."""

from __future__ import annotations

from typing import final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.mechanisms.carriers.contract import BaseCarrier
from pkmcal.mechanisms.carriers.joint import JointEnd


@final
class FixedPoint(JointEnd, BaseCarrier):
    """Spherical, universal or revolute joint on the base; ``center`` in metres, base frame."""

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
