"""What new data tell of a change of a calibrated machine, nothing estimated but where things stand.

The machine is held at its calibrated values; the platform's poses, stations, boards and edge shifts
are found from the new data. At that point the residuals y (in standard deviations) have the
derivative A by the machine's parameters, and the truth is the calibrated values plus the
calibration's error e, of covariance C, plus a change c. To first order, what the poses and the
other nuisances can take up projected out of both,

    -y = A (c + e) + noise,      covariance  V = 1 + A C A^T.

Whitened by V that is a linear regression on the change: ``w = X c + noise`` with noise of unit
variance. Every test of a change is one on w and X (a score test: no machine is estimated).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import ResultError
from pkmcal.identify.assembly import Assembled, assemble, batch_of, state_of
from pkmcal.identify.blocks import BatchState
from pkmcal.identify.covariance import RANK_TOLERANCE
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.problem import Estimate, State
from pkmcal.identify.residuals import Problem
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.solver import RESTART_DAMPING, Stop, eliminate, minimise, transposed

SIZE = 1e-3
"""Of a magnification, relative: the size against which it counts as seen."""


@dataclass(frozen=True)
class Trust:
    """How far new data are believed: robust weights (N,) of edges and of poses, 0..1, and factors
    on their stated noise.

    Weights come from an estimate whose machine could move: with the machine held, a leg that has
    changed would be taken for an error of its edges, and be let go.
    """

    edges: Array
    poses: Array
    noise_scale: float = 1.0
    pose_scale: float = 1.0

    @classmethod
    def full(cls, measurements: Measurements) -> Trust:
        """All data as they are stated."""
        return cls(np.ones(len(measurements.edges)), np.ones(len(measurements.poses)))

    @classmethod
    def of(cls, estimate: Estimate, noise_scale: float = 1.0, pose_scale: float = 1.0) -> Trust:
        """An estimate's weights, and the larger of its factors and of the calibration's."""
        return cls(
            estimate.edge_weights,
            estimate.pose_weights,
            max(estimate.statistics.noise_scale, noise_scale),
            max(estimate.statistics.pose_scale, pose_scale),
        )


@dataclass(frozen=True)
class Evidence:
    """New data as a linear regression on a change of the machine; see the module.

    w : (n,) of unit variance. by : X (n, P + C), by the parameters' changes in m and rad, and by
    the magnification of C cameras where that was asked for; an axis' own length has no part in it.
    residuals : (K,) root mean squares of each configuration's residuals with the machine held, in
    standard deviations, its own pose's freedoms allowed for; NaN where nothing was seen.
    state : stations, mounts and poses, in the calibration's frames.
    """

    w: Array
    by: Array
    residuals: Array
    state: State


def evidence(
    machine: Machine,
    covariance: Array,
    measurements: Measurements,
    start: State,
    trust: Trust,
    magnified: Measurements | None = None,
) -> Evidence:
    """What measurements tell of a change of the machine from its present values.

    covariance : (P, P) of those values by the calibration. start : stations, mounts and poses in
    frames near the machine's. magnified : the measurements with an unknown magnification a camera
    (:func:`~pkmcal.watching.lens.magnified`), to tell it from a change. Raises
    ResultError where the poses are not found.
    """
    still = _still(machine)
    assembled = assemble(still, measurements, default_gauge(still))
    problem = _trusted(assembled, trust)
    begin = batch_of(still, assembled, replace(start, theta=still.values))
    found = minimise(problem, begin, damping=RESTART_DAMPING)
    if found.stop[0] in (Stop.NOT_FINITE, Stop.STALLED):
        raise ResultError(
            "the platform's poses were not found with the calibrated machine:"
            f" {found.stop[0].value}"
        )
    if magnified is None:
        by, told = _reduced(problem, found.state, machine)
    else:
        wide = _trusted(assemble(still, magnified, default_gauge(still)), trust)
        by, told = _reduced(wide, _with_magnification(found.state), machine)
    known = by[:, : len(covariance)]
    spread = np.eye(len(told)) + known @ covariance @ known.T
    lower = np.linalg.cholesky(0.5 * (spread + spread.T))
    by = np.linalg.solve(lower, by)
    return Evidence(
        w=np.linalg.solve(lower, told),
        by=by,
        residuals=_residuals(problem, assembled, found.state),
        state=state_of(assembled, found.state, start),
    )


def _still(machine: Machine) -> Machine:
    """The machine with nothing free: the drawing of what is looked for is what it is."""
    table = machine.parameters
    values = table.unit_axes(machine.values)
    fixed = replace(table, drawing=values, fixed=table.names, tied=(), opposed=())
    return replace(machine, parameters=fixed, values=values.copy())


def _trusted(assembled: Assembled, trust: Trust) -> Problem:
    """The problem with the weights of :class:`Trust`."""
    problem = assembled.problem
    edges, poses = problem.data.weight.copy(), problem.pose_data.weight.copy()
    edges[0, assembled.row, assembled.place] = trust.edges / trust.noise_scale**2
    poses[0, assembled.pose_row, assembled.pose_place] = trust.poses / trust.pose_scale**2
    return problem.weighted(edges, poses)


def _with_magnification(state: BatchState) -> BatchState:
    """The state with each camera's magnification at 1."""
    return replace(state, optics=np.pad(state.optics, ((0, 0), (0, 0), (0, 1))))


def _reduced(problem: Problem, state: BatchState, machine: Machine) -> tuple[Array, Array]:
    """A (n, P + C) and -y (n,), independent rows of unit variance, nuisances taken out."""
    n = problem.drawing.size
    wide = replace(problem, free=np.eye(n))
    wide = replace(wide, prior=np.pad(problem.prior, ((0, 0), (n, 0))))
    linear = wide.linearize(replace(state, z=problem.theta(state) - problem.drawing))
    reduced = eliminate(linear, np.zeros(1))
    value = linear.value[0, ..., None]
    value = value - reduced.q[0] @ (transposed(reduced.q[0]) @ value)
    rows = np.concatenate([reduced.rows[0].reshape(-1, wide.n_shared), linear.shared_by])
    left = np.concatenate([value.reshape(-1), linear.shared_value[0]])
    lens = n + 6 * wide.n_stations + wide.n_optics * np.arange(wide.n_cameras) + 1
    lens = lens if wide.n_optics > 1 else lens[:0]
    asked = np.zeros(wide.n_shared, dtype=bool)
    asked[:n] = asked[lens] = True
    # what is known beforehand of a magnification is what this asks
    kept = np.r_[
        np.ones(len(rows) - len(linear.shared_by), bool), ~linear.shared_by[:, asked].any(1)
    ]
    rows, left = rows[kept], left[kept]
    q = _column_space(rows[:, ~asked])
    size = np.append(machine.parameters.tolerance, np.full(len(lens), SIZE))
    by = rows[:, asked] * size
    by[:, :n] = rows[:, :n] @ _across_axes(machine) * size[:n]
    by, left = by - q @ (q.T @ by), left - q @ (q.T @ left)
    u, s, vt = np.linalg.svd(by, full_matrices=False)
    known = s > RANK_TOLERANCE * s.max(initial=0.0)
    return s[known, None] * vt[known] / size, -u[:, known].T @ left


def _across_axes(machine: Machine) -> Array:
    """Projector (P, P) that takes out what would only make axes longer."""
    table = machine.parameters
    values, out = table.unit_axes(machine.values), np.eye(len(table))
    for index in table.axes:
        out[np.ix_(index, index)] -= np.outer(values[index], values[index])
    return out


def _column_space(columns: Array) -> Array:
    """An orthonormal basis of what columns can make."""
    norm = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns[:, norm > 0] / norm[norm > 0], full_matrices=False)
    return u[:, s > RANK_TOLERANCE * s.max(initial=0.0)]


def _residuals(problem: Problem, assembled: Assembled, state: BatchState) -> Array:
    """Root mean squares of the rows in use of each configuration, (K,)."""
    linear = problem.linearize(state)
    weight = np.repeat(problem.data.weight[0], problem.data.whiten.shape[-1], axis=-1)
    count = np.sum(weight > 0, axis=1) + problem.layout.n_equations
    if problem.pose_blocks.count:
        measured = np.any(problem.pose_data.whiten[0] != 0, axis=-1) & (
            problem.pose_data.weight[0, ..., None] > 0
        )
        count = count + measured.sum(axis=(1, 2))
    # a configuration's own pose takes up as many as it has freedoms
    free = np.maximum(count - linear.by_own.shape[-1], 1)
    out = np.full(len(assembled.seen), np.nan)
    out[assembled.seen] = np.sqrt(np.sum(linear.value[0] ** 2, axis=1) / free)
    return out
