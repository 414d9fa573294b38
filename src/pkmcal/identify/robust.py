"""Edges and poses that belong to something else: weights that let them go.

A wrong edge (another leg's, a shadow's) is wrong as a whole, so the weight belongs to the whole
edge and judges the Mahalanobis norm d of its two residuals; so does that of a board's pose, of its
six. The search begins with a scale so wide that everything counts and narrows it while the
estimate settles (graduated non-convexity, Geman-McClure weights); it ends with weights that are 1
for all that is clean.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.solver import (
    FIRST_DAMPING,
    FULL,
    RESTART_DAMPING,
    final_weights,
    minimise,
    soft_weights,
)

TAIL = np.exp(-(FULL**2) / 2)
"""Share of two clean residuals' norms beyond FULL, where weights begin to fall."""
MEDIAN = float(np.sqrt(2 * np.log(2)))
"""Of the norm of two residuals that are noise."""
POSE_STEPS = 10
"""Steps of a stage where there are poses: against readings a hundred times sharper they allow
short steps only at first, and one that is refused would look as if all had settled."""
STAGES = 30
WIDE = 4.0
"""Geman-McClure scale in units of the residuals' robust scale."""


class Both(NamedTuple):
    """A number for the edges and one for the poses, or an array for each of their blocks."""

    edges: Array
    poses: Array


class Anneal(NamedTuple):
    """Where the annealing ended: state, weights (B, K, G), robust scale (B,), solver steps."""

    state: BatchState
    weight: Both
    scale: Both
    steps: int


def norms(problem: Problem, state: BatchState) -> Array:
    """Mahalanobis norms of the blocks by their stated noise, (B, K, G); NaN for padding.

    A block of g edges has 2g residuals; the norm is scaled so that its mean square is 2.
    """
    rows = problem.block_residuals(state)
    d = np.sqrt(np.sum(rows**2, axis=-1) * (2 / rows.shape[-1]))
    return np.where(problem.blocks.present, d, np.nan)


def measured_rows(problem: Problem) -> Integers:
    """How many of its six numbers each pose has, (K, G): a point has three, padding none."""
    return np.any(problem.pose_data.whiten[0] != 0, axis=-1).sum(axis=-1)


def pose_norms(problem: Problem, state: BatchState) -> Array:
    """The same of the poses, scaled so that as many clean ones lie beyond FULL as of edges."""
    d = np.sqrt(np.sum(problem.pose_residuals(state) ** 2, axis=-1))
    return np.where(problem.pose_blocks.present, d * _pose_factor(problem), np.nan)


def _pose_factor(problem: Problem) -> Array:
    from scipy.special import chdtri

    rows = np.maximum(measured_rows(problem), 1)
    return FULL / np.sqrt(chdtri(rows, TAIL))


def distances(problem: Problem, state: BatchState) -> Both:
    """Both kinds of norms."""
    return Both(norms(problem, state), pose_norms(problem, state))


def robust_scale(d: Array, usual: Array | float = MEDIAN) -> Array:
    """Factor by which the noise seems to differ from the stated one, from the median, (B,).

    usual : the median of clean norms, by default of two residuals'.
    """
    flat = np.sort((d / usual).reshape(d.shape[0], -1), axis=1)  # NaN last
    count = np.sum(np.isfinite(flat), axis=1)
    if not count.all():  # nothing of this kind
        return np.ones(len(flat))
    return flat[np.arange(len(flat)), count // 2]


def scales(problem: Problem, d: Both, least: float) -> Both:
    """Both kinds' factors, (B,) each, not below the least."""
    from scipy.special import chdtri

    rows = np.maximum(measured_rows(problem), 1)
    usual = np.sqrt(chdtri(rows, 0.5)) * _pose_factor(problem)
    both = robust_scale(d.edges), robust_scale(d.poses, usual)
    return Both(*(np.maximum(scale, least) for scale in both))


def settled_weights(problem: Problem, state: BatchState, scale: Both) -> Both:
    """Both kinds' weights at a state."""
    d = distances(problem, state)
    parts = zip(d, scale, strict=True)
    return Both(*(final_weights(part / each[:, None, None]) for part, each in parts))


def anneal(problem: Problem, start: BatchState, least_scale: float) -> Anneal:
    """A state near the answer although many edges, or poses, are wrong.

    least_scale : the robust scale is not believed below this (1: stated noise is a floor).
    """
    state, steps = start, 0
    most = POSE_STEPS if problem.pose_blocks.present.size else 1
    d = distances(problem, state)
    cut = [4 * WIDE * scale for scale in scales(problem, d, least_scale)]
    for _ in range(STAGES):
        aim = [WIDE * scale for scale in scales(problem, d, least_scale)]
        new = [np.minimum(c, np.maximum(a, c / 4)) for c, a in zip(cut, aim, strict=True)]
        settled = all(np.all(n > 0.8 * c) for n, c in zip(new, cut, strict=True))
        cut = new
        weight = Both(*(soft_weights(p, c[:, None, None]) for p, c in zip(d, cut, strict=True)))
        damping = RESTART_DAMPING if steps else FIRST_DAMPING
        found = minimise(problem.weighted(*weight), state, max_steps=most, damping=damping)
        state, steps = found.state, steps + int(found.steps.max())
        d = distances(problem, state)
        if settled:
            break
    scale = scales(problem, d, least_scale)
    return Anneal(state, settled_weights(problem, state, scale), scale, steps)
