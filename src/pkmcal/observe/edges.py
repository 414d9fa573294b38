"""The one measurement that a leg gives: its silhouette edges, as planes through the camera.

Everything after the image works on :class:`EdgeSet`, whatever the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.observe.poses import PoseSet


@dataclass(frozen=True)
class EdgeSet:
    """Silhouette edges of legs in photographs; N edges, flat arrays, all indices from 0.

    station, configuration, leg, tube, side : (N,) where the edge was seen; side as in
        :mod:`pkmcal.geometry.cylinders` (0 or 1).
    normal : (N, 3) unit normal of the plane of edge and camera centre, camera frame,
        pointing away from the leg's axis.
    basis : (N, 3, 2) orthonormal tangent basis at the normal: shift first, tilt second.
    covariance : (N, 2, 2) of the normal in that basis, rad^2.
    shift : (N, 2) change of the normal, in that basis, when every point of the edge moves
        outward by one pixel (rad/px).
    span : (N, 2) first and last seen place along the leg, m from A.
    by_intrinsics : (N, 2, n) change of the normal, in that basis, by the camera's parameters with
        the edge's pixels held; n = 0 where nobody asked.
    """

    station: Integers
    configuration: Integers
    leg: Integers
    tube: Integers
    side: Integers
    normal: Array
    basis: Array
    covariance: Array
    shift: Array
    span: Array
    by_intrinsics: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))

    def __post_init__(self) -> None:
        """Edges without derivatives by intrinsics get empty ones, so that all select alike."""
        if len(self.by_intrinsics) != len(self.station):
            object.__setattr__(self, "by_intrinsics", np.zeros((len(self.station), 2, 0)))

    @classmethod
    def empty(cls) -> EdgeSet:
        """No edge, for sessions of boards alone."""
        none = np.zeros(0, dtype=int)
        shapes = ((3,), (3, 2), (2, 2), (2,), (2,))
        return cls(none, none, none, none, none, *(np.zeros((0, *shape)) for shape in shapes))

    def __len__(self) -> int:
        return len(self.station)

    def select(self, keep: Booleans | Integers) -> EdgeSet:
        """The edges at a mask or at positions."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})


@dataclass(frozen=True)
class Rejection:
    """Something that was seen but left out, or looked for and not found, and why.

    tube and side are -1 where the whole leg, leg -1 where the whole photograph is meant.
    """

    station: int
    configuration: int
    leg: int
    tube: int
    side: int
    reason: str


@dataclass(frozen=True)
class Observation:
    """What the photographs of a session gave.

    edges : the measurements.
    rejected : what was left out, with its reason.
    points, point_edge : (M, 2) sub-pixel edge points (px) and the edge that each supports,
        for pictures and residuals.
    T_camera_base : (S, 4, 4) poses of the stations as the search left them.
    poses : of boards, and of trackers' targets.
    """

    edges: EdgeSet
    rejected: tuple[Rejection, ...]
    points: Array
    point_edge: Integers
    T_camera_base: Array
    poses: PoseSet = field(default_factory=PoseSet.empty)


def concatenate(sets: list[EdgeSet]) -> EdgeSet:
    """Several edge sets as one; cameras with fewer parameters get zeros for the rest."""
    widest = max(s.by_intrinsics.shape[-1] for s in sets)
    padded = [
        np.pad(s.by_intrinsics, ((0, 0), (0, 0), (0, widest - s.by_intrinsics.shape[-1])))
        for s in sets
    ]
    joined = {
        f.name: np.concatenate([getattr(s, f.name) for s in sets])
        for f in fields(EdgeSet)
        if f.name != "by_intrinsics"
    }
    return EdgeSet(**joined, by_intrinsics=np.concatenate(padded))
