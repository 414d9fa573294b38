"""Robust start of an estimate: IRLS weights that reject wrong edges, poses and links.

A wrong edge (another leg's, a shadow's) is wrong as a whole, so an edge has one weight by the
Mahalanobis norm d of its two residuals. A board's pose has one weight by its six residuals, and any
other measurement by all of its residuals. The search begins at a scale so wide that all
measurements have weight and narrows it from stage to stage (graduated non-convexity, Geman-McClure
weights); it ends with weights that are 1 for all inliers.

At the first scales most measurements may fit by chance, and the effect of one wrong parameter may
look like outliers. So where the annealing rejects measurements, least squares of all of them is a
second start, and the solution with the larger posterior density is used (:func:`robust_cost`): a
change of a parameter within its prior is likelier than many wrong measurements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements.rows import RowGroup, RowGroups
from pkmcal.solver.kernels import (
    FULL_WEIGHT_DISTANCE,
    INLIER_WEIGHT,
    final_loss,
    final_weights,
    geman_mcclure_weights,
)
from pkmcal.solver.search import minimise, put, take

CLEAN_TAIL_SHARE = float(np.exp(-(FULL_WEIGHT_DISTANCE**2) / 2))
"""Share of inliers with two residuals beyond FULL_WEIGHT_DISTANCE, where weights begin to fall."""
LEAST_SCALE = 1.0
"""Lower bound of the noise scale of poses, and of edges without shading. An error that several
measurements share (a lens) is partly absorbed by the parameters, so residuals are smaller than
errors: a smaller scale would promise too much."""


@dataclass(frozen=True)
class RobustOptions:
    """Constants of the search for a robust start.

    The width of the final weights is that of their kernel, which edges of a plot and rejections
    share: ``FULL_WEIGHT_DISTANCE`` and ``NO_WEIGHT_DISTANCE`` of :mod:`pkmcal.solver.kernels`.
    """

    # solver steps of a stage of the annealing where there are poses. Readings may be a hundred
    # times sharper than poses; the first steps are then short, and after a single refused step the
    # scales would seem to have converged
    pose_steps: int = 10
    # largest number of stages of the annealing
    most_stages: int = 30
    # factor of the first scale on the last one, and the largest by which a stage divides the scale
    stage_factor: float = 4.0
    # ratio of a stage's scale to the previous one above which the annealing has converged
    settled_stage: float = 0.8
    # Geman-McClure scale in units of the residuals' robust scale: an inlier at two of these keeps
    # two thirds of its weight
    geman_mcclure_scale: float = FULL_WEIGHT_DISTANCE
    # a kind's noise scale is searched over LEAST_SCALE times powers of two up to this exponent
    largest_power: int = 12
    # fixed-point steps to a kind's noise scale after that
    scale_steps: int = 5
    # largest number of rounds of weights and solution from the start by least squares
    most_reweightings: int = 8
    # change of the robust cost, in squared standard deviations, below which weights have converged
    loss_change: float = 1e-2
    # step tolerance of such a round: remaining change of all fitted values together, in standard
    # deviations
    roughly_solved: float = 1e-2


ROBUST = RobustOptions()


class RobustStart(NamedTuple):
    """Start of a robust search.

    weight : (B, K, G) of each kind.
    scale : (B,) noise scale of each kind.
    steps : solver steps so far.
    """

    state: BatchState
    weight: RowGroups[Array]
    scale: RowGroups[Array]
    steps: int


def clean_norm(share: float, count: Integers) -> Array:
    """Norm that a share of inliers exceeds; count : number of residuals of each measurement."""
    pair = np.sqrt(-2 * np.log(share))  # the closed form of two residuals: most are edges
    out = np.full(count.shape, pair)
    others = [int(number) for number in np.unique(count) if number != 2]
    if others:  # few numbers, though of very many measurements
        from scipy.special import chdtri

        for number in others:
            out[count == number] = np.sqrt(chdtri(max(number, 1), share))
    return out


def as_pairs(kind: RowGroup) -> Array:
    """Factors (K, G) that convert a kind's norms to those of pairs of residuals, so that the same
    share of inliers lies beyond FULL_WEIGHT_DISTANCE.
    """
    return FULL_WEIGHT_DISTANCE / clean_norm(CLEAN_TAIL_SHARE, kind.count)


def norms(problem: Problem, rows: RowGroups[Array]) -> RowGroups[Array]:
    """Mahalanobis norms (B, K, G) of each kind, converted to those of pairs (:func:`as_pairs`); NaN
    where nothing was measured.

    rows : unweighted residuals (:meth:`Problem.unweighted`).
    """
    parts = zip(problem.row_groups, rows, strict=True)
    return RowGroups(
        *(
            np.where(kind.measured, np.sqrt(np.sum(own**2, axis=-1)) * as_pairs(kind), np.nan)
            for kind, own in parts
        )
    )


def robust_scale(d: Array, usual: Array) -> Array:
    """Noise relative to the stated one (B,), by the median of the norms.

    d : (B, K, G) norms.
    usual : (K, G) median norms of inliers.
    """
    flat = np.sort((d / usual).reshape(d.shape[0], -1), axis=1)  # NaN last
    count = np.sum(np.isfinite(flat), axis=1)
    if not count.all():  # nothing of this kind
        return np.ones(len(flat))
    return flat[np.arange(len(flat)), count // 2]


def noise_scales(problem: Problem, d: RowGroups[Array], least: float) -> RowGroups[Array]:
    """Noise scale of each kind (B,), at least ``least``."""
    parts = zip(problem.row_groups, d, strict=True)
    values = (robust_scale(part, clean_norm(0.5, k.count) * as_pairs(k)) for k, part in parts)
    return RowGroups(*(np.maximum(scale, least) for scale in values))


def settled_weights(distance: RowGroups[Array], scale: RowGroups[Array]) -> RowGroups[Array]:
    """Final weights of each kind by its :func:`norms`."""
    parts = zip(distance, scale, strict=True)
    return RowGroups(*(final_weights(part / each[:, None, None]) for part, each in parts))


def robust_cost(
    problem: Problem, state: BatchState, *, scaled: bool = True, options: RobustOptions = ROBUST
) -> tuple[Array, RowGroups[Array], RowGroups[Array]]:
    """-2 log of the posterior density (B,) at a state, up to a constant.

    Returns also each kind's weights (B, K, G) and most likely noise scale (B,), which is 1 unless
    ``scaled``. A measurement of k numbers with the norm d costs ``loss(d / s) + 2 w k log(s)`` at
    the noise scale s, with its weight w. The cost of a rejected measurement does not depend on s,
    and the logarithm is part of the cost, so no solution gains by a larger or smaller noise.
    """
    values = problem.residuals(state)
    closures = np.nan_to_num(values.value[..., problem.closure_rows])
    cost = np.sum(closures**2, axis=(1, 2)) + np.sum(values.shared_value**2, axis=-1)
    weights, scales = list[Array](), list[Array]()
    distances = norms(problem, problem.unweighted(state))
    for kind, distance in zip(problem.row_groups, distances, strict=True):
        there = kind.present
        d, n_runs = distance[:, there], len(cost)
        own, scale = np.zeros(n_runs), np.ones(n_runs)
        if there.any():
            unit = as_pairs(kind)[there]
            own, scale = _kind_cost(d, kind.count[there], unit, options, scaled=scaled)
        weight = np.zeros(distance.shape)
        weight[:, there] = final_weights(d / scale[:, None])
        cost = cost + own
        weights.append(weight)
        scales.append(scale)
    return cost, RowGroups(*weights), RowGroups(*scales)


def _kind_cost(
    d: Array, count: Integers, unit: Array, options: RobustOptions, *, scaled: bool
) -> tuple[Array, Array]:
    """Smallest cost (B,) of one kind's norms over the noise scale, and that scale (B,).

    d : (B, n) norms, as those of pairs.
    count, unit : (n,) residuals of each measurement, and its factor :func:`as_pairs`.
    """
    squares = np.nan_to_num(d / unit) ** 2

    def cost_at(scale: Array) -> tuple[Array, Array]:
        """Cost at a scale (B,), and the scale at which the weighted squares equal their
        expectation.
        """
        weight = final_weights(d / scale[:, None])
        numbers = weight @ count
        expected = np.sum(weight * squares, axis=1) / np.maximum(numbers, 1.0)
        loss = np.sum(final_loss(d / scale[:, None]) / unit**2, axis=1)
        return loss + 2 * numbers * np.log(scale), np.maximum(np.sqrt(expected), LEAST_SCALE)

    best, at = np.full(len(d), np.inf), np.full(len(d), LEAST_SCALE)
    next_scale, powers = at, options.largest_power + 1
    for number in range(powers + options.scale_steps if scaled else 1):
        step = number >= powers
        scale = next_scale if step else np.full(len(d), LEAST_SCALE * 2.0**number)
        value, expected = cost_at(scale)
        better = value < best
        best, at = np.where(better, value, best), np.where(better, scale, at)
        next_scale = expected if step else np.where(better, expected, next_scale)
    return best, at


def robust_start(
    problem: Problem, start: BatchState, *, scaled: bool = True, options: RobustOptions = ROBUST
) -> RobustStart:
    """Start near the solution, also where measurements are wrong or parameters far from nominal.

    The end of the annealing; where that rejects measurements and least squares of all measurements
    leads to a smaller robust cost, the end of the latter.

    scaled : whether noise may be larger than stated.
    """
    annealed = anneal(problem, start, options)
    # runs in which the annealing rejects measurements
    rejects = [
        np.any(kind.measured & (weight < INLIER_WEIGHT), axis=(1, 2))
        for kind, weight in zip(problem.row_groups, annealed.weight, strict=True)
    ]
    runs = np.flatnonzero(np.any(rejects, axis=0))
    if not runs.size:
        return annealed  # both starts lead to the same solution
    part, state = problem.select(runs), take(annealed.state, runs)
    usual, _, _ = robust_cost(part, state, scaled=scaled, options=options)
    # second start: all measurements at full weight
    every = RowGroups(*(kind.ones(len(runs)) for kind in part.row_groups))
    other = RobustStart(state, every, RowGroups(*(np.ones(len(runs)) for _ in every)), 0)
    poses, before = bool(problem.row_groups.poses.present.any()), np.full(len(runs), np.inf)
    for _ in range(options.most_reweightings):
        parts = zip(other.weight, other.scale, strict=True)
        weight = RowGroups(*(own / each[:, None, None] ** 2 for own, each in parts))
        searched = part.weighted(weight).as_noisy_as_at(other.state)
        solution = minimise(searched, other.state, tolerance=options.roughly_solved)
        cost, weight, scale = robust_cost(part, solution.state, scaled=scaled, options=options)
        other = RobustStart(solution.state, weight, scale, other.steps + int(solution.steps.max()))
        # A few wrong edges among thousands always bias least squares, so without poses the
        # iterations continue only if they cost less than the annealing at once.
        if np.all(cost > before - options.loss_change) or not (poses or np.any(cost < usual)):
            break
        before = cost
    # the cheaper solution of each run
    better = np.flatnonzero(cost < usual - options.loss_change)
    runs = runs[better]
    return RobustStart(
        put(annealed.state, runs, take(other.state, better)),
        put(annealed.weight, runs, take(other.weight, better)),
        put(annealed.scale, runs, take(other.scale, better)),
        annealed.steps + other.steps,
    )


def anneal(problem: Problem, start: BatchState, options: RobustOptions = ROBUST) -> RobustStart:
    """Graduated non-convexity from a start: weights at a scale that shrinks from stage to stage."""
    state, steps = start, 0
    most = options.pose_steps if problem.row_groups.poses.present.size else 1
    d = norms(problem, problem.unweighted(state))
    cut = [
        options.stage_factor * options.geman_mcclure_scale * scale
        for scale in noise_scales(problem, d, LEAST_SCALE)
    ]
    for _ in range(options.most_stages):
        # next scale: that of the residuals, but at most ``stage_factor`` smaller
        aim = [
            options.geman_mcclure_scale * scale for scale in noise_scales(problem, d, LEAST_SCALE)
        ]
        new = [
            np.minimum(c, np.maximum(a, c / options.stage_factor))
            for c, a in zip(cut, aim, strict=True)
        ]
        settled = all(np.all(n > options.settled_stage * c) for n, c in zip(new, cut, strict=True))
        cut = new
        weight = RowGroups(
            *(geman_mcclure_weights(p, c[:, None, None]) for p, c in zip(d, cut, strict=True))
        )
        # weights at that scale, then a few solver steps
        searched = problem.weighted(weight).as_noisy_as_at(state)
        solution = minimise(searched, state, max_steps=most)
        state, steps = solution.state, steps + int(solution.steps.max())
        d = norms(problem, problem.unweighted(state))
        if settled:
            break
    scale = noise_scales(problem, d, LEAST_SCALE)
    return RobustStart(state, settled_weights(d, scale), scale, steps)
