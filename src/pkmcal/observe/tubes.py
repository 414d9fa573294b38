"""Detection of tubes in one image: pairs of parallel edges at a tube's width, and their surprisal.

Nothing moves in a single image, so only appearance distinguishes the machine from its surroundings:
a leg has two straight parallel edges, one from dark to bright, the other back. For each of a few
widths and directions a map has the support of each point as the middle of such a pair, along a
stretch of some widths. A shelf has many upright and level pairs, and few oblique ones: so the worth
of a point is its surprisal, by how rarely a pair of its width and direction is as clear in this
image.

The maps are on a chart of angles from the image's middle, equal for any lens, on which a turn of
the camera is nearly a shift.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras import Camera

FINE_CHART_CELLS = 384
"""Cells of the fine chart along the longer side of the image: the edges of a leg that is a fiftieth
of the image wide, as where a machine fills it, are eight cells apart."""
MAP_CELL_SIZE = 6
"""Fine cells in one cell of the maps; these are looked up at steps of 15 and of 8 degrees."""
SUPPORT_SPACING = 2
"""Pitch, in fine cells, of the points whose support is computed."""
PAIR_DIRECTIONS = 24
"""Directions of a pair: 7.5 degrees apart."""
PAIR_WIDTHS = 3.2 * np.sqrt(2.0) ** np.arange(6)
"""Widths (fine cells) of a pair: narrower ones have edges that merge."""
SUPPORT_LENGTH_WIDTHS = 4.0
"""Length, in widths, along which a pair's support is averaged: tubes are longer."""
SHORTEST_SUPPORT_LENGTH = 12.0
"""Shortest length, in fine cells, along which support is averaged."""
HALF_STRENGTH_SLOPE = 2.5
"""Slope (levels a fine cell) at which an edge has half of the full strength. Levels are square
roots (255 stays), with uniform noise of half a level at most; the slope is five times that."""
SLOPE_ALONG_WEIGHT = 2.0
"""Weight of a slope along a pair against one across it: directions within 27 degrees."""
LEAST_PAIR_SUPPORT = 0.24
"""Support below which a point is no pair: a quarter of its length."""
GREATEST_SURPRISAL = 4.0
"""Largest surprisal (nats): one leg must not outweigh six."""
SURPRISAL_STEPS = 60
"""Steps of the maps' numbers for each nat of surprisal."""


class TubeChart(NamedTuple):
    """Maps of surprisal (W, D, h, w) uint8, in steps: minus the logarithm of the share of points
    with as clear a pair. scale : fine cells a radian. size : (w, h) of the fine chart.
    """

    surprisal: Integers
    scale: float
    size: tuple[int, int]

    @property
    def middle(self) -> Array:
        """The chart's middle, fine cells (2,)."""
        return (np.array(self.size) - 1) / 2

    def width_number(self, width: Array) -> Integers:
        """Indices of the nearest PAIR_WIDTHS to widths (...), fine cells."""
        apart = np.abs(np.log(np.maximum(width, 1e-9))[..., None] - np.log(PAIR_WIDTHS))
        return apart.argmin(axis=-1)


def tube_chart(image: Integers, camera: Camera) -> TubeChart:
    """Chart of an image (height, width)."""
    grey, scale = _on_chart(image, camera)
    return TubeChart(_rarity(_support(grey)), scale, (grey.shape[1], grey.shape[0]))


def _on_chart(image: Integers, camera: Camera) -> tuple[Array, float]:
    """Square-root levels (h, w) on the fine chart of angles from the optical axis, with its scale
    (cells a radian).
    """
    import cv2

    height, width = image.shape
    across = np.stack([np.linspace(0, width - 1, 65), np.full(65, (height - 1) / 2)], axis=-1)
    along = np.stack([np.full(65, (width - 1) / 2), np.linspace(0, height - 1, 65)], axis=-1)
    half = [float(np.nanmax(np.abs(_angle(camera.ray(line))))) for line in (across, along)]
    scale = FINE_CHART_CELLS / (2 * max(half))
    w, h = (int(2 * angle * scale) for angle in half)
    x, y = np.meshgrid((np.arange(w) - (w - 1) / 2) / scale, (np.arange(h) - (h - 1) / 2) / scale)
    away = np.hypot(x, y)
    sine = np.sinc(away / np.pi)
    pixel = camera.project(np.stack([x * sine, y * sine, np.cos(away)], axis=-1))
    pixel = np.nan_to_num(pixel, nan=-1e4).astype(np.float32)
    blur = 0.4 * width / w  # of what a cell of the chart cannot show
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur) if blur > 0.4 else image
    smooth = np.asarray(smooth, dtype=np.float32)
    grey = cv2.remap(
        smooth, np.ascontiguousarray(pixel[..., 0]), np.ascontiguousarray(pixel[..., 1]),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.sqrt(255.0 * np.asarray(grey)), scale


def _angle(rays: Array) -> Array:
    """Angles (...) of rays (..., 3) from the optical axis."""
    return np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])


def _support(grey: Array) -> Array:
    """Support (PAIR_WIDTHS, PAIR_DIRECTIONS, h, w), 0 to 1, of a pair about each point; points are
    SUPPORT_SPACING fine cells apart.
    """
    import cv2

    dx, dy = (
        cv2.Sobel(grey.astype(np.float32), cv2.CV_32F, *direction) / 8
        for direction in ((1, 0), (0, 1))
    )
    height, width = (n // SUPPORT_SPACING for n in grey.shape)
    out = np.empty((len(PAIR_WIDTHS), PAIR_DIRECTIONS, height, width), dtype=np.float32)
    for k in range(PAIR_DIRECTIONS):
        angle = np.pi * k / PAIR_DIRECTIONS
        n = np.array([np.cos(angle), np.sin(angle)])
        slope, other = dx * n[0] + dy * n[1], np.abs(dy * n[0] - dx * n[1])
        rising, falling = (_strength(sign * slope - SLOPE_ALONG_WEIGHT * other) for sign in (1, -1))
        for w, wide in enumerate(PAIR_WIDTHS):
            # at x + n wide/2 and x - n wide/2: a bright tube rises inwards, a dark one falls
            step = np.rint(n * wide / 2).astype(int)
            bright = np.minimum(_shifted(falling, step), _shifted(rising, -step))
            dark = np.minimum(_shifted(rising, step), _shifted(falling, -step))
            pair = np.maximum(bright, dark)[: height * SUPPORT_SPACING, : width * SUPPORT_SPACING]
            rows = reduce(np.maximum, (pair[n::SUPPORT_SPACING] for n in range(SUPPORT_SPACING)))
            pair = reduce(np.maximum, (rows[:, n::SUPPORT_SPACING] for n in range(SUPPORT_SPACING)))
            length = max(SUPPORT_LENGTH_WIDTHS * wide, SHORTEST_SUPPORT_LENGTH) / SUPPORT_SPACING
            out[w, k] = cv2.filter2D(pair, -1, _line(np.array([-n[1], n[0]]), length))
    return out


def _strength(slope: Array) -> Array:
    """Strength of edges, 0 to 1, dilated by one cell."""
    import cv2

    up = np.square(np.maximum(slope, 0.0))
    wide = cv2.dilate(up / (up + HALF_STRENGTH_SLOPE**2), np.ones((3, 3), np.uint8))
    return np.asarray(wide, dtype=np.float32)


def _shifted(values: Array, step: Integers) -> Array:
    """Values (h, w) at x + step, zero beyond the border."""
    x, y = (int(s) for s in step)
    height, width = values.shape
    out = np.zeros_like(values)
    out[max(-y, 0) : height - max(y, 0), max(-x, 0) : width - max(x, 0)] = values[
        max(y, 0) : height - max(-y, 0), max(x, 0) : width - max(-x, 0)
    ]
    return out


def _line(along: Array, length: float) -> Array:
    """Kernel that averages along a line."""
    half = int(np.ceil(length / 2))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    for place in np.linspace(-length / 2, length / 2, 8 * half):
        x, y = np.rint(half + place * along).astype(int)
        kernel[y, x] = 1.0
    return kernel / kernel.sum()


def _rarity(support: Array) -> Integers:
    """Maps of :class:`TubeChart` from supports (W, PAIR_DIRECTIONS, h, w).

    A cell has the largest support about it and in neighbouring directions, as candidates are that
    far apart.
    """
    import cv2

    cell = MAP_CELL_SIZE // SUPPORT_SPACING
    height, width = (n // cell for n in support.shape[-2:])
    around = np.ones((cell + 2, cell + 2), np.uint8)
    rows, columns = (slice(cell // 2, n * cell, cell) for n in (height, width))
    best = np.stack(
        [[np.asarray(cv2.dilate(m, around))[rows, columns] for m in maps] for maps in support]
    )
    best = np.maximum(best, np.maximum(np.roll(best, 1, axis=1), np.roll(best, -1, axis=1)))
    level = np.rint(255 * np.clip(best, 0, 1)).astype(np.intp)
    out = np.empty(best.shape, dtype=np.uint8)
    for place in np.ndindex(level.shape[:2]):
        count = np.bincount(level[place].ravel(), minlength=256)
        share = count[::-1].cumsum()[::-1] / count.sum()
        worth = np.minimum(-np.log(np.maximum(share, 1e-9)), GREATEST_SURPRISAL)
        worth[: round(255 * LEAST_PAIR_SUPPORT)] = 0.0
        out[place] = np.rint(SURPRISAL_STEPS * worth)[level[place]]
    return out
