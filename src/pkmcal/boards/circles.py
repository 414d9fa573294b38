"""Centres of a grid of circles in one image.

The image of a circle is an ellipse whose centroid is not the image of the circle's centre: at a
tilt of 45 degrees they differ by tenths of a pixel. Each circle is therefore resampled into the
board's plane by the homography of its neighbours, where it is a circle again; the centroid of its
grey levels there is the centre, also of blurred circles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from math import pi
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.board import Board
from pkmcal.boards.lattice import Lattice, lattices
from pkmcal.levels import CONTRADICTION_SIGMAS, FEW, MAJORITY
from pkmcal.observe.images import narrowed

BASES: Integers = np.array([
    (a, b, c, d) for a, b, c, d in product((-1, 0, 1), repeat=4) if a * d - b * c == 1
]).reshape(-1, 2, 2)  # fmt: skip
"""Changes from one basis of a lattice to others of the same sense: the two shortest steps in an
image may be others than on the board."""
DIAGONALS: Integers = np.array([(1, 1), (-1, 1)])
"""Steps of an asymmetric grid's lattice along the board's axes, in spacings."""
LEAST_WINDOW_RADIUS = 2.5
"""Smallest radius, px, of what is measured on a board: a smaller window holds too few pixels for
the seven unknowns of a corner."""


@dataclass(frozen=True)
class CircleOptions:
    """Constants of the detection of circles."""

    # width, px, to which larger images are reduced to search for the grid
    searched_width: int = 1600
    # least area of a circle, px, there: that of the smallest window of a corner
    least_area: float = pi * LEAST_WINDOW_RADIUS**2
    # neighbours, the circle included, of which the homography of a circle is fitted
    neighbours: int = 9
    # samples across a circle's surroundings in the board's plane
    samples: int = 41
    # passes: the homographies of the second are of the centres of the first
    passes: int = 3
    # inner edge of the ring of paper around a circle, as a share of half the distance to the next
    ring: float = 0.85
    # least difference between circle and paper, in standard deviations of the paper
    least_contrast: float = CONTRADICTION_SIGMAS
    # largest fourth cumulant of a grid's outlines, the median: the middle between that of circles,
    # 0, and that of squares, 1 / 60, the least of rectangles (derived)
    most_angular: float = 1 / 120
    # share of a grid's circles that must be reliable; with less, another grid is tried
    whole_share: float = MAJORITY


CIRCLE_OPTIONS = CircleOptions()


class Circles(NamedTuple):
    """Centres (N, 2) px in the board's order, whether each is reliable (N,), and sigma (N,) px."""

    pixels: Array
    good: Booleans
    sigma: Array


def find_circles(
    image: Integers, board: Board, options: CircleOptions = CIRCLE_OPTIONS
) -> tuple[Circles | None, str]:
    """The board's circles, None if they are not detected; and what was found instead.

    A grid of circles has no mark of its own but its counts. A lattice that goes on beyond them, or
    of which a border is missing, is not the board.
    """
    searched, scale = narrowed(image, options.searched_width)
    best: Circles | None = None
    why = f"no grid like {board.described}"
    for blobs in _blobs(searched, board, options):
        for lattice in lattices(blobs):
            if len(lattice.points) < options.whole_share * len(board.points):
                continue
            centres, description = _on_board(lattice, blobs, board)
            if centres is None:
                why = description
                continue
            start = (centres + 0.5) / scale - 0.5
            measured = circle_centres(image, board, start, options)
            if best is None or measured.good.sum() > best.good.sum():
                best = measured
            if best.good.mean() >= options.whole_share:
                return best, ""
    return best, why


def circle_centres(
    image: Integers, board: Board, start: Array, options: CircleOptions = CIRCLE_OPTIONS
) -> Circles:
    """The circles near rough centres (N, 2) px; none is reliable if they are not circles."""
    xy = board.points[:, :2]
    gap = np.linalg.norm(xy[:, None] - xy, axis=-1)
    order = np.argsort(gap, axis=1, kind="stable")[:, : options.neighbours]
    half = float(np.min(gap + np.where(np.eye(len(xy)) > 0, np.inf, 0.0))) / 2
    centres = start.astype(float)
    grey = image.astype(np.float32)
    good, sigma = np.zeros(len(xy), dtype=bool), np.zeros(len(xy))
    cumulants: list[complex] = []
    for _ in range(options.passes):
        measured = [
            _centre(grey, xy[i], _homography(xy[near], centres[near]), half, options)
            for i, near in enumerate(order)
        ]
        good = np.array([one is not None for one in measured])
        centres = np.array(
            [old if one is None else one[0] for old, one in zip(centres, measured, strict=True)]
        )
        sigma = np.array([0.0 if one is None else one[1] for one in measured])
        cumulants = [one[2] for one in measured if one is not None]
    # windows, keys or tiles, which all have one orientation on the board
    if cumulants:
        middle = np.median(np.real(cumulants)) + 1j * np.median(np.imag(cumulants))
        good &= abs(middle) <= options.most_angular
    return Circles(centres, good, sigma)


def _blobs(image: Integers, board: Board, options: CircleOptions) -> Iterator[Array]:
    """Places (n, 2) px of dark blobs, then of light ones."""
    import cv2

    settings: Any = cv2.SimpleBlobDetector.Params()
    settings.minArea = options.least_area
    settings.maxArea = image.size / len(board.points)
    if settings.maxArea < settings.minArea:
        return  # the image has no room for the grid
    settings.minDistBetweenBlobs = float(np.sqrt(options.least_area))
    detector: Any = cv2.SimpleBlobDetector.create(settings)
    for picture in (image, 255 - image):
        yield np.array([blob.pt for blob in detector.detect(picture)]).reshape(-1, 2)


def _on_board(lattice: Lattice, blobs: Array, board: Board) -> tuple[Array | None, str]:
    """Centres (N, 2) px in the board's order, those without a blob by the homography of their
    neighbours; None if the lattice is not the board's. And a description of the lattice.
    """
    asymmetric = bool(board.document.get("asymmetric", False))
    columns, rows = board.counts
    row, column = np.mgrid[-1 : rows + 1, -1 : columns + 1].reshape(2, -1)
    # the board's places and those around it, and which are its own
    around = np.stack([2 * column + row % 2 if asymmetric else column, row], axis=-1)
    own = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    turns = [lattice.cells @ turn for turn in BASES]
    fits = [
        (
            _placed(turn @ DIAGONALS if asymmetric else turn, around[own], blobs[lattice.points]),
            turn,
        )
        for turn in turns
    ]
    fits.sort(key=lambda fit: fit[0][:3], reverse=True)
    cells = fits[0][0][3]
    point_at = {tuple(cell): int(k) for cell, k in zip(cells.tolist(), lattice.points, strict=True)}
    points = np.array([point_at.get(tuple(cell), -1) for cell in around.tolist()])
    present = (points >= 0).reshape(rows + 2, columns + 2)
    border, beyond = (
        np.concatenate(
            [present[[k, -1 - k], 1:-1].mean(axis=1), present[1:-1, [k, -1 - k]].mean(axis=0)]
        )
        for k in (1, 0)
    )
    # too few circles of an outer row or column do not tell it from a stray blob beside it
    if border.min() < FEW or beyond.max() > MAJORITY or beyond.max() >= border.min():
        return None, _described([turn for _, turn in fits], asymmetric)
    xy, mine = board.points[:, :2], points[own]
    known = mine >= 0
    centres = np.where(known[:, None], blobs[mine], np.nan)
    for k in np.flatnonzero(~known):
        gap = np.linalg.norm(xy[known] - xy[k], axis=-1)
        near = np.flatnonzero(known)[np.argsort(gap, kind="stable")[: CIRCLE_OPTIONS.neighbours]]
        centres[k] = _projected(_homography(xy[near], centres[near]), xy[k])
    return centres, board.described


def _described(turns: list[Integers], asymmetric: bool) -> str:
    """Description of a lattice, symmetric or not, by the counts with the fewest gaps.

    turns : the lattice's cells (n, 2) in several bases; the first of equally good ones is taken.
    asymmetric : the kind that is taken if both are equally good.
    """
    shapes = [
        (np.ptp(cells @ DIAGONALS if kind else cells, axis=0).tolist(), kind)
        for kind in (asymmetric, not asymmetric)
        for cells in turns
    ]
    # every second place of an asymmetric lattice is empty
    counts = [
        (width // 2 + 1 if kind else width + 1, height + 1, kind)
        for (width, height), kind in shapes
    ]
    columns, rows, kind = min(counts, key=lambda one: one[0] * one[1])
    return f"{'an asymmetric' if kind else 'a'} lattice of {columns}x{rows} blobs"


def _placed(cells: Integers, board: Integers, places: Array) -> tuple[int, int, float, Integers]:
    """Number of lattice points (n, 2) on the board's places (N, 2) after the best shift; the
    negative area of their bounding box; cosine of the angle between the board's x axis and the
    image's; and the shifted points.

    places : (n, 2) px.
    """
    shifts = (cells[:, None] - board).reshape(-1, 2)
    low, size = shifts.min(axis=0), np.ptp(shifts, axis=0) + 1
    number = np.bincount((shifts - low) @ [size[1], 1])
    shift = np.array(divmod(int(number.argmax()), int(size[1]))) + low
    # mean step of the image along the two axes
    axes = np.linalg.lstsq(cells - cells.mean(axis=0), places - places.mean(axis=0), rcond=None)[0]
    rightward = float(axes[0, 0] / np.linalg.norm(axes[0]))
    area = int(np.prod(np.ptp(cells, axis=0) + 1))
    return int(number.max()), -area, rightward, cells - shift


def _homography(xy: Array, pixels: Array) -> Array:
    """Homography (3, 3) from the board's plane, m, to pixels, by least squares."""
    import cv2

    H: Any = cv2.findHomography(xy, pixels, 0)[0]
    return np.full((3, 3), np.nan) if H is None else H


def _centre(
    image: Array, xy: Array, H: Array, half: float, options: CircleOptions
) -> tuple[Array, float, complex] | None:
    """Centre (2,) px, its standard deviation, and fourth cumulant; None where nothing stands out.

    image : grey levels, float32. xy : (2,) m, place on the board. half : half the distance to the
        nearest circle, m.

    The fourth cumulant is that of z = x + i y, from the centroid of an outline of the area A, in
    units of A^2: the mean of z^4 less three times the square of that of z^2. A Gaussian blur, whose
    own is zero, does not change it, be it isotropic on the board or not. It is 0 for a circle and
    -(t^2 + 1 / t^2) / 120 for a rectangle with the ratio t of its sides, along these.
    """
    import cv2

    axis = np.linspace(-half, half, options.samples)
    offsets = np.stack(np.meshgrid(axis, axis), axis=-1)
    radius = np.linalg.norm(offsets, axis=-1) / half
    pixels = _projected(H, xy + offsets)
    last = np.array(image.shape[::-1]) - 1
    if not np.isfinite(pixels).all() or (pixels < 0).any() or (pixels > last).any():
        return None
    x, y = np.moveaxis(pixels.astype(np.float32), -1, 0)
    grey = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR))
    paper = grey[(radius > options.ring) & (radius <= 1)]
    # bilinear interpolation leaves two thirds of the pixels' standard deviation, on average
    level, noise = float(np.median(paper)), 1.5 * float(np.std(paper))
    contrast = level - float(np.median(grey[radius < 0.2]))
    if not abs(contrast) > options.least_contrast * noise:
        return None
    share = np.where(radius <= 1, (level - grey) / contrast, 0.0)
    total = float(share.sum())
    offset = np.sum(share[..., None] * offsets, axis=(0, 1)) / total
    place = (offsets - offset) @ [1, 1j]
    area = total * (axis[1] - axis[0]) ** 2
    second, fourth = (np.sum(share * place**n) / total for n in (2, 4))
    cumulant = complex((fourth - 3 * second**2) / area**2)
    # White noise of the pixels; their number in a sample cancels.
    spread = float(np.sum(offsets[radius <= 1][:, 0] ** 2))
    sigma = noise / abs(contrast) * np.sqrt(spread) / total / (axis[1] - axis[0])
    centre = _projected(H, xy + offset)
    return centre, float(max(sigma, 1e-4)), cumulant


def _projected(H: Array, xy: Array) -> Array:
    """Pixels (..., 2) of points (..., 2) of the board's plane."""
    h = xy @ H[:, :2].T + H[:, 2]
    return h[..., :2] / h[..., 2:]
