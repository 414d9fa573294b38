"""The calibration board of a session as its stations saw it: measurements.

Where it is looked for stands in :mod:`pkmcal.boards.stations`, which sessions without a board do
not load.
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
"""A session has one board, so one mount."""


@dataclass(frozen=True)
class StationBoard:
    """The board in one station's photographs; stood : where, of a board on the base."""

    views: BoardViews
    stood: Standing | None

    @property
    def poses(self) -> PoseSet:
        """The measurements that it gives."""
        return (
            self._moving[0]
            if self.stood is None
            else self.stood.poses(self.views, ONLY_BOARD_MOUNT)
        )

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Photographs whose board is not used."""
        return self.views.rejected + (
            self._moving[1] if self.stood is None else self.stood.rejected
        )

    @cached_property
    def _moving(self) -> tuple[PoseSet, tuple[Rejection, ...]]:
        from pkmcal.boards.poses import one_a_configuration

        return one_a_configuration(self.views, ONLY_BOARD_MOUNT)


@dataclass(frozen=True)
class Boards:
    """The board in all stations that observe it.

    stations : by their number in the session. body : what the board is fixed to. tolerance :
    standard deviation of its size, relative.
    """

    stations: Mapping[int, StationBoard] = field(default_factory=dict[int, StationBoard])
    body: BoardBody = "platform"
    tolerance: float = 0.0

    __repr__ = short_repr

    @property
    def poses(self) -> PoseSet:
        """All measurements."""
        return concatenate(
            [PoseSet.empty(), *(station.poses for station in self.stations.values())]
        )

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """All that is not used."""
        return tuple(r for station in self.stations.values() for r in station.rejected)

    def of(self, stations: Integers) -> Boards:
        """The board in some of the stations, numbered anew in their order."""
        retained = {new: self.stations[k] for new, k in enumerate(stations) if k in self.stations}
        return replace(
            self,
            stations={
                new: replace(one, views=replace(one.views, station=new))
                for new, one in retained.items()
            },
        )

    def joined(self, T_camera_base: Sequence[Array | None]) -> list[Array | None]:
        """Poses of the stations with those that are not known put in through a board on the base.

        T_camera_base : (4, 4) each, None where not known.
        T_camera_base = T_camera_board T_board_other T_other_base, [A] 3.3.
        """
        stood = {k: s.stood.T_camera_board for k, s in self.stations.items() if s.stood}
        reference_values = (
            (k, T) for k, T in enumerate(T_camera_base) if T is not None and k in stood
        )
        T_board_base = next((inverse(stood[k]) @ T for k, T in reference_values), None)
        if T_board_base is None:
            return list(T_camera_base)
        return [
            stood[k] @ T_board_base if T is None and k in stood else T
            for k, T in enumerate(T_camera_base)
        ]
