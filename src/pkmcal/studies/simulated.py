"""Simulated sessions of many runs: true machines, their poses, and noisy measurements.

Runs are batched: B runs, K configurations, m readings, S stations. A camera observes legs' axes, as
[A] measures them, or a board on the platform, as [C] does. A run becomes the same measurements and
the same least-squares problem as a session with images.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import apply, perturb
from pkmcal.identify.assembly import assemble
from pkmcal.identify.axis_measurements import as_edges, to_coordinates
from pkmcal.identify.gauge import Gauge
from pkmcal.identify.problem import Problem
from pkmcal.measurements import BOARD_MOUNT_NAME, EdgeSet, Measurements, Mount, PoseSet
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends


@dataclass(frozen=True)
class Viewpoints:
    """Stations and what they observe of K configurations, the same in all runs.

    T_camera_base : (S, 4, 4).
    station : (K,).
    legs : (K, G) legs whose axes are observed.
    T_platform_board : (4, 4), None without a board.
    """

    T_camera_base: Array
    station: Integers
    legs: Integers = field(default_factory=lambda: np.zeros((0, 0), dtype=int))
    T_platform_board: Array | None = None


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the measurements.

    reading : m or rad; errors are uniform if ``even``, else normal.
    axis : (4,) of an axis's psi, theta, x and z.
    pose : (6,) of a board's (omega, tau).
    """

    reading: float
    even: bool = False
    axis: Array = field(default_factory=lambda: np.zeros(4))
    pose: Array = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True)
class SimulatedRuns:
    """Simulated runs with their truth.

    machine : model of the truth.
    theta : (B, P).
    T_base_platform : (B, K, 4, 4) true.
    joints : (B, K, m) measured.
    axis : (B, K, G, 4) measured.
    T_camera_board : (B, K, 4, 4) measured; (B, 0, 4, 4) without a board.
    control : number of configurations at the end that are held out from the calibration.
    """

    machine: Machine
    theta: Array
    view: Viewpoints
    noise: Noise
    T_base_platform: Array
    joints: Array
    axis: Array
    T_camera_board: Array
    control: int = 0

    @property
    def count(self) -> int:
        """Number of configurations for the calibration."""
        return self.joints.shape[1] - self.control


def spread_evenly(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> Array:
    """Uniform random numbers of zero mean and standard deviation sigma."""
    return rng.uniform(-1, 1, shape) * np.sqrt(3) * sigma


def simulate_runs(
    machine: Machine,
    theta: Array,
    readings: Array,
    T_base_platform: Array,
    view: Viewpoints,
    noise: Noise,
    rng: np.random.Generator,
    control: int = 0,
) -> SimulatedRuns:
    """Simulate the measurements of machines (B, P) at exact readings (B, K, m) and poses (B, K, 4,
    4).
    """
    runs, count = readings.shape[:2]
    camera = view.T_camera_base[view.station]
    axis, board = np.zeros((runs, count, 0, 4)), np.zeros((runs, 0, 4, 4))
    if view.legs.size:
        # Axes of the observed legs.
        ends = limb_ends(machine.layout, theta[:, None], readings, T_base_platform)
        k = np.arange(count)[:, None]
        a, b = (apply(camera[:, None], p[:, k, view.legs]) for p in ends.rods)
        axis = to_coordinates(a, b)
        axis = axis + noise.axis * rng.normal(size=axis.shape)
    if view.T_platform_board is not None:
        # Poses of the board.
        off = noise.pose * rng.normal(size=(runs, count, 6))
        board = perturb(camera @ T_base_platform @ view.T_platform_board, off)
    if noise.even:
        joints = readings + spread_evenly(rng, readings.shape, noise.reading)
    else:
        joints = readings + noise.reading * rng.normal(size=readings.shape)
    return SimulatedRuns(machine, theta, view, noise, T_base_platform, joints, axis, board, control)


def measurements(data: SimulatedRuns, run: int = 0) -> Measurements:
    """Measurements of one run's calibration, as a session gives them; axes only with the place of
    one edge.
    """
    n, view = data.count, data.view
    none = np.zeros(n, dtype=int)
    poses, mounts = PoseSet.empty(), ()
    if view.T_platform_board is not None:
        whiten = np.broadcast_to(np.diag(1 / data.noise.pose), (n, 6, 6))
        measured = data.T_camera_board[run, :n]
        poses = PoseSet(view.station[:n], np.arange(n), none, measured, whiten)
        mounts = (Mount(BOARD_MOUNT_NAME, "platform"),)
    stations = len(view.T_camera_base)
    return Measurements(
        _positions_of_axes(view),
        data.joints[run, :n],
        data.noise.reading,
        stations,
        np.zeros(stations, dtype=int),
        poses=poses,
        mounts=mounts,
    )


def _positions_of_axes(view: Viewpoints) -> EdgeSet:
    """One edge for each axis, with its indices and no numbers."""
    legs = view.legs.reshape(-1)
    n, each = len(legs), view.legs.shape[1]
    configuration = np.repeat(np.arange(len(view.legs)), each)
    none = np.zeros(n, dtype=int)
    return EdgeSet(
        np.repeat(view.station[: len(view.legs)], each), configuration, legs, none, none,
        normal=np.zeros((n, 3)), basis=np.zeros((n, 3, 2)), shift=np.zeros((n, 2)),
        covariance=np.broadcast_to(np.eye(2), (n, 2, 2)), span=np.zeros((n, 2)),
    )  # fmt: skip


def joint_problem(
    machine: Machine, data: SimulatedRuns, gauge: Gauge, *, use_prior: bool = False
) -> Problem:
    """Joint problem of all runs with a model: that of a session, with the data of all runs.

    An axis is represented by two edges that are whitened together, [A] Table 1.
    """
    n = data.count
    assembled = assemble(machine, measurements(data), gauge, use_prior=use_prior)
    template, at = assembled.problem, assembled.places.edges
    blocks, edge_data = template.blocks, replace(template.data, joints=data.joints[:, :n])
    if data.view.legs.size:
        # Each axis as two whitened edges.
        axis = data.axis.reshape(len(data.axis), -1, 4)
        radius = machine.parameters.nominal[blocks.radius[at.row, at.place]]
        whitened = as_edges(axis, data.noise.axis, np.broadcast_to(radius, axis.shape[:-1]))
        basis, white = (np.zeros((len(axis), *at.shape, *part.shape[2:])) for part in whitened)
        basis[:, at.row, at.place], white[:, at.row, at.place] = whitened
        # both sides of an axis, on which no column acts: axes have no edge shift
        sides, of_none = np.broadcast_to([0, 1], (*at.shape, 2)), blocks.column[..., :0]
        blocks = replace(blocks, side=sides, column=of_none)
        shift, none = np.zeros((1, *at.shape, 4)), np.zeros((1, *at.shape, 4, 0))
        edge_data = replace(edge_data, basis=basis, white=white, shift=shift, columns=none)
    poses = template.pose_data
    if data.view.T_platform_board is not None:
        poses = replace(poses, T_station_target=data.T_camera_board[:, :n, None])
    return replace(template, blocks=blocks, data=edge_data, pose_data=poses)
