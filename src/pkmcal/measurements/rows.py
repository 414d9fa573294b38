"""What all sorts of rows have in common: places of measurements in configurations, padded.

Measurements stand in K configurations of G places each, padded to a common count.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

Item = TypeVar("Item", covariant=True)
Numbers = TypeVar("Numbers")


class Kinds(NamedTuple, Generic[Item]):
    """Something of each sort of rows: of the edges, of the poses of boards and targets, and of what
    links configurations.

    An estimate weighs, counts and scales all kinds alike. Readings are none: no robust weight lets
    them go.
    """

    edges: Item
    poses: Item
    links: Item


@dataclass(frozen=True)
class RowsOfKind:
    """The rows of one sort in a problem.

    rows : those of a configuration that are its. present : (K, G) False for padding. weight :
    (B or 1, K, G). whiten : (B or 1, K, G, n, n).
    """

    rows: slice
    present: Booleans
    weight: Array
    whiten: Array

    @property
    def count(self) -> Integers:
        """Residuals of each measurement, (K, G): a board's pose has six, a point's three of them,
        padding none.
        """
        return np.any(self.whiten[0] != 0, axis=-1).sum(axis=-1)


def among(numbers: Numbers, configurations: slice, axis: int) -> Numbers:
    """All arrays of a dataclass cut along the configurations' axis; what is the same for all of
    them, a single one or none, stays.
    """
    whole: Any = numbers
    cut = (slice(None),) * axis + (configurations,)
    values = ((f.name, getattr(whole, f.name)) for f in fields(whole))
    arrays = ((name, x) for name, x in values if isinstance(x, np.ndarray))
    return replace(whole, **{name: x[cut] for name, x in arrays if x.shape[axis] > 1})
