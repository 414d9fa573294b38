"""What edges that are another thing's, and go unnoticed, add to the covariance of an estimate.

Some edges are not the leg's: a highlight's, another leg's, that of a cable behind it. One that all
others contradict is given up. Where few others say anything of it, as in a photograph by hand with
a dozen edges and seven unknowns of its own, the unknowns follow it, the next look finds it where
they have it, and no residual shows it. What it does to the result then is its external reliability
(Baarda, A testing procedure for use in geodetic networks, 1968); here that is counted as a
variance, as every other error is.

With probability p an edge is wrong, and its shift, and its tilt, then off by anything up to
``most`` of its own standard deviations. With H the hat matrix, r = 1 - H_ii of it is left in its
own residual, which is all that speaks against it once the looks have followed; so it is noticed
from ``NOTICED_DISTANCE / r`` on. Unnoticed ones have, on average, the square

    p u_i,      u = min(most, NOTICED_DISTANCE / r)^3 / (3 most),

of which the noise that residuals tell has had its share: all edges of a tube are believed to err by
the mean of it, p U with U = sum(r u) / sum(r), whoever makes it. What is added is the rest,

    C J^T D J C,      D_ii = s_i (p u_i - min(p U, 1)),

with J the rows of the edges, the own unknowns eliminated, C the inverse of the normal matrix, and
s the variance that an edge has by itself in that with which it counts among those shaded alike. p
is what was given up of all that would have been noticed, with Jeffreys' prior for a share: half a
wrong one more, and half a right one.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.covariance import Information
from pkmcal.identify.reduced_edges import ReducedEdges, reduced_edges
from pkmcal.identify.scatter import NUMBERS_AN_EDGE, shift_squares
from pkmcal.solver.kernels import FULL_WEIGHT_DISTANCE, NO_WEIGHT_DISTANCE

NOTICED_DISTANCE = (FULL_WEIGHT_DISTANCE + NO_WEIGHT_DISTANCE) / 2
"""Standard deviations of its residual at which an edge has lost half of its weight."""
WRONG_EDGE_REACH = 3.0
"""Pixels by which a wrong edge lies off at most: a look takes what lies within 1.5 of where an edge
is predicted, and what is predicted may lie as far to the other side."""
LEAST_REDUNDANCY = 1e-3
"""Part of an error in its own residual below which it is rounding."""


def covariance_of_undetected(info: Information, weight: Array) -> Array:
    """What wrong edges that go unnoticed add to the covariance (B, na, na) of the shared unknowns
    at a solution; nothing where light moves no edge.

    weight : (B, K, G) of edges, 0..1, their trust left out; what is missing to 1 was given up.
    """
    half, blocks = info.root, info.problem.blocks
    n_runs, na = half.shape[:2]
    shifted = info.problem.kinds.edges.present & (blocks.n_effective > 0)
    if not shifted.any():
        return np.zeros_like(half)
    n_kinds = NUMBERS_AN_EDGE * (int(blocks.tube.max()) + 1)
    by_wrong, by_any = np.zeros((n_runs, na, na)), np.zeros((n_kinds, n_runs, na, na))
    in_residuals, redundancy = np.zeros((2, n_kinds, n_runs))
    noticed = np.zeros(n_runs)
    for piece in reduced_edges(info):
        inliers = weight[:, piece.first : piece.first + len(piece.problem.blocks.present)]
        most, own_share = _deviations(piece)
        kinds, inliers = _kinds(piece), np.repeat(inliers[:, *piece.at], NUMBERS_AN_EDGE, axis=-1)
        for cut, shared in piece.shared(half):
            taken = shared.swapaxes(1, 2).reshape(n_runs, na, kinds[cut].size)
            far, share, irls_weight = (
                part[:, cut].reshape(len(part), kinds[cut].size)
                for part in (most, own_share, inliers)
            )
            by_own = np.sum(piece.own[:, cut] ** 2, axis=2).reshape(n_runs, kinds[cut].size)
            kind, irls_weight = kinds[cut].ravel(), np.where(far > 0, irls_weight, 0.0)
            far, remainder = (
                np.maximum(far, LEAST_REDUNDANCY),
                1 - by_own - np.sum(taken**2, axis=1),
            )
            unseen = np.minimum(NOTICED_DISTANCE / np.maximum(remainder, LEAST_REDUNDANCY), far)
            square = unseen**3 / (3 * far)
            noticed += np.sum((irls_weight * (1 - unseen / far))[:, ::NUMBERS_AN_EDGE], axis=1)
            for number in range(n_kinds):
                mine = kind == number
                size, each = (irls_weight * share)[:, mine], (irls_weight * remainder)[:, mine]
                wrong = taken[..., mine] * np.sqrt(size * square[:, mine])[:, None]
                reference_values = taken[..., mine] * np.sqrt(size)[:, None]
                by_wrong += wrong @ wrong.mT
                by_any[number] += reference_values @ reference_values.mT
                in_residuals[number] += np.sum(each * square[:, mine], axis=1)
                redundancy[number] += np.sum(each, axis=1)
    lost = np.sum((1 - weight) * shifted, axis=(1, 2))
    p = (lost + 0.5) / (noticed + lost + 1)
    counted = np.minimum(p * in_residuals / np.maximum(redundancy, LEAST_REDUNDANCY), 1.0)
    added = p[:, None, None] * by_wrong - np.sum(counted[..., None, None] * by_any, axis=0)
    return half @ added @ half.mT


def _deviations(piece: ReducedEdges) -> tuple[Array, Array]:
    """By how many of its own standard deviations a wrong edge's shift and tilt are off at most, 0
    of edges that are not in use, or not moved by light; and the part that the own variance is of
    that with which they count. (B or 1, N, r) both.

    A line through places evenly along an edge is told root three times less surely at its ends than
    in its middle.
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


def _kinds(piece: ReducedEdges) -> Integers:
    """Of which tube's shifts, or tilts, each number is, (N, r)."""
    tube = piece.problem.blocks.tube[*piece.at][..., None]
    kind = NUMBERS_AN_EDGE * tube + np.arange(NUMBERS_AN_EDGE)
    return kind.reshape(len(kind), NUMBERS_AN_EDGE * tube.shape[1])
