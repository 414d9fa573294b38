"""Small motions of legs and camera seen in the legs' edges: what made repeats differ.

N edges of one station, each of a cylinder from a to b. A motion of the two ends turns the edge's
plane, so the turns of several edges tell the motion of what they belong to: one leg's its axis'
([A] 4.2: psi, theta, x, z), all legs' that of the camera or of the platform.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import cross, dot, skew
from pkmcal.observe.edges import EdgeSet
from pkmcal.observe.repeats import Groups

LEVEL = float(np.sin(np.deg2rad(10.0)))
"""Part u_y of an axis below which it is level in the image: its point with y = 0 ([A] 4.2) lies
far away or nowhere (errata)."""
_RANK = 1e-9
"""Singular values below this part of the largest are those of motions that no edge shows."""


@dataclass(frozen=True)
class Cylinders:
    """The legs of N edges: ends a, b (N, 3) of the axes, camera frame, and radii (N,), m."""

    a: Array
    b: Array
    radius: Array


def half_angles(edges: EdgeSet, legs: Cylinders) -> Array:
    """Half the angle (N,), rad, under which the camera sees an edge's length."""
    d = legs.b - legs.a
    u = d / np.sqrt(dot(d, d))[:, None]
    first, last = (legs.a + edges.span[:, k, None] * u for k in (0, 1))
    return np.arctan2(np.linalg.norm(cross(first, last), axis=-1), dot(first, last)) / 2


def by_ends(edges: EdgeSet, basis: Array, legs: Cylinders) -> Array:
    """Turn of the edges, in tangent bases (N, 3, 2), by motions of a and b: (N, 2, 6), rad/m."""
    e = edge_normal_jacobians(legs.a, legs.b, legs.radius, edges.side)
    return np.swapaxes(basis, 1, 2) @ np.concatenate([e.dn_da, e.dn_db], axis=-1)


def by_camera(ends: Array, legs: Cylinders) -> Array:
    """Turn (N, 2, 6) by six numbers (omega, tau) of the camera, from that by the ends."""
    return ends[..., :3] @ _rigid(legs.a) + ends[..., 3:] @ _rigid(legs.b)


def by_platform(ends: Array, legs: Cylinders) -> Array:
    """Turn (N, 2, 6) by six numbers (omega, tau) of the platform about the b ends' middle."""
    return ends[..., 3:] @ _rigid(legs.b - legs.b.mean(axis=0))


def _rigid(points: Array) -> Array:
    """Motion of points (N, 3) by (omega, tau): omega x p + tau, (N, 3, 6)."""
    eye = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([-skew(points), eye], axis=-1)


@dataclass(frozen=True)
class Fit:
    """Motions that explain edges' turns best, by group.

    motion : (G, p). explained, total : sums of squared whitened turns. rank : (G,) freedoms used.
    """

    motion: Array
    explained: Array
    total: Array
    rank: Array


def fit_motions(turn: Array, rows: Array, whiten: Array, groups: Groups) -> Fit:
    """Least squares, by group, of turns (N, 2) on rows (N, 2, p), both whitened by (N, 2, 2).

    Motions that no edge shows stay zero.
    """
    white = (whiten @ turn[..., None])[..., 0]
    rows = whiten @ rows
    normal = groups.total(np.swapaxes(rows, 1, 2) @ rows)
    right = groups.total((white[:, None, :] @ rows)[:, 0])
    values, axes = np.linalg.eigh(normal)
    seen = values > _RANK * values[:, -1:]
    along = (np.swapaxes(axes, 1, 2) @ right[..., None])[..., 0]
    along = np.where(seen, along / np.where(seen, values, 1.0), 0.0)
    motion = (axes @ along[..., None])[..., 0]
    total = groups.total(dot(white, white))
    return Fit(motion, dot(motion, right), total, seen.sum(axis=1))


def axis_coordinates(motion: Array, a: Array, b: Array) -> Array:
    """Change (G, 4) of psi, theta (rad), x, z (m) by motions (G, 6) of an axis' ends a, b (G, 3).

    To first order; the coordinates of papers.axis_measurements.to_coordinates. x and z are NaN
    for a leg that is level in the image, which has no point with y = 0.
    """
    d = b - a
    length = np.sqrt(dot(d, d))[:, None]
    u = d / length
    step = motion[:, 3:] - motion[:, :3]
    du = (step - dot(step, u)[:, None] * u) / length
    across = np.hypot(u[:, 0], u[:, 1])
    psi = (u[:, 0] * du[:, 1] - u[:, 1] * du[:, 0]) / across**2
    theta = du[:, 2] / across
    uy = np.where(np.abs(u[:, 1]) < LEVEL, np.nan, u[:, 1])[:, None]
    ay, day, duy = a[:, 1, None], motion[:, 1, None], du[:, 1, None]
    point = motion[:, :3] - day / uy * u + ay / uy**2 * duy * u - ay / uy * du
    return np.stack([psi, theta, point[:, 0], point[:, 2]], axis=-1)
