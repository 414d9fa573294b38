"""Distance to the nearest picture edge of a given direction: what the coarse search looks at.

Photographs are reduced, picture edges found, and for each of a few directions the distance to
the nearest edge of about that direction is tabulated. A predicted silhouette then scores by the
distances under its points, smooth enough to be descended from a hundred pixels away. Where a
station took several photographs, edges that never move are left out: the floor and the wall do
not say where the machine is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

DIRECTIONS = 8
"""Edge directions told apart; each table takes the neighbouring directions in as well."""
WORKING_WIDTH = 256
"""Width in pixels that photographs are reduced to: fine enough for a leg's two edges to stay
apart, coarse enough to search quickly."""
STILL = 10.0
"""Grey levels from the station's median photograph within which a place counts as still."""
ENOUGH_TO_COMPARE = 4
"""Photographs from which a median is a picture of the background."""


@dataclass(frozen=True)
class DistanceTables:
    """Distances in reduced pixels, (K, DIRECTIONS, h, w), and the reduction factor."""

    tables: Array
    scale: float

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
        return self.tables[photograph, direction, y, x], inside

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
        x, y = corner[..., 0], corner[..., 1]
        at = self.tables
        upper = (1 - fx) * at[photograph, direction, y, x]
        upper = upper + fx * at[photograph, direction, y, x + 1]
        lower = (1 - fx) * at[photograph, direction, y + 1, x]
        lower = lower + fx * at[photograph, direction, y + 1, x + 1]
        return (1 - fy) * upper + fy * lower, inside


def direction_of(normal: Array) -> Integers:
    """Direction number of edges whose image normals are (..., 2); the sign does not matter."""
    angle = np.arctan2(normal[..., 1], normal[..., 0]) % np.pi
    number = np.floor(np.nan_to_num(angle) * (DIRECTIONS / np.pi))
    return number.astype(np.intp) % DIRECTIONS


def distance_tables(images: list[Integers]) -> DistanceTables:
    """Tables of one station's photographs, K arrays (height, width) uint8 of one size."""
    import cv2

    scale = max(images[0].shape[1] / WORKING_WIDTH, 1.0)
    size = (round(images[0].shape[1] / scale), round(images[0].shape[0] / scale))
    small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    still = np.median(np.stack(small), axis=0) if len(small) >= ENOUGH_TO_COMPARE else None
    return DistanceTables(np.stack([_tables_of(image, still) for image in small]), scale)


def _tables_of(image: Any, still: Array | None) -> Array:
    """Distance tables (DIRECTIONS, h, w) of one reduced photograph."""
    import cv2

    dx = cv2.Sobel(image, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(image, cv2.CV_16S, 0, 1)
    # weak edges count too: a dark rod before a dark wall differs by a few grey levels
    edges = cv2.Canny(dx, dy, 40, 80) > 0
    if still is not None:
        moving = (np.abs(image - still) > STILL).astype(np.uint8)
        edges &= cv2.dilate(moving, np.ones((3, 3), np.uint8)) > 0
    y, x = np.nonzero(edges)
    number = direction_of(np.stack([dx[y, x], dy[y, x]], axis=-1).astype(np.float32))
    tables = np.empty((DIRECTIONS, *image.shape), dtype=np.float32)
    for k in range(DIRECTIONS):
        near = np.isin(number, [(k - 1) % DIRECTIONS, k, (k + 1) % DIRECTIONS])
        mask = np.ones(image.shape, dtype=np.uint8)
        mask[y[near], x[near]] = 0
        tables[k] = cv2.distanceTransform(mask, cv2.DIST_L2, 3) if near.any() else 1e3
    return tables
