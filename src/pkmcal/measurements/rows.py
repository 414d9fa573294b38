"""Common parts of all kinds of rows: positions of measurements in configurations, padded.

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
    """A value for each kind of rows: edges, poses of boards and targets, links.

    An estimate weights, counts and scales these kinds alike. Readings are not among them, for they
    have no robust weights.
    """

    edges: Item
    poses: Item
    links: Item


@dataclass(frozen=True)
class RowsOfKind:
    """The rows of one kind in a problem.

    rows : of a configuration. present : (K, G) False for padding. weight :
    (B or 1, K, G). whiten : (B or 1, K, G, n, n).
    """

    rows: slice
    present: Booleans
    weight: Array
    whiten: Array

    @property
    def count(self) -> Integers:
        """Number of residuals of each measurement, (K, G): a board's pose has six, a point three,
        padding none.
        """
        return np.any(self.whiten[0] != 0, axis=-1).sum(axis=-1)


def among(numbers: Numbers, configurations: slice, axis: int) -> Numbers:
    """A dataclass whose arrays are cut along the axis of the configurations; arrays of length one
    or zero along it, which hold for all configurations, stay.
    """
    whole: Any = numbers
    cut = (slice(None),) * axis + (configurations,)
    values = ((f.name, getattr(whole, f.name)) for f in fields(whole))
    arrays = ((name, x) for name, x in values if isinstance(x, np.ndarray))
    return replace(whole, **{name: x[cut] for name, x in arrays if x.shape[axis] > 1})
