"""What was measured: silhouette edges, poses of boards and targets, readings; plain and frozen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypeVar

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.geometry.rigid import perturb

SHADING_SIGMA = 0.03
"""Standard deviation (px) of what shading adds to all edges of one side of a tube at one station,
where light is even; hard light and polished metal show ten times as much, so data may enlarge it.
Path-traced photographs of matt machines show 0.02, our own renderer's 0.05."""
OWN_SHADING = 0.015
"""Standard deviation (px) of what shading adds to one edge beside what all of its line have in
common, where light is even; highlights and what metal mirrors add ten times as much."""
SHADING_ALIKE_ANGLE = np.radians(7.0)
"""Angle between the normals of two edges of one side of a tube at one station over which their
shading ceases to be the same, by exp(-angle / SHADING_ALIKE_ANGLE): what a surface mirrors, and
where its highlight lies, turns with it. Edges of path-traced tubes, of metal and painted, agree by
half at 5 degrees once what all have in common is taken off."""
TUBES_ALIKE = 0.4
"""The same between edges of two tubes of a leg on one side: they see the same light, and mirror the
same, in part. Of path-traced legs of five finishes 0.2 to 0.6."""
BREATHING_SIGMA = 1.5e-3
"""Standard deviation of a hand-held photograph's focal length, relative to the camera's. A lens of
focal length f that is focused at a distance u forms its picture at f u / (u - f): a telephone's (5
mm) changes by 0.3 % from 3 m to 1 m, as one walks about a machine, so half of that to each side."""


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
    by_focal : (N, 6) the same by the relative excess of the focal lengths, where these breathe from
        photograph to photograph; else zero.
    """

    station: Integers
    configuration: Integers
    mount: Integers
    T_station_target: Array
    whiten: Array
    by_intrinsics: Array = field(default_factory=lambda: np.zeros((0, 6, 0)))
    by_focal: Array = field(default_factory=lambda: np.zeros((0, 6)))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Poses without derivatives by intrinsics get empty ones, so that all select alike."""
        if len(self.by_intrinsics) != len(self.station):
            object.__setattr__(self, "by_intrinsics", np.zeros((len(self.station), 6, 0)))
        if len(self.by_focal) != len(self.station):
            object.__setattr__(self, "by_focal", np.zeros((len(self.station), 6)))

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
    by_focal : (N, 2) the same by the relative excess of the focal lengths, where these breathe from
        photograph to photograph; else zero.
    shading : (N,) px, standard deviation of what shading adds to each edge beside what it adds to
        all of its line; edges of a line share it as far as their normals agree, see
        :mod:`~pkmcal.identify.line_cells`. It counts where measurements are ``shaded``.
    coarse : (N,) whether it is where a whole machine's silhouettes lie on picture edges
        (:mod:`pkmcal.observe.silhouettes`), and not measured by itself.
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
    by_focal: Array = field(default_factory=lambda: np.zeros((0, 2)))
    shading: Array = field(default_factory=lambda: np.zeros(0))
    coarse: Booleans = field(default_factory=lambda: np.zeros(0, dtype=bool))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """What is not given is empty, zero or the usual, so that all edges select alike."""
        if len(self.coarse) != len(self.station):
            object.__setattr__(self, "coarse", np.zeros(len(self.station), dtype=bool))
        if len(self.by_intrinsics) != len(self.station):
            object.__setattr__(self, "by_intrinsics", np.zeros((len(self.station), 2, 0)))
        if len(self.by_focal) != len(self.station):
            object.__setattr__(self, "by_focal", np.zeros((len(self.station), 2)))
        if len(self.shading) != len(self.station):
            object.__setattr__(self, "shading", np.full(len(self.station), OWN_SHADING))

    @classmethod
    def empty(cls) -> EdgeSet:
        """No edge, for sessions of boards alone."""
        none = np.zeros(0, dtype=int)
        each = [np.zeros((0, *shape)) for shape in ((3,), (3, 2), (2, 2), (2,), (2,))]
        normal, basis, covariance, shift, span = each
        return cls(none, none, none, none, none, normal, basis, covariance, shift, span)

    def __len__(self) -> int:
        return len(self.station)

    def select(self, keep: Booleans | Integers) -> EdgeSet:
        """The edges at a mask or at positions."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def same_as(self, other: EdgeSet) -> tuple[Integers, Integers]:
        """Positions in this set and in another of the edges that are in both: of one station's
        photograph of a configuration, and one side of a leg's tube. Each is in a set once.
        """
        each = [
            np.stack([of.station, of.configuration, of.leg, of.tube, of.side], axis=1)
            for of in (self, other)
        ]
        number = np.unique(np.concatenate(each), axis=0, return_inverse=True)[1].ravel()
        own, others = number[: len(self)], number[len(self) :]
        return np.intersect1d(own, others, return_indices=True)[1:]

    def scaled(self, factor: float) -> EdgeSet:
        """The same, that scatter by a factor more."""
        return replace(self, covariance=self.covariance * factor**2)

    def rejection(self, k: int, reason: str) -> Rejection:
        """The edge at k, left out for a reason."""
        return Rejection(
            station=int(self.station[k]),
            configuration=int(self.configuration[k]),
            leg=int(self.leg[k]),
            tube=int(self.tube[k]),
            side=int(self.side[k]),
            reason=reason,
        )


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
    binning : (S,) pixels of each station's photographs across, and down, that were one where edges
        were looked for: what of an edge is in pixels, is in these.
    """

    edges: EdgeSet
    rejected: tuple[Rejection, ...]
    points: Array
    point_edge: Integers
    T_camera_base: Array
    poses: PoseSet = field(default_factory=PoseSet.empty)
    binning: Integers = field(default_factory=lambda: np.ones(0, dtype=int))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Where nothing is said of binning, there is none."""
        if not len(self.binning):
            object.__setattr__(self, "binning", np.ones(len(self.T_camera_base), dtype=int))


Set = TypeVar("Set", PoseSet, EdgeSet)


def concatenate(sets: Sequence[Set]) -> Set:
    """One set or more as one; cameras with fewer parameters get zeros for the rest."""
    widest = max(s.by_intrinsics.shape[-1] for s in sets)
    padded = [
        np.pad(s.by_intrinsics, ((0, 0), (0, 0), (0, widest - s.by_intrinsics.shape[-1])))
        for s in sets
    ]
    joined = {
        f.name: np.concatenate(
            padded if f.name == "by_intrinsics" else [getattr(s, f.name) for s in sets]
        )
        for f in fields(sets[0])
    }
    return replace(sets[0], **joined)


def of_stations(edges: Mapping[int, EdgeSet]) -> EdgeSet:
    """Edges by the number of their station, whatever number it had, as one set."""
    return concatenate([replace(e, station=np.full(len(e), k)) for k, e in edges.items()])


@dataclass(frozen=True)
class Mount:
    """What a board or a tracker's target is fixed to; its place there is estimated.

    tolerance : standard deviation of a board's size, relative: its squares are all larger or
    smaller by one factor, which is estimated where the data tell it.
    """

    name: str
    body: Literal["base", "platform"]
    tolerance: float = 0.0


@dataclass(frozen=True)
class Measurements:
    """Everything that was measured, nothing that was assumed.

    edges : silhouette edges. joints : (K, m) readings, m or rad. joint_noise : their
    standard deviation. n_stations : S. camera_of_station : (S,) number of the camera (file)
    that each station uses: one edge shift is estimated for each camera. intrinsics_factor :
    (C, n, r) square roots F of the cameras' intrinsics' covariances F F^T, where these are to be
    refined; r = 0 where they are held. intrinsics_at : (C, r) where the edges were measured, in
    those units from the calibration's values. poses : of boards or targets, each on one of the
    ``mounts``. shaded : each side of a tube has, at each station, a shift of its own, as shading
    gives edges in photographs. breathing_at : (S,) excess of the stations' focal lengths at which
    they were measured, in BREATHING_SIGMA; empty where none breathes. level : (S,) stations whose z
    axis is the base's, exactly; empty where there is none. look_variance : by what part of its
    variance by noise a result varies besides, with where its edges were looked for.
    """

    edges: EdgeSet
    joints: Array
    joint_noise: float
    n_stations: int
    camera_of_station: Integers
    intrinsics_factor: Array = field(default_factory=lambda: np.zeros((1, 0, 0)))
    intrinsics_at: Array = field(default_factory=lambda: np.zeros((1, 0)))
    poses: PoseSet = field(default_factory=PoseSet.empty)
    mounts: tuple[Mount, ...] = ()
    shaded: bool = False
    breathing_at: Array = field(default_factory=lambda: np.zeros(0))
    level: Booleans = field(default_factory=lambda: np.zeros(0, dtype=bool))
    look_variance: float = 0.0

    __repr__ = short_repr

    @property
    def n_cameras(self) -> int:
        """Number of cameras, C."""
        return int(self.camera_of_station.max(initial=-1)) + 1

    @property
    def on_platform(self) -> Booleans:
        """(M,) which of the mounts move with the platform."""
        return np.array([mount.body == "platform" for mount in self.mounts], dtype=bool)


@dataclass(frozen=True)
class Effect:
    """What k numbers do to what was measured, to first order: from what was measured to what should
    have been.

    edges : (N, 2, k) turn of the normals, in their bases. readings : (K, m, k). poses : (N', 6, k)
    left perturbation of T_station_target. motion : (S, K, 6, k) left perturbation (omega, tau) of
    the stations' poses, by configuration. Absent: none. Or, where ``station`` is given, the camera
    or tracker of that number stands elsewhere from configuration ``since`` on, by (omega, tau).
    """

    edges: Array | None = None
    readings: Array | None = None
    poses: Array | None = None
    motion: Array | None = None
    station: int | None = None
    since: int = 0

    @property
    def count(self) -> int:
        """How many numbers, k."""
        if self.station is not None:
            return 6
        parts = (self.edges, self.readings, self.poses, self.motion)
        return max((part.shape[-1] for part in parts if part is not None), default=0)


@dataclass(frozen=True)
class Departure:
    """Something that a session takes for granted and that may be otherwise.

    code : of its finding. of : what departs, by name. facts : of its finding, from the estimates
    and their standard deviations (k,). effect : what it does to what was
    measured; empty for a single reading, see :class:`pkmcal.identify.score.Departures`.
    """

    code: str
    of: str
    facts: Callable[[Array, Array], dict[str, Any]]
    effect: Effect = field(default_factory=Effect)
