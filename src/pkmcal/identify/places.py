"""Places of measurements in configurations, padded to a common number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr

FilledNumbers = TypeVar("FilledNumbers", Array, Integers)


@dataclass(frozen=True)
class Places:
    """Places of N measurements among K' configurations of G places each.

    row, place : (N,) configuration and place of each.
    shape : (K', G).
    """

    row: Integers
    place: Integers
    shape: tuple[int, int]
    __repr__ = short_repr

    def filled(self, values: FilledNumbers) -> FilledNumbers:
        """Scatter values (N, ...) to their places, (K', G, ...); zero for padding."""
        count, each = self.shape
        out = np.zeros((count * each, *values.shape[1:]), dtype=values.dtype)
        out[self.row * each + self.place] = values
        return cast(FilledNumbers, out.reshape(*self.shape, *values.shape[1:]))

    def taken(self, values: Array) -> Array:
        """Gather the values (N, ...) of the measurements from (K', G, ...)."""
        return values[self.row, self.place]

    @property
    def present(self) -> Booleans:
        """(K', G) False for padding."""
        return self.filled(np.ones(len(self.row), dtype=int)).astype(bool)
