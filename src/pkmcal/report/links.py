"""Links from charts to the images on the page."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array, Integers

Place = tuple[int, int]
"""Image by the indices of its station and configuration."""


@dataclass(frozen=True)
class Links:
    """Links to images; empty texts for images that are not on the page.

    anchors : ids on the page, in its order.
    by_configuration : id of each configuration's first image.
    """

    anchors: dict[Place, str] = field(default_factory=dict[Place, str])
    by_configuration: dict[int, str] = field(default_factory=dict[int, str])

    @classmethod
    def of(cls, places: Iterable[Place]) -> Links:
        """Links to images in the page's order."""
        anchors = {(s, k): f"image-{s + 1}-{k + 1}" for s, k in places}
        return cls(anchors, {k: name for (_, k), name in reversed([*anchors.items()])})

    def to_configuration(self, k: int) -> str:
        """Link to a configuration's first image."""
        return f"#{self.by_configuration[k]}" if k in self.by_configuration else ""

    def to_largest(self, station: Integers, configuration: Integers, size: Array) -> str:
        """Link to the image of the largest value.

        station, configuration, size : (n,); NaN counts least.
        """
        order = np.argsort(-np.nan_to_num(size, nan=-np.inf), kind="stable")
        places = zip(station[order].tolist(), configuration[order].tolist(), strict=True)
        return next((f"#{self.anchors[place]}" for place in places if place in self.anchors), "")
