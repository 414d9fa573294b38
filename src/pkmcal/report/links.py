"""Keys of images and configurations, by which plots and arrows lead to images of the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.outcome.blocks.base import Key, image_key
from pkmcal.session.load import Session

Place = tuple[int, int]
"""Image by the indices of its station and configuration."""


@dataclass(frozen=True)
class Links:
    """Keys by indices of stations and configurations; empty keys without their names."""

    stations: tuple[str, ...] = ()
    configurations: tuple[str, ...] = ()

    @classmethod
    def of(cls, session: Session) -> Links:
        """Keys of a session's images and configurations."""
        return cls(tuple(one.name for one in session.stations), tuple(session.configurations))

    def to_image(self, s: int, k: int) -> Key:
        """Key of the image of a configuration at a station."""
        return image_key(self.stations[s], self.configurations[k]) if self.stations else ""

    def to_largest(self, station: Integers, configuration: Integers, size: Array) -> Key:
        """Key of the image of the largest value.

        station, configuration, size : (n,); NaN counts least.
        """
        if not len(size):
            return ""
        largest = int(np.argmax(np.nan_to_num(size, nan=-np.inf)))
        return self.to_image(int(station[largest]), int(configuration[largest]))
