"""Search for blocks of chessboard corners, whatever the board's counts.

A corner of a chessboard is a saddle of the grey levels: on a ring around it, opposite pixels are
equal and pixels a quarter turn apart differ. In a block of 3 x 3 corners, opposite neighbours are
about as far away, and light and dark quadrants change places from one to the next. The search takes
a tenth of a second; a detector of boards takes longer for each pair of counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers

RING = np.array([
    (3, 0), (3, 1), (2, 2), (1, 3), (0, 3), (-1, 3), (-2, 2), (-3, 1),
    (-3, 0), (-3, -1), (-2, -2), (-1, -3), (0, -3), (1, -3), (2, -2), (3, -1),
])  # fmt: skip
"""Pixels x, y of a circle of radius 3 px."""


@dataclass(frozen=True)
class SaddleOptions:
    """Constants of the search for blocks of chessboard corners.

    None is critical within a factor of two (of the angle for cosines, of the logarithm for a ratio;
    one for a count of diagonals), measured with each changed by itself on new images: 72 of
    chessboards (12 of three seeds of rendered machines, 60 of random views by a pinhole camera and
    a fisheye lens) and 72 without one (12 of these machines, 60 of random grids of windows). All
    chessboards are large enough with all values but a ``growth`` of 0.3, which loses one; of images
    without, two are, none with that growth, and four with a ``least_contrast`` of 3.
    """

    # least side of an image, px, of which the half is searched too: in a smaller one, windows of a
    # facade alternate as squares do
    least_side: int = 300
    # least difference between light and dark quadrants, grey levels
    least_contrast: float = 6.0
    # most saddles of one image that are examined, those of the largest contrast first
    most: int = 6000
    # nearest saddles among which the neighbours of a corner are searched
    nearest: int = 12
    # share of the nearer neighbour's distance by which two opposite ones may miss each other's
    # reflection: at the border of a very wide lens, squares grow by a half from one to the next
    growth: float = 0.6
    # share of a square's side by which a corner may miss its place by its neighbours: that of the
    # parallelogram of three others here, the middle between two in the whole board
    bend: float = 0.35
    # least cosine between the directions of light and dark quadrants of corners of a block
    least_cosine: float = 0.5
    # the same between these and the middle of the axes that its neighbours span
    least_cosine_axes: float = 0.8
    # least sine of the angle between the two sides of a square
    least_sine: float = 0.2
    # corners of the four diagonal ones that a block must have
    least_diagonals: int = 3
    # largest ratio of the contrasts of a corner and its neighbour
    most_ratio: float = 3.0


SADDLE_OPTIONS = SaddleOptions()


def largest_block(image: Integers, options: SaddleOptions = SADDLE_OPTIONS) -> int:
    """Number of adjoining middles of 3 x 3 corners in the largest part of a chessboard that an
    image, grey levels (height, width) uint8, seems to show, at the scale with most of them; a whole
    board of (columns, rows) has (columns - 2) * (rows - 2).
    """
    import cv2

    picture: Any = image
    most = _largest_block(*saddles(picture, options), options)
    while min(picture.shape) >= options.least_side:
        picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        most = max(most, _largest_block(*saddles(picture, options), options))
    return most


def is_large_enough(block: int, counts: tuple[int, int], share: float) -> bool:
    """Whether a part of a chessboard, by :func:`largest_block`, can be a whole board of ``counts``
    (columns, rows) of inner corners; share : of its inner corners that must be in the part.
    """
    return block >= max(1.0, share * (counts[0] - 2) * (counts[1] - 2))


def saddles(image: Integers, options: SaddleOptions = SADDLE_OPTIONS) -> tuple[Array, Array]:
    """Saddles of the grey levels: places (n, 2) px, and the second harmonic (n,) of the grey levels
    on a ring around each, complex: its modulus is the contrast, twice the direction of its light
    quadrants the phase.
    """
    import cv2

    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    xx, yy, xy = (cv2.Sobel(smooth, cv2.CV_32F, i, j) for i, j in ((2, 0), (0, 2), (1, 1)))
    curvature = xy * xy - xx * yy
    peak = (curvature == cv2.dilate(curvature, np.ones((5, 5), np.uint8))) & (curvature > 1)
    margin = int(RING.max())
    peak[:margin] = peak[-margin:] = False
    peak[:, :margin] = peak[:, -margin:] = False
    y, x = np.nonzero(peak)
    grey = smooth[y[:, None] + RING[:, 1], x[:, None] + RING[:, 0]]
    opposite = grey[:, :8] + grey[:, 8:]
    quarter = np.abs(opposite[:, :4] - opposite[:, 4:]).sum(axis=1)
    half = np.abs(grey[:, :8] - grey[:, 8:]).sum(axis=1)
    harmonic = grey @ np.exp(2j * np.arctan2(RING[:, 1], RING[:, 0])) / 8
    contrast = np.abs(harmonic)
    corner = (quarter > half) & (contrast > options.least_contrast)
    chosen = np.flatnonzero(corner)
    chosen = chosen[np.argsort(-contrast[chosen], kind="stable")[: options.most]]
    return np.stack([x, y], axis=-1)[chosen].astype(float), harmonic[chosen]


def _largest_block(places: Array, harmonic: Array, options: SaddleOptions) -> int:
    """Number of adjoining saddles that each are the middle of a block of 3 x 3 corners."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if len(places) < 9:
        return 0
    tree = KDTree(places)
    nearest = tree.query(places, k=min(options.nearest + 1, len(places)))[1][:, 1:]
    contrast = np.abs(harmonic)
    phase = harmonic / contrast
    ratio = np.abs(np.log(contrast[nearest] / contrast[:, None]))
    opposite = np.real(phase[nearest] * phase[:, None].conj()) < -options.least_cosine
    opposite &= ratio < np.log(options.most_ratio)
    steps = places[nearest] - places[:, None]
    length = np.linalg.norm(steps, axis=-1)
    # Axes: pairs of neighbours on both sides.
    first, second = np.triu_indices(nearest.shape[1], 1)
    miss = np.linalg.norm(steps[:, first] + steps[:, second], axis=-1)
    short = np.minimum(length[:, first], length[:, second])
    axis = opposite[:, first] & opposite[:, second] & (miss <= options.growth * short)
    neighbours: dict[int, Integers] = {}
    for i in np.flatnonzero(axis.sum(axis=1) >= 2).tolist():
        pairs = nearest[i][np.stack([first, second], axis=-1)[axis[i]]]
        for a, b in combinations(pairs, 2):
            ends = np.concatenate([a, b])
            if _diagonals(i, ends, places, phase, tree, options) >= options.least_diagonals:
                neighbours[i] = ends
                break
    joined = [(i, j) for i, ends in neighbours.items() for j in ends.tolist() if j in neighbours]
    if not joined:
        return min(len(neighbours), 1)
    rows, columns = np.array(joined).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(places),) * 2)
    return int(np.bincount(connected_components(graph, directed=False)[1]).max())


def _diagonals(
    i: int, ends: Integers, places: Array, phase: Array, tree: Any, options: SaddleOptions
) -> int:
    """Number of diagonal corners beside a saddle; ends : (4,), its neighbours on both sides along
    one axis, then along the other.
    """
    a, minus_a, b, minus_b = ends
    pairs = np.array([(a, b), (a, minus_b), (minus_a, b), (minus_a, minus_b)])
    sides = places[pairs] - places[i]
    lengths = np.linalg.norm(sides, axis=-1)
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    # Light quadrants lie between the edges, which run along the axes.
    x, y = (places[[a, b]] - places[[minus_a, minus_b]]).T
    along = np.prod(x + 1j * y)
    if abs(np.real(phase[i] * np.conj(along))) < options.least_cosine_axes * abs(along):
        return 0
    # Two axes that are almost one span no square.
    if np.any(area < options.least_sine * lengths.prod(axis=1)):
        return 0
    distance, corner = tree.query(places[i] + sides.sum(axis=1))
    parallel = np.real(phase[corner] * np.conj(phase[i])) > options.least_cosine
    return int(np.sum((distance <= options.bend * lengths.min(axis=1)) & parallel))
