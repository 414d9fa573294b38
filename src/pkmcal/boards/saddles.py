"""Search for blocks of chessboard corners, whatever the board's counts.

A corner of a chessboard is a saddle of the grey levels: on a ring around it, opposite pixels are
equal and pixels a quarter turn apart differ. A block of 3 x 3 corners is a lattice, and light and
dark quadrants change places from one corner to the next.

A block is accepted by its number of false alarms (Desolneux, Moisan, Morel: From Gestalt Theory to
Image Analysis, 2008, chapter 3): the number of blocks tried, times the probability of one as
regular among independent saddles, uniformly distributed in place and in the direction of their
light quadrants. It bounds the expected number of blocks accepted in an image without regularity.
White noise has such saddles. That of JPEG files is not white, and the bound not proven for it
(measured: none of 40 images of noise at quality 95 has a block); one block by chance passes for
boards of at most three middles. The search of 1.2 megapixels takes 0.1 to 0.8 s, longest where many
saddles stand out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.levels import FALSE_ALARM

RING = np.array([
    (3, 0), (3, 1), (2, 2), (1, 3), (0, 3), (-1, 3), (-2, 2), (-3, 1),
    (-3, 0), (-3, -1), (-2, -2), (-1, -3), (0, -3), (1, -3), (2, -2), (3, -1),
])  # fmt: skip
"""Pixels x, y of a circle of radius 3 px."""
_DOUBLED = 2 * np.arctan2(RING[:, 1], RING[:, 0])
HARMONIC: Array = np.cos(_DOUBLED) / np.sum(np.cos(_DOUBLED) ** 2) + 1j * (
    np.sin(_DOUBLED) / np.sum(np.sin(_DOUBLED) ** 2)
)
"""Weights (16,) of the second harmonic on the ring, complex: its least-squares fit, since the
pixels are not evenly spaced."""
RING_NOISE = 0.137
"""Standard deviation of each component of the second harmonic, per grey level of white noise in the
image: the norm of its weights convolved with the Gaussian, 0.1370 and 0.1363. Phases of noise are
uniformly distributed as these are equal."""
LAPLACIAN = np.array([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]])
"""Difference of two Laplacians, to which grey levels that change quadratically contribute nothing;
of white noise it has six times the standard deviation (Immerkaer, 1996)."""
MEDIAN_NORMAL = 0.6745
"""Median of the modulus of a normal number, in standard deviations."""
LATTICE = np.array([(-1, 0), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)])
"""Corners of a block that two steps from its middle predict, in these steps."""
COLOURS = np.array([-1, -1, -1, -1, 1, 1, 1, 1])
"""Sign of the second harmonic at the corners of a block, relative to its middle: at the ends of the
two steps, then as in `LATTICE`."""


@dataclass(frozen=True)
class SaddleOptions:
    """Constants of the search for blocks of chessboard corners. Sides and numbers bound its cost:
    they determine which blocks are tried. ``nearest`` also counts in the level of a block, by the
    number of tests, and determines how locally the density of saddles is taken.
    """

    # two levels: expected number of saddles by white noise that are examined, and of blocks by
    # chance that are accepted, in an image
    false_alarms: float = FALSE_ALARM
    # least side of an image, px, of which the half is searched too
    least_side: int = 300
    # most saddles of one image that are examined, those of the largest contrast first
    most: int = 2000
    # nearest saddles among which the ends of the two steps of a block are searched
    nearest: int = 12


SADDLE_OPTIONS = SaddleOptions()


def largest_block(image: Integers, options: SaddleOptions = SADDLE_OPTIONS) -> int:
    """Number of adjoining middles of 3 x 3 corners in the largest part of a chessboard that an
    image, grey levels (height, width) uint8, seems to show, at the scale with most of them; a whole
    board of (columns, rows) has (columns - 2) * (rows - 2).
    """
    import cv2

    picture: Any = image
    scales = [saddles(picture, options)]
    while min(picture.shape) >= options.least_side:
        picture = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        scales.append(saddles(picture, options))
    # blocks tried: every pair of neighbours of every saddle
    number = np.array([len(places) for places, _ in scales])
    neighbours = np.minimum(options.nearest, number - 1)
    tests = float(np.sum(number * neighbours * (neighbours - 1) / 2))
    return max(_largest_block(*scale, tests, options) for scale in scales)


def image_noise(image: Integers) -> float:
    """Standard deviation of the noise of an image, grey levels (height, width): at least that of
    rounding, 1 / sqrt 12.
    """
    import cv2

    second: Any = cv2.filter2D(image, cv2.CV_32F, LAPLACIAN)
    return max(float(np.median(np.abs(second))) / (6 * MEDIAN_NORMAL), 12**-0.5)


def saddles(image: Integers, options: SaddleOptions = SADDLE_OPTIONS) -> tuple[Array, Array]:
    """Saddles of the grey levels: places (n, 2) px, and the second harmonic (n,) of the grey levels
    on a ring around each, complex: its modulus is the contrast, twice the direction of its light
    quadrants the phase.

    The modulus exceeds that of white noise: by Rayleigh's distribution, less than ``false_alarms``
    of the image's pixels are expected to.
    """
    import cv2

    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
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
    harmonic = grey @ HARMONIC
    contrast = np.abs(harmonic)
    noise = RING_NOISE * image_noise(image) * np.sqrt(2 * np.log(image.size / options.false_alarms))
    chosen = np.flatnonzero((quarter > half) & (contrast > noise))
    chosen = chosen[np.argsort(-contrast[chosen], kind="stable")[: options.most]]
    return np.stack([x, y], axis=-1)[chosen].astype(float), harmonic[chosen]


def _largest_block(places: Array, harmonic: Array, tests: float, options: SaddleOptions) -> int:
    """Number of adjoining saddles that each are the middle of a block of 3 x 3 corners; tests :
    number of blocks tried in the image.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if len(places) <= len(COLOURS):
        return 0
    count = min(options.nearest, len(places) - 1)
    tree = KDTree(places)
    distance, nearest = tree.query(places, k=count + 1)
    # Blocks (k,): a saddle, and two neighbours of opposite colours as the ends of its two steps.
    opposite = np.real(harmonic[nearest[:, 1:]] * harmonic[:, None].conj()) < 0
    first, second = np.triu_indices(count, 1)
    middle, pair = np.nonzero(opposite[:, first] & opposite[:, second])
    ends = nearest[middle[:, None], 1 + np.stack([first, second], axis=-1)[pair]]
    steps = places[ends] - places[middle, None]
    # The saddles nearest to the places of the other six corners (k, 6), and their distances.
    miss, others = tree.query(places[middle, None] + LATTICE @ steps)
    corners = np.concatenate([ends, others], axis=1)
    # Angles (k, 8) of the phases from that of the middle, and (k,) of the middle's own from that of
    # the squares' diagonals, which lie between the steps; light and dark ones are not distinguished
    angle = np.angle(harmonic[corners] * COLOURS * harmonic[middle, None].conj())
    diagonal = np.prod(steps[..., 0] + 1j * steps[..., 1], axis=1)
    own = np.abs(np.angle(harmonic[middle] * diagonal.conj()))
    largest = np.maximum(np.abs(angle).max(axis=1), np.minimum(own, np.pi - own))
    density = count / (np.pi * distance[middle, -1] ** 2)
    chance = _chance(miss.max(axis=1), density, largest)
    distinct = np.diff(np.sort(np.column_stack([middle, corners]), axis=1), axis=1).all(axis=1)
    accepted = (tests * chance < options.false_alarms) & distinct
    # The largest number of middles that neighbour each other.
    middle, sides = middle[accepted], corners[accepted, :4]
    joined = np.isin(sides, middle)
    rows, columns = np.repeat(middle, 4)[joined.ravel()], sides[joined]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(places),) * 2)
    part = connected_components(graph, directed=False)[1][np.unique(middle)]
    return int(np.bincount(part, minlength=1).max())


def _chance(miss: Array, density: Array, angle: Array) -> Array:
    """Probability (k,) that independent saddles form a block as regular.

    miss : (k,) px, largest distance of six corners from their places. density : (k,) saddles per
        square pixel. angle : (k,) rad, largest angle of nine phases from theirs.

    A uniformly distributed saddle lies within a distance with at most the expected number of
    saddles there, and its phase within an angle with angle / pi; that of the middle, of either
    sign, with twice that. Of the product p of two independent probabilities, one at most as small
    has the probability p (1 - ln p) (Fisher).
    """
    from scipy.special import xlogy

    # a disc of whole pixels: a distance of 0 is that of one pixel
    expected = density * np.pi * (miss + np.pi**-0.5) ** 2
    product = np.minimum(expected, 1.0) ** len(LATTICE)
    product = product * np.minimum(2 * (angle / np.pi) ** (len(COLOURS) + 1), 1.0)
    return product - xlogy(product, product)
