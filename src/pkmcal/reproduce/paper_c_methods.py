"""The methods of [C] on simulated runs, and how far each is from the truth over the workspace."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import pose_difference
from pkmcal.identify.assembly import assemble
from pkmcal.identify.bundle import BatchResult, solve_batch
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.problem import State
from pkmcal.identify.residuals import BatchState, Problem
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward, inverse, on_manifold
from pkmcal.papers.hand_eye import Pair, PairProblem, size_of, solve_pairs
from pkmcal.papers.inverse_kinematic import Form, PoseFit, fit_poses, pose_problem
from pkmcal.reproduce.paper_c_simulation import Settings, Truth, measurements, workspace
from pkmcal.solver import eliminate, minimise

POSES = 100
"""Poses at which a run's machine is held against the truth."""
LOOSE = 1e-9
FREE = 1e3
"""Standard deviation (m) of the tool frame in a registration: free."""


class Fitted(NamedTuple):
    """An estimate of B runs: theta (B, P), stations and mounts (B, 4, 4), its chi2 per degree of
    freedom (B,), NaN where rows are not whitened.
    """

    theta: Array
    T_camera_base: Array
    T_mount: Array
    chi2: Array


def start(machine: Machine, truth: Truth) -> State:
    """Where every method begins: the drawing, camera and board by the closed form; B runs."""
    n = truth.n_calibration
    found = forward(machine.layout, machine.parameters.drawing, truth.joints[:, :n], machine.home())
    pair = solve_pairs(found.T_base_platform, truth.seen[:, :n], size_of(machine))
    return State(
        machine.parameters.drawing,
        pair.T_camera_base[:, None],
        found.T_base_platform,
        np.zeros(1),
        T_mount=pair.T_mount[:, None],
        on_platform=np.ones(1, dtype=bool),
        internal=found.internal,
    )


def at_poses(
    machine: Machine, truth: Truth, settings: Settings, begin: State, form: Form, *,
    whitened: bool, use_drawing: bool = False,
) -> PoseFit:  # fmt: skip
    """[C] eq. 3 or 5, as printed or whitened. begin : of :func:`start`."""
    n = truth.n_calibration
    problem, state = pose_problem(
        machine, measurements(truth, settings), truth.seen[:, :n], truth.joints[:, :n], begin, form
    )
    noise = np.broadcast_to(np.diag(settings.sigma**2), (n, 6, 6)) if whitened else None
    return fit_poses(machine, problem, state, noise, settings.joint_noise, use_drawing)


def fitted(fit: PoseFit) -> Fitted:
    """A fit at measured poses as an estimate."""
    state, rows = fit.solution.state, fit.problem.weigh.shape[-1]
    theta = fit.problem.theta(state)
    n = fit.problem.readings.shape[1]
    own = fit.problem.layout.n_internal
    free = n * (rows - own) + len(fit.problem.prior) - fit.rank
    printed = len(fit.problem.weigh) == 1 and fit.problem.weigh.shape[1] == 1
    chi2 = np.full(len(theta), np.nan) if printed else fit.solution.cost / free
    return Fitted(theta, state.T_camera_base[:, 0], state.T_mount[:, 0], chi2)


def joint_problem(
    machine: Machine, truth: Truth, settings: Settings, *, use_drawing: bool
) -> Problem:
    """The joint problem of all runs: board poses and readings, platform poses unknown."""
    n = truth.n_calibration
    first = assemble(
        machine, measurements(truth, settings), default_gauge(machine), use_drawing=use_drawing
    ).problem
    return replace(
        first,
        data=replace(first.data, joints=truth.joints[:, :n]),
        pose_data=replace(first.pose_data, T_station_target=truth.seen[:, :n, None]),
    )


def joint(
    machine: Machine, truth: Truth, settings: Settings, begin: PoseFit, *, use_drawing: bool = False
) -> tuple[Fitted, BatchResult]:
    """The joint maximum-likelihood estimate, from a fit at measured poses."""
    problem = joint_problem(machine, truth, settings, use_drawing=use_drawing)
    state = begin.solution.state
    poses = begin.problem.platform_poses(state)
    batch = BatchState(
        state.z, state.T_camera_base, poses, np.zeros((len(poses), 1, 1)), state.T_mount,
        state.internal,
    )  # fmt: skip
    found = solve_batch(problem, batch, robust=False, scale_noise=False)
    end = found.solution.state
    own = machine.layout.own_motion.shape[1]
    data = poses.shape[1] * (6 + machine.layout.n_equations - own)
    chi2 = found.solution.cost / (data + len(begin.problem.prior) - begin.rank)
    return Fitted(problem.theta(end), end.T_camera_base[:, 0], end.T_mount[:, 0], chi2), found


def bound(machine: Machine, truth: Truth, settings: Settings, rng: np.random.Generator) -> Fitted:
    """A draw from the Cramér-Rao bound at the truth, whose parameters are the machine's."""
    n = truth.n_calibration
    problem = joint_problem(machine, truth, settings, use_drawing=False)
    z = (truth.theta - machine.parameters.drawing) @ np.linalg.pinv(problem.free).T
    runs = len(z)
    camera = np.broadcast_to(truth.T_camera_base, (runs, 1, 4, 4))
    mount = np.broadcast_to(truth.T_platform_board, (runs, 1, 4, 4))
    batch = BatchState(
        z, camera, truth.poses[:, :n], np.zeros((runs, 1, 1)), mount,
        np.zeros((runs, n, machine.layout.n_internal)),
    )  # fmt: skip
    step = _drawn(problem, batch, rng)
    theta = truth.theta + step[:, : z.shape[1]] @ problem.free.T
    return Fitted(theta, camera[:, 0], mount[:, 0], np.full(runs, np.nan))


def _drawn(problem: Problem, state: BatchState, rng: np.random.Generator) -> Array:
    """Errors (B, na) of the shared unknowns with the covariance of the bound; none along what
    nothing tells.
    """
    reduced = eliminate(problem.linearize(state), np.zeros(len(state.z)))
    rows = reduced.rows.reshape(len(state.z), -1, reduced.rows.shape[-1])
    scale = np.sqrt(np.sum(rows**2, axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    s, vt = np.linalg.svd(np.linalg.qr(rows / scale[:, None], mode="r"))[1:]
    known: Booleans = s > LOOSE * s[:, :1]
    draw = rng.normal(size=s.shape) * np.where(known, 1 / np.where(known, s, 1.0), 0.0)
    return (np.swapaxes(vt, -1, -2) @ draw[..., None])[..., 0] / scale


class Errors(NamedTuple):
    """Root mean squares of runs over a workspace, (B,) m and rad: of the tool after registration
    of both its frames, and before any.
    """

    shift: Array
    turn: Array
    shift_before: Array
    turn_before: Array


class Places(NamedTuple):
    """Where machines are held against the truth: poses (B, n, 4, 4) and readings (B, n, m)."""

    poses: Array
    readings: Array


def places(truth: Truth, rng: np.random.Generator, larger: float = 1.0) -> Places:
    """Random ones in the measured volume, or in a larger workspace."""
    poses, layout = workspace(POSES, rng, larger), truth.machine.layout
    if layout.n_internal:  # what tilts can only take some poses
        poses = on_manifold(layout, truth.theta[:, None], poses).T_base_platform
    readings = inverse(layout, truth.theta[:, None], poses)
    return Places(np.broadcast_to(poses, (*readings.shape[:2], 4, 4)), readings)


def errors(machine: Machine, theta: Array, at: Places, settings: Settings) -> Errors:
    """How far machines (B, P) are from the truth, by the same readings.

    Registered: base and tool frames are those that fit best, since a calibration gives them too.
    """
    layout, poses = machine.layout, at.poses
    found = forward(layout, theta[..., None, :], at.readings, poses).T_base_platform
    before = pose_difference(found, poses)
    still = np.broadcast_to(np.eye(4), (len(poses), 4, 4))
    weight = np.ones(poses.shape[:2])
    problem = PairProblem(found, poses, weight, settings.turn, settings.shift, FREE)
    pair: Pair = minimise(problem, Pair(still, still)).state
    after = problem.differences(pair) * settings.sigma
    return Errors(
        _rms(after[..., 3:]), _rms(after[..., :3]), _rms(before[..., 3:]), _rms(before[..., :3])
    )


def _rms(values: Array) -> Array:
    return np.sqrt(np.mean(np.sum(values**2, axis=-1), axis=-1))
