"""Keys of images and configurations, by which plots and arrows lead to images of the page."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.outcome.blocks.base import Key, image_key
from pkmcal.session.load import Session

Place = tuple[int, int]
"""Image by the indices of its station and configuration."""


@dataclass(frozen=True)
class Links:
    """Keys by indices of stations and configurations; empty for images that the page lacks.

    keys : of the images on the page.
    """

    stations: tuple[str, ...]
    configurations: tuple[str, ...]
    keys: frozenset[Key]

    @classmethod
    def of(cls, session: Session, keys: Iterable[Key]) -> Links:
        """Keys of a session's images and configurations."""
        stations = tuple(one.name for one in session.stations)
        return cls(stations, tuple(session.configurations), frozenset(keys))

    def to_image(self, s: int, k: int) -> Key:
        """Key of the image of a configuration at a station."""
        key = image_key(self.stations[s], self.configurations[k])
        return key if key in self.keys else ""

    def to_largest(self, station: Integers, configuration: Integers, size: Array) -> Key:
        """Key of the image of the largest value, of the images on the page.

        station, configuration, size : (n,); NaN counts least.
        """
        order = np.argsort(-np.nan_to_num(size, nan=-np.inf), kind="stable")
        places = zip(station[order].tolist(), configuration[order].tolist(), strict=True)
        return next(filter(None, (self.to_image(s, k) for s, k in places)), "")
