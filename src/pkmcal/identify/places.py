"""Positions of measurements in configurations, padded to a common number."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

FilledNumbers = TypeVar("FilledNumbers", Array, Integers)


@dataclass(frozen=True)
class Places:
    """Positions of N measurements among K' configurations of G each: row, place (N,)."""

    row: Integers
    place: Integers
    shape: tuple[int, int]

    def filled(self, values: FilledNumbers) -> FilledNumbers:
        """Scatter values (N, ...) to their positions, (K', G, ...); zero for padding."""
        count, each = self.shape
        out = np.zeros((count * each, *values.shape[1:]), dtype=values.dtype)
        out[self.row * each + self.place] = values
        return cast(FilledNumbers, out.reshape(*self.shape, *values.shape[1:]))

    def taken(self, values: Array) -> Array:
        """Gather values (N, ...) from the positions of the measurements in (K', G, ...)."""
        return values[self.row, self.place]

    @property
    def present(self) -> Booleans:
        """(K', G) False for padding."""
        return self.filled(np.ones(len(self.row), dtype=int)).astype(bool)
