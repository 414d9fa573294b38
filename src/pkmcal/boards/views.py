"""Measurements of a session's calibration board by its stations.

Detection is in :mod:`pkmcal.boards.stations`, which sessions without a board do not import.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.geometry.rigid import inverse
from pkmcal.measurements import PoseSet, Rejection, concatenate
from pkmcal.session.schema import BoardBody

if TYPE_CHECKING:
    from pkmcal.boards.poses import BoardViews, Standing

ONLY_BOARD_MOUNT = 0
"""Mount of the board; a session has only one."""


@dataclass(frozen=True)
class StationBoard:
    """Board in the images of one station; stood : pose of a board on the base, else None."""

    views: BoardViews
    stood: Standing | None

    @property
    def poses(self) -> PoseSet:
        """Measurements from the board."""
        return (
            self._moving[0]
            if self.stood is None
            else self.stood.poses(self.views, ONLY_BOARD_MOUNT)
        )

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Images whose board is not used, with the reason."""
        return self.views.rejected + (
            self._moving[1] if self.stood is None else self.stood.rejected
        )

    @cached_property
    def _moving(self) -> tuple[PoseSet, tuple[Rejection, ...]]:
        """Measurements and rejections of a board on the platform."""
        from pkmcal.boards.poses import one_a_configuration

        return one_a_configuration(self.views, ONLY_BOARD_MOUNT)


@dataclass(frozen=True)
class Boards:
    """Board in all stations that observe it.

    stations : by station number.
    body : body to which the board is fixed.
    tolerance : prior sigma of its size, relative, as its file states.
    """

    stations: Mapping[int, StationBoard] = field(default_factory=dict[int, StationBoard])
    body: BoardBody = "platform"
    tolerance: float = 0.0

    __repr__ = short_repr

    @property
    def poses(self) -> PoseSet:
        """Measurements of all stations."""
        return concatenate(
            [PoseSet.empty(), *(station.poses for station in self.stations.values())]
        )

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Images of all stations whose board is not used."""
        return tuple(r for station in self.stations.values() for r in station.rejected)

    def of(self, stations: Integers) -> Boards:
        """Boards of a subset of the stations, renumbered in their order."""
        selected = {new: self.stations[k] for new, k in enumerate(stations) if k in self.stations}
        return replace(
            self,
            stations={
                new: replace(one, views=replace(one.views, station=new))
                for new, one in selected.items()
            },
        )

    def joined(self, T_camera_base: Sequence[Array | None]) -> list[Array | None]:
        """Poses of the stations, with unknown ones derived through a board on the base.

        T_camera_base : (4, 4) each, None if unknown. At least one station with a known pose must
            observe the board.

        T_camera_base = T_camera_board T_board_other T_other_base, [A] 3.3.
        """
        stood = {k: s.stood.T_camera_board for k, s in self.stations.items() if s.stood}
        posed = ((k, T) for k, T in enumerate(T_camera_base) if T is not None and k in stood)
        T_board_base = next((inverse(stood[k]) @ T for k, T in posed), None)
        if T_board_base is None:
            return list(T_camera_base)
        return [
            stood[k] @ T_board_base if T is None and k in stood else T
            for k, T in enumerate(T_camera_base)
        ]
