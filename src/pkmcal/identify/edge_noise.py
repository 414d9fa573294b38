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
alike (:func:`pkmcal.identify.assembly.crowd`), so its variance counts times their number.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.covariance import Information
from pkmcal.identify.scatter import (
    EDGE_SCATTER_FLOOR,
    NUMBERS_AN_EDGE,
    EdgeScatter,
    shift_squares,
    worth,
)
from pkmcal.measurements import OWN_SHADING
from pkmcal.solver.elimination import divisions
from pkmcal.solver.strips import Eliminated, Strips, eliminated

TAILS_TRIED = np.array([1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, 100.0])
"""Degrees of freedom that are tried: the last is as good as the normal distribution."""
LEAST_TILT_SHADING = 1e-3
"""px; practically nothing, but a step of factors can leave it."""
STATED_NOISE_WORTH = 5.0
"""Edges that the stated noise is worth when their own is found."""
MOST_EDGE_NOISE_ROUNDS = 60
VARIANCE_FOUND_CHANGE = 1e-4
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
    tube, found = info.problem.blocks.tube, list[tuple[Array, ...]]()
    for number in range(before.scale.shape[1]):
        own = info.problem.kinds.edges.present & (tube == number)
        begin = tuple(part[:, number] for part in before.parts)
        if not own.any():
            found.append(begin)
            continue
        tails = before.tails[None, :, number] if same_tails else TAILS_TRIED[:, None]
        squares = np.stack([along[:, own], rest[:, own]])
        found.append(_student(squares, size[:, own], weight[:, own], begin, tails))
    return EdgeScatter(*(np.stack(part, axis=-1) for part in zip(*found, strict=True)))


def _squares(info: Information) -> tuple[Array, Array, Array]:
    """Squares expected of the edges' errors, in their stated noise, (B, K, G) each: along what a
    shift outward does, and across; and the square of that shift by a pixel.
    """
    problem, half = info.problem, info.root
    n_runs, n_places = len(half), problem.blocks.present.shape[1]
    squares: list[Array] = []
    for cut in divisions(info.state.T_base_platform.shape[1], problem.n_rows * n_runs):
        part, state = problem.among(cut), problem.state_among(info.state, cut)
        data, rows = part.data, part.compact(state)
        layout, numbers = rows.strips
        at = layout.configuration[:, None], layout.rows[:, ::NUMBERS_AN_EDGE] // NUMBERS_AN_EDGE
        v = data.by_shift
        norm = np.sqrt(np.sum(v**2, axis=-1, keepdims=True))
        unit = np.where(norm > 0, v / np.where(norm > 0, norm, 1.0), [1.0, 0.0])
        turned = Strips(layout, _turned(numbers, unit[:, *at]))
        taken = _taken_up(turned, eliminated(rows, np.zeros(n_runs)), half)
        # a place more than there are takes in the strips' padding, -1
        square = np.zeros((n_runs, len(part.blocks.present), n_places + 1, NUMBERS_AN_EDGE))
        square[:, *at] = taken.reshape(*taken.shape[:2], -1, NUMBERS_AN_EDGE)
        square = square[:, :, :-1]
        size = shift_squares(part.blocks, data)
        weight = np.where(data.weight > 0, data.weight, 1.0)
        along = square[..., 0] * (data.scale[..., 0] ** 2 + data.own**2 * size) / weight
        rest = square[..., 1] * data.scale[..., 1] ** 2 / weight
        squares.append(np.stack([along, rest, np.broadcast_to(size, along.shape)]))
    along, rest, size = np.concatenate(squares, axis=2)
    return along, rest, size


def _turned(numbers: Array, unit: Array) -> Array:
    """Numbers (B, ..., N, n) of strips of edges with the two rows of each turned into those along
    ``unit`` (B, N, n / 2, 2) and across.
    """
    first, second = numbers[..., ::NUMBERS_AN_EDGE], numbers[..., 1::NUMBERS_AN_EDGE]
    x, y = np.moveaxis(unit, -1, 0)[:, :, None]
    out = np.empty_like(numbers)
    out[..., ::NUMBERS_AN_EDGE] = x * first + y * second
    out[..., 1::NUMBERS_AN_EDGE] = x * second - y * first
    return out


def _taken_up(strips: Strips, found: Eliminated, half: Array) -> Array:
    """Squares (B, N, n) of strips' residuals with what the unknowns have taken up of them, where
    ``half half^T`` is the covariance of the shared ones.
    """
    layout, numbers = strips.layout, strips.numbers.swapaxes(1, 2)
    d, at = layout.n_own, layout.configuration
    by_own = found.inverse.mT[:, at] @ numbers[:, :, :d]
    squares = numbers[:, :, -1] ** 2 + np.sum(by_own**2, axis=-2)
    of_own = (found.along @ half[:, None]).mT
    by_shared = np.pad(half, ((0, 0), (0, 1), (0, 0)))  # nothing for columns that are none
    for cut, columns in zip(layout.groups, layout.columns, strict=True):
        taken = by_shared[:, None, columns].mT @ numbers[:, cut, d:-1]
        taken -= of_own[:, at[cut]] @ by_own[:, cut]
        squares[:, cut] += np.einsum("...ir,...ir->...r", taken, taken)
    return squares


def _student(
    squares: Array, size: Array, weight: Array, begin: tuple[Array, ...], tried: Array
) -> tuple[Array, ...]:
    """Scale, shading of shift and of tilt, and tails, (B,) each, of n edges by their likelihood.

    squares : (2, B, n) of shift and of tilt, size and weight (B, n). begin : where the search
    begins, (B,) each. tried : (V, B or 1) tails; for each of them weights and the three variances
    in turns: with fixed weights these are components of the variances of two normal variables, a
    step of Fisher's scoring each.
    """
    from scipy.special import gammaln

    tails, norm, each = tried[..., None], worth(tried), squares[:, None]
    least = np.array([OWN_SHADING, LEAST_TILT_SHADING])[:, None, None] ** 2 / norm
    count, square = np.sum(weight, axis=-1), size**2

    def scored(a: Array, b: Array) -> tuple[Array, Array]:
        """One step of the variances a (V, B) and b (2, V, B)."""
        s = a[..., None] + b[..., None] * size  # (2, V, B, n) of shift and of tilt
        trust = (tails + NUMBERS_AN_EDGE) / (tails + np.sum(each / s, axis=0))
        of_s = weight / s**2
        left = (trust * each - s) * of_s
        # the stated noise counts as some edges more
        by_a = np.sum(left, axis=(0, -1)) + STATED_NOISE_WORTH * (1 - a) / a**2
        aa = np.sum(of_s, axis=(0, -1)) + STATED_NOISE_WORTH / a**2
        by_b, ab = np.sum(left * size, axis=-1), np.sum(of_s * size, axis=-1)
        bb = np.sum(of_s * square, axis=-1) + EDGE_SCATTER_FLOOR
        held = np.zeros(b.shape, dtype=bool)
        for _ in range(2):  # a shading at its least is known: the others go on alone
            found = np.where(held, least - b, by_b / bb)
            share = np.where(held, 0.0, ab / bb)
            det = aa - np.sum(share * ab, axis=0)
            det = np.where(det > EDGE_SCATTER_FLOOR * aa, det, np.inf)
            step = (by_a - np.sum(ab * found, axis=0)) / det
            new = b + found - share * step
            held = new <= least
        new_a = np.clip(a + step, a / LARGEST_VARIANCE_FACTOR, a * LARGEST_VARIANCE_FACTOR)
        return new_a, np.maximum(
            np.clip(new, b / LARGEST_VARIANCE_FACTOR, b * LARGEST_VARIANCE_FACTOR), least
        )

    scale, *shading, _ = begin
    a = scale**2 / norm
    b = np.maximum(np.stack(shading)[:, None] ** 2 / norm, least)
    for _ in range(MOST_EDGE_NOISE_ROUNDS):
        before, (a, b) = (a, b), scored(a, b)
        change = max(np.abs(new / old - 1).max() for new, old in zip((a, b), before, strict=True))
        if change < VARIANCE_FOUND_CHANGE:
            break
    s = a[..., None] + b[..., None] * size
    distance = np.sum(each / s, axis=0)
    cost = np.sum(
        weight
        * (np.log(s).sum(axis=0) + (tails + NUMBERS_AN_EDGE) * np.log1p(distance / tails))
        / 2,
        axis=-1,
    )
    constant = (
        gammaln((tried + NUMBERS_AN_EDGE) / 2)
        - gammaln(tried / 2)
        - NUMBERS_AN_EDGE / 2 * np.log(tried)
    )
    cost = cost - constant * count
    best, run = np.argmin(cost, axis=0), np.arange(cost.shape[-1])
    found = np.sqrt(norm * np.concatenate([a[None], b]))[:, best, run]
    return *found, np.broadcast_to(tried, cost.shape)[best, run]
