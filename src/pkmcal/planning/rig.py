"""Instruments of a plan: cameras that observe legs or a board, and trackers, each at its station.

An instrument predicts its measurements of the machine at given poses, without errors but with their
covariance, in the same form as real measurements. There are no measurements outside the image,
behind a leg, or on the back of a board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.boards.poses import BOARD_POSE_OPTIONS, pose_set
from pkmcal.calibration.reading_effects import reading_effects
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply, inverse, skew
from pkmcal.identify.assembly import Assembled, assemble, batch_of
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.state import State
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
from pkmcal.placement.edges import hidden, pixel_angle, simulate_edges
from pkmcal.planning.defaults import NOMINAL_CORNER_SIGMA, NOMINAL_EDGE_SIGMA
from pkmcal.planning.first import EXACT_EDGE_NOISE, FIRST_EDGES_SEED, EdgePool, Pools, drawn_edges
from pkmcal.solver.ranks import NORMAL_RANK_TOLERANCE, unit_diagonal

FLATTEST_BOARD_COSINE = np.cos(np.deg2rad(70))
"""Minimum cosine of the angle between a board's normal and the line of sight."""


class At(NamedTuple):
    """Machine at K configurations: joints (K, m), T_base_platform (K, 4, 4)."""

    machine: Machine
    joints: Array
    T_base_platform: Array


def nominal_pools(machine: Machine, sigma: float = NOMINAL_EDGE_SIGMA) -> Pools:
    """Pools of edges that are all found, with standard deviation sigma (px) of shift and tilt."""
    one = EdgePool(np.eye(2)[None] / sigma**2, np.ones(1), np.ones(1))
    return (one,) * len(tubes_of(machine))


@dataclass(frozen=True)
class LegsFrom:
    """Legs observed by a camera at T_camera_base (4, 4).

    pools : information of its edges. binning : pixels that are averaged, in each direction, in the
    search for edges.
    """

    station: int
    camera: Camera
    T_camera_base: Array
    pools: Pools
    binning: int = 1

    def measure(self, at: At, rows: Integers, rng: np.random.Generator | None, /) -> EdgeSet:
        """Edges of the legs. rng : for drawing the information of each edge; its mean without
        it.
        """
        pairs = np.stack([np.zeros_like(rows), rows], axis=-1)
        edges, _ = simulate_edges(
            at.machine,
            self.T_camera_base[None],
            self.camera.binned(self.binning),
            at.T_base_platform,
            EXACT_EDGE_NOISE,
            np.random.default_rng(FIRST_EDGES_SEED),
            images=pairs,
        )
        edges = drawn_edges(at.machine, edges, [self.pools], rng)
        return replace(edges, station=np.full(len(edges), self.station))


@dataclass(frozen=True)
class BoardFrom:
    """Board on the platform or on the base, observed by a camera at T_camera_base (4, 4).

    points : (N, 3) corners, board frame, m.
    T_body_board : (4, 4) in the frame of its body.
    sigma : of a corner, px.
    mount : its index.
    on_platform : whether its body is the platform.
    """

    station: int
    camera: Camera
    T_camera_base: Array
    points: Array
    T_body_board: Array
    sigma: float = NOMINAL_CORNER_SIGMA
    mount: int = 0
    on_platform: bool = True

    def measure(self, at: At, rows: Integers, _rng: np.random.Generator | None, /) -> PoseSet:
        """Poses of the board where enough corners are visible, not all of them on one line."""
        T_base_body = at.T_base_platform[rows] if self.on_platform else np.eye(4)
        T = np.tile(self.T_camera_base, (len(rows), 1, 1)) @ T_base_body @ self.T_body_board
        there = apply(T[:, None], self.points)
        visible = self._visible_corners(
            At(at.machine, at.joints[rows], at.T_base_platform[rows]), T, there
        )
        # Information of the visible corners on (omega, tau) of the board's pose.
        by_point = self.camera.project_jacobians(there)[0]
        by_pose = np.concatenate([-by_point @ skew(there - T[:, None, :3, 3]), by_point], axis=-1)
        by_pose = np.where(visible[..., None, None], by_pose, 0.0) / self.sigma
        normal = np.einsum("knip,kniq->kpq", by_pose, by_pose)
        values = np.linalg.eigvalsh(unit_diagonal(normal)[0])
        enough = visible.sum(axis=1) >= BOARD_POSE_OPTIONS.least_weight
        enough &= values[:, 0] > NORMAL_RANK_TOLERANCE * values[:, -1]
        covariance = np.linalg.inv(normal[enough])
        return pose_set(self.station, rows[enough], self.mount, T[enough], covariance)

    def _visible_corners(self, at: At, T: Array, there: Array) -> Booleans:
        """Corners (K, N) in the image, on the board's face, and not behind a leg."""
        with np.errstate(invalid="ignore"):
            visible = np.asarray(self.camera.in_image(self.camera.project(there)))
        # the print is on the side of the board's -z axis
        eye = inverse(T)[:, :3, 3] - self.points.mean(axis=0)
        visible &= (-eye[:, 2] / np.linalg.norm(eye, axis=-1) > FLATTEST_BOARD_COSINE)[:, None]
        machine, tubes = at.machine, tubes_of(at.machine)
        if not len(tubes):
            return visible
        rods = machine.ends_at(at.joints, at.T_base_platform).rods
        a, b = (apply(self.T_camera_base, end) for end in rods)
        nothing, radius = np.array([-1]), machine.values[tubes.radius]
        pixel = pixel_angle(self.camera)
        behind = hidden(there[:, None], nothing, nothing, tubes, radius, a, b, pixel)
        return visible & ~behind[:, 0]


@dataclass(frozen=True)
class TargetFrom:
    """Target on the platform, measured by a tracker or a probe at T_tracker_base (4, 4).

    T_platform_target : (4, 4). whiten : (6, 6) as in :class:`~pkmcal.measurements.PoseSet`.
    """

    station: int
    T_tracker_base: Array
    T_platform_target: Array
    whiten: Array
    mount: int = 0

    def measure(self, at: At, rows: Integers, _rng: np.random.Generator | None, /) -> PoseSet:
        """Poses of the target at every configuration."""
        T = self.T_tracker_base @ at.T_base_platform[rows] @ self.T_platform_target
        n = len(rows)
        whiten = np.broadcast_to(self.whiten, (n, 6, 6)).copy()
        return PoseSet(np.full(n, self.station), rows, np.full(n, self.mount), T, whiten)


Instrument = LegsFrom | BoardFrom | TargetFrom
"""Instrument of one station; ``measure`` predicts its measurements of configurations ``rows``."""


@dataclass(frozen=True)
class Rig:
    """Machine with its instruments.

    names : of S stations.
    T_station_base : (S, 4, 4) of cameras and trackers.
    camera_of_station : (S,) index of the camera.
    joint_noise : standard deviation of a reading, m or rad.
    mounts : of boards and targets, with poses T_mount (M, 4, 4).
    shading : px, standard deviation of the common shift of edges of one side of a tube at one
        station.
    where : prefix of a station's name in messages; None without a file.
    temperatures, forces : of the configurations, repeated in their order; None where joints.csv has
        none.
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
    temperatures: Array | None = None
    forces: Array | None = None

    __repr__ = short_repr

    def only(self, stations: Sequence[int]) -> Rig:
        """Rig with selected stations, in this order, and all mounts."""
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
        """Predicted measurements at joints (K, m), T_base_platform (K, 4, 4).

        pairs : (M, 2) stations and configurations. rng : as in :meth:`LegsFrom.measure`.
        """
        edges, poses = [EdgeSet.empty()], [PoseSet.empty()]
        at = At(self.machine, joints, T_base_platform)
        for one in self.instruments:
            rows = pairs[pairs[:, 0] == one.station, 1]
            predicted = one.measure(at, rows, rng)
            if isinstance(predicted, EdgeSet):
                edges.append(predicted)
            else:
                poses.append(predicted)
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
            effects=reading_effects(
                self.machine,
                joints,
                T_base_platform,
                *(
                    None if x is None else np.resize(x, (len(joints), *x.shape[1:]))
                    for x in (self.temperatures, self.forces)
                ),
            ),
        )

    def assembled(
        self, measurements: Measurements, T_base_platform: Array, share: float = 1.0
    ) -> tuple[Assembled, BatchState]:
        """Problem of the joint estimate for the measurements, and the true state. share : as in
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
    """Pairs (M, 2) of every station with every configuration."""
    return np.array([(s, k) for s in stations for k in configurations], dtype=int).reshape(-1, 2)
