"""Estimators for simulated runs, the Cramér-Rao bound, and the tool's errors.

All functions are batched over B runs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.bundle import BatchResult, solve_batch
from pkmcal.identify.hand_eye import Pair, PairProblem, whitener
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import forward, on_manifold, readings_at_poses
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.solver.elimination import eliminate
from pkmcal.solver.ranks import scaled_directions
from pkmcal.solver.search import minimise
from pkmcal.studies.simulated import SimulatedRuns

UNTOLD_SINGULAR_SHARE = 1e-9
"""Relative size of singular values of scaled rows below which a direction is unidentifiable."""
FREE_TOOL_FRAME_SIGMA = 1e3
"""Prior sigma (m) of the tool frame in a registration: effectively free."""


@dataclass(frozen=True)
class Fitted:
    """Estimate of B runs.

    theta : (B, P).
    T_camera_base, T_mount : (B, 4, 4) of the only station and the only mount.
    extra : figures reported by the method, (B,) or (B, n) by name, such as chi2 per degree of
        freedom.
    sigma : stated standard deviations, by quantity.
    covariance : (B, P, P) stated covariance of theta, None if the method has none.
    """

    theta: Array
    T_camera_base: Array | None = None
    T_mount: Array | None = None
    extra: dict[str, Array] = field(default_factory=dict[str, Array])
    sigma: dict[str, Array] = field(default_factory=dict[str, Array])
    covariance: Array | None = None


def nominal_estimate(machine: Machine, runs: int) -> Fitted:
    """Nominal parameters as an estimate."""
    nominal = machine.parameters.nominal
    return Fitted(np.broadcast_to(nominal, (runs, len(nominal))))


def joint(problem: Problem, start: BatchState) -> BatchResult:
    """Joint maximum-likelihood estimate with the true noise levels of the simulation."""
    return solve_batch(problem, start, robust=False, scale_noise=False)


def freedom(data: SimulatedRuns, layout: LimbLayout, shared_rank: int) -> int:
    """Degrees of freedom of the joint problem.

    shared_rank : rank of the unknowns shared by all configurations, less the number of their
    priors.
    """
    boards = 0 if data.view.T_platform_board is None else 6
    rows = 4 * data.axis.shape[2] + boards + layout.n_equations
    return data.count * (rows - layout.own_motion.shape[1]) - shared_rank


def drawn_from_bound(problem: Problem, state: BatchState, rng: np.random.Generator) -> Array:
    """Errors (B, na) of the shared unknowns, drawn with the covariance of the Cramér-Rao bound at a
    state.

    The components along unidentifiable directions are zero.
    """
    reduced = eliminate(problem.linearize(state))
    rows = reduced.rows.reshape(len(state.z), -1, reduced.rows.shape[-1])
    s, vt, scale = scaled_directions(rows)
    identifiable = s > UNTOLD_SINGULAR_SHARE * s[:, :1]
    spread = np.where(identifiable, 1 / np.where(identifiable, s, 1.0), 0.0)
    # The symmetric root is unique, whereas the signs of singular vectors depend on rounding.
    draw = spread[..., None] * (vt @ rng.normal(size=s.shape)[..., None])
    return (vt.mT @ draw)[..., 0] / scale


class ToolPlaces(NamedTuple):
    """Poses at which machines are compared with the truth: (B, n, 4, 4), with readings (B, n,
    m).
    """

    poses: Array
    readings: Array


def tool_positions(data: SimulatedRuns, wanted: Array) -> ToolPlaces:
    """Poses near the wanted ones (n, 4, 4) that each true machine can reach, and its readings."""
    layout, theta = data.machine.layout, data.theta[:, None]
    poses = on_manifold(layout, theta, wanted).T_base_platform if layout.n_internal else wanted
    readings = readings_at_poses(layout, theta, poses)
    return ToolPlaces(np.broadcast_to(poses, (*readings.shape[:2], 4, 4)), readings)


class ToolErrors(NamedTuple):
    """Root mean square errors over poses: (B,) m and rad."""

    shift: Array
    turn: Array


def tool_errors(
    layout: LimbLayout, theta: Array, at: ToolPlaces, turn: float, shift: float
) -> ToolErrors:
    """Errors of machines (B, P) with respect to the truth at the same readings.

    Base and tool frames are registered for the best fit, since a calibration determines them too.
    turn, shift : rad and m that have equal weight in the registration.
    """
    # Register base and tool frames of all runs, then take the remaining differences.
    fk = forward(layout, theta[..., None, :], at.readings, at.poses).T_base_platform
    still = np.broadcast_to(np.eye(4), (len(fk), 4, 4))
    weight = np.ones(fk.shape[:2])
    problem = PairProblem(fk, at.poses, weight, whitener(turn, shift), FREE_TOOL_FRAME_SIGMA)
    pair: Pair = minimise(problem, Pair(still, still)).state
    off = problem.differences(pair) * np.repeat([turn, shift], 3)
    size = np.sqrt(np.mean(np.square(off).reshape(*off.shape[:2], 2, 3).sum(axis=-1), axis=1))
    return ToolErrors(size[:, 1], size[:, 0])
