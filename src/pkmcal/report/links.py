"""Where charts lead to: the photographs that are on the page."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array, Integers

Place = tuple[int, int]
"""A photograph by the numbers of its station and configuration."""


@dataclass(frozen=True)
class Links:
    """Links to photographs, empty for those that are not on the page.

    anchors : their names on the page, in its order. by_configuration : the first of each.
    """

    anchors: dict[Place, str] = field(default_factory=dict[Place, str])
    by_configuration: dict[int, str] = field(default_factory=dict[int, str])

    @classmethod
    def of(cls, places: Iterable[Place]) -> Links:
        """To photographs in the page's order."""
        anchors = {(s, k): f"photograph-{s + 1}-{k + 1}" for s, k in places}
        return cls(anchors, {k: name for (_, k), name in reversed([*anchors.items()])})

    def to_configuration(self, k: int) -> str:
        """The link to a configuration's first photograph."""
        return f"#{self.by_configuration[k]}" if k in self.by_configuration else ""

    def to_largest(self, station: Integers, configuration: Integers, size: Array) -> str:
        """The link to the photograph of the largest of some things (n,), NaN left out."""
        order = np.argsort(-np.nan_to_num(size, nan=-np.inf), kind="stable")
        places = zip(station[order].tolist(), configuration[order].tolist(), strict=True)
        return next((f"#{self.anchors[place]}" for place in places if place in self.anchors), "")
