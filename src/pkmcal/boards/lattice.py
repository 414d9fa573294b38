"""Lattices of points in an image, such as the circles of a board: an integer place for each point.

A lattice grows from a block of 3 x 3 points: from a point and the steps of its neighbours the next
points are predicted, so that perspective and distortion may change the steps from place to place. A
block is accepted by its number of false alarms, as blocks of chessboard corners are
(:mod:`pkmcal.boards.saddles`). The cost grows as the number of points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.boards.saddles import LATTICE
from pkmcal.levels import FALSE_ALARM

SIDES = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
"""The four neighbours of a lattice point."""


@dataclass(frozen=True)
class LatticeOptions:
    """Constants of the search for lattices."""

    # expected number of blocks by chance, among points uniformly distributed in an image
    false_alarms: float = FALSE_ALARM
    # nearest points among which the ends of the two steps of a block are searched; a board tilted
    # by 75 degrees has six in a row before the first beside it
    nearest: int = 12
    # largest cosine of the angle between the two steps: the shortest two of a lattice have at most
    # 1 / 2, and perspective adds a little
    most_parallel: float = 0.75
    # distance from its predicted place within which a point belongs to the lattice, in the shorter
    # step: nearer to its own place than to the middle between two
    reach: float = 0.25


LATTICE_OPTIONS = LatticeOptions()


class Lattice(NamedTuple):
    """Points of a lattice: their numbers (n,) among all, and integer places (n, 2) along two steps,
    of which the second is clockwise of the first in the image.
    """

    points: Integers
    cells: Integers


def lattices(places: Array, options: LatticeOptions = LATTICE_OPTIONS) -> Iterator[Lattice]:
    """Lattices among points (N, 2) px that share none, from the densest block on."""
    from scipy.spatial import KDTree

    if len(places) <= len(LATTICE) + 2:
        return
    tree = KDTree(places)
    free = np.ones(len(places), dtype=bool)
    for middle, steps in zip(*_blocks(places, tree, options), strict=True):
        if free[middle]:
            lattice = _grown(places, tree, free, int(middle), steps, options)
            free[lattice.points] = False
            yield lattice


def _blocks(places: Array, tree: Any, options: LatticeOptions) -> tuple[Integers, Array]:
    """Middles (k,) and steps (k, 2, 2) px of blocks of 3 x 3 points.

    In order of the points in one cell of the block's lattice, by the density around the middle:
    there is one, more in a block that skips points.
    """
    count = min(options.nearest, len(places) - 1)
    distance, nearest = tree.query(places, k=count + 1)
    first, second = np.triu_indices(count, 1)
    middle = np.repeat(np.arange(len(places)), len(first))
    ends = np.stack([nearest[:, 1 + first], nearest[:, 1 + second]], axis=-1).reshape(-1, 2)
    steps = places[ends] - places[middle, None]
    length = np.linalg.norm(steps, axis=-1)
    across = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
    along = np.abs(np.sum(steps[:, 0] * steps[:, 1], axis=-1))
    usable = np.flatnonzero(along <= options.most_parallel * length.prod(axis=-1))
    middle, ends, steps = middle[usable], ends[usable], steps[usable]
    steps = np.where((across[usable] < 0)[:, None, None], steps[:, ::-1], steps)
    # The points nearest to the places of the other six, and their distances.
    miss, others = tree.query(places[middle, None] + LATTICE @ steps)
    corners = np.sort(np.column_stack([middle, ends, others]), axis=1)
    density = count / (np.pi * distance[middle, -1] ** 2)
    # a disc of whole pixels: a distance of 0 is that of one pixel
    expected = density * np.pi * (miss.max(axis=1) + np.pi**-0.5) ** 2
    chance = np.minimum(expected, 1.0) ** len(LATTICE)
    tests = len(places) * len(first)
    accepted = (tests * chance < options.false_alarms) & np.diff(corners, axis=1).all(axis=1)
    skipped = (np.abs(across[usable]) * density)[accepted]
    chosen = np.flatnonzero(accepted)[np.argsort(skipped, kind="stable")]
    return middle[chosen], steps[chosen]


def _grown(
    places: Array, tree: Any, free: Array, seed: int, start: Array, options: LatticeOptions
) -> Lattice:
    """The lattice of a point and its two steps (2, 2) px, grown wave by wave."""
    point_at = {(0, 0): seed}
    cell_of, steps = {seed: (0, 0)}, {seed: start}
    front: list[int] = [seed]
    while front:
        moves = np.stack([SIDES @ steps[k] for k in front])
        # steps change as they did before, under perspective and distortion
        for k, point in enumerate(front):
            for side, (di, dj) in enumerate(SIDES.tolist()):
                i, j = cell_of[point]
                last, first = (point_at.get((i - n * di, j - n * dj)) for n in (1, 2))
                if last is not None and first is not None:
                    change = places[point] - 2 * places[last] + places[first]
                    moves[k, side] = places[point] - places[last] + change
        miss, nearest = tree.query(places[front, None] + moves)
        reach = [options.reach * np.linalg.norm(steps[k], axis=-1).min() for k in front]
        hits = np.argwhere(miss < np.array(reach)[:, None])
        before = front
        front = []
        # the nearest to its predicted place first
        for k, side in hits[np.argsort(miss[tuple(hits.T)], kind="stable")].tolist():
            point, source = int(nearest[k, side]), before[k]
            i, j = np.add(cell_of[source], SIDES[side]).tolist()
            if point in cell_of or (i, j) in point_at or not free[point]:
                continue
            point_at[i, j], cell_of[point] = point, (i, j)
            steps[point] = steps[source]
            front.append(point)
        # steps to the neighbours that have their places
        for point in front:
            i, j = cell_of[point]
            own = steps[point].copy()
            for di, dj in SIDES.tolist():
                other = point_at.get((i + di, j + dj))
                if other is not None:
                    own[abs(dj)] = (places[other] - places[point]) * (di + dj)
            steps[point] = own
    return Lattice(np.array(list(cell_of)), np.array(list(cell_of.values())))
