"""Poses as measurements: of a calibration board in photographs, or of a target by a tracker.

A target is fixed to the machine's base or to its platform by a *mount*; what a mount is, and
where the target sits on it, belongs to the identification. Here stands only what was measured:
the target's pose in the frame of the station that saw it, with its uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import perturb


@dataclass(frozen=True)
class PoseSet:
    """N measured poses.

    station : (N,) index into the session's stations. configuration : (N,) row of the readings.
    mount : (N,) what the target is fixed to.
    T_station_target : (N, 4, 4) target to station (camera or tracker) coordinates, m.
    whiten : (N, 6, 6) for the left perturbation (omega, tau) of T_station_target, rad and m:
        whiten @ error has unit covariance. Rows of what is not measured (a point's turn) are zero.
    by_intrinsics : (N, 6, n) that perturbation by the camera's parameters, with the corners'
        pixels held; n = 0 where nobody asked.
    """

    station: Integers
    configuration: Integers
    mount: Integers
    T_station_target: Array
    whiten: Array
    by_intrinsics: Array = field(default_factory=lambda: np.zeros((0, 6, 0)))

    def __post_init__(self) -> None:
        """Poses without derivatives by intrinsics get empty ones, so that all select alike."""
        if len(self.by_intrinsics) != len(self.station):
            object.__setattr__(self, "by_intrinsics", np.zeros((len(self.station), 6, 0)))

    @classmethod
    def empty(cls) -> PoseSet:
        """No pose."""
        none = np.zeros(0, dtype=int)
        return cls(none, none, none, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))

    def __len__(self) -> int:
        return len(self.station)

    @property
    def rows(self) -> Integers:
        """(N,) how many of its six numbers each measurement has."""
        return np.any(self.whiten != 0, axis=-1).sum(axis=-1)

    def select(self, mask: Booleans | Integers) -> PoseSet:
        """The poses that a mask or an index picks."""
        return PoseSet(*(getattr(self, f.name)[mask] for f in fields(self)))

    def moved(self, change: Array) -> PoseSet:
        """The poses as cameras with other parameters see them; change : (S, n), by station.

        To first order: a camera's calibration is good to a thousandth, so what is left out is a
        millionth.
        """
        n = self.by_intrinsics.shape[-1]
        delta = (self.by_intrinsics @ change[self.station, :n, None])[..., 0]
        return replace(self, T_station_target=perturb(self.T_station_target, delta))


def concatenate_poses(sets: Sequence[PoseSet]) -> PoseSet:
    """All poses in one set; cameras with fewer parameters get zeros for the rest."""
    parts = [PoseSet.empty(), *sets]
    widest = max(s.by_intrinsics.shape[-1] for s in parts)
    padded = [
        np.pad(s.by_intrinsics, ((0, 0), (0, 0), (0, widest - s.by_intrinsics.shape[-1])))
        for s in parts
    ]
    joined = {
        f.name: np.concatenate([getattr(s, f.name) for s in parts])
        for f in fields(PoseSet)
        if f.name != "by_intrinsics"
    }
    return PoseSet(**joined, by_intrinsics=np.concatenate(padded))
