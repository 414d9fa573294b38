"""What measures: cameras that see legs or a board, and trackers, each at its place.

An instrument tells what it would measure of the machine at given poses, without errors but with
their covariance: the same measurements as photographs and tables give. Nothing is seen beyond a
picture's border, behind a leg, or on a board's back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.boards.poses import LEAST_CORNERS_WEIGHED, pose_set
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply, inverse, skew
from pkmcal.identify.assembly import Assembled, assemble, batch_of
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import (
    SHADING_SIGMA,
    EdgeSet,
    Measurements,
    Mount,
    PoseSet,
    concatenate,
)
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import tubes_of
from pkmcal.planning.defaults import NOMINAL_CORNER_SIGMA, NOMINAL_EDGE_SIGMA
from pkmcal.planning.first import EXACT_EDGE_NOISE, FIRST_EDGES_SEED, EdgePool, Pools, drawn_edges
from pkmcal.simulation.edges import hidden, pixel_angle, simulate_edges

FLATTEST_BOARD_COSINE = np.cos(np.deg2rad(70))
"""Cosine of the angle between a board's normal and the line of sight below which it is not read."""


class At(NamedTuple):
    """A machine at K configurations: joints (K, m), T_base_platform (K, 4, 4)."""

    machine: Machine
    joints: Array
    T_base_platform: Array


def nominal_pools(machine: Machine, sigma: float = NOMINAL_EDGE_SIGMA) -> Pools:
    """Edges that are all found, sigma (px) off across and as much by turning."""
    one = EdgePool(np.eye(2)[None] / sigma**2, np.ones(1), np.ones(1))
    return (one,) * len(tubes_of(machine))


@dataclass(frozen=True)
class LegsFrom:
    """The legs seen by a camera at T_camera_base (4, 4). pools : what its edges tell. binning : how
    many pixels across, and down, are one where these are looked for.
    """

    station: int
    camera: Camera
    T_camera_base: Array
    pools: Pools
    binning: int = 1

    def measure(self, at: At, rows: Integers, rng: np.random.Generator | None, /) -> EdgeSet:
        """Edges of the legs. rng : draws how good each turns out; without it each is as good as
        such a one is on average.
        """
        pairs = np.stack([np.zeros_like(rows), rows], axis=-1)
        edges, _ = simulate_edges(
            at.machine,
            self.T_camera_base[None],
            self.camera.binned(self.binning),
            at.T_base_platform,
            EXACT_EDGE_NOISE,
            np.random.default_rng(FIRST_EDGES_SEED),
            photographs=pairs,
        )
        edges = drawn_edges(at.machine, edges, [self.pools], rng)
        return replace(edges, station=np.full(len(edges), self.station))


@dataclass(frozen=True)
class BoardFrom:
    """A board on the platform, seen by a camera at T_camera_base (4, 4).

    points : (N, 3) its corners, board frame, m. T_platform_board : (4, 4). sigma : px, of a
    corner. mount : its number.
    """

    station: int
    camera: Camera
    T_camera_base: Array
    points: Array
    T_platform_board: Array
    sigma: float = NOMINAL_CORNER_SIGMA
    mount: int = 0

    def measure(self, at: At, rows: Integers, _rng: np.random.Generator | None, /) -> PoseSet:
        """The board's pose wherever enough corners are seen."""
        T = self.T_camera_base @ at.T_base_platform[rows] @ self.T_platform_board
        there = apply(T[:, None], self.points)
        prediction = self._visible_corners(
            At(at.machine, at.joints[rows], at.T_base_platform[rows]), T, there
        )
        by_point = self.camera.project_jacobians(there)[0]
        by_pose = np.concatenate([-by_point @ skew(there - T[:, None, :3, 3]), by_point], axis=-1)
        by_pose = np.where(prediction[..., None, None], by_pose, 0.0) / self.sigma
        normal = np.einsum("knip,kniq->kpq", by_pose, by_pose)
        enough = prediction.sum(axis=1) >= LEAST_CORNERS_WEIGHED
        covariance = np.linalg.inv(normal[enough])
        return pose_set(self.station, rows[enough], self.mount, T[enough], covariance)

    def _visible_corners(self, at: At, T: Array, there: Array) -> Booleans:
        """(K, N) corners in the picture, on the board's face, and not behind a leg."""
        with np.errstate(invalid="ignore"):
            visible = np.asarray(self.camera.in_image(self.camera.project(there)))
        # the print is on the side of the board's -z
        eye = inverse(T)[:, :3, 3] - self.points.mean(axis=0)
        visible &= (-eye[:, 2] / np.linalg.norm(eye, axis=-1) > FLATTEST_BOARD_COSINE)[:, None]
        machine, tubes = at.machine, tubes_of(at.machine)
        if not len(tubes):
            return visible
        ends = machine.ends_at(at.joints, at.T_base_platform)
        a, b = apply(self.T_camera_base, ends.a), apply(self.T_camera_base, ends.b)
        nothing, radius = np.array([-1]), machine.values[tubes.radius]
        pixel = pixel_angle(self.camera)
        behind = hidden(there[:, None], nothing, nothing, tubes, radius, a, b, pixel)
        return visible & ~behind[:, 0]


@dataclass(frozen=True)
class TargetFrom:
    """A target on the platform, measured by a tracker or a probe at T_tracker_base (4, 4).

    T_platform_target : (4, 4). whiten : (6, 6) as of :class:`~pkmcal.measurements.PoseSet`.
    """

    station: int
    T_tracker_base: Array
    T_platform_target: Array
    whiten: Array
    mount: int = 0

    def measure(self, at: At, rows: Integers, _rng: np.random.Generator | None, /) -> PoseSet:
        """The target's pose at every configuration."""
        T = self.T_tracker_base @ at.T_base_platform[rows] @ self.T_platform_target
        n = len(rows)
        whiten = np.broadcast_to(self.whiten, (n, 6, 6)).copy()
        return PoseSet(np.full(n, self.station), rows, np.full(n, self.mount), T, whiten)


Instrument = LegsFrom | BoardFrom | TargetFrom
"""One way in which the station of a number measures configurations ``rows`` of a machine."""


@dataclass(frozen=True)
class Rig:
    """A machine and what measures it.

    names : of S stations. T_station_base : (S, 4, 4) of cameras and trackers. camera_of_station :
    (S,) number of each one's camera. joint_noise : of a reading. instruments : what they measure.
    mounts : what boards and targets are fixed to, with their places T_mount (M, 4, 4). shading :
    px, standard deviation of what the edges of one side of a tube at one station have in common.
    where : what precedes a station's name in messages about it; None where no file names it.
    """

    machine: Machine
    names: tuple[str, ...]
    T_station_base: Array
    camera_of_station: Integers
    joint_noise: float
    instruments: tuple[Instrument, ...]
    mounts: tuple[Mount, ...] = ()
    T_mount: Array | None = None
    shading: float = SHADING_SIGMA
    where: str | None = "session.yaml, stations."

    __repr__ = short_repr

    def only(self, stations: Sequence[int]) -> Rig:
        """With some of its stations, in this order; mounts stay."""
        number = {s: k for k, s in enumerate(stations)}
        cameras = self.camera_of_station[list(stations)]
        return replace(
            self,
            names=tuple(self.names[s] for s in stations),
            T_station_base=self.T_station_base[list(stations)],
            camera_of_station=np.unique(cameras, return_inverse=True)[1].reshape(-1),
            instruments=tuple(
                replace(one, station=number[one.station])
                for one in self.instruments
                if one.station in number
            ),
        )

    def measured(
        self, joints: Array, T_base_platform: Array, pairs: Integers,
        rng: np.random.Generator | None = None,
    ) -> Measurements:  # fmt: skip
        """What is measured at joints (K, m), T_base_platform (K, 4, 4).

        pairs : (M, 2) stations and configurations that they measure. rng : as for
        :meth:`LegsFrom.measure`.
        """
        edges, poses = [EdgeSet.empty()], [PoseSet.empty()]
        at = At(self.machine, joints, T_base_platform)
        for one in self.instruments:
            rows = pairs[pairs[:, 0] == one.station, 1]
            value = one.measure(at, rows, rng)
            if isinstance(value, EdgeSet):
                edges.append(value)
            else:
                poses.append(value)
        edges = concatenate(edges)
        return Measurements(
            edges=edges,
            joints=joints,
            joint_noise=self.joint_noise,
            n_stations=len(self.names),
            camera_of_station=self.camera_of_station,
            poses=concatenate(poses),
            mounts=self.mounts,
            shaded=len(edges) > 0,
        )

    def assembled(
        self, measurements: Measurements, T_base_platform: Array, share: float = 1.0
    ) -> tuple[Assembled, BatchState]:
        """The joint estimate's problem of these measurements, at the true state. share : as of
        :func:`~pkmcal.identify.assembly.assemble`.
        """
        machine, shading = self.machine, self.shading
        gauge = default_gauge(machine)
        assembled = assemble(machine, measurements, gauge, shading=shading, share=share)
        state = State(
            machine.values,
            self.T_station_base,
            T_base_platform,
            T_mount=np.zeros((0, 4, 4)) if self.T_mount is None else self.T_mount,
            on_platform=measurements.on_platform,
        )
        return assembled, batch_of(machine, assembled, state)


def all_pairs(stations: Sequence[int], configurations: Integers) -> Integers:
    """(M, 2) every station at every configuration."""
    return np.array([(s, k) for s in stations for k in configurations], dtype=int).reshape(-1, 2)
