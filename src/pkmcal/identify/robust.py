"""Edges and poses that belong to something else: weights that let them go.

A wrong edge (another leg's, a shadow's) is wrong as a whole, so the weight belongs to the whole
edge and judges the Mahalanobis norm d of its two residuals; so does that of a board's pose, of its
six, and that of any other kind of measurement, of as many as it has. The search begins with a scale
so wide that everything counts and narrows it while the estimate settles (graduated non-convexity,
Geman-McClure weights); it ends with weights that are 1 for all that is clean.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.problem import Problem
from pkmcal.identify.rows import Kinds, MeasurementKind
from pkmcal.identify.unknowns import BatchState
from pkmcal.solver.search import FULL_WEIGHT_DISTANCE, final_weights, minimise, soft_weights

CLEAN_TAIL_SHARE = float(np.exp(-(FULL_WEIGHT_DISTANCE**2) / 2))
"""Share of two clean residuals' norms beyond FULL_WEIGHT_DISTANCE, where weights begin to fall."""
POSE_STEPS = 10
"""Steps of a stage where there are poses: against readings a hundred times sharper they allow
short steps only at first, and one that is refused would look as if all had settled."""
MOST_ANNEALING_STAGES = 30
GEMAN_MCCLURE_SCALE = 4.0
"""Geman-McClure scale in units of the residuals' robust scale."""


class Anneal(NamedTuple):
    """Where the annealing ended: state, weights (B, K, G), robust scale (B,), solver steps."""

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


def as_pairs(kind: MeasurementKind) -> Array:
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
    found = (robust_scale(part, clean_norm(0.5, k.count) * as_pairs(k)) for k, part in parts)
    return Kinds(*(np.maximum(scale, least) for scale in found))


def settled_weights(distance: Kinds[Array], scale: Kinds[Array]) -> Kinds[Array]:
    """Each kind's weights by its :func:`norms`."""
    parts = zip(distance, scale, strict=True)
    return Kinds(*(final_weights(part / each[:, None, None]) for part, each in parts))


def anneal(problem: Problem, start: BatchState, least_scale: float) -> Anneal:
    """A state near the answer although many edges, or poses, are wrong.

    least_scale : the robust scale is not believed below this (1: stated noise is a floor).
    """
    state, steps = start, 0
    most = POSE_STEPS if problem.kinds.poses.present.size else 1
    d = norms(problem, problem.unweighted(state))
    cut = [4 * GEMAN_MCCLURE_SCALE * scale for scale in noise_scales(problem, d, least_scale)]
    for _ in range(MOST_ANNEALING_STAGES):
        aim = [GEMAN_MCCLURE_SCALE * scale for scale in noise_scales(problem, d, least_scale)]
        new = [np.minimum(c, np.maximum(a, c / 4)) for c, a in zip(cut, aim, strict=True)]
        settled = all(np.all(n > 0.8 * c) for n, c in zip(new, cut, strict=True))
        cut = new
        weight = Kinds(*(soft_weights(p, c[:, None, None]) for p, c in zip(d, cut, strict=True)))
        searched = problem.weighted(weight).as_noisy_as_at(state)
        found = minimise(searched, state, max_steps=most)
        state, steps = found.state, steps + int(found.steps.max())
        d = norms(problem, problem.unweighted(state))
        if settled:
            break
    scale = noise_scales(problem, d, least_scale)
    return Anneal(state, settled_weights(d, scale), scale, steps)
