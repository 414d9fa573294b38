"""Centres of a grid of circles in one image.

The image of a circle is an ellipse whose centroid is not the image of the circle's centre: at a
tilt of 45 degrees they differ by tenths of a pixel. Each circle is therefore resampled into the
board's plane by the homography of its neighbours, where it is a circle again; the centroid of its
grey levels there is the centre, also of blurred circles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.board import Board
from pkmcal.levels import CONTRADICTION_SIGMAS, MAJORITY
from pkmcal.observe.images import narrowed

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
) -> Circles | None:
    """The board's circles; None if the grid is not detected.

    OpenCV's detector may find the counts of circles at wrong places first, such as partly beside
    the board. Among its grids, the one with the most reliable circles is taken.
    """
    columns, rows = board.counts
    searched, scale = narrowed(image, options.searched_width)
    best: Circles | None = None
    for centres in _attempts(searched, board, options):
        grid = ((centres + 0.5) / scale - 0.5).reshape(rows, columns, 2)
        right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
        if right[0] * down[1] - right[1] * down[0] <= 0:
            if board.document.get("asymmetric", False):
                continue
            grid = grid[:, ::-1]
        measured = circle_centres(image, board, grid.reshape(-1, 2), options)
        if best is None or measured.good.sum() > best.good.sum():
            best = measured
        if best.good.mean() >= options.whole_share:
            break
    return best


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


def _attempts(image: Integers, board: Board, options: CircleOptions) -> Iterator[Array]:
    """Centres (N, 2) by OpenCV's detector, of dark circles, then of light ones."""
    import cv2

    kind = (
        cv2.CALIB_CB_ASYMMETRIC_GRID
        if board.document.get("asymmetric", False)
        else cv2.CALIB_CB_SYMMETRIC_GRID
    )
    settings: Any = cv2.SimpleBlobDetector.Params()
    settings.minArea = options.least_area
    settings.maxArea = image.size / len(board.points)
    if settings.maxArea < settings.minArea:
        return  # the image has no room for the grid
    settings.minDistBetweenBlobs = float(np.sqrt(options.least_area))
    detector: Any = cv2.SimpleBlobDetector.create(settings)
    no_detector: Any = None  # then the first argument is the places of blobs
    for picture in (image, 255 - image):
        blobs = np.array([blob.pt for blob in detector.detect(picture)], dtype=np.float32)
        if len(blobs) < options.whole_share * len(board.points):
            continue
        for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
            success, centres = cv2.findCirclesGrid(
                blobs[:, None], board.counts, flags, no_detector, cv2.CirclesGridFinderParameters()
            )
            if success and centres is not None:
                yield np.asarray(centres, dtype=float).reshape(-1, 2)


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
