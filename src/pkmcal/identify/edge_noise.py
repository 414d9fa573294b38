"""The edges' noise as the data show it: a scale, a shading and how heavy its tails are.

What the profiles of an edge scatter by is stated with it, C. On real surfaces that is not what it
is wrong by: within an edge the points agree better than their profiles promise, while a highlight
or something mirrored moves an edge as a whole, some far more than others. So the errors of the
edges of one tube (first, second, ... of all legs) have Student's distribution with the covariance

    scale^2 C + shading^2 s s^T,      s the change of the normal by a pixel outward,

and as many degrees of freedom as they show. All three are found by restricted maximum likelihood:
what the unknowns have taken up of an edge's residual is added to its square, by the hat matrix. An
edge then counts by its weight (Lange, Little, Taylor 1989), and the information of Student's
distribution is what the covariance of the result is made of.

What one edge alone is shaded by is not its own: edges of a line whose normals are near are moved
alike (:mod:`pkmcal.identify.error_correlation`), so its variance counts times their number.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.covariance import Information
from pkmcal.identify.reduced_edges import reduced_edges
from pkmcal.identify.scatter import (
    EDGE_SCATTER_FLOOR,
    LEAST_OWN_SHADING,
    NUMBERS_AN_EDGE,
    EdgeScatter,
    shift_squares,
    t_variance,
)

TAILS_TRIED = np.array([1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, 100.0])
"""Degrees of freedom that are tried: the last is as good as the normal distribution."""
STATED_NOISE_WORTH = 5.0
"""Edges that the stated noise is worth when their own is found."""
MOST_EDGE_NOISE_ROUNDS = 60
VARIANCE_CHANGE = 1e-4
"""Relative change of a variance below which it counts as found."""
LARGEST_VARIANCE_FACTOR = 4.0
"""Largest factor on a variance in one round."""


def edge_noise(
    info: Information, weight: Array, before: EdgeScatter, *, same_tails: bool = False
) -> EdgeScatter:
    """The edges' noise that a solution shows.

    weight : (B, K, G) of edges, 0..1, their trust left out; those of 0 do not belong to the machine
    and tell nothing. before : where the search begins, whose tails are kept where that is asked; a
    tube of which no edge was seen keeps all.
    """
    along, rest, size = _squares(info)
    tube, results = info.problem.blocks.tube, list[tuple[Array, ...]]()
    for number in range(before.scale.shape[1]):
        own = info.problem.kinds.edges.present & (tube == number)
        if not own.any():
            results.append(
                (before.scale[:, number], before.shading[:, number], before.dof[:, number])
            )
            continue
        begin = before.scale[:, number], before.shading[:, number]
        tails = before.dof[None, :, number] if same_tails else TAILS_TRIED[:, None]
        squares = along[:, own], rest[:, own], size[:, own]
        results.append(_student(*squares, weight[:, own], *begin, tails))
    scale, shading, tails = (np.stack(part, axis=-1) for part in zip(*results, strict=True))
    return EdgeScatter(scale, shading, tails)


def _squares(info: Information) -> tuple[Array, Array, Array]:
    """Squares expected of the edges' errors, in their stated noise, (B, K, G) each: along what a
    shift outward does, and across; and the square of that shift by a pixel.
    """
    half, squares = info.root, list[Array]()
    for piece in reduced_edges(info):
        data, blocks = piece.problem.data, piece.problem.blocks
        square = piece.value**2 + np.sum(piece.own**2, axis=2)
        for cut, shared in piece.shared(half):
            square[:, cut] += np.einsum("...ir,...ir->...r", shared, shared)
        square = piece.placed(square)
        size = shift_squares(blocks, data)
        weight = np.where(data.weight > 0, data.weight, 1.0)
        along = square[..., 0] * (data.scale**2 + data.own**2 * size) / weight
        rest = square[..., 1] * data.scale**2 / weight
        squares.append(np.stack([along, rest, np.broadcast_to(size, along.shape)]))
    along, rest, size = np.concatenate(squares, axis=2)
    return along, rest, size


def _student(
    along: Array,
    rest: Array,
    size: Array,
    weight: Array,
    scale: Array,
    shading: Array,
    tried: Array,
) -> tuple[Array, Array, Array]:
    """Scale, shading and tails (B,) of n edges, all (B, n), by their likelihood.

    scale, shading : (B,) where the search begins. tried : (V, B or 1) tails; for each of them
    weights and the two variances in turns: with fixed weights these are components of the variances
    of two normal variables, a step of Fisher's scoring each.
    """
    from scipy.special import gammaln

    tails, norm = tried[..., None], t_variance(tried)
    least, count = LEAST_OWN_SHADING**2 / norm, np.sum(weight, axis=-1)
    of_rest, square = weight * rest, size**2

    def total(each: Array, times: Array) -> Array:
        """Sums (V, B) over the edges of products (V, B, n) and (B, n)."""
        return np.einsum("vbn,bn->vb", each, times)

    def scored(a: Array, b: Array) -> tuple[Array, Array]:
        """One step of the two variances."""
        s, t = a[..., None] + b[..., None] * size, a[..., None]
        irls_weight = (tails + NUMBERS_AN_EDGE) / (tails + along / s + rest / t)
        of_s = weight / s**2
        remainder = (irls_weight * along - s) * of_s
        # the stated noise counts as some edges more
        by_a = np.sum(remainder, axis=-1) + (total(irls_weight, of_rest) - count * a) / a**2
        by_a += STATED_NOISE_WORTH * (1 - a) / a**2
        by_b = total(remainder, size)
        aa, ab = np.sum(of_s, axis=-1) + (count + STATED_NOISE_WORTH) / a**2, total(of_s, size)
        bb = total(of_s, square) + EDGE_SCATTER_FLOOR
        det = aa * bb - ab**2
        det = np.where(det > EDGE_SCATTER_FLOOR * aa * bb, det, np.inf)
        new_a, new_b = a + (bb * by_a - ab * by_b) / det, b + (aa * by_b - ab * by_a) / det
        # a shading at its least is known: the scale goes on alone
        new_a = np.where(new_b > least, new_a, a + (by_a + (b - least) * ab) / aa)
        new_a = np.clip(new_a, a / LARGEST_VARIANCE_FACTOR, a * LARGEST_VARIANCE_FACTOR)
        return new_a, np.maximum(
            np.clip(new_b, b / LARGEST_VARIANCE_FACTOR, b * LARGEST_VARIANCE_FACTOR), least
        )

    a = scale**2 / norm
    b = np.broadcast_to(shading**2 / norm, a.shape)
    for _ in range(MOST_EDGE_NOISE_ROUNDS):
        before, (a, b) = (a, b), scored(a, b)
        change = max(np.abs(new / old - 1).max() for new, old in zip((a, b), before, strict=True))
        if change < VARIANCE_CHANGE:
            break
    s, t = a[..., None] + b[..., None] * size, a[..., None]
    distance = along / s + rest / t
    cost = np.sum(
        weight * (np.log(s * t) + (tails + NUMBERS_AN_EDGE) * np.log1p(distance / tails)) / 2,
        axis=-1,
    )
    constant = (
        gammaln((tried + NUMBERS_AN_EDGE) / 2)
        - gammaln(tried / 2)
        - NUMBERS_AN_EDGE / 2 * np.log(tried)
    )
    cost = cost - constant * count
    best, run = np.argmin(cost, axis=0), np.arange(len(scale))
    factor = (norm * np.ones_like(a))[best, run]
    values = np.broadcast_to(tried, a.shape)[best, run]
    return np.sqrt(factor * a[best, run]), np.sqrt(factor * b[best, run]), values
