"""Joint estimate of all unknowns from all measurements: robust maximum likelihood.

Machine parameters, stations, platform poses and edge shifts are estimated together from edges,
poses, links, readings and the nominal model, each divided by its standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import PkmcalError, ResultError
from pkmcal.identify.assembly import (
    Assembled,
    assemble,
    assemble_runs,
    batch_of,
    check_measurements,
    state_of,
)
from pkmcal.identify.covariance import (
    Information,
    covariance_by_noise,
    data_share,
    machine_covariance,
    reduced_rows,
)
from pkmcal.identify.edge_noise import EDGE_NOISE, EdgeNoiseOptions, edge_noise
from pkmcal.identify.error_correlation import (
    ERROR_CORRELATION,
    ErrorCorrelationOptions,
    covariance_of_correlated,
)
from pkmcal.identify.estimate import Estimate, Statistics
from pkmcal.identify.external_reliability import covariance_of_undetected
from pkmcal.identify.gauge import Gauge, default_gauge, in_gauge
from pkmcal.identify.innovation_test import innovations
from pkmcal.identify.line_shading import LINE_SHADING, LineShadingOptions, common_shading
from pkmcal.identify.noise import (
    LEAST_NOISE_FREEDOM,
    NOISE,
    Components,
    NoiseOptions,
    NoiseShares,
    components,
    counts,
    noise_shares,
)
from pkmcal.identify.problem import Problem
from pkmcal.identify.robust import (
    LEAST_SCALE,
    ROBUST,
    RobustOptions,
    norms,
    robust_start,
    settled_weights,
)
from pkmcal.identify.row_sums import (
    EDGE_ROWS,
    LINK_ROWS,
    POSE_ROWS,
    READING_ROWS,
)
from pkmcal.identify.scatter import EdgeScatter
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import BatchState, batch_of_runs
from pkmcal.measurements import SHADING_SIGMA, Measurements
from pkmcal.measurements.effects import SHADING, SHIFT_SIGMA
from pkmcal.measurements.rows import RowGroups
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import rank_of_normal
from pkmcal.solver.search import (
    SEARCH,
    STEP_TOLERANCE,
    SearchOptions,
    Solution,
    Stop,
    minimise,
    take,
)


@dataclass(frozen=True)
class BatchOptions:
    """Constants of the alternation of weights, noise and solution."""

    # tolerance of a round's solution: distance from the optimum in standard deviations of all
    # unknowns together, usually reached in two steps. It is small beside the effect of the next
    # round's weights; the last round is solved to STEP_TOLERANCE
    nearly_solved: float = 1e-3
    # largest number of rounds
    most_rounds: int = 30
    # over-relaxation factor of the noise of shading and edges, whose fixed-point steps are too
    # short, and the first round that uses it
    scatter_pace: float = 1.6
    first_paced_round: int = 2
    # upper bound of the over-relaxation factor of the readings' noise, which follows from the ratio
    # of two consecutive steps
    furthest_noise_pace: float = 3.0
    # rounds in which the degrees of freedom of the edges' noise may change; they are discrete, and
    # two equally likely values could alternate for ever
    free_rounds: int = 6
    # relative change of a noise scale below which it has converged
    scale_change: float = 1e-3
    # lower bound of the lines' shading, relative to its usual standard deviation
    least_shading_share: float = 0.1
    # change of the standard deviations of shading and edges below which they have converged,
    # relative to the larger of the previous and the usual value
    shading_change: float = 0.02
    robust: RobustOptions = ROBUST
    edge_noise: EdgeNoiseOptions = EDGE_NOISE
    line_shading: LineShadingOptions = LINE_SHADING
    noise: NoiseOptions = NOISE
    search: SearchOptions = SEARCH
    error_correlation: ErrorCorrelationOptions = ERROR_CORRELATION

    @property
    def uncut_noise_log_step(self) -> float:
        """Logarithmic step of the readings' noise below which ``noise.largest_step`` did not limit
        it.
        """
        return 0.99 * float(np.log(self.noise.largest_step))


BATCH = BatchOptions()


@dataclass(frozen=True)
class BatchResult:
    """Joint estimate of B runs, with the estimated weights and noise.

    solution : states, costs and stopping reasons; ``steps`` counts the steps of all rounds.
    weight : (B, K, G) robust weights 0..1 of each kind of measurement.
    scale : (B,) factors on the stated noise of each kind; for edges the factor of the annealing,
        and 1 once their noise is estimated.
    info : linearized problem at the solution, with these weights and this noise.
    edges : noise of the edges, as stated where it was not estimated.
    irls_weight : (B, K, G) IRLS weight of each edge by that noise.
    stated : (B or 1,) stated standard deviation of the readings.
    """

    solution: Solution
    weight: RowGroups[Array]
    scale: RowGroups[Array]
    info: Information
    edges: EdgeScatter
    irls_weight: Array
    stated: Array
    options: BatchOptions

    @cached_property
    def components(self) -> Components:
        """Sum of squares of each kind of rows, and its expected value."""
        return components(self.info, self.weight)

    @cached_property
    def reading_noise(self) -> NoiseShares:
        """Likelihood of factors on the readings' noise."""
        return self.noise_of(READING_ROWS)

    def noise_of(self, kind: int) -> NoiseShares:
        """Independent residuals of a kind of rows, for the restricted likelihood of its noise."""
        return noise_shares(self.info, kind, self.options.noise)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (B, na, na) of the shared unknowns, with correlated edge errors and undetected
        outliers.
        """
        unnoticed = covariance_of_undetected(self.info, self.weight.edges)
        return covariance_of_correlated(self.info, self.options.error_correlation) + unnoticed

    @property
    def noise_scale(self) -> Array:
        """Scatter of the edges in use relative to their stated noise, (B,)."""
        problem = self.info.problem
        return self.edges.factor(problem.blocks, problem.data, self.weight.edges)

    @property
    def reading_scale(self) -> Array:
        """Factor on the readings' stated noise, (B,)."""
        used = self.info.problem.joint_noise
        return np.broadcast_to(used / self.stated, len(self.scale.poses))


def solve_batch(
    problem: Problem,
    start: BatchState,
    *,
    robust: bool = True,
    scale_noise: bool = True,
    scale_readings: bool = True,
    hopeless: float = np.inf,
    options: BatchOptions = BATCH,
) -> BatchResult:
    """Solve all runs of a problem from their starts; see :func:`bundle` for the options.

    scale_readings : with ``scale_noise``, estimate the readings' noise too. False where the machine
        is held, because the noise would absorb its changes.
    hopeless : return all runs as they are if the poses' noise after a search exceeds the stated
        noise by more than this factor.
    """
    n_runs = start.z.shape[0]
    ones = RowGroups(*(np.ones(n_runs) for _ in problem.row_groups))
    every = RowGroups(*(kind.ones(n_runs) for kind in problem.row_groups))
    # The shading starts with the prior of a whole camera's shift: a narrow prior would make
    # outliers of edges that contradict it.
    n_lines = problem.shading.shape[1]
    least = options.least_shading_share * problem.shading[:, :1]
    if scale_noise and n_lines:
        problem = problem.shaded(np.full((n_runs, n_lines), SHIFT_SIGMA))
    # robust start: annealing, and least squares where it is cheaper
    state, weight, scale, steps = start, every, ones, np.zeros(n_runs, dtype=int)
    if robust:
        value = robust_start(problem, start, scaled=scale_noise, options=options.robust)
        state, weight, steps = value.state, value.weight, steps + value.steps
        scale = value.scale if scale_noise else ones
    # first solution, with the stated noise of the edges; then weights, noise and solution in turns
    begin = EdgeScatter.stated(n_runs, max(map(len, problem.layout.radius), default=0))
    irls_weight, stated = np.ones_like(every.edges), problem.joint_noise
    solved = partial(_solved, options=options)
    fit = solved(problem, state, weight, scale, steps, begin, irls_weight, stated, STEP_TOLERANCE)
    if robust or scale_noise:
        settle = partial(
            _settle, robust=robust, scale_noise=scale_noise, least=least, options=options
        )
        fit = settle(fit, hopeless=hopeless, by_data=np.zeros(n_runs, dtype=bool))
        if scale_noise and scale_readings and fit.scale.poses.min() <= hopeless:
            # The readings' noise is estimated where the data contradict the stated one, or where
            # nothing else was measured, so that it is only the unit of all standard deviations.
            noise = fit.reading_noise
            alone = not any(kind.present.any() for kind in fit.info.problem.row_groups)
            by_data = noise.contradicts() | (
                alone & (noise.freedom(noise.best) > LEAST_NOISE_FREEDOM)
            )
            if by_data.any():
                fit = settle(fit, hopeless=hopeless, by_data=by_data)
    return fit


def _settle(
    fit: BatchResult,
    by_data: Booleans,
    *,
    robust: bool,
    scale_noise: bool,
    least: Array,
    hopeless: float,
    options: BatchOptions,
) -> BatchResult:
    """Alternate weights, noise and solution until they have converged.

    by_data : (B,) runs whose readings' noise is estimated instead of stated.
    least : lower bound of the lines' shading, px.
    """
    by_tube = scale_noise and robust and bool(fit.info.problem.blocks.n_effective.any())
    previous_factor = made = np.zeros(len(by_data))  # of the readings' noise, in the last round
    nearly = False
    for number in range(options.most_rounds):
        noise = _Noise.of(fit)
        if scale_noise:
            # noise of poses and links, of the readings, and of edges and lines, by the residuals
            noise = noise.with_scales(fit)
            if noise.scale.poses.min() > hopeless:
                return replace(fit, scale=noise.scale)
            previous_factor, made = _readings_step(fit, by_data, previous_factor, made, options)
            noise = noise.with_edges(fit, by_tube, number, least, options)
        if by_data.any():
            noise = noise.with_readings(fit, np.where(by_data, np.exp(made), 1.0))
        # weights by that noise
        weight, irls_weight = fit.weight, fit.irls_weight
        if robust:
            weight, irls_weight = _weights(fit, noise, by_tube)
        # converged, or the next solution
        if noise.close_to(fit, by_tube, options) and _settled(
            noise.scale, fit.scale, weight, fit.weight, options.scale_change
        ):
            break
        fit = _solved(
            *noise.applied(fit.info.state),
            weight,
            noise.scale,
            fit.solution.steps,
            noise.edges,
            irls_weight,
            fit.stated,
            options.nearly_solved,
            options,
        )
        nearly = True
    if not nearly:
        return fit
    # complete the search of the last round
    solution, info = _searched(
        fit.info.problem, fit.info.state, fit.solution.steps, STEP_TOLERANCE, options
    )
    return replace(fit, solution=solution, info=info)


class _Noise(NamedTuple):
    """Noise of the next round, from the residuals of a solution.

    problem : that of the solution, with the new noise of the edges.
    scale : (B,) factors on the stated noise of poses and links.
    shading : (B, lines) px.
    readings : (B,) standard deviations of the readings.
    """

    problem: Problem
    scale: RowGroups[Array]
    edges: EdgeScatter
    shading: Array
    readings: Array

    @classmethod
    def of(cls, fit: BatchResult) -> _Noise:
        """Noise with which a solution was computed."""
        problem = fit.info.problem
        return cls(problem, fit.scale, fit.edges, problem.shading, problem.joint_noise)

    def with_scales(self, fit: BatchResult) -> _Noise:
        """Update the scales of all groups but the edges from their residuals."""
        scales = (_scale_of(fit, kind) for kind in range(POSE_ROWS, READING_ROWS))
        return self._replace(scale=RowGroups(np.ones_like(fit.scale.edges), *scales))

    def with_edges(
        self, fit: BatchResult, by_tube: bool, number: int, least: Array, options: BatchOptions
    ) -> _Noise:
        """Update the noise and the shading of the edges from their residuals.

        The shading is over-relaxed from round ``first_paced_round`` on.
        """
        edges = _edges(fit, by_tube, number, options)
        problem = replace(self.problem, data=edges.applied(self.problem.blocks, self.problem.data))
        shading = problem.shading
        if shading.size:
            shading = _shading_of(fit, least, options.line_shading)
        if number >= options.first_paced_round:
            pace = (shading / problem.shading) ** options.scatter_pace
            shading = np.maximum(problem.shading * pace, least)
        return self._replace(problem=problem, edges=edges, shading=shading)

    def with_readings(self, fit: BatchResult, factor: Array) -> _Noise:
        """Multiply the readings' noise by a factor (B,)."""
        return self._replace(readings=self.problem.joint_noise_times(factor, fit.info.state))

    def close_to(self, fit: BatchResult, by_tube: bool, options: BatchOptions) -> bool:
        """Whether the noise of edges, lines and readings has converged to that of a solution."""
        before = fit.info.problem
        change = (self.shading - before.shading) / np.maximum(before.shading, SHADING_SIGMA)
        most = options.shading_change if by_tube else options.scale_change
        return (
            np.abs(change).max(initial=0.0) < options.shading_change
            and np.abs(self.readings / before.joint_noise - 1).max() < options.scale_change
            and self.edges.close_to(fit.edges, most)
        )

    def applied(self, state: BatchState) -> tuple[Problem, BatchState]:
        """Problem with this noise, and the state with its shading in the new units."""
        problem = self.problem
        if not np.array_equal(self.shading, problem.shading):
            state = problem.with_shading_units(state, self.shading)
            problem = problem.shaded(self.shading)
        return replace(problem, joint_noise=self.readings), state


def _weights(fit: BatchResult, noise: _Noise, by_tube: bool) -> tuple[RowGroups[Array], Array]:
    """Robust weights from a solution's residuals and the noise, and the IRLS weights of the
    edges.
    """
    problem, irls_weight = noise.problem, fit.irls_weight
    rows = problem.unweighted(fit.info.state)
    distance = norms(problem, rows)
    poses = innovations(fit.info, distance.poses, fit.weight.poses, noise.scale.poses)
    weight = settled_weights(distance._replace(poses=poses), noise.scale)
    if by_tube:
        irls_weight = noise.edges.irls_weight(problem.blocks, np.sum(rows.edges**2, axis=-1))
    return weight, irls_weight


def _readings_step(
    fit: BatchResult, by_data: Booleans, before: Array, made: Array, options: BatchOptions
) -> tuple[Array, Array]:
    """Logarithmic steps (B,) of the readings' noise: the step that the residuals require, and the
    step to take.

    The step to take is extrapolated by the secant through this required step and the previous one
    (``before``, after the step ``made``), to the point where no further step is required. Both are
    unchanged where no run's readings' noise is estimated.
    """
    if not by_data.any():
        return before, made
    log_factor = np.log(fit.reading_noise.factor())
    # a step that was limited does not show the whole remaining change, so it gives no secant
    shrinks = (
        (log_factor * before > 0)
        & (np.abs(log_factor) < np.abs(before))
        & (np.abs(before) < options.uncut_noise_log_step)
    )
    pace = np.where(shrinks, made / np.where(shrinks, before - log_factor, 1.0), 1.0)
    return log_factor, log_factor * np.clip(pace, 1.0, options.furthest_noise_pace)


def _settled(
    scale: RowGroups[Array],
    old_scale: RowGroups[Array],
    weight: RowGroups[Array],
    old_weight: RowGroups[Array],
    most: float,
) -> bool:
    """Whether scales changed by less than ``most``, relative, and weights by less than 10
    ``most``.
    """
    change = [np.abs(new / old - 1).max() for new, old in zip(scale, old_scale, strict=True)]
    change += [
        0.1 * np.abs(new - old).max(initial=0.0)
        for new, old in zip(weight, old_weight, strict=True)
    ]
    return max(change) < most


def _solved(
    problem: Problem,
    state: BatchState,
    weight: RowGroups[Array],
    scale: RowGroups[Array],
    steps: Integers,
    edges: EdgeScatter,
    irls_weight: Array,
    stated: Array,
    tolerance: float,
    options: BatchOptions,
) -> BatchResult:
    """Solution with given weights up to a tolerance, started from a state that took ``steps``
    (B,).
    """
    parts = zip(weight._replace(edges=weight.edges * irls_weight), scale, strict=True)
    used = problem.weighted(RowGroups(*(own / each[:, None, None] ** 2 for own, each in parts)))
    solution, info = _searched(used, state, steps, tolerance, options)
    return BatchResult(solution, weight, scale, info, edges, irls_weight, stated, options)


def _searched(
    problem: Problem, state: BatchState, steps: Integers, tolerance: float, options: BatchOptions
) -> tuple[Solution, Information]:
    """Minimum up to a tolerance, started from a state that took ``steps`` (B,), and its
    linearization.
    """
    solution = minimise(
        problem.as_noisy_as_at(state), state, tolerance=tolerance, options=options.search
    )
    solution = replace(solution, steps=steps + solution.steps)
    return solution, Information(problem, solution.state, solution.normal)


def _edges(fit: BatchResult, by_tube: bool, number: int, options: BatchOptions) -> EdgeScatter:
    """Noise of the edges: for each tube if light shifts edges, otherwise one factor for all.

    The single factor makes the edges' chi2 equal its degrees of freedom, with normal errors. That
    is also the optimum of the likelihood, except that rejected edges count as stated. Heavy tails
    are not used there: they would absorb the effect of wrong readings on some edges.

    number : of the round.
    """
    if by_tube:
        late = number >= options.free_rounds
        edges = edge_noise(
            fit.info,
            fit.weight.edges,
            fit.edges,
            same_tails=late,
            options=options.edge_noise,
        )
        return (
            edges.beyond(fit.edges, options.scatter_pace)
            if number >= options.first_paced_round
            else edges
        )
    scale, components = fit.scale.edges[:, None] * fit.edges.scale, fit.components
    chi2, freedom = (
        components.chi2[:, EDGE_ROWS, None],
        components.freedom[:, EDGE_ROWS, None],
    )
    ratio = np.sqrt(chi2 / np.maximum(freedom, 1.0))
    scale = np.where(freedom > LEAST_NOISE_FREEDOM, np.maximum(scale * ratio, LEAST_SCALE), scale)
    return replace(fit.edges, scale=scale)


def _scale_of(fit: BatchResult, kind: int) -> Array:
    """Factor (B,) on the stated noise of a group of rows that makes their chi2 equal its degrees of
    freedom.

    The factor in use is unchanged where too few residuals determine another: their effective number
    is tr M^2 with the noise's share M in their covariance (:mod:`pkmcal.identify.noise`). Four
    cables' readings scatter more than a tracker, whose poses have small shares in many residuals.

    kind : such as POSE_ROWS.
    """
    scale = fit.scale[kind]
    if not fit.info.problem.row_groups[kind].present.any():
        return scale
    components = fit.components
    chi2, freedom = components.chi2[:, kind], components.freedom[:, kind]
    # (tr M)^2 / n is a lower bound, which nearly always suffices
    number = freedom**2 / np.maximum(counts(fit.info.problem, fit.weight)[kind], 1.0)
    if number.min() <= LEAST_NOISE_FREEDOM:
        number = np.sum(fit.noise_of(kind).own ** 2, axis=-1)
    ratio = np.sqrt(chi2 / np.maximum(freedom, 1.0))
    return np.where(number > LEAST_NOISE_FREEDOM, np.maximum(scale * ratio, LEAST_SCALE), scale)


def _shading_of(fit: BatchResult, least: Array, options: LineShadingOptions) -> Array:
    """Standard deviations of the lines' shading by :func:`common_shading`."""
    problem, unit = fit.info.problem, fit.info.problem.shading
    lines = problem.unknowns.of_code(SHADING)
    half = unit[..., None] * fit.info.root[:, lines]
    covariance = half @ half.mT
    prior = problem.prior[:, lines]
    correlation = np.linalg.inv(prior.T @ prior)
    shift = unit * problem.lines_of(fit.info.state)
    return common_shading(shift, covariance, correlation, unit, least, options)


@dataclass(frozen=True)
class MarginalPrior:
    """Information of measurements and nominal model on a machine, as the prior of another estimate.

    free : (n,) mean of the free unknowns.
    root : (n, n) with ``root^T root`` the inverse of their marginal covariance.
    """

    free: Array
    root: Array

    def like(self, before: MarginalPrior) -> bool:
        """Whether the machine differs by less than half of its standard deviations (RMS).

        Such a difference is usual until the information has grown by a quarter.
        """
        change = 2 * self.root @ (self.free - before.free)
        return float(change @ change) < len(change)


def bundle(
    machine: Machine,
    measurements: Measurements,
    start: State,
    *,
    use_prior: bool = True,
    marginal_prior: MarginalPrior | None = None,
    robust: bool = True,
    scale_noise: bool = True,
    scale_readings: bool = True,
    gauge: Gauge | None = None,
    hopeless: float = np.inf,
    options: BatchOptions = BATCH,
) -> Estimate:
    """Joint estimate of one session.

    start : initial value of every unknown, see :func:`pkmcal.identify.start.start_state`.
    use_prior : use the nominal values as measurements with their prior sigmas; radii and edge
        shifts keep their priors in any case.
    marginal_prior : information of other measurements on the machine; replaces the nominal prior,
        whatever ``use_prior``.
    robust : reject edges, poses and links that do not fit.
    scale_noise : estimate factors on the stated noise of edges, poses and links where the residuals
        require it.
    scale_readings : estimate the factor of the readings too, which may be below 1.
    gauge : frames of the result, three centres by default.
    hopeless : factor on the poses' noise above which the search is abandoned, for trial poses.

    Raises ResultError if the search cannot start, is abandoned, or does not converge.
    """
    gauge = gauge or default_gauge(machine)
    assembled, result = _assembled_fit(
        machine,
        measurements,
        start,
        gauge,
        marginal_prior,
        use_prior=use_prior,
        robust=robust,
        scale_noise=scale_noise,
        scale_readings=scale_readings,
        hopeless=hopeless,
        options=options,
    )
    return _estimate(machine, measurements, start, assembled, result, gauge)


class BundleSolution(NamedTuple):
    """Solution of :func:`bundle` with its defaults, from which its estimate follows.

    The covariance of an estimate depends on the variance between imputations, the solution does
    not.
    """

    machine: Machine
    start: State
    assembled: Assembled
    result: BatchResult

    @classmethod
    def of(cls, machine: Machine, measurements: Measurements, start: State) -> BundleSolution:
        """Solution of a session; arguments and errors are those of :func:`bundle`."""
        gauge = default_gauge(machine)
        solved = _assembled_fit(machine, measurements, start, gauge, None)
        return cls(machine, start, *solved)

    def estimate(self, measurements: Measurements) -> Estimate:
        """Estimate by the same measurements, with their variance between imputations."""
        gauge = default_gauge(self.machine)
        return _estimate(self.machine, measurements, self.start, self.assembled, self.result, gauge)


class Fit(NamedTuple):
    """Joint estimate without covariance.

    machine : with the identified values. state : all unknowns, in the default gauge. change : half
    the sum of squares by which the machine and the readings are changed, in their standard
    deviations. edge_scale : factor on the edges' stated noise by their residuals; 1 for too few.
    info : linearized at the state.
    """

    machine: Machine
    state: State
    change: float
    edge_scale: float
    info: Information


def marginalize_to_machine(info: Information) -> MarginalPrior:
    """Marginal prior of the machine from a linearized estimate, for the estimate of other
    measurements.

    The frames keep the nominal model's uncertainty, about their position in the estimate.
    """
    rows, _ = reduced_rows(info, ("machine",), silent=())
    root: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    return MarginalPrior(info.state.z[0], root)


def fit_state(
    machine: Machine,
    measurements: Measurements,
    start: State,
    marginal_prior: MarginalPrior | None = None,
    *,
    scale_readings: bool = False,
) -> Fit:
    """Robust joint estimate without covariance, for trials.

    Arguments and errors are those of :func:`bundle`; the readings' noise is as stated by default.
    """
    gauge = default_gauge(machine)
    assembled, result = _assembled_fit(
        machine, measurements, start, gauge, marginal_prior, scale_readings=scale_readings
    )
    (fit,) = _fits(machine, [start], assembled, result, gauge)
    state = _with_unseen_poses(fit.machine, measurements, assembled, fit.state)
    return fit._replace(state=state)


def fit_states(
    machine: Machine,
    measurements: Sequence[Measurements],
    starts: Sequence[State],
    marginal_prior: MarginalPrior | None = None,
    options: BatchOptions = BATCH,
) -> list[Fit | PkmcalError]:
    """Estimates as by :func:`fit_state` of trials that differ in their edges and starts, as runs of
    one batch; the error of each that has none.

    Poses of configurations without measurements remain those of the start.

    measurements : without boards and trackers, edges of the same configurations.
    """
    gauge, errors = default_gauge(machine), dict[int, PkmcalError]()
    for k, one in enumerate(measurements):
        try:
            check_measurements(machine, one)
        except PkmcalError as error:
            errors[k] = error
    runs = [k for k in range(len(starts)) if k not in errors]
    fits = dict[int, Fit | PkmcalError](errors)
    if runs:
        begin = [starts[k] for k in runs]
        assembled = assemble_runs(machine, [measurements[k] for k in runs], gauge)
        problem, batch = _prepared(machine, assembled, begin, marginal_prior)
        result = solve_batch(problem, batch, scale_readings=False, options=options)
        fits |= zip(runs, _fits(machine, begin, assembled, result, gauge), strict=True)
        for k, stop in zip(runs, result.solution.stop, strict=True):
            if stop in (Stop.NOT_FINITE, Stop.STALLED):
                fits[k] = _failed(stop)
    return [fits[k] for k in range(len(starts))]


def _fits(
    machine: Machine,
    starts: Sequence[State],
    assembled: Assembled,
    result: BatchResult,
    gauge: Gauge,
) -> list[Fit]:
    """Fits of all runs of a result; poses of unobserved configurations are those of the starts."""
    problem, batch = result.info.problem, result.solution.state
    value = result.info.by_kind.value
    drawn = ~np.isin(assembled.priors, ("gauge", "mount"))
    prior = (problem.prior_values(batch) - problem.prior_target)[:, drawn]
    change = np.sum(value[..., problem.closure_rows] ** 2, axis=(1, 2)) + np.sum(prior**2, axis=-1)
    edge_rows = value[..., problem.row_groups.edges.rows]
    chi2 = np.sum(result.edges.squares(problem.blocks, edge_rows), axis=(1, 2))
    freedom = result.components.freedom[:, EDGE_ROWS]
    scale = np.where(
        freedom > LEAST_NOISE_FREEDOM, np.sqrt(chi2 / np.maximum(freedom, LEAST_NOISE_FREEDOM)), 1.0
    )
    fits: list[Fit] = []
    for k, start in enumerate(starts):
        run = np.array([k])
        state = in_gauge(machine, state_of(assembled, take(batch, run), start), gauge)
        state = replace(state, theta=machine.parameters.unit_axes(state.theta))
        identified, own = machine.with_values(state.theta), problem.select(run)
        there = batch_of(identified, replace(assembled, problem=own), state)
        info = Information(own, there)
        fits.append(Fit(identified, state, float(change[k]) / 2, float(scale[k]), info))
    return fits


def _assembled_fit(
    machine: Machine,
    measurements: Measurements,
    start: State,
    gauge: Gauge,
    marginal_prior: MarginalPrior | None,
    *,
    use_prior: bool = True,
    hopeless: float = np.inf,
    **options: Any,
) -> tuple[Assembled, BatchResult]:
    """The problem and its solution; ``options`` are those of :func:`solve_batch`.

    Raises ResultError as :func:`bundle`.
    """
    assembled = assemble(
        machine, measurements, gauge, use_prior=use_prior or marginal_prior is not None
    )
    problem, batch = _prepared(machine, assembled, [start], marginal_prior)
    result = solve_batch(problem, batch, hopeless=hopeless, **options)
    # a failed search is an error, not a result
    if result.scale.poses[0] > hopeless:
        raise ResultError(
            what="the measured poses do not fit the machine",
            found=f"{result.scale.poses[0]:.0f} times their noise after a first search",
        )
    stop = result.solution.stop[0]
    if stop in (Stop.NOT_FINITE, Stop.STALLED):
        raise _failed(stop)
    return assembled, result


def _failed(stop: Stop) -> ResultError:
    """Error of a search that did not converge."""
    return ResultError(what=f"the joint estimate failed: {stop.value}")


def _prepared(
    machine: Machine,
    assembled: Assembled,
    starts: Sequence[State],
    marginal_prior: MarginalPrior | None,
) -> tuple[Problem, BatchState]:
    """Problem with the priors of mounts and of the machine, and the starts of its runs."""
    batch = batch_of_runs([batch_of(machine, assembled, start) for start in starts])
    problem = assembled.problem
    # the prior of mounts is centred at their start
    mounts, there = np.array(assembled.priors) == "mount", problem.prior_values(batch)[0]
    problem = replace(problem, prior_target=np.where(mounts, there, problem.prior_target))
    # the marginal prior replaces the nominal rows
    if marginal_prior is not None:
        drawn, u = np.array(assembled.priors) == "nominal", problem.unknowns
        prior, target = problem.prior.copy(), problem.prior_target.copy()
        prior[drawn, u.machine], target[drawn] = (
            marginal_prior.root,
            marginal_prior.root @ marginal_prior.free,
        )
        problem = replace(problem, prior=prior, prior_target=target)
    return problem, batch


def _estimate(
    machine: Machine,
    measurements: Measurements,
    start: State,
    assembled: Assembled,
    result: BatchResult,
    gauge: Gauge,
) -> Estimate:
    """Estimate in the gauge, with all quantities of the report."""
    solution, problem = result.solution.state, result.info.problem
    shared, u = result.covariance[0], problem.unknowns
    if measurements.imputation_covariance:
        shared = shared + measurements.imputation_covariance * covariance_by_noise(result.info)[0]
    # state and covariance in the gauge
    solved = state_of(assembled, solution, start)
    full = machine_covariance(problem, machine, solved, shared, gauge)
    state = in_gauge(machine, solved, gauge)
    state = replace(state, theta=machine.parameters.unit_axes(state.theta))
    # effects and lines
    identified = machine.with_values(state.theta)
    parts = {code: u.of_code(code) for code, _ in u.codes}
    covariance = {code: shared[part, part] for code, part in parts.items()}
    line_sigma = np.sqrt(np.diagonal(shared)[u.of_code(SHADING)])
    # residuals and weights by measurement
    edges, poses, links = problem.unweighted(solution)
    residuals = RowGroups(
        assembled.places.edges.taken(edges[0]),
        assembled.places.poses.taken(poses[0] / result.scale.poses[0]),
        assembled.places.links.taken(links[0] / result.scale.links[0]),
    )
    weighted = zip(assembled.places, result.weight, strict=True)
    weights = RowGroups(*(at.taken(weight[0]) for at, weight in weighted))
    value = result.info.by_kind.value
    closures = value[..., problem.closure_rows]
    joints = np.zeros(measurements.joints.shape)  # zero where no pose was estimated
    joints[assembled.observed] = problem.joint_rows(closures, solution)[0]
    return Estimate(
        machine=identified,
        state=_with_unseen_poses(identified, measurements, assembled, state),
        joint_covariance=full,
        column_covariance={c: x for c, x in covariance.items() if c != SHADING},
        edge_residuals=residuals.edges,
        edge_weights=weights.edges,
        edge_noise=result.edges.of_run(0),
        edge_trust=assembled.places.edges.taken(result.irls_weight[0]),
        joint_residuals=joints,
        data_share=data_share(machine, state.theta, full, gauge),
        configurations=assembled.observed,
        statistics=_statistics(result, assembled, value, measurements.imputation_covariance),
        gauge=gauge.name,
        problem=assembled,
        pose_residuals=residuals.poses,
        pose_weights=weights.poses,
        link_residuals=residuals.links[:, 0],
        link_weights=weights.links,
        line_shading=problem.shading[0],
        line_shift=(problem.shading * problem.lines_of(solution))[0],
        line_shift_sigma=problem.shading[0] * line_sigma,
    )


def _with_unseen_poses(
    machine: Machine, measurements: Measurements, assembled: Assembled, state: State
) -> State:
    """State with the poses of configurations without measurements, by forward kinematics of the
    readings.
    """
    unseen = ~assembled.observed
    if not unseen.any():
        return state
    poses, internal = state.T_base_platform.copy(), state.internal.copy()
    fk = machine.forward_result(measurements.joints[unseen], poses[unseen])
    poses[unseen], internal[unseen] = fk.T_base_platform, fk.internal
    return replace(state, T_base_platform=poses, internal=internal)


def _statistics(
    result: BatchResult, assembled: Assembled, value: Array, imputation_covariance: float
) -> Statistics:
    """Statistics of the fit from the residuals (1, K, r)."""
    problem, state = result.info.problem, result.info.state
    kinds = np.array(assembled.priors)
    rows = [kind.rows for kind in problem.row_groups]
    rows.insert(1, problem.closure_rows)
    # sums of squares by kind
    chi2 = [float(np.sum(value[0, :, part] ** 2)) for part in rows]
    chi2[0] = float(np.sum(result.edges.squares(problem.blocks, value[..., rows[0]])))
    drawn = ~np.isin(kinds, ("gauge", "mount"))
    prior = problem.prior_values(state)[0] - problem.prior_target
    chi2_drawing = float(np.sum(prior[drawn] ** 2))
    # numbers of data, and the rank of the unknowns
    n_edges, n_poses, n_links = (float(number[0]) for number in counts(problem, result.weight))
    n_joints = value[0, :, rows[1]].size
    n_drawing = int(np.sum(drawn))
    # Prior rows of mounts and gauge are not data, so neither they nor unknowns that only they
    # determine count among the degrees of freedom.
    prior_rows = problem.prior[~np.isin(kinds, ("gauge", "mount"))]
    normal = result.info.by_kind.every[0] + prior_rows.T @ prior_rows
    own = value.shape[1] * problem.layout.own_motion.shape[1] - problem.unknowns.n_linked
    unknowns = rank_of_normal(normal) + own
    components = result.components
    freedom = components.freedom[0].tolist()
    of_poses, of_links = result.noise_of(POSE_ROWS), result.noise_of(LINK_ROWS)
    return Statistics(
        chi2=sum(chi2) + chi2_drawing,
        dof=n_edges + n_joints + n_poses + n_links + n_drawing - unknowns,
        chi2_edges=chi2[0],
        n_edges=n_edges,
        chi2_joints=chi2[1],
        n_joints=n_joints,
        chi2_drawing=chi2_drawing,
        n_drawing=n_drawing,
        steps=int(result.solution.steps[0]),
        stopped=result.solution.stop[0].value,
        noise_scale=float(result.noise_scale[0]),
        chi2_poses=chi2[2],
        n_poses=n_poses,
        pose_scale=float(result.scale.poses[0]),
        dof_edges=freedom[EDGE_ROWS],
        dof_joints=freedom[READING_ROWS],
        dof_poses=freedom[POSE_ROWS],
        reading_scale=float(result.reading_scale[0]),
        reading_range=_range(result.reading_noise, result.reading_scale),
        pose_range=_range(of_poses, result.scale.poses),
        pose_chance=float(of_poses.stated_chance(result.scale.poses)[0]),
        chi2_links=chi2[3],
        n_links=n_links,
        link_scale=float(result.scale.links[0]),
        dof_links=freedom[LINK_ROWS],
        link_range=_range(of_links, result.scale.links),
        link_chance=float(of_links.stated_chance(result.scale.links)[0]),
        shading=float(np.median(problem.shading[0])) if problem.shading.size else SHADING_SIGMA,
        look_scatter=float(np.sqrt(imputation_covariance)),
    )


def _range(shares: NoiseShares, scale: Array) -> tuple[float, float | None]:
    """Confidence interval of the factor on a stated noise; None for no upper bound.

    scale : (1,) factor in use.
    """
    low, high = (float((scale * end)[0]) for end in shares.interval())
    return low, high if np.isfinite(high) else None
