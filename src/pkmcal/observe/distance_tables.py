"""Distance tables of one station's images: distances to the nearest image edge of each direction.

Images are reduced and their edges detected. For each of a few directions, the distance of every
pixel to the nearest edge of about that direction is tabulated on first use. A predicted silhouette
is then scored by the distances under its points; the distances vary smoothly enough for a descent
from a hundred pixels away. Where a station has several images, edges that are the same in all of
them are left out: the floor and the wall carry no information about the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans, Integers
from pkmcal.observe.grey_levels import MOST_ROWS_INTERPOLATED, interpolated


@dataclass(frozen=True)
class DistanceTableOptions:
    """Constants of the distance tables; lengths in reduced pixels."""

    # width to which images are reduced: fine enough to separate the two edges of a leg, coarse
    # enough for a fast search
    width: int = 256
    # number of edge directions; each table includes the neighbouring directions
    directions: int = 8
    # largest difference in grey levels from the station's median image at which a pixel counts as
    # static: five times the noise of one level, the most in a reduced image
    still: float = 5.0
    # fewest images whose median is taken as the background
    enough: int = 4
    # Canny thresholds on the Sobel slope, lower and upper: five times the slope caused by a noise
    # of one level, the most in a reduced image. Half or twice these values change little
    # (measured)
    canny: tuple[int, int] = (20, 40)
    # distance beyond which distances share one bin of the chance histogram
    furthest: float = 32.0
    # width of a bin of the histogram of chance distances
    bin_width: float = 0.5


DISTANCE_TABLE_OPTIONS = DistanceTableOptions()

NO_EDGE_DISTANCE = 1e3
"""Distance, in reduced pixels, where an image has no edge of a direction: stands for infinity."""


class PictureEdges(NamedTuple):
    """Edge points of one reduced image: pixel (n, 2), reduced px, and unit normal (n, 2)."""

    pixel: Array
    normal: Array


@dataclass(frozen=True)
class DirectionTables:
    """Distance tables of K images by edge direction, each computed on first use.

    The silhouettes of most machines have about half of the directions.

    place, number : for each image the flat pixel indices (n,) of its edge points, row by row, and
        their direction numbers (n,).
    picture : (rows, h, columns, directions, w). The tables of image n are at row n % rows and
        column n // rows.
    chance : (directions, bins) density of the distances of arbitrary pixels, in bins of
        the options' width.
    ready : (directions,) whether table and density of a direction are computed.
    """

    place: tuple[Integers, ...]
    number: tuple[Integers, ...]
    picture: Array
    chance: Array
    ready: Booleans
    options: DistanceTableOptions

    @classmethod
    def of_edges(
        cls,
        place: Sequence[Integers],
        number: Sequence[Integers],
        size: tuple[int, int],
        options: DistanceTableOptions,
    ) -> DirectionTables:
        """Tables of given edge points, none computed yet; size : height, width."""
        (height, width), directions = size, options.directions
        rows = min(len(place), MOST_ROWS_INTERPOLATED // height)
        columns = -(-len(place) // rows)
        picture = np.zeros((rows, height, columns, directions, width), dtype=np.float32)
        bins = round(options.furthest / options.bin_width)
        chance = np.zeros((directions, bins), dtype=np.float32)
        ready = np.zeros(directions, dtype=bool)
        return cls(tuple(place), tuple(number), picture, chance, ready, options)

    def get_ready(self, direction: Integers) -> None:
        """Compute the tables of directions (...) that are still missing."""
        if self.ready.take(direction).all():
            return
        missing = [k for k in np.unique(direction) if not self.ready[k]]
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(self._work_out, missing))

    def _work_out(self, direction: int) -> None:
        """Compute the table and the chance density of one direction."""
        import cv2

        rows, taken_in = len(self.picture), bin_neighbours(direction, len(self.ready))
        bins = self.chance.shape[1]
        counted = np.ones(bins)  # a distance that does not occur is not impossible
        for n, (place, number) in enumerate(zip(self.place, self.number, strict=True)):
            table = self.picture[n % rows, :, n // rows, direction]
            write_distances(place[taken_in.take(number)], table)
        # many images in one operation, for threads wait for each other in Python
        for first in range(0, len(self.place), rows):
            tables = self.picture[: len(self.place) - first, :, first // rows, direction]
            # every second pixel of every second row: with fewer, the chance densities would differ
            # between hypotheses about one image
            bin_number = tables[:, ::2, ::2] * np.float32(1 / self.options.bin_width)
            bin_number = np.minimum(bin_number, bins - 1).astype(np.uint16).reshape(1, -1)
            counted += cv2.calcHist([bin_number], [0], None, [bins], [0, bins]).ravel()
        self.chance[direction] = counted / counted.sum() / self.options.bin_width
        self.ready[direction] = True  # last, because other threads read it

    def mirrored(self) -> DirectionTables:
        """Tables of the images with left and right exchanged, none computed yet."""
        _, height, _, directions, width = self.picture.shape
        place = [p + width - 1 - 2 * (p % width) for p in self.place]
        # direction a becomes pi - a
        number = [directions - 1 - n for n in self.number]
        return self.of_edges(place, number, (height, width), self.options)


@dataclass(frozen=True)
class DistanceTables:
    """Distance tables, in reduced pixels, of some images of a station.

    row : (K,) each image's number in the tables.
    scale : full-size pixels per reduced pixel.
    edges : edge points of each image.
    moving : (h, w) share of the images in which a pixel differs from the median or, with too few
        images for a median, whether it changes at all; for a single image, 1 at its edges.
    against : (n, h, w) of all images in the tables, 1 where a pixel is brighter than in the median
        image, -1 where it is darker, 0 where it is about equal or there is no median.
    """

    tables: DirectionTables
    row: Integers
    scale: float
    edges: tuple[PictureEdges, ...]
    moving: Array
    against: Integers

    def direction(self, normal: Array) -> Integers:
        """Direction numbers of edges whose image normals are (..., 2)."""
        return direction_of(normal, len(self.tables.ready))

    def look_up(
        self, direction: Integers, pixel: Array, image: Integers, between: bool = False
    ) -> tuple[Array, Booleans]:
        """Distances (reduced px) at full-size pixels (..., 2), and which of these lie in the image.

        direction, image : (...) direction numbers and image numbers.
        between : interpolate bilinearly between table entries; otherwise take the nearest.
        """
        import cv2

        x, y, inside = self._place(direction, pixel, image)
        how = cv2.INTER_LINEAR if between else cv2.INTER_NEAREST
        return self._interpolated(x, y, how), inside

    def look_along(
        self, direction: Integers, pixel: Array, outward: Array, image: Integers
    ) -> tuple[Array, Array, Booleans]:
        """Distances as in :meth:`look_up`, bilinear, with their derivatives along unit vectors
        (..., 2).

        The derivatives, per full-size pixel, are central differences over a reduced pixel to each
        side. The third array is the mask of the pixels in the image.
        """
        import cv2

        x, y, inside = self._place(direction, pixel, image)
        right, down = outward[..., 0], outward[..., 1]
        here = self._interpolated(x, y, cv2.INTER_LINEAR)
        ahead = self._interpolated(x + right, y + down, cv2.INTER_LINEAR)
        behind = self._interpolated(x - right, y - down, cv2.INTER_LINEAR)
        return here, np.clip((ahead - behind) / 2, -1, 1) / np.float32(self.scale), inside

    def brighter(self, pixel: Array, image: Integers) -> tuple[Integers, Booleans]:
        """Sign of the difference from the median image at full-size pixels (..., 2), and which lie
        inside.

        1 is brighter, -1 darker, 0 about equal or outside the image.
        """
        height, width = self.against.shape[1:]
        x, y = ((pixel[..., i] + 0.5) / self.scale for i in (0, 1))
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x, y = (np.where(inside, v, 0.0).astype(np.intp) for v in (x, y))
        return np.where(inside, self.against[self.row[image], y, x], 0), inside

    def _place(
        self, direction: Integers, pixel: Array, image: Integers
    ) -> tuple[Array, Array, Booleans]:
        """Column and row (...) in the mosaic of all tables, and whether the pixel lies in its
        image.
        """
        self.tables.get_ready(direction)
        rows, height, _, count, width = self.tables.picture.shape
        x, y = ((pixel[..., i] + 0.5) / self.scale - 0.5 for i in (0, 1))
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
        # single precision is exact for columns and rows below 2**15 and sufficient for a search
        number = self.row[image].astype(np.int32)
        column = ((number // rows * count + direction) * width).astype(np.float32)
        line = (number % rows * height).astype(np.float32)
        x, y = (np.where(inside, v, 0.0) for v in (x + column, y + line))
        return x, y, inside

    def _interpolated(self, x: Array, y: Array, how: int) -> Array:
        """Values of the mosaic of all tables at columns and rows (...)."""
        tables = self.tables.picture
        return interpolated(tables.reshape(tables.shape[0] * tables.shape[1], -1), x, y, how)

    def by_chance(self, direction: Integers, values: Array) -> Array:
        """Probability density, per reduced pixel, of distances (...) at arbitrary pixels."""
        self.tables.get_ready(direction)
        bins = self.tables.chance.shape[1]
        number = np.minimum(values / np.float32(self.tables.options.bin_width), bins - 1).astype(
            np.int32
        )
        return self.tables.chance.take(direction * bins + number)

    def select(self, images: Integers) -> DistanceTables:
        """Tables of some of the images; ``moving`` and the chance densities stay those of all
        images.
        """
        edges = tuple(self.edges[k] for k in images)
        return replace(self, row=self.row[images], edges=edges)

    def mirrored(self) -> DistanceTables:
        """Tables of the images with left and right exchanged."""
        width = self.moving.shape[1]
        edges = (
            PictureEdges(e.pixel * (-1, 1) + (width - 1, 0), e.normal * (-1, 1)) for e in self.edges
        )
        return DistanceTables(
            self.tables.mirrored(),
            self.row,
            self.scale,
            tuple(edges),
            self.moving[:, ::-1],
            self.against[..., ::-1],
        )


def direction_of(normal: Array, count: int) -> Integers:
    """Direction numbers, of ``count``, of edges with image normals (..., 2), regardless of their
    sign.
    """
    turn = np.arctan2(normal[..., 1], normal[..., 0]) * (count / np.pi)
    with np.errstate(invalid="ignore"):  # the direction of a NaN is arbitrary
        return np.floor(turn).astype(np.int32) % count


def bin_neighbours(direction: int, count: int) -> Booleans:
    """Mask (count,) of the directions that a direction's table includes: itself and its two
    neighbours.
    """
    return (np.arange(count) - (direction - 1)) % count < 3


def write_distances(place: Integers, out: Array) -> None:
    """Write the distance (h, w) of every pixel to the nearest of some pixels into ``out``.

    place : (n,) flat pixel indices, row by row.
    out : single precision, each row contiguous.
    """
    import cv2

    if not len(place):
        out[...] = NO_EDGE_DISTANCE
        return
    mask = np.ones(out.shape, dtype=np.uint8)
    mask.reshape(-1)[place] = 0
    table: Any = out
    cv2.distanceTransform(mask, cv2.DIST_L2, 3, dst=table)


def distance_tables(
    images: Sequence[Integers],
    options: DistanceTableOptions = DISTANCE_TABLE_OPTIONS,
) -> DistanceTables:
    """Distance tables of one station's images, K arrays (height, width) uint8 of equal size.

    Images are decoded and reduced on several threads.
    """
    import cv2

    def reduced(number: int) -> tuple[Integers, float]:
        image = images[number]  # decoded once; only the reduced image stays in memory
        scale = max(image.shape[1] / options.width, 1.0)
        size = (round(image.shape[1] / scale), round(image.shape[0] / scale))
        light = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        # the square root has even noise: a sensor's noise grows with the root of the light. A dark
        # machine in front of a dark wall is then as distinct as a bright one in the sun
        return np.rint(np.sqrt(255.0 * light)).astype(np.uint8), scale

    with ThreadPoolExecutor(THREADS) as pool:
        pairs = list(pool.map(reduced, range(len(images))))
        small, scale = [image for image, _ in pairs], pairs[0][1]
        height, across = small[0].shape
        against = np.zeros((len(small), height, across), dtype=np.int8)
        differs = None
        if len(small) >= options.enough:
            against = _against_median(np.stack(small), options)
            differs = against != 0
        each = [None] * len(small) if differs is None else differs
        edges = tuple(pool.map(lambda i, m: _edges_of(i, m, options), small, each))
    if differs is not None:
        moving = differs.mean(axis=0)
    elif len(small) > 1:  # too few for a median: whatever changes
        moving = (np.ptp(np.stack(small).astype(float), axis=0) > options.still).astype(float)
    else:  # a single image: its edges
        moving = np.zeros(small[0].shape)
        x, y = edges[0].pixel.astype(int).T
        moving[y, x] = 1.0
    place = [e.pixel.astype(int) @ (1, across) for e in edges]
    number = [direction_of(e.normal, options.directions) for e in edges]
    tables = DirectionTables.of_edges(place, number, (height, across), options)
    return DistanceTables(tables, np.arange(len(small)), scale, edges, moving, against)


def _against_median(small: Integers, options: DistanceTableOptions) -> Integers:
    """Signs (K, h, w) of the difference of images (K, h, w) from their median."""
    # odd-even transposition sort on whole images: thirty times as fast as sorting pixel by pixel
    order = small.copy()
    for turn in range(len(order)):
        low, high = order[turn % 2 : -1 : 2], order[turn % 2 + 1 :: 2]
        less = np.minimum(low, high)
        np.maximum(low, high, out=high)
        low[...] = less
    n = len(order)
    # twice the median, an integer
    twice = order[(n - 1) // 2].astype(np.int16) + order[n // 2]
    off = 2 * small.astype(np.int16) - twice
    return (off > 2 * options.still).astype(np.int8) - (off < -2 * options.still)


def _edges_of(image: Any, moving: Booleans | None, options: DistanceTableOptions) -> PictureEdges:
    """Canny edge points of one reduced image, where it differs from the other images (h, w)."""
    import cv2

    dx = cv2.Sobel(image, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(image, cv2.CV_16S, 0, 1)
    edges = cv2.Canny(dx, dy, *options.canny) > 0
    if moving is not None:
        edges &= cv2.dilate(moving.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    y, x = np.divmod(np.flatnonzero(edges), edges.shape[1])  # faster than np.nonzero
    normal = np.stack([dx[y, x], dy[y, x]], axis=-1).astype(float)
    return PictureEdges(
        np.stack([x, y], axis=-1).astype(float),
        normal / np.hypot(normal[:, 0], normal[:, 1])[:, None],
    )
