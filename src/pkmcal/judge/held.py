"""A calibrated machine held as it is, on new measurements: the regression behind every judgement.

Nothing is calibrated anew. The machine's parameters stay where they are; the platform's poses,
stations, boards, edge shifts and shading are found. At that point the residuals y, in standard
deviations, have the derivative A by the machine's parameters, and Q and q are orthonormal bases of
what the unknowns of each configuration, and those that all share, can make of them. What only the
machine can explain is seen through the projector

    P = 1 - Q Q^T - q q^T.

The truth is the calibrated values plus the calibration's error e, of covariance C, plus a change c;
to first order ``-P y = P A (c + e) + P noise``, the noise of unit variance. Two things are read
from that: what all else predicts of a configuration's readings (:mod:`pkmcal.judge.prediction`),
and whether there is a change c (:func:`evidence`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.errors import ResultError
from pkmcal.identify.assembly import Assembled, assemble, batch_of, state_of
from pkmcal.identify.bundle import solve_batch
from pkmcal.identify.estimate import Estimate, State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.solver import (
    RANK_TOLERANCE,
    RESTART_DAMPING,
    Linear,
    Reduced,
    Stop,
    eliminate,
    minimise,
    transposed,
)

MAGNIFIED = 1e-3
"""Of a camera's magnification, relative: the size against which it counts as seen."""


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
class Held:
    """A machine held on new measurements; see the module. K' configurations were seen.

    machine : as held, with tubes' radii where these were found. state : stations, mounts and poses,
    in its frames. seen : (K,). noise_scale, pose_scale : factors on the stated noise of edges and
    of boards' poses. problem, batch : at the solution, weights included.
    linear, reduced : rows of all unknowns but the machine, (K', r) a configuration and the priors'
    after them, and the elimination of each configuration's own. by : (K', r, P + C) derivatives A
    by the machine's parameters, m and rad, and by the magnification of C cameras where asked for.
    basis : q (K' r + c, a) of the shared unknowns, own ones taken out. inverse : (u, u), N^+ of
    their normal matrix; open directions count as exact.
    """

    machine: Machine
    state: State
    seen: Booleans
    noise_scale: float
    pose_scale: float
    problem: Problem
    batch: BatchState
    linear: Linear
    reduced: Reduced
    by: Array
    basis: Array
    inverse: Array

    def projected(self, rows: Array, priors: Array | None = None) -> Array:
        """P rows: what no pose, station, board or shift explains of rows (K', r, n).

        priors : (c, n) their part in the priors' rows, zero where not given. Returns (K' r + c, n).
        """
        n = rows.shape[-1]
        if priors is None:
            priors = np.zeros((len(self.linear.shared_by), n))
        own = self.reduced.q[0]
        rows = rows - own @ (transposed(own) @ rows)
        stacked = np.concatenate([rows.reshape(-1, n), priors])
        return stacked - self.basis @ (self.basis.T @ stacked)

    def residuals(self) -> Array:
        """Root mean squares of each configuration's residuals in standard deviations, (K,).

        Its own pose takes up as many rows as it has freedoms; NaN where nothing was seen.
        """
        problem, value = self.problem, self.linear.value[0]
        weight = np.repeat(problem.data.weight[0], problem.data.whiten.shape[-1], axis=-1)
        count = np.sum(weight > 0, axis=1) + problem.layout.n_equations
        if problem.pose_blocks.count:
            measured = np.any(problem.pose_data.whiten[0] != 0, axis=-1)
            measured &= problem.pose_data.weight[0, ..., None] > 0
            count = count + measured.sum(axis=(1, 2))
        free = np.maximum(count - self.linear.by_own.shape[-1], 1)
        out = np.full(len(self.seen), np.nan)
        out[self.seen] = np.sqrt(np.sum(value**2, axis=1) / free)
        return out


def held_machine(machine: Machine, radii: bool) -> Machine:
    """The machine with nothing free, its values for a drawing; radii : but its tubes' radii, which
    light and photographs decide.
    """
    table = machine.parameters
    free = {n for n, kind in zip(table.names, table.kinds, strict=True) if kind == "radius"}
    free = free if radii else set[str]()
    opposed = table.opposed or ((),) * len(table.tied)
    groups = [g for g in zip(table.tied, opposed, strict=True) if free & set(g[0])]
    values = table.unit_axes(machine.values)
    table = replace(
        table,
        drawing=values,
        fixed=tuple(n for n in table.names if n not in free or n in table.fixed),
        tied=tuple(group for group, _ in groups),
        opposed=tuple(against for _, against in groups),
    )
    return replace(machine, parameters=table, values=values.copy())


def hold(
    machine: Machine,
    measurements: Measurements,
    start: State,
    trust: Trust | None = None,
    magnified: Measurements | None = None,
) -> Held:
    """Poses, stations and boards of measurements, found with the machine held.

    start : stations, mounts and poses in frames near the machine's. trust : how far to believe the
    data; without it that is found here, and so are the tubes' radii. magnified : the measurements
    with an unknown magnification a camera (:func:`~pkmcal.judge.causes.magnified`), to tell that
    from a change of the machine. Raises ResultError where the poses are not found.
    """
    still = held_machine(machine, radii=trust is None)
    assembled = assemble(still, measurements, default_gauge(still))
    begin = batch_of(still, assembled, replace(start, theta=still.values))
    if trust is None:
        _check_enough(assembled.problem, begin)
        result = solve_batch(assembled.problem, begin)
        problem, found = result.problem, result.solution
        scales = float(result.noise_scale[0]), float(result.pose_scale[0])
    else:
        problem = _trusted(assembled, trust)
        found = minimise(problem, begin, damping=RESTART_DAMPING)
        scales = trust.noise_scale, trust.pose_scale
    if found.stop[0] in (Stop.NOT_FINITE, Stop.STALLED):
        raise ResultError(
            "the platform's poses were not found with the calibrated machine:"
            f" {found.stop[0].value}"
        )
    state = state_of(assembled, found.state, start)
    batch: BatchState = found.state
    if magnified is not None and trust is not None:
        problem = _trusted(assemble(still, magnified, default_gauge(still)), trust)
        batch = replace(batch, optics=np.pad(batch.optics, ((0, 0), (0, 0), (0, 1))))
    linear, by = _split(problem, batch)
    reduced = eliminate(linear, np.zeros(1))
    rows = reduced.rows[0]
    basis, half = _column_space(
        np.concatenate([rows.reshape(-1, rows.shape[-1]), linear.shared_by])
    )
    return Held(
        machine=still.with_values(state.theta),
        state=state,
        seen=assembled.seen,
        noise_scale=scales[0],
        pose_scale=scales[1],
        problem=problem,
        batch=batch,
        linear=linear,
        reduced=reduced,
        by=by,
        basis=basis,
        inverse=half @ half.T,
    )


def _check_enough(problem: Problem, state: BatchState) -> None:
    """Raise ResultError where there are fewer rows than unknowns."""
    linear = problem.linearize(state)
    rows = int(linear.usable.sum()) + len(linear.shared_by)
    if rows < problem.n_shared + linear.by_own.shape[1] * linear.by_own.shape[-1]:
        raise too_little()


def too_little() -> ResultError:
    """What is said where readings would be predicted from themselves."""
    return ResultError(
        "too little was seen to predict readings: some poses follow from their own readings alone",
        expected="legs, or a board in several more configurations",
        next_step="Photograph more configurations from each station",
    )


def _trusted(assembled: Assembled, trust: Trust) -> Problem:
    """The problem with the weights of :class:`Trust`."""
    problem = assembled.problem
    edges, poses = problem.data.weight.copy(), problem.pose_data.weight.copy()
    edges[0, assembled.row, assembled.place] = trust.edges / trust.noise_scale**2
    poses[0, assembled.pose_row, assembled.pose_place] = trust.poses / trust.pose_scale**2
    return problem.weighted(edges, poses)


def _split(problem: Problem, state: BatchState) -> tuple[Linear, Array]:
    """Rows of all unknowns but what is asked for, and A (K', r, P + C) of that: every parameter of
    the machine that is not free here, and the cameras' magnification.
    """
    n = problem.drawing.size
    opened = replace(problem, free=np.eye(n))
    opened = replace(opened, prior=np.zeros((len(problem.prior), opened.n_shared)))
    there = replace(state, z=problem.theta(state) - problem.drawing)
    machine = opened.linearize(there).by_shared[0, ..., :n].copy()
    machine[..., np.any(problem.free != 0, axis=1)] = 0.0
    linear = problem.linearize(state)
    asked = np.zeros(problem.n_shared, dtype=bool)
    if problem.n_optics > 1:
        first = problem.free.shape[1] + 6 * problem.n_stations + 1
        asked[first + problem.n_optics * np.arange(problem.n_cameras)] = True
    by = np.concatenate([machine, linear.by_shared[0][..., asked]], axis=-1)
    # what is known beforehand of a magnification is what is asked
    kept = ~linear.shared_by[:, asked].any(axis=1)
    rest = linear._replace(
        by_shared=linear.by_shared[..., ~asked],
        shared_value=linear.shared_value[:, kept],
        shared_by=linear.shared_by[kept][:, ~asked],
    )
    return rest, by


def _column_space(columns: Array) -> tuple[Array, Array]:
    """An orthonormal basis of what columns can make, and H with H H^T the inverse of columns^T
    columns; open directions count as exact.
    """
    norm = np.linalg.norm(columns, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    u, s, vt = np.linalg.svd(columns / norm, full_matrices=False)
    known = s > RANK_TOLERANCE * s.max(initial=0.0)
    return u[:, known], vt[known].T / s[known] / norm[:, None]


@dataclass(frozen=True)
class Evidence:
    """New data as a linear regression on a change of the machine, ``w = X c + noise``.

    w : (n,) of unit variance. by : X (n, P + C), by the parameters' changes in m and rad, and by
    the magnification of C cameras where that was asked for; an axis' own length has no part in it.
    Every test of a change is one on w and X: a score test, no machine is estimated.
    """

    w: Array
    by: Array


def evidence(held: Held, covariance: Array) -> Evidence:
    """What the data tell of a change from the held values, whose covariance (P, P) is the
    calibration's: whitened by V = 1 + A C A^T.
    """
    machine, n = held.machine, len(held.machine.parameters)
    size = np.append(machine.parameters.tolerance, np.full(held.by.shape[-1] - n, MAGNIFIED))
    by = held.by * size
    by[..., :n] = held.by[..., :n] @ _across_axes(machine) * size[:n]
    by = held.projected(by)
    left = held.projected(held.linear.value[0, ..., None], held.linear.shared_value[0, :, None])
    u, s, vt = np.linalg.svd(by, full_matrices=False)
    seen = s > RANK_TOLERANCE * s.max(initial=0.0)
    # noise is drawn in this basis: its signs must not be rounding's choice
    sign = np.sign(vt[np.arange(len(vt)), np.abs(vt).argmax(axis=1)])[seen]
    by = (sign * s[seen])[:, None] * vt[seen] / size
    told = -sign * (u[:, seen].T @ left[:, 0])
    known = by[:, : len(covariance)]
    spread = np.eye(len(told)) + known @ covariance @ known.T
    lower = np.linalg.cholesky(0.5 * (spread + spread.T))
    return Evidence(np.linalg.solve(lower, told), np.linalg.solve(lower, by))


def _across_axes(machine: Machine) -> Array:
    """Projector (P, P) that takes out what would only make axes longer."""
    table = machine.parameters
    values, out = table.unit_axes(machine.values), np.eye(len(table))
    for index in table.axes:
        out[np.ix_(index, index)] -= np.outer(values[index], values[index])
    return out
