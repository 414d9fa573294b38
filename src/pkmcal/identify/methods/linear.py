"""[B] section IV: each base centre in the camera frame from its leg's edges, linear and robust.

Every edge of a leg is an equation ``n . A = -R`` ([B] 12-13); the edges of all configurations
together determine A ([B] 14). All functions solve many systems together: leading axes (...), then
the n edges of one leg at one station, padded with weight zero. Distances in metres, camera frame.

With wrong edges, plain least squares and M-estimators that start from it collapse to A = 0, where
every residual is only R; least median of squares does not (errata).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import dot
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.solver.kernels import FULL_WEIGHT_DISTANCE

RegressionMethod = Literal[
    "plain", "huber", "tukey", "least-median", "robust", "errors-in-variables"
]

RANDOM_EDGE_TRIPLES = 500
"""Number of random triples: with 35 % wrong edges, the probability of no clean triple is 1e-69."""
RESIDUALS_SORTED_TOGETHER = 2**22
"""Number of residuals that are sorted together, 32 MB."""
HUBER_TUNING, TUKEY_TUNING = 1.345, 4.685
"""Tuning constants with 95 % efficiency for normal residuals."""
COUNTED_TUKEY_WEIGHT = (1 - (FULL_WEIGHT_DISTANCE / TUKEY_TUNING) ** 2) ** 2
"""Tukey weight above which an edge is an inlier with full weight: a clean edge may have lost most
of its weight."""
POORLY_FIXED = 1e-7
"""Ratio of the normal matrix's eigenvalues below which A is unidentifiable: one leg direction."""


@dataclass(frozen=True)
class LinearCentres:
    """Base centres in the camera frames, [B] 14.

    centres : (S, L, 3) m, NaN where a leg was not seen in enough directions.
    covariance : (S, L, 3, 3).
    weights : (N,) of the edges.
    """

    centres: Array
    covariance: Array
    weights: Array


def weighted_solution(n: Array, radius: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares of [B] 14: A (..., 3) and inverse normal matrix (..., 3, 3).

    n : (..., n, 3). radius, weight : (..., n). NaN where A is unidentifiable.
    """
    # unknown edges have no weight
    n, weight = (np.where(np.isfinite(x), x, 0.0) for x in (n, weight))
    rows = n * weight[..., None]
    normal = rows.mT @ n
    values, vectors = np.linalg.eigh(normal)
    fixed = values[..., 0] > POORLY_FIXED * np.maximum(values[..., -1], 1e-300)
    safe = np.where(fixed[..., None], values, 1.0)
    inverse = (vectors / safe[..., None, :]) @ vectors.mT
    right = -rows.mT @ radius[..., None]
    a = (inverse @ right)[..., 0]
    return (
        np.where(fixed[..., None], a, np.nan),
        np.where(fixed[..., None, None], inverse, np.nan),
    )


def edge_plane_residuals(n: Array, radius: Array, a: Array) -> Array:
    """Residuals n . A + R (..., n), in m: distance of A from each edge's plane moved in by the
    radius.
    """
    return (n @ a[..., None])[..., 0] + radius


def scale_of(r: Array, present: Array) -> Array:
    """Robust standard deviation (...) from the median of |r| over the present edges, n - 3 degrees
    of freedom.
    """
    count = np.sum(present > 0, axis=-1)
    ordered = np.sort(np.where(present > 0, np.abs(r), np.inf), axis=-1)
    middle = np.where(count > 0, count // 2, 0)[..., None]
    median = np.take_along_axis(ordered, middle, axis=-1)[..., 0]
    return 1.4826 * (1 + 5 / np.maximum(count - 3, 1)) * np.maximum(median, 1e-12)


def huber_weights(x: Array) -> Array:
    """Huber weights of whitened residuals."""
    return HUBER_TUNING / np.maximum(np.abs(x), HUBER_TUNING)


def tukey_weights(x: Array) -> Array:
    """Tukey biweights of whitened residuals; 0 above 4.685."""
    return np.where(np.abs(x) < TUKEY_TUNING, (1 - (x / TUKEY_TUNING) ** 2) ** 2, 0.0)


def reweighted(
    n: Array, radius: Array, present: Array, start: Array, kind: Literal["huber", "tukey"]
) -> tuple[Array, Array, Array]:
    """Iteratively reweighted least squares from ``start`` (..., 3).

    Returns A, weights (..., n) and the inverse normal matrix. The scale is that of the start: with
    a scale estimated anew in each step, Tukey's weights diverge.
    """
    weights_of = huber_weights if kind == "huber" else tukey_weights
    a, inverse, w = start, np.zeros((*start.shape, 3)), present
    sigma = scale_of(edge_plane_residuals(n, radius, start), present)[..., None]
    for _ in range(30):
        w = present * weights_of(edge_plane_residuals(n, radius, a) / sigma)
        new, inverse = weighted_solution(n, radius, w)
        step = np.max(np.abs(np.nan_to_num(new - a)), initial=0.0)
        a = new
        if step < 1e-10:
            break
    return a, w, inverse


def least_median(
    n: Array,
    radius: Array,
    present: Array,
    rng: np.random.Generator,
    noise: Array | None = None,
    residuals_at_once: int = RESIDUALS_SORTED_TOGETHER,
) -> Array:
    """Least median of squares: the best of random triples' exact solutions, A (..., 3).

    noise : (..., n, 3, 3) covariances of the normals; residuals are then divided by their own
    standard deviations at each solution. Edges of a rod, far from A, determine A thirty times less
    than edges of its tube: in metres half of all edges are outliers to the other half. With the
    noise, A = 0, to which wrong edges pull a solution, has unbounded residuals.
    """
    # random triples of present edges, and their exact solutions
    shape = (*present.shape[:-1], RANDOM_EDGE_TRIPLES, 3)
    count = np.sum(present > 0, axis=-1)[..., None, None]
    order = np.argsort(present <= 0, axis=-1, kind="stable")
    draw = np.minimum((rng.random(shape) * count).astype(int), np.maximum(count - 1, 0))
    pick = np.take_along_axis(order[..., None, :], draw, axis=-1)
    rows = np.take_along_axis(n[..., None, :, :], pick[..., None], axis=-2)
    right = np.take_along_axis(np.broadcast_to(radius, present.shape)[..., None, :], pick, axis=-1)
    det = np.linalg.det(rows)
    good = np.abs(det) > 1e-9
    rows = np.where(good[..., None, None], rows, np.eye(3))
    a = np.linalg.solve(rows, -right[..., None])[..., 0]
    # quantile over the present edges only, so sort instead of taking a median
    half = np.minimum((count[..., 0] + 3) // 2, present.shape[-1] - 1)
    cost = np.empty(a.shape[:-1])
    # residuals of every edge for every triple, in blocks of legs that fit the memory
    each = max(residuals_at_once // (RANDOM_EDGE_TRIPLES * max(present.shape[-1], 1)), 1)
    every = a, n, np.broadcast_to(radius, present.shape), present
    a_of, n_of, radius_of, present_of = (x.reshape(-1, *x.shape[present.ndim - 1 :]) for x in every)
    half_of = half.reshape(-1, 1)
    flat = cost.reshape(-1, RANDOM_EDGE_TRIPLES)
    for first in range(0, len(flat), each):
        some = slice(first, first + each)
        r = np.abs(a_of[some] @ n_of[some].mT + radius_of[some, None])
        if noise is not None:
            square = (a_of[some, :, :, None] * a_of[some, :, None, :]).reshape(*r.shape[:2], 9)
            spread = square @ noise.reshape(len(flat), -1, 9)[some].mT
            r /= np.sqrt(np.maximum(spread, np.finfo(float).tiny))
        r = np.where((present_of[some] > 0)[:, None], r, np.inf)
        at = np.broadcast_to(half_of[some], r.shape[:2])[..., None]
        flat[some] = np.take_along_axis(np.sort(r, axis=-1), at, axis=-1)[..., 0]
    best = np.argmin(np.where(good, cost, np.inf), axis=-1)
    valid = np.take_along_axis(a, best[..., None, None], axis=-2)[..., 0, :]
    return np.where((count[..., 0] >= 3) & good.any(axis=-1, keepdims=True), valid, np.nan)


def errors_in_variables(
    n: Array, radius: Array, covariance: Array, weight: Array, start: Array
) -> tuple[Array, Array]:
    """Minimum of sum w (n.A + R)^2 / (A^T Sigma_n A): A and its covariance, (..., 3, 3).

    covariance : (..., n, 3, 3) of the normals. The noise of n.A grows with A; without it, or
    without its derivative, A is biased towards the camera. Gauss-Newton, eight steps.
    """
    a, inverse = start, np.full((*start.shape, 3), np.nan)
    for _ in range(8):
        spread = (covariance @ a[..., None, :, None])[..., 0]
        sigma = np.sqrt(np.maximum(dot(a[..., None, :], spread), 1e-300))
        r = edge_plane_residuals(n, radius, a) / sigma
        jac = (n - (r / sigma)[..., None] * spread) / sigma[..., None]
        # the step solves jac . da = -r, which is [B] 14 with other rows
        step, inverse = weighted_solution(jac, r, weight)
        a = a + step
    return a, inverse


def centres(
    machine: Machine,
    measurements: Measurements,
    method: RegressionMethod = "robust",
    rng: np.random.Generator | None = None,
) -> LinearCentres:
    """All base centres from all stations, [B] 14, with the machine's present radii.

    method : plain, huber and tukey as the paper proposes; least-median alone; robust is least
    median, then Tukey, then errors-in-variables on the inliers; errors-in-variables alone is for
    edges without outliers. rng : for the random triples; seed 0 by default.
    """
    edges = measurements.edges
    group = edges.station * machine.n_legs + edges.leg
    n_groups = measurements.n_stations * machine.n_legs
    # position of each edge in its group, padded to the largest group
    order = np.argsort(group, kind="stable")
    place = np.empty(len(group), dtype=int)
    place[order] = np.arange(len(group)) - np.searchsorted(group[order], group[order])
    width = int(place.max(initial=-1)) + 1

    def padded(values: Array) -> Array:
        out = np.zeros((n_groups, width, *values.shape[1:]))
        out[group, place] = values
        return out

    radii = machine.radii_of(edges.leg, edges.tube)
    n, present, radius = (padded(x) for x in (edges.normal, np.ones(len(edges)), radii))
    noise = padded(edges.basis @ edges.covariance @ edges.basis.mT)
    rng = np.random.default_rng(0) if rng is None else rng
    a, weight, covariance = solve_regressions(n, radius, present, noise, method, rng)
    shape = (measurements.n_stations, machine.n_legs)
    return LinearCentres(
        a.reshape(*shape, 3), covariance.reshape(*shape, 3, 3), weight[group, place]
    )


def solve_regressions(
    n: Array,
    radius: Array,
    present: Array,
    noise: Array,
    method: RegressionMethod,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Solution of many systems by one method: A, weights, covariance (see :func:`centres`)."""
    a, inverse = weighted_solution(n, radius, present)
    w = present
    if method in ("least-median", "robust"):
        stated_noise = noise if method == "robust" else None
        a = least_median(n, radius, present, rng, noise=stated_noise)
        if method == "least-median":
            return a, w, np.full((*a.shape, 3), np.nan)
    if method == "robust":
        # whitened residuals, with the standard deviations at the start
        spread = dot(a[..., None, :], (noise @ a[..., None, :, None])[..., 0])
        sigma = np.sqrt(np.maximum(np.nan_to_num(spread), np.finfo(float).tiny))
        one = np.where(present > 0, 1 / sigma, 0.0)
        a, w, _ = reweighted(n * one[..., None], radius * one, present, a, "tukey")
    if method in ("huber", "tukey"):
        a, w, inverse = reweighted(n, radius, present, a, method)
    if method in ("errors-in-variables", "robust"):
        # a clean edge may have lost most of its Tukey weight: inliers get full weight, outliers
        # none
        w = np.where(w > COUNTED_TUKEY_WEIGHT, 1.0, 0.0) * present
        a, covariance = errors_in_variables(n, radius, noise, w, a)
        return a, w, covariance
    sigma = scale_of(edge_plane_residuals(n, radius, a), present)
    return a, w, inverse * sigma[..., None, None] ** 2


def scale_ratio(points: Array, nominal: Array) -> float:
    """[B] 16 as printed: mean ratio of the distances; divide the points by it.

    points, nominal : (n, 3). Close pairs dominate the mean, and their ratio is the noisiest.
    """
    i, j = np.triu_indices(len(points), 1)
    measured = np.linalg.norm(points[i] - points[j], axis=-1)
    return float(np.mean(measured / np.linalg.norm(nominal[i] - nominal[j], axis=-1)))


def procrustes_scale(points: Array, nominal: Array) -> float:
    """Scale r of the similarity that fits the nominal model to the points; divide the points by it.

    points, nominal : (n, 3). Maximum over rotations of the least-squares scale: sum of the singular
    values over the nominal model's sum of squares (Umeyama).
    """
    p, d = points - points.mean(axis=0), nominal - nominal.mean(axis=0)
    u, s, vt = np.linalg.svd(p.T @ d)
    s[-1] *= np.sign(np.linalg.det(u @ vt))
    return float(s.sum() / np.sum(d**2))
