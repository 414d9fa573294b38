"""Edge positions along predicted edges to planes: one normal and covariance an edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot
from pkmcal.observe.edges import EdgeSet
from pkmcal.observe.predict import EdgePoints, TubeList

FLOOR = 0.02
"""Pixels below which no position is believed, however crisp the profile."""
HALVES = 2.0
"""Independent measurements that an edge counts as, whatever its length. Shading and paint move
all positions along an edge together, so they do not average out: an edge is one line measured
once at each of two halves, not three hundred points."""
FEWEST = 3
"""Places along an edge without which its tilt is a guess."""


@dataclass(frozen=True)
class EdgeFits:
    """Planes fitted to positions along edges; all (K, E, ...).

    turn : (2,) of the normal in ``basis`` (3, 2). covariance : (2, 2). operator : (2, n) turn by
    the positions at the n samples, with the final weights. used : samples taken as the edge's.
    good : enough of them.
    """

    turn: Array
    basis: Array
    covariance: Array
    operator: Array
    used: Booleans
    good: Booleans


def fit_edges(
    points: EdgePoints, position: Array, sigma: Array, found: Booleans, rounds: int = 8
) -> EdgeFits:
    """Robust weighted line through positions (K, E, n) px outward, in the plane's two turns.

    Cauchy weights against positions on highlights and neighbours. The scatter about the fit,
    where it exceeds the stated sigmas, enlarges the covariance.
    """
    middle = _middle_ray(points)
    basis = tangent_basis(points.normal, middle)
    rows = np.where(found[..., None], np.nan_to_num(points.by_normal() @ basis), 0.0)
    value = np.where(found, position, 0.0)
    base = np.where(found, 1 / (sigma**2 + FLOOR**2), 0.0)
    turn, normal = _weighted(rows, value, base)
    off2 = _squared_misfit(rows, value, turn, base)
    weight = base
    for _ in range(rounds):
        weight = base / (1 + off2 / 4.0)  # Cauchy, two sigmas
        turn, normal = _weighted(rows, value, weight)
        off2 = _squared_misfit(rows, value, turn, base)
    used = found & (off2 < 9.0)
    count = used.sum(axis=-1)
    scatter = np.sum(used * off2, axis=-1) / np.maximum(count - 2, 1)
    factor = np.maximum(scatter, 1.0) * np.maximum(count / HALVES, 1.0)
    covariance = np.linalg.inv(normal) * factor[..., None, None]
    operator = np.linalg.solve(normal, np.swapaxes(rows * weight[..., None], -1, -2))
    good = (count >= FEWEST) & (count >= 0.5 * found.sum(axis=-1))
    good &= np.isfinite(covariance).all(axis=(-1, -2))
    return EdgeFits(turn, basis, covariance, operator, used, good)


def _middle_ray(points: EdgePoints) -> Array:
    ray = points.point[..., points.point.shape[-2] // 2, :]
    return ray / np.sqrt(dot(ray, ray))[..., None]


def _squared_misfit(rows: Array, value: Array, turn: Array, base: Array) -> Array:
    return (value - (rows @ turn[..., None])[..., 0]) ** 2 * base


def _weighted(rows: Array, value: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares of value (..., n) on rows (..., n, 2): solution and normal matrix."""
    weighted = np.swapaxes(rows * weight[..., None], -1, -2)
    normal = weighted @ rows
    ridge = 1e-12 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] + 1e-30
    normal = normal + ridge * np.eye(2)
    return np.linalg.solve(normal, weighted @ value[..., None])[..., 0], normal


def edge_set(
    points: EdgePoints,
    fits: EdgeFits,
    tubes: TubeList,
    station: int,
    configuration: Integers,
    keep: Booleans,
    by_parameters: Array | None = None,
) -> EdgeSet:
    """The fits at ``keep`` (K, E) as measurements; configuration : (K,) of the photographs.

    by_parameters : (K, E, n, 2, p) motion of the predicted pixels by the camera's parameters,
    where the intrinsics are to be refined: the measured places then move the other way.
    """
    k, e = np.nonzero(keep)
    basis = fits.basis[k, e]
    normal = points.normal[k, e] + (basis @ fits.turn[k, e, :, None])[..., 0]
    normal /= np.sqrt(dot(normal, normal))[:, None]
    middle = _middle_ray(points)[k, e]
    along = np.where(fits.used[k, e], points.along[k, e], np.nan)
    return EdgeSet(
        station=np.full(len(k), station),
        configuration=configuration[k],
        leg=tubes.leg[e],
        tube=tubes.tube[e],
        side=tubes.side[e],
        normal=normal,
        # the turn is a few milliradians: the same two coordinates serve at the turned normal
        basis=tangent_basis(normal, middle),
        covariance=fits.covariance[k, e],
        shift=fits.operator[k, e].sum(axis=-1),
        span=np.stack([np.nanmin(along, axis=1), np.nanmax(along, axis=1)], axis=1),
        by_intrinsics=_by_intrinsics(points, fits, by_parameters)[k, e],
    )


def _by_intrinsics(points: EdgePoints, fits: EdgeFits, by_parameters: Array | None) -> Array:
    """Turn of the fitted planes by the camera's parameters, the pixels held; (K, E, 2, p)."""
    if by_parameters is None:
        return np.zeros((*fits.turn.shape, 0))
    outward = (points.outward[..., None, :] @ by_parameters)[..., 0, :]
    used = fits.used[..., None] & np.isfinite(outward)
    return -fits.operator @ np.where(used, outward, 0.0)
