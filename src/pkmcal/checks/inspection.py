"""Localization of the machine in a check's images, for its pictures and its forecast."""

from __future__ import annotations

from dataclasses import dataclass

from pkmcal.arrays import Array, Integers
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.quality import Quality
from pkmcal.planning.first import spread_over
from pkmcal.session.load import Session


@dataclass(frozen=True)
class StationInspection:
    """Station in whose images the machine was searched for.

    name : name of the station.
    images : decoded images; ``station_images.station`` is the station's number.
    by_hand : rough pose T_camera_base (4, 4) of the session, None without one.
    T_camera_base : (4, 4) result of the search.
    quality : quality of the legs' images, None if the machine was not localized.
    """

    name: str
    images: StationImages
    by_hand: Array | None
    T_camera_base: Array
    quality: Quality | None

    @property
    def recognised(self) -> bool:
        """Whether the machine was recognized."""
        return self.quality is not None

    def few(self) -> Integers:
        """Indices of the images that are shown."""
        return spread_over(self.images.configuration)


@dataclass(frozen=True)
class Inspection:
    """Stations of a session that observe legs. poses : T_base_platform (K, 4, 4) by the nominal
    model.
    """

    session: Session
    poses: Array
    stations: tuple[StationInspection, ...]

    @property
    def measured(self) -> tuple[Integers, ...]:
        """Indices of the images that are measured for the forecast, by station."""
        n = len(self.stations)
        return tuple(spread_over(s.images.configuration, n) for s in self.stations)
