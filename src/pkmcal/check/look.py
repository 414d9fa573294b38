"""Where the check found the machine in photographs: what its pictures and its forecast use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.observe.legs import Photographs
from pkmcal.observe.quality import Quality
from pkmcal.session.load import Session

FIRST = 3
"""Photographs of a station that are looked at closely: what people take before the long capture."""
MEASURED = 6
"""Photographs of all stations together whose edges tell a forecast: a hexapod shows forty edges of
each kind in them, enough for their scatter to be known to a tenth."""


@dataclass(frozen=True)
class StationLook:
    """One station in whose photographs the machine was looked for.

    name : the station's. photographs : decoded; ``photographs.station`` is its number.
    by_hand : T_camera_base (4, 4) as the session says, None where it does not. found : (4, 4) where
    the search ended. quality : on the legs, None where the machine was not recognised.
    """

    name: str
    photographs: Photographs
    by_hand: Array | None
    found: Array
    quality: Quality | None

    @property
    def recognised(self) -> bool:
        """Whether the machine was recognised."""
        return self.quality is not None

    def few(self, most: int = FIRST) -> Integers:
        """Numbers of up to ``most`` photographs of different configurations, spread over all."""
        first = np.sort(np.unique(self.photographs.configuration, return_index=True)[1])
        return first[np.unique(np.linspace(0, len(first) - 1, min(most, len(first))).astype(int))]


@dataclass(frozen=True)
class Look:
    """A session's stations that observe legs. poses : T_base_platform (K, 4, 4) by the drawing."""

    session: Session
    poses: Array
    stations: tuple[StationLook, ...]

    @property
    def measured(self) -> tuple[Integers, ...]:
        """Numbers of the photographs that tell a forecast, by station."""
        most = min(FIRST, -(-MEASURED // len(self.stations)))
        return tuple(station.few(most) for station in self.stations)
