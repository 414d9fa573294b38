"""Layout of the rows of all groups: K configurations of G places for measurements each, padded."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

Item = TypeVar("Item", covariant=True)
Numbers = TypeVar("Numbers")


class RowGroups(NamedTuple, Generic[Item]):
    """One value for each group of rows: edges, poses (of boards and targets), and links.

    Several kinds of measurement share a group. An estimate weights, counts and scales all groups in
    the same way. Readings are not a group, since they have no robust weight.
    """

    edges: Item
    poses: Item
    links: Item

    def __repr__(self) -> str:
        return "RowGroups(edges, poses, links)"


@dataclass(frozen=True)
class RowGroup:
    """Rows of one group in a problem.

    rows : slice among a configuration's rows.
    present : (K, G) False for padding.
    weight : (B or 1, K, G).
    whiten : (B or 1, K, G, n, n).
    """

    rows: slice
    present: Booleans
    weight: Array
    whiten: Array

    @property
    def count(self) -> Integers:
        """Number (K, G) of residuals of each measurement: six for a board's pose, three for a
        point, none for padding.
        """
        return np.any(self.whiten != 0, axis=-1).sum(axis=-1).max(axis=0)

    @property
    def measured(self) -> Booleans:
        """Whether a run has a measurement at a place, (B or 1, K, G): its whitening is not zero."""
        return self.present & np.any(self.whiten != 0, axis=(-2, -1))

    def ones(self, n_runs: int) -> Array:
        """Full weights (B, K, G) of all measurements; zero where there is none."""
        return np.broadcast_to(self.measured, (n_runs, *self.present.shape)).astype(float)


def among(numbers: Numbers, configurations: slice, axis: int) -> Numbers:
    """Restrict all arrays of a dataclass to some configurations; ``axis`` is their axis.

    Arrays of length 1 or 0 along that axis, which hold for all configurations, stay.
    """
    whole: Any = numbers
    cut = (slice(None),) * axis + (configurations,)
    values = ((f.name, getattr(whole, f.name)) for f in fields(whole))
    arrays = ((name, x) for name, x in values if isinstance(x, np.ndarray))
    return replace(whole, **{name: x[cut] for name, x in arrays if x.shape[axis] > 1})
