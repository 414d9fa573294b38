"""Edges that belong to something else: weights that let them go.

A wrong edge (another leg's, a shadow's) is wrong as a whole, so the weight belongs to the whole
edge and judges the Mahalanobis norm d of its two residuals. The search begins with a scale
so wide that every edge counts and narrows it while the estimate settles (graduated
non-convexity, Geman-McClure weights); it ends with weights that are 1 for all clean edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.blocks import BatchState
from pkmcal.identify.residuals import Problem
from pkmcal.identify.solver import FIRST_DAMPING, RESTART_DAMPING, minimise

FULL, NONE = 4.0, 6.5
"""Weights are 1 up to FULL and 0 from NONE standard deviations: of clean edges 3 in 10^4 lose
part of their weight and none all of it, so efficiency on clean data is above 0.999."""
STAGES = 30
WIDE = 4.0
"""Geman-McClure scale in units of the residuals' robust scale."""


class Anneal(NamedTuple):
    """Where the annealing ended: state, weights (B, K, G), robust scale (B,), solver steps."""

    state: BatchState
    weight: Array
    scale: Array
    steps: int


def norms(problem: Problem, state: BatchState) -> Array:
    """Mahalanobis norms of the blocks by their stated noise, (B, K, G); NaN for padding.

    A block of g edges has 2g residuals; the norm is scaled so that its mean square is 2.
    """
    rows = problem.block_residuals(state)
    d = np.sqrt(np.sum(rows**2, axis=-1) * (2 / rows.shape[-1]))
    return np.where(problem.blocks.present, d, np.nan)


def robust_scale(d: Array) -> Array:
    """Factor by which the noise seems to differ from the stated one, from the median, (B,)."""
    flat = np.sort(d.reshape(d.shape[0], -1), axis=1)  # NaN last
    count = np.sum(np.isfinite(flat), axis=1)
    if not count.all():  # no edge at all: boards alone
        return np.ones(len(flat))
    return flat[np.arange(len(flat)), count // 2] / np.sqrt(2 * np.log(2))


def final_weights(d: Array, scale: Array) -> Array:
    """1 inside FULL, cosine taper to 0 at NONE; 0 where nothing can be predicted."""
    x = np.clip((d / scale[:, None, None] - FULL) / (NONE - FULL), 0, 1)
    return np.where(np.isfinite(d), 0.5 * (1 + np.cos(np.pi * x)), 0.0)


def anneal(problem: Problem, start: BatchState, least_scale: float) -> Anneal:
    """A state near the answer although many edges are wrong.

    least_scale : the robust scale is not believed below this (1: stated noise is a floor).
    """
    state, steps = start, 0
    d = norms(problem, state)
    cut = 4 * WIDE * np.maximum(robust_scale(d), least_scale)
    for _ in range(STAGES):
        aim = WIDE * np.maximum(robust_scale(d), least_scale)
        new_cut = np.minimum(cut, np.maximum(aim, cut / 4))
        settled = np.all(new_cut > 0.8 * cut)
        cut = new_cut
        c2 = cut[:, None, None] ** 2
        weight = np.where(np.isfinite(d), (c2 / (c2 + np.nan_to_num(d) ** 2)) ** 2, 0.0)
        damping = RESTART_DAMPING if steps else FIRST_DAMPING
        found = minimise(problem.weighted(weight), state, max_steps=1, damping=damping)
        state, steps = found.state, steps + 1
        d = norms(problem, state)
        if settled:
            break
    scale = np.maximum(robust_scale(d), least_scale)
    return Anneal(state, final_weights(d, scale), scale, steps)
