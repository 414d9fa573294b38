"""Poses as measurements: of a calibration board in photographs, or of a target by a tracker.

A target is fixed to the machine's base or to its platform by a *mount*; what a mount is, and
where the target sits on it, belongs to the identification. Here stands only what was measured:
the target's pose in the frame of the station that saw it, with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers


@dataclass(frozen=True)
class PoseSet:
    """N measured poses.

    station : (N,) index into the session's stations. configuration : (N,) row of the readings.
    mount : (N,) what the target is fixed to.
    T_station_target : (N, 4, 4) target to station (camera or tracker) coordinates, m.
    whiten : (N, 6, 6) for the left perturbation (omega, tau) of T_station_target, rad and m:
        whiten @ error has unit covariance.
    """

    station: Integers
    configuration: Integers
    mount: Integers
    T_station_target: Array
    whiten: Array

    @classmethod
    def empty(cls) -> PoseSet:
        """No pose."""
        none = np.zeros(0, dtype=int)
        return cls(none, none, none, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))

    def __len__(self) -> int:
        return len(self.station)

    def select(self, mask: Booleans | Integers) -> PoseSet:
        """The poses that a mask or an index picks."""
        return PoseSet(*(getattr(self, f.name)[mask] for f in fields(self)))


def concatenate_poses(sets: Sequence[PoseSet]) -> PoseSet:
    """All poses in one set."""
    parts = [PoseSet.empty(), *sets]
    return PoseSet(*(np.concatenate([getattr(s, f.name) for s in parts]) for f in fields(PoseSet)))
