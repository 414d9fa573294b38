"""Where the check found the machine in photographs: what its pictures and its forecast use."""

from __future__ import annotations

from dataclasses import dataclass

from pkmcal.arrays import Array, Integers
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.quality import Quality
from pkmcal.planning.first import spread_over
from pkmcal.session.load import Session


@dataclass(frozen=True)
class StationInspection:
    """One station in whose photographs the machine was looked for.

    name : the station's. photographs : decoded; ``photographs.station`` is its number.
    by_hand : T_camera_base (4, 4) as the session says, None where it does not. T_camera_base : (4,
    4) where the search ended. quality : on the legs, None where the machine was not recognised.
    """

    name: str
    photographs: Photographs
    by_hand: Array | None
    T_camera_base: Array
    quality: Quality | None

    @property
    def recognised(self) -> bool:
        """Whether the machine was recognised."""
        return self.quality is not None

    def few(self) -> Integers:
        """Numbers of the few photographs that are looked at closely."""
        return spread_over(self.photographs.configuration)


@dataclass(frozen=True)
class Inspection:
    """A session's stations that observe legs. poses : T_base_platform (K, 4, 4) by the drawing."""

    session: Session
    poses: Array
    stations: tuple[StationInspection, ...]

    @property
    def measured(self) -> tuple[Integers, ...]:
        """Numbers of the photographs that tell a forecast, by station."""
        n = len(self.stations)
        return tuple(spread_over(s.photographs.configuration, n) for s in self.stations)
