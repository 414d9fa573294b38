"""Configurations grouped by where the platform is: spread ones, and regions to leave out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.mechanisms import Machine

ROUNDS = 100
STANDS_OUT = 0.7
"""Standard deviations of the whole workspace by which a region must lie off its middle to be named
by that direction."""
AXES = (
    ("turned about −x", "turned about +x"),
    ("turned about −y", "turned about +y"),
    ("turned about −z", "turned about +z"),
    ("towards −x", "towards +x"),
    ("towards −y", "towards +y"),
    ("low", "high"),
)


@dataclass(frozen=True)
class Region:
    """rows : (n,) configurations. name : where it is, in words."""

    rows: Integers
    name: str


def places(machine: Machine, poses: Array) -> Array:
    """Where poses (n, 4, 4) are, as points (n, 6) in metres: turns times the platform's radius,
    then positions; both from the mean.
    """
    joints = machine.platform_centers()
    radius = float(np.sqrt(np.mean(np.sum((joints - joints.mean(axis=0)) ** 2, axis=1))))
    turns = rotation_vector(poses[:, :3, :3] @ poses[0, :3, :3].T)
    out = np.concatenate([turns * radius, poses[:, :3, 3]], axis=1)
    return out - out.mean(axis=0)


def clusters(points: Array, n: int) -> Integers:
    """Number (k,) of each point's cluster: k-means, begun at points far from one another.

    No random draw: the same points give the same clusters.
    """
    centres = points[[int(np.argmax(np.sum(points**2, axis=1)))]]
    for _ in range(n - 1):
        far = _distances(points, centres).min(axis=1)
        centres = np.concatenate([centres, points[[int(np.argmax(far))]]])
    owner = np.argmin(_distances(points, centres), axis=1)
    for _ in range(ROUNDS):
        inside = owner[:, None] == np.arange(n)
        centres = (inside.T @ points) / np.maximum(inside.sum(axis=0), 1)[:, None]
        new = np.argmin(_distances(points, centres), axis=1)
        if np.array_equal(new, owner) or len(np.unique(new)) < n:
            break
        owner = new
    return owner


def spread(points: Array, n: int) -> Integers:
    """Some points, n in rising order, spread over all: the middle one of each of n clusters."""
    owner = clusters(points, n)
    chosen: list[int] = []
    for k in range(n):
        rows = np.flatnonzero(owner == k)
        middle = points[rows].mean(axis=0)
        chosen.append(int(rows[np.argmin(np.sum((points[rows] - middle) ** 2, axis=1))]))
    return np.sort(np.array(chosen))


def regions(points: Array, rows: Integers, n: int) -> tuple[Region, ...]:
    """The regions, n, of configurations ``rows`` at points (k, 6), see :func:`places`."""
    owner = clusters(points, n)
    scale = points.std(axis=0)
    scale = np.where(scale > 1e-6, scale, np.inf)  # a direction in which nothing moves
    found = [np.flatnonzero(owner == k) for k in range(n)]
    return tuple(
        Region(rows[own], _named(points[own].mean(axis=0) / scale)) for own in found if own.size
    )


def _named(middle: Array) -> str:
    """A region by the two directions in which it lies off the middle the most."""
    order = np.argsort(-np.abs(middle))[:2]
    words = [AXES[k][int(middle[k] > 0)] for k in order if abs(middle[k]) > STANDS_OUT]
    return ", ".join(words) or "the middle"


def _distances(points: Array, centres: Array) -> Array:
    """Squared distances (k, n)."""
    return np.sum((points[:, None] - centres) ** 2, axis=-1)
