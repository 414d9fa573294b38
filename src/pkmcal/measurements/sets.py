"""All measurements of a session: plain, frozen data."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Literal, TypeVar

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.measurements.columns import Column
from pkmcal.measurements.edges import EdgeSet, Rejection
from pkmcal.measurements.links import LinkSet
from pkmcal.measurements.poses import PoseSet


@dataclass(frozen=True)
class Observation:
    """Measurements from the images of a session.

    edges : silhouette edges.
    rejected : measurements that were rejected, with their reasons.
    points, point_edge : (M, 2) sub-pixel edge points (px), and the edge that each supports, for
        plots and residuals.
    T_camera_base : (S, 4, 4) poses of the stations after the search.
    poses : of boards, and of trackers' targets.
    binning : (S,) pixels of each station's images, across and down, that were averaged to one for
        the measurement of edges; pixel values of edges refer to these.
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
        """Default to no binning."""
        if not len(self.binning):
            object.__setattr__(self, "binning", np.ones(len(self.T_camera_base), dtype=int))


Set = TypeVar("Set", PoseSet, EdgeSet)
Effect = Callable[["Measurements"], Iterable[Column]]
"""An effect on measurements: its columns."""


def concatenate(sets: Sequence[Set]) -> Set:
    """Concatenation of sets; derivatives by the intrinsics are padded with zeros to the widest."""
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
    """Concatenation of edges, numbered by the stations that are the keys."""
    return concatenate([replace(e, station=np.full(len(e), k)) for k, e in edges.items()])


def edges_of_any(sets: Sequence[EdgeSet]) -> list[tuple[EdgeSet, Booleans]]:
    """Each of several sets with the edges of any of them, in one order, and which are its own.

    Edges are equal as by :meth:`EdgeSet.same_as`; those of other sets have the values there.
    """
    every = concatenate(sets)
    keys = np.stack([every.station, every.configuration, every.leg, every.tube, every.side], axis=1)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    number = number.reshape(-1)
    results: list[tuple[EdgeSet, Booleans]] = []
    stop = 0
    for edges in sets:
        start, stop = stop, stop + len(edges)
        place, own = first.copy(), np.zeros(len(first), dtype=bool)
        place[number[start:stop]], own[number[start:stop]] = np.arange(start, stop), True
        results.append((every.select(place), own))
    return results


BOARD_MOUNT_NAME = "board"
"""Name of the mount of a session's board."""


@dataclass(frozen=True)
class Mount:
    """Body to which a board or a tracker's target is fixed; its pose on the body is estimated.

    tolerance : prior sigma of a board's relative size (``Boards.tolerance``): one factor on all
        squares, which is estimated.
    """

    name: str
    body: Literal["base", "platform"]
    tolerance: float = 0.0


@dataclass(frozen=True)
class Measurements:
    """All measurements of a session, with their stated noise.

    edges : silhouette edges.
    joints, joint_noise : (K, m) readings, m or rad, and their standard deviation.
    n_stations : number of stations, S.
    camera_of_station : (S,) number of the camera (file) of each station. One edge shift is
        estimated for each camera.
    intrinsics_factor : (C, n, r) square roots F of the covariances F F^T of the cameras'
        intrinsics, if these are refined; r = 0 if they are held.
    intrinsics_at : (C, r) intrinsics with which the edges were measured, as changes from the
        calibration's values in units of F.
    poses : of boards or targets, each on one of the ``mounts``.
    shaded : whether each side of a tube has, at each station, an unknown shift by shading, as edges
        in images have.
    focal_at : (S,) relative excess of the stations' focal lengths with which they were measured;
        empty without hand-held cameras.
    effects : further effects in addition to those of every estimate
        (:mod:`pkmcal.measurements.effects`).
    links : measurements that link two configurations, one set for each kind.
    level : (S,) stations whose z axis is exactly the base's; empty if there is none.
    imputation_covariance : variance of a result with the prediction from which edges were measured,
        relative to its variance by noise.
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
    focal_at: Array = field(default_factory=lambda: np.zeros(0))
    level: Booleans = field(default_factory=lambda: np.zeros(0, dtype=bool))
    imputation_covariance: float = 0.0
    links: tuple[LinkSet, ...] = ()
    effects: tuple[Effect, ...] = ()

    __repr__ = short_repr

    @property
    def n_links(self) -> int:
        """Number of measurements that link two configurations."""
        return sum(len(links) for links in self.links)

    @property
    def link_ends(self) -> Integers:
        """(n, 2) configurations of all links."""
        none = np.zeros((0, 2), dtype=int)
        return np.concatenate([none, *(links.configuration for links in self.links)])

    def link_at(self, number: int) -> tuple[LinkSet, int]:
        """Set that contains a link, from the link's number among all, and its number in the set."""
        for links in self.links:
            if number < len(links):
                return links, number
            number -= len(links)
        raise IndexError(number)

    def links_among(self, keep: Booleans) -> Booleans:
        """Mask (n,) of the links between configurations that are both in ``keep`` (K,)."""
        first, second = self.link_ends.T
        return keep[first] & keep[second]

    def with_links(self, keep: Booleans) -> Measurements:
        """Measurements with some of the links; keep : (n,)."""
        ends = np.cumsum([len(links) for links in self.links]).tolist()
        parts = [
            links.select(keep[end - len(links) : end])
            for links, end in zip(self.links, ends, strict=True)
        ]
        return replace(self, links=tuple(parts))

    @property
    def n_cameras(self) -> int:
        """Number of cameras, C."""
        return int(self.camera_of_station.max(initial=-1)) + 1

    @property
    def on_platform(self) -> Booleans:
        """(M,) whether each mount moves with the platform."""
        return np.array([mount.body == "platform" for mount in self.mounts], dtype=bool)
