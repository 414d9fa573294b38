"""Noise of the edges: scale, shading and tails, by restricted maximum likelihood.

The stated covariance C of an edge is that of the scatter of its profiles. On real surfaces the
error differs: the points of one edge scatter less than their profiles promise, while a highlight or
a mirrored object shifts an edge as a whole, and some edges far more than others. So the errors of
the edges of one tube (first, second, ... of all legs) have Student's distribution with the
covariance

    scale^2 C + shading^2 s s^T,      s the change of the normal by a shift of one pixel outward,

and estimated degrees of freedom. All three are estimated by restricted maximum likelihood: the part
of an edge's error that the unknowns have absorbed is added to its squared residual, by the hat
matrix. Each edge has an IRLS weight (Lange, Little, Taylor 1989), and the covariance of the result
follows from the information of Student's distribution.

Shading is correlated between edges of a line with similar normals
(:mod:`pkmcal.identify.error_correlation`), so its variance is multiplied by the number of edges
that share it.
"""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class EdgeNoiseOptions:
    """Constants of the estimate of the edges' noise."""

    # candidates of the degrees of freedom; the last is close to the normal distribution
    tails: tuple[float, ...] = (1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, 100.0)
    # weight of the stated noise as the prior of the scale, as a number of edges
    stated_noise_worth: float = 5.0
    # largest number of scoring steps
    most_rounds: int = 60
    # relative change of a variance below which the iteration has converged
    converged: float = 1e-4
    # largest factor on a variance in one step, so that scoring does not overshoot
    largest_factor: float = 4.0


EDGE_NOISE = EdgeNoiseOptions()


def edge_noise(
    info: Information,
    weight: Array,
    before: EdgeScatter,
    *,
    same_tails: bool = False,
    options: EdgeNoiseOptions = EDGE_NOISE,
) -> EdgeScatter:
    """Noise of the edges of each tube, at a solution.

    weight : (B, K, G) robust weights 0..1 of the edges, without their IRLS weight; edges of weight
        0 are outliers and are not used.
    before : start of the iteration; a tube without edges keeps its values.
    same_tails : keep the degrees of freedom of ``before``.
    """
    along, rest, size = _squares(info)
    tube, results = info.problem.blocks.tube, list[tuple[Array, ...]]()
    for number in range(before.scale.shape[1]):
        own = info.problem.row_groups.edges.present & (tube == number)
        if not own.any():
            results.append(
                (before.scale[:, number], before.shading[:, number], before.dof[:, number])
            )
            continue
        begin = before.scale[:, number], before.shading[:, number]
        tails = before.dof[None, :, number] if same_tails else np.array(options.tails)[:, None]
        squares = along[:, own], rest[:, own], size[:, own]
        results.append(_student(*squares, weight[:, own], *begin, tails, options))
    scale, shading, tails = (np.stack(part, axis=-1) for part in zip(*results, strict=True))
    return EdgeScatter(scale, shading, tails)


def _squares(info: Information) -> tuple[Array, Array, Array]:
    """Expected squared errors of the edges in their stated noise, (B, K, G) each.

    Returns the squares along the change of the normal by a shift outward, and across it, and the
    square of that change by a shift of one pixel.
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
    options: EdgeNoiseOptions,
) -> tuple[Array, Array, Array]:
    """Scale, shading and degrees of freedom (B,) of n edges with the highest likelihood.

    For each candidate of the degrees of freedom, weights and the two variances are updated in
    turns. With fixed weights the variances are variance components of two normal variables, and an
    update is one step of Fisher scoring.

    along, rest, size, weight : (B, n), see :func:`_squares`.
    scale, shading : (B,) start of the iteration.
    tried : (V, B or 1) candidates of the degrees of freedom.
    """
    from scipy.special import gammaln

    tails, norm = tried[..., None], t_variance(tried)
    least, count = LEAST_OWN_SHADING**2 / norm, np.sum(weight, axis=-1)
    of_rest, square = weight * rest, size**2

    def total(each: Array, times: Array) -> Array:
        """Sums (V, B) over the edges of products (V, B, n) and (B, n)."""
        return np.einsum("vbn,bn->vb", each, times)

    def scored(a: Array, b: Array) -> tuple[Array, Array]:
        """Step of Fisher's scoring of both variances."""
        s, t = a[..., None] + b[..., None] * size, a[..., None]
        # weights of Student's distribution
        irls_weight = (tails + NUMBERS_AN_EDGE) / (tails + along / s + rest / t)
        of_s = weight / s**2
        remainder = (irls_weight * along - s) * of_s
        # gradient by the variances a (scale) and b (shading); the stated noise is a prior
        by_a = np.sum(remainder, axis=-1) + (total(irls_weight, of_rest) - count * a) / a**2
        by_a += options.stated_noise_worth * (1 - a) / a**2
        by_b = total(remainder, size)
        # Fisher information
        aa = np.sum(of_s, axis=-1) + (count + options.stated_noise_worth) / a**2
        ab = total(of_s, size)
        bb = total(of_s, square) + EDGE_SCATTER_FLOOR
        det = aa * bb - ab**2
        det = np.where(det > EDGE_SCATTER_FLOOR * aa * bb, det, np.inf)
        new_a, new_b = a + (bb * by_a - ab * by_b) / det, b + (aa * by_b - ab * by_a) / det
        # where the shading is at its lower bound, only the scale is updated
        new_a = np.where(new_b > least, new_a, a + (by_a + (b - least) * ab) / aa)
        new_a = np.clip(new_a, a / options.largest_factor, a * options.largest_factor)
        return new_a, np.maximum(
            np.clip(new_b, b / options.largest_factor, b * options.largest_factor), least
        )

    # variances for each number of degrees of freedom
    a = scale**2 / norm
    b = np.broadcast_to(shading**2 / norm, a.shape)
    for _ in range(options.most_rounds):
        before, (a, b) = (a, b), scored(a, b)
        change = max(np.abs(new / old - 1).max() for new, old in zip((a, b), before, strict=True))
        if change < options.converged:
            break
    s, t = a[..., None] + b[..., None] * size, a[..., None]
    # likelihood of each number of degrees of freedom, and the best
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
