"""Picture edges of one station's photographs, ready to be looked up: how far is the nearest?

Photographs are reduced, picture edges found, and for each of a few directions the distance to
the nearest edge of about that direction is tabulated. A predicted silhouette then scores by the
distances under its points, smooth enough to be descended from a hundred pixels away. Where a
station took several photographs, edges that never move are left out: the floor and the wall do
not say where the machine is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

DIRECTIONS = 8
"""Edge directions told apart; each table takes the neighbouring directions in as well."""
WORKING_WIDTH = 256
"""Width in pixels that photographs are reduced to: fine enough for a leg's two edges to stay
apart, coarse enough to search quickly."""
STILL = 5.0
"""Levels from the station's median photograph within which a place counts as still."""
ENOUGH_TO_COMPARE = 4
"""Photographs from which a median is a picture of the background."""
CANNY = (20, 40)
"""Sobel slopes from which an edge goes on and begins: five times what the noise of a level, that a
reduced photograph has at most, makes of it; from half of that to the double, little changes."""
FURTHEST = 32.0
"""Reduced pixels beyond which distances are not told apart."""
BIN = 0.5
"""Reduced pixels of a bin of the distances that chance gives."""


class PictureEdges(NamedTuple):
    """Edge points of one reduced photograph: pixel (n, 2), reduced px, and unit normal (n, 2)."""

    pixel: Array
    normal: Array


@dataclass(frozen=True)
class DistanceTables:
    """Distances in reduced pixels, (T, DIRECTIONS, h, w), and the reduction factor.

    row : (K,) each photograph's table. edges : of each photograph. moving : (h, w) share of the
    photographs in which each place differs from the others; where a single one cannot tell, where
    it has edges. chance : (DIRECTIONS, bins) of BIN: how often a place taken anywhere has that
    distance.
    """

    tables: Array
    row: Integers
    scale: float
    edges: tuple[PictureEdges, ...]
    moving: Array
    chance: Array

    def direction(self, normal: Array) -> Integers:
        """Direction number of edges whose image normals are (..., 2)."""
        return direction_of(normal, self.tables.shape[1])

    def look(
        self, direction: Integers, pixel: Array, photograph: Integers
    ) -> tuple[Array, Booleans]:
        """Distances (reduced px) at full-size pixels (..., 2), and which lie in the photograph.

        direction, photograph : (...) table numbers. Nearest table entry; callers that need a
        slope look on both sides.
        """
        height, width = self.tables.shape[-2:]
        with np.errstate(invalid="ignore"):
            place = (pixel + 0.5) / self.scale - 0.5
            inside = (place[..., 0] >= 0) & (place[..., 0] <= width - 1)
            inside &= (place[..., 1] >= 0) & (place[..., 1] <= height - 1)
        x, y = (np.where(inside, np.rint(place[..., i]), 0).astype(np.intp) for i in (0, 1))
        return self.tables[self.row[photograph], direction, y, x], inside

    def look_smooth(
        self, direction: Integers, pixel: Array, photograph: Integers
    ) -> tuple[Array, Booleans]:
        """As :meth:`look`, bilinear between table entries."""
        height, width = self.tables.shape[-2:]
        with np.errstate(invalid="ignore"):
            place = (pixel + 0.5) / self.scale - 0.5
            inside = (place[..., 0] >= 0) & (place[..., 0] < width - 1)
            inside &= (place[..., 1] >= 0) & (place[..., 1] < height - 1)
        place = np.where(inside[..., None], place, 0.0)
        corner = np.floor(place).astype(np.intp)
        fx, fy = (place[..., i] - corner[..., i] for i in (0, 1))
        table = self.row[photograph] * self.tables.shape[1] + direction
        at = (table * height + corner[..., 1]) * width + corner[..., 0]
        entries = self.tables.reshape(-1)
        upper = (1 - fx) * entries.take(at) + fx * entries.take(at + 1)
        lower = (1 - fx) * entries.take(at + width) + fx * entries.take(at + width + 1)
        return (1 - fy) * upper + fy * lower, inside

    def by_chance(self, direction: Integers, found: Array) -> Array:
        """How often (a share a reduced pixel) places taken anywhere have distances (...)."""
        last = self.chance.shape[1] - 1
        return self.chance[direction, np.minimum(found / BIN, last).astype(np.intp)]

    def select(self, photographs: Integers) -> DistanceTables:
        """Of some of the photographs; what moves and what chance gives, as all show it."""
        edges = tuple(self.edges[k] for k in photographs)
        return replace(self, row=self.row[photographs], edges=edges)

    def mirrored(self) -> DistanceTables:
        """Of the photographs with left and right exchanged."""
        width = self.tables.shape[-1]
        # the direction a becomes pi - a
        edges = (
            PictureEdges(e.pixel * (-1, 1) + (width - 1, 0), e.normal * (-1, 1)) for e in self.edges
        )
        return DistanceTables(
            np.ascontiguousarray(self.tables[:, ::-1, :, ::-1]),
            self.row,
            self.scale,
            tuple(edges),
            self.moving[:, ::-1],
            self.chance[::-1],
        )


def direction_of(normal: Array, count: int = DIRECTIONS) -> Integers:
    """Direction number, of ``count``, of edges whose image normals are (..., 2); the sign does not
    matter.
    """
    angle = np.arctan2(normal[..., 1], normal[..., 0]) % np.pi
    number = np.floor(np.nan_to_num(angle) * (count / np.pi))
    return number.astype(np.intp) % count


def distances(
    pixel: Integers, number: Integers, shape: tuple[int, int], count: int = DIRECTIONS
) -> Array:
    """Distance tables (DIRECTIONS, h, w) of edge points at whole pixels (n, 2), x first.

    number : (n,) their directions. shape : (h, w).
    """
    import cv2

    tables = np.empty((count, *shape), dtype=np.float32)
    for k in range(count):
        near = np.isin(number, [(k - 1) % count, k, (k + 1) % count])
        mask = np.ones(shape, dtype=np.uint8)
        mask[pixel[near, 1], pixel[near, 0]] = 0
        tables[k] = cv2.distanceTransform(mask, cv2.DIST_L2, 3) if near.any() else 1e3
    return tables


def distance_tables(
    images: Sequence[Integers],
    width: int = WORKING_WIDTH,
    directions: int = DIRECTIONS,
) -> DistanceTables:
    """Tables of one station's photographs, K arrays (height, width) uint8 of one size."""
    import cv2

    small: list[Integers] = []
    scale = 1.0
    for image in images:  # each is decoded once, and only its reduction kept
        scale = max(image.shape[1] / width, 1.0)
        size = (round(image.shape[1] / scale), round(image.shape[0] / scale))
        small.append(_levels(cv2.resize(image, size, interpolation=cv2.INTER_AREA)))
    still = np.median(np.stack(small), axis=0) if len(small) >= ENOUGH_TO_COMPARE else None
    edges = tuple(_edges_of(image, still) for image in small)
    shape = small[0].shape
    tables = np.empty((len(small), directions, *shape), dtype=np.float32)
    for table, e in zip(tables, edges, strict=True):
        number = direction_of(e.normal, directions)
        table[:] = distances(e.pixel.astype(int), number, shape, directions)
    row = np.arange(len(small))
    return DistanceTables(tables, row, scale, edges, _moving(small, still, edges), _chance(tables))


def _levels(image: Any) -> Integers:
    """Grey levels (h, w) whose noise is even: a sensor's grows with the root of the light. So a
    dark machine before a dark wall stands out as a bright one does in the sun.
    """
    return np.rint(np.sqrt(255.0 * image.astype(np.float32))).astype(np.uint8)


def _edges_of(image: Any, still: Array | None) -> PictureEdges:
    """Edge points of one reduced photograph."""
    import cv2

    dx = cv2.Sobel(image, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(image, cv2.CV_16S, 0, 1)
    edges = cv2.Canny(dx, dy, *CANNY) > 0
    if still is not None:
        moving = (np.abs(image - still) > STILL).astype(np.uint8)
        edges &= cv2.dilate(moving, np.ones((3, 3), np.uint8)) > 0
    y, x = np.nonzero(edges)
    normal = np.stack([dx[y, x], dy[y, x]], axis=-1).astype(float)
    return PictureEdges(
        np.stack([x, y], axis=-1).astype(float),
        normal / np.hypot(normal[:, 0], normal[:, 1])[:, None],
    )


def _moving(small: list[Integers], still: Array | None, edges: tuple[PictureEdges, ...]) -> Array:
    """Share (h, w) of the photographs in which each place differs from the others."""
    if still is not None:
        return np.mean([np.abs(image - still) > STILL for image in small], axis=0)
    if len(small) > 1:
        return (np.ptp(np.stack(small).astype(float), axis=0) > STILL).astype(float)
    out = np.zeros(small[0].shape)
    x, y = edges[0].pixel.astype(int).T
    out[y, x] = 1.0
    return out


def _chance(tables: Array) -> Array:
    """How often each distance occurs, (DIRECTIONS, bins), a share a reduced pixel."""
    bins = np.arange(0.0, FURTHEST + BIN, BIN)
    count = np.stack(
        [
            np.histogram(np.minimum(tables[:, k], FURTHEST - BIN / 2), bins)[0]
            for k in range(tables.shape[1])
        ]
    )
    count = count + 1.0  # a distance that no place has is not impossible
    return count / count.sum(axis=1, keepdims=True) / BIN
