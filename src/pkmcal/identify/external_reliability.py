"""External reliability: covariance due to wrong edges that no residual reveals.

Some edges belong to a highlight, another leg, or a cable behind the leg. A wrong edge that
contradicts the others is rejected. Where few others constrain it, as in a hand-held image with a
dozen edges and seven unknowns of its own, the unknowns follow the wrong edge, the next measurement
pass finds it where they predict it, and no residual reveals it. The effect of such errors on the
result is the external reliability (Baarda, A testing procedure for use in geodetic networks, 1968),
which is here added to the covariance as a variance.

An edge is wrong with probability p; its shift, and its tilt, are then off by a uniformly
distributed number of its own standard deviations, up to ``most``. With H the hat matrix, the share
r = 1 - H_ii of that error remains in the edge's own residual. After repeated measurement passes no
other residual contains it, so it is detected from ``NOTICED_DISTANCE / r`` on. Undetected errors
have the mean square

    p u_i,      u = min(most, NOTICED_DISTANCE / r)^3 / (3 most).

The estimated noise contains a part of that already: the variance of all edges of a tube contains
their mean, p U with U = sum(r u) / sum(r), whichever edges are wrong. The rest is added,

    C J^T D J C,      D_ii = s_i (p u_i - min(p U, 1)),

with J the rows of the edges, the own unknowns eliminated, C the inverse of the normal matrix, and
s_i the ratio of an edge's own variance to the variance that it has in the estimate, which counts
the edges that share its shading. p is the share of rejected edges among detectable wrong and right
ones, with Jeffreys' prior of a binomial share.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.covariance import Information
from pkmcal.identify.reduced_edges import ReducedEdges, reduced_edges
from pkmcal.identify.scatter import NUMBERS_AN_EDGE, shift_squares
from pkmcal.solver.kernels import FULL_WEIGHT_DISTANCE, NO_WEIGHT_DISTANCE

NOTICED_DISTANCE = (FULL_WEIGHT_DISTANCE + NO_WEIGHT_DISTANCE) / 2
"""Residual, in standard deviations, at which an edge has lost half of its weight."""
WRONG_EDGE_REACH = 3.0
"""Largest error of a wrong edge, pixels: a measurement pass accepts edges within 1.5 pixels of the
prediction, and the prediction may be off by as much to the other side."""
LEAST_REDUNDANCY = 1e-3
"""Redundancy of a residual below which it is rounding."""


def covariance_of_undetected(info: Information, weight: Array) -> Array:
    """Covariance (B, na, na) of the shared unknowns due to undetected wrong edges at a solution;
    zero where no edge has shading.

    weight : (B, K, G) robust weights 0..1 of the edges, without their IRLS weight.
    """
    half, blocks = info.root, info.problem.blocks
    n_runs, na = half.shape[:2]
    shifted = info.problem.row_groups.edges.present & (blocks.n_effective > 0)
    if not shifted.any():
        return np.zeros_like(half)
    # sums over all edges; U is formed by tube, shift and tilt apart
    n_kinds = NUMBERS_AN_EDGE * (int(blocks.tube.max()) + 1)
    by_wrong, by_any = np.zeros((n_runs, na, na)), np.zeros((n_kinds, n_runs, na, na))
    in_residuals, redundancy = np.zeros((2, n_kinds, n_runs))
    noticed = np.zeros(n_runs)
    for piece in reduced_edges(info):
        inliers = weight[:, piece.first : piece.first + len(piece.problem.blocks.present)]
        most, own_share = _deviations(piece)
        # number (N, r) of each shift or tilt by tube: two for each tube
        tube = piece.problem.blocks.tube[*piece.at][..., None]
        kinds = NUMBERS_AN_EDGE * tube + np.arange(NUMBERS_AN_EDGE)
        kinds = kinds.reshape(len(kinds), NUMBERS_AN_EDGE * tube.shape[1])
        inliers = np.repeat(inliers[:, *piece.at], NUMBERS_AN_EDGE, axis=-1)
        for cut, shared in piece.shared(half):
            # rows t = F^T J, largest errors, variance ratios and weights of these edges
            taken = shared.swapaxes(1, 2).reshape(n_runs, na, kinds[cut].size)
            far, share, irls_weight = (
                part[:, cut].reshape(len(part), kinds[cut].size)
                for part in (most, own_share, inliers)
            )
            # redundancy r = 1 - H_ii and mean square u of undetected errors
            by_own = np.sum(piece.own[:, cut] ** 2, axis=2).reshape(n_runs, kinds[cut].size)
            kind, irls_weight = kinds[cut].ravel(), np.where(far > 0, irls_weight, 0.0)
            far, remainder = (
                np.maximum(far, LEAST_REDUNDANCY),
                1 - by_own - np.sum(taken**2, axis=1),
            )
            unseen = np.minimum(NOTICED_DISTANCE / np.maximum(remainder, LEAST_REDUNDANCY), far)
            square = unseen**3 / (3 * far)
            noticed += np.sum((irls_weight * (1 - unseen / far))[:, ::NUMBERS_AN_EDGE], axis=1)
            # sums of t t^T, weighted by u and not, and of U's numerator and denominator
            for number in range(n_kinds):
                mine = kind == number
                size, each = (irls_weight * share)[:, mine], (irls_weight * remainder)[:, mine]
                wrong = taken[..., mine] * np.sqrt(size * square[:, mine])[:, None]
                effect = taken[..., mine] * np.sqrt(size)[:, None]
                by_wrong += wrong @ wrong.mT
                by_any[number] += effect @ effect.mT
                in_residuals[number] += np.sum(each * square[:, mine], axis=1)
                redundancy[number] += np.sum(each, axis=1)
    # probability p, and J^T D J
    lost = np.sum((1 - weight) * shifted, axis=(1, 2))
    p = (lost + 0.5) / (noticed + lost + 1)
    counted = np.minimum(p * in_residuals / np.maximum(redundancy, LEAST_REDUNDANCY), 1.0)
    added = p[:, None, None] * by_wrong - np.sum(counted[..., None, None] * by_any, axis=0)
    return half @ added @ half.mT


def _deviations(piece: ReducedEdges) -> tuple[Array, Array]:
    """Largest errors of a wrong edge in its own standard deviations, and variance ratios s, (B or
    1, N, r) each, shift and tilt in turns.

    Errors are 0 for edges that are not in use, or have no shading. The tilt's largest error follows
    from points evenly distributed along the edge: the standard deviation of the line at its ends is
    sqrt(3) times that in its middle.
    """
    blocks, data = piece.problem.blocks, piece.problem.data
    size = np.where(data.weight > 0, shift_squares(blocks, data), 0.0)
    counted = data.own**2 * size
    alone = counted / np.maximum(blocks.n_effective, 1.0) + data.scale**2
    shift, tilt = np.sqrt(size / alone), np.sqrt(size / 3) / data.scale
    share = alone / (counted + data.scale**2)
    most = WRONG_EDGE_REACH * np.stack(np.broadcast_arrays(shift, tilt), axis=-1)
    shares = np.stack(np.broadcast_arrays(share, 1.0), axis=-1)
    row, place = piece.at
    there = (place >= 0)[..., None]
    numbers = len(place), NUMBERS_AN_EDGE * place.shape[1]
    most, shares = (np.where(there, part[:, row, place], 0.0) for part in (most, shares))
    return most.reshape(len(most), *numbers), shares.reshape(len(shares), *numbers)
