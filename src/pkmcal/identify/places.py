"""Where measurements stand among configurations of a common number of places, padded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

FilledNumbers = TypeVar("FilledNumbers", Array, Integers)


@dataclass(frozen=True)
class Places:
    """Where N measurements stand among K' configurations of G places each: row, place (N,)."""

    row: Integers
    place: Integers
    shape: tuple[int, int]

    def filled(self, values: FilledNumbers) -> FilledNumbers:
        """Values (N, ...) at their places, (K', G, ...); zero where there is none."""
        count, each = self.shape
        out = np.zeros((count * each, *values.shape[1:]), dtype=values.dtype)
        out[self.row * each + self.place] = values
        return cast(FilledNumbers, out.reshape(*self.shape, *values.shape[1:]))

    def taken(self, values: Array) -> Array:
        """Of values (K', G, ...) those at the measurements' places, (N, ...)."""
        return values[self.row, self.place]

    @property
    def present(self) -> Booleans:
        """(K', G) where there is one."""
        return self.filled(np.ones(len(self.row), dtype=int)).astype(bool)
