"""Edges and poses that belong to something else: weights that let them go.

A wrong edge (another leg's, a shadow's) is wrong as a whole, so the weight belongs to the whole
edge and judges the Mahalanobis norm d of its two residuals; so does that of a board's pose, of its
six, and that of any other kind of measurement, of as many as it has. The search begins with a scale
so wide that everything counts and narrows it while the estimate settles (graduated non-convexity,
Geman-McClure weights); it ends with weights that are 1 for all that is clean.

Where that search begins, most measurements may fit by chance, and what one parameter explains then
looks like outliers. So where it rejects something, least squares of all measurements are a second
start, and the solution with the larger posterior density is kept (:func:`robust_cost`): a change of
a parameter that its prior allows is likelier than many wrong measurements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements.rows import Kinds, RowsOfKind
from pkmcal.solver.kernels import (
    FULL_WEIGHT_DISTANCE,
    final_loss,
    final_weights,
    geman_mcclure_weights,
)
from pkmcal.solver.search import minimise, put, take

CLEAN_TAIL_SHARE = float(np.exp(-(FULL_WEIGHT_DISTANCE**2) / 2))
"""Share of two clean residuals' norms beyond FULL_WEIGHT_DISTANCE, where weights begin to fall."""
POSE_STEPS = 10
"""Steps of a stage where there are poses: against readings a hundred times sharper they allow
short steps only at first, and one that is refused would look as if all had settled."""
MOST_ANNEALING_STAGES = 30
GEMAN_MCCLURE_SCALE = 4.0
"""Geman-McClure scale in units of the residuals' robust scale."""


LEAST_SCALE = 1.0
"""The stated noise of poses, and of edges that nothing shades, is never believed to be too large.
What moves several alike (a lens) is partly taken up by the parameters, so residuals come out
smaller than errors are: scaling down by them would promise too much."""
SCALES_TRIED = 2.0 ** np.arange(13)
"""Factors on a kind's stated noise, from the least on, from which its likeliest one is sought."""
SCALE_STEPS, MOST_REWEIGHTINGS = 5, 8
"""Steps to that factor, and most rounds of weights and solution from a start."""
LOSS_CHANGE = 1e-2
"""Change of the robust cost, in squared standard deviations, below which weights are settled."""
ROUGHLY_SOLVED_DISTANCE = 1e-2
"""Standard deviations, of all fitted values together, that such a round may have left to go."""


class RobustStart(NamedTuple):
    """Where a robust search begins: state, weights (B, K, G), robust scale (B,), solver steps."""

    state: BatchState
    weight: Kinds[Array]
    scale: Kinds[Array]
    steps: int


def clean_norm(share: float, count: Integers) -> Array:
    """The norm beyond which a share of those of ``count`` clean residuals lies."""
    pair = np.sqrt(-2 * np.log(share))  # the closed form of two residuals: most are edges
    out = np.full(count.shape, pair)
    others = [int(number) for number in np.unique(count) if number != 2]
    if others:  # few numbers, though of very many measurements
        from scipy.special import chdtri

        for number in others:
            out[count == number] = np.sqrt(chdtri(max(number, 1), share))
    return out


def as_pairs(kind: RowsOfKind) -> Array:
    """Factors (K, G) on a kind's norms, so that as many clean ones lie beyond FULL_WEIGHT_DISTANCE
    as of pairs.
    """
    return FULL_WEIGHT_DISTANCE / clean_norm(CLEAN_TAIL_SHARE, kind.count)


def norms(problem: Problem, rows: Kinds[Array]) -> Kinds[Array]:
    """Mahalanobis norms (B, K, G) of each kind's residuals (:meth:`Problem.unweighted`), as those
    of pairs (:func:`as_pairs`); NaN for padding.
    """
    parts = zip(problem.kinds, rows, strict=True)
    return Kinds(
        *(
            np.where(kind.present, np.sqrt(np.sum(own**2, axis=-1)) * as_pairs(kind), np.nan)
            for kind, own in parts
        )
    )


def robust_scale(d: Array, usual: Array) -> Array:
    """Factor by which the noise seems to differ from the stated one, from the median, (B,).

    d : (B, K, G) norms. usual : (K, G) the medians of clean ones.
    """
    flat = np.sort((d / usual).reshape(d.shape[0], -1), axis=1)  # NaN last
    count = np.sum(np.isfinite(flat), axis=1)
    if not count.all():  # nothing of this kind
        return np.ones(len(flat))
    return flat[np.arange(len(flat)), count // 2]


def noise_scales(problem: Problem, d: Kinds[Array], least: float) -> Kinds[Array]:
    """Each kind's factor, (B,), not below the least."""
    parts = zip(problem.kinds, d, strict=True)
    values = (robust_scale(part, clean_norm(0.5, k.count) * as_pairs(k)) for k, part in parts)
    return Kinds(*(np.maximum(scale, least) for scale in values))


def settled_weights(distance: Kinds[Array], scale: Kinds[Array]) -> Kinds[Array]:
    """Each kind's weights by its :func:`norms`."""
    parts = zip(distance, scale, strict=True)
    return Kinds(*(final_weights(part / each[:, None, None]) for part, each in parts))


def robust_cost(
    problem: Problem, state: BatchState, *, scaled: bool = True
) -> tuple[Array, Kinds[Array], Kinds[Array]]:
    """-2 log of the posterior density (B,) at a state, constants left out, with each kind's weights
    (B, K, G) and likeliest noise scale (B,); that is 1 unless ``scaled``.

    A measurement of k numbers at a distance d costs ``loss(d / s) + 2 w k log(s)`` in the noise
    scale s, with its weight w. What is rejected costs the same at any scale, and all scales are
    compared with their log, so no solution wins by enlarging or shrinking its noise.
    """
    values = problem.residuals(state)
    closures = np.nan_to_num(values.value[..., problem.closure_rows])
    cost = np.sum(closures**2, axis=(1, 2)) + np.sum(values.shared_value**2, axis=-1)
    weights, scales = list[Array](), list[Array]()
    distances = norms(problem, problem.unweighted(state))
    for kind, distance in zip(problem.kinds, distances, strict=True):
        there = kind.present
        d, n_runs = distance[:, there], len(cost)
        own, scale = np.zeros(n_runs), np.ones(n_runs)
        if there.any():
            own, scale = _kind_cost(d, kind.count[there], as_pairs(kind)[there], scaled=scaled)
        weight = np.zeros(distance.shape)
        weight[:, there] = final_weights(d / scale[:, None])
        cost = cost + own
        weights.append(weight)
        scales.append(scale)
    return cost, Kinds(*weights), Kinds(*scales)


def _kind_cost(d: Array, count: Integers, unit: Array, *, scaled: bool) -> tuple[Array, Array]:
    """The least cost (B,) of one kind's norms d (B, n), as those of pairs, and the scale (B,) that
    has it. count, unit : (n,) numbers of each measurement, and its factor of :func:`as_pairs`.
    """
    squares = np.nan_to_num(d / unit) ** 2

    def cost_at(scale: Array) -> tuple[Array, Array]:
        """The cost at a scale (B,), and the scale at which the weighted squares are as expected."""
        weight = final_weights(d / scale[:, None])
        numbers = weight @ count
        expected = np.sum(weight * squares, axis=1) / np.maximum(numbers, 1.0)
        loss = np.sum(final_loss(d / scale[:, None]) / unit**2, axis=1)
        return loss + 2 * numbers * np.log(scale), np.maximum(np.sqrt(expected), LEAST_SCALE)

    best, at = np.full(len(d), np.inf), np.full(len(d), LEAST_SCALE)
    next_scale = at
    for number in range(len(SCALES_TRIED) + SCALE_STEPS if scaled else 1):
        step = number >= len(SCALES_TRIED)
        scale = next_scale if step else np.full(len(d), LEAST_SCALE * SCALES_TRIED[number])
        value, expected = cost_at(scale)
        better = value < best
        best, at = np.where(better, value, best), np.where(better, scale, at)
        next_scale = expected if step else np.where(better, expected, next_scale)
    return best, at


def robust_start(problem: Problem, start: BatchState, *, scaled: bool = True) -> RobustStart:
    """A start near the solution although measurements are wrong, or parameters far from nominal:
    the end of the annealing; or, where that rejects measurements and least squares of all of them
    lead to a smaller robust cost, the end of these.

    scaled : whether noise may be larger than stated.
    """
    annealed = anneal(problem, start)
    rejects = [
        np.any(kind.present & (weight < 0.5), axis=(1, 2))
        for kind, weight in zip(problem.kinds, annealed.weight, strict=True)
    ]
    runs = np.flatnonzero(np.any(rejects, axis=0))
    if not runs.size:
        return annealed  # both starts lead to the same solution
    part, state = problem.select(runs), take(annealed.state, runs)
    usual, _, _ = robust_cost(part, state, scaled=scaled)
    every = (np.broadcast_to(k.present, (len(runs), *k.present.shape)) for k in problem.kinds)
    one = np.ones(len(runs))
    every = Kinds(*(p.astype(float) for p in every))
    other = RobustStart(state, every, Kinds(one, one, one), 0)
    poses, before = bool(problem.kinds.poses.present.any()), np.full(len(runs), np.inf)
    for _ in range(MOST_REWEIGHTINGS):
        parts = zip(other.weight, other.scale, strict=True)
        weight = Kinds(*(own / each[:, None, None] ** 2 for own, each in parts))
        searched = part.weighted(weight).as_noisy_as_at(other.state)
        solution = minimise(searched, other.state, tolerance=ROUGHLY_SOLVED_DISTANCE)
        cost, weight, scale = robust_cost(part, solution.state, scaled=scaled)
        other = RobustStart(solution.state, weight, scale, other.steps + int(solution.steps.max()))
        # a few wrong ones among thousands of edges always draw least squares aside: where these do
        # not cost less at once, they are not followed
        if np.all(cost > before - LOSS_CHANGE) or not (poses or np.any(cost < usual)):
            break
        before = cost
    better = np.flatnonzero(cost < usual - LOSS_CHANGE)
    runs = runs[better]
    return RobustStart(
        put(annealed.state, runs, take(other.state, better)),
        put(annealed.weight, runs, take(other.weight, better)),
        put(annealed.scale, runs, take(other.scale, better)),
        annealed.steps + other.steps,
    )


def anneal(problem: Problem, start: BatchState) -> RobustStart:
    """Where graduated non-convexity leads from a start."""
    state, steps = start, 0
    most = POSE_STEPS if problem.kinds.poses.present.size else 1
    d = norms(problem, problem.unweighted(state))
    cut = [4 * GEMAN_MCCLURE_SCALE * scale for scale in noise_scales(problem, d, LEAST_SCALE)]
    for _ in range(MOST_ANNEALING_STAGES):
        aim = [GEMAN_MCCLURE_SCALE * scale for scale in noise_scales(problem, d, LEAST_SCALE)]
        new = [np.minimum(c, np.maximum(a, c / 4)) for c, a in zip(cut, aim, strict=True)]
        settled = all(np.all(n > 0.8 * c) for n, c in zip(new, cut, strict=True))
        cut = new
        weight = Kinds(
            *(geman_mcclure_weights(p, c[:, None, None]) for p, c in zip(d, cut, strict=True))
        )
        searched = problem.weighted(weight).as_noisy_as_at(state)
        solution = minimise(searched, state, max_steps=most)
        state, steps = solution.state, steps + int(solution.steps.max())
        d = norms(problem, problem.unweighted(state))
        if settled:
            break
    scale = noise_scales(problem, d, LEAST_SCALE)
    return RobustStart(state, settled_weights(d, scale), scale, steps)
