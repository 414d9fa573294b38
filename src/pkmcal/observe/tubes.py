"""Chart of possible tubes in one image: pairs of parallel edges at a tube's width, scored by
rarity.

Nothing moves in a single image, so only appearance distinguishes the machine from its surroundings:
a leg has two parallel straight edges, one from dark to bright and the other back. For each of a few
widths and directions, a map gives the evidence that a point is the middle of such a pair along a
stretch of a few widths. Shelves show many vertical and horizontal pairs and few oblique ones; the
value of a point is therefore how rarely its width and direction occur with such clarity in this
image.

The chart is in angles from the middle of the image, the same for any lens, in which a rotation of
the camera is nearly a shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property, reduce
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras import Camera


@dataclass(frozen=True)
class TubeChartOptions:
    """Constants of the chart of possible tubes; lengths in fine cells."""

    # cells of the fine chart along the image's longer side: the edges of a leg whose width is a
    # fiftieth of the image, as where a machine fills it, are eight cells apart
    cells: int = 384
    # fine cells per cell of the maps, which are evaluated at steps of 15 degrees and 8 degrees
    map_cell: int = 6
    # spacing of the points at which support is computed
    support_spacing: int = 2
    # number of directions of a pair: 7.5 degrees apart
    directions: int = 24
    # narrowest width of a pair; the edges of narrower ones merge
    narrowest: float = 3.2
    # number of widths, each wider than the one before by the root of two
    width_count: int = 6
    # length, in widths, along which a pair's support is averaged; tubes are longer
    support_widths: float = 4.0
    # smallest averaging length
    least_length: float = 12.0
    # slope, in levels per cell, at which an edge has half the strength of a strong one. Levels are
    # square roots of grey levels (255 is unchanged), whose noise is even and half a level at most;
    # this is five times that (derived)
    half_slope: float = 2.5
    # weight of a slope along a pair against one across it: directions within 27 degrees pass
    along_weight: float = 2.0
    # support below which a point has no value: one in four points of its length
    least_support: float = 0.24
    # largest negative logarithm of rarity; one leg must not outweigh six
    most_surprisal: float = 4.0
    # integer steps of the maps per unit of the negative logarithm: 4 times 60 fits into 8 bits
    steps: int = 60

    @cached_property
    def widths(self) -> Array:
        """Widths of a pair, fine cells."""
        return self.narrowest * np.sqrt(2.0) ** np.arange(self.width_count)


TUBE_CHART_OPTIONS = TubeChartOptions()


class TubeChart(NamedTuple):
    """Maps of possible tubes.

    surprisal : (W, D, h, w) uint8, negative logarithm of the share of points with such clear a
        pair, in steps of 1 / ``options.steps``.
    scale : fine cells per radian.
    size : (w, h) of the fine chart.
    options : of the chart.
    """

    surprisal: Integers
    scale: float
    size: tuple[int, int]
    options: TubeChartOptions

    @property
    def middle(self) -> Array:
        """Middle of the chart, fine cells (2,)."""
        return (np.array(self.size) - 1) / 2

    def width_number(self, width: Array) -> Integers:
        """Indices (...) of the tabulated widths nearest to widths (...) in fine cells, by ratio."""
        apart = np.abs(np.log(np.maximum(width, 1e-9))[..., None] - np.log(self.options.widths))
        return apart.argmin(axis=-1)


def tube_chart(
    image: Integers, camera: Camera, options: TubeChartOptions = TUBE_CHART_OPTIONS
) -> TubeChart:
    """Chart of one image (height, width)."""
    grey, scale = _on_chart(image, camera, options)
    surprisal = _rarity(_support(grey, options), options)
    return TubeChart(surprisal, scale, (grey.shape[1], grey.shape[0]), options)


def _on_chart(image: Integers, camera: Camera, options: TubeChartOptions) -> tuple[Array, float]:
    """Levels (h, w) on the fine chart, equidistant angles from the optical axis, and cells per
    radian.
    """
    import cv2

    height, width = image.shape
    across = np.stack([np.linspace(0, width - 1, 65), np.full(65, (height - 1) / 2)], axis=-1)
    along = np.stack([np.full(65, (width - 1) / 2), np.linspace(0, height - 1, 65)], axis=-1)
    half = [
        float(np.nanmax(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])))
        for rays in (camera.ray(across), camera.ray(along))
    ]
    # angular extent along the image's two middle lines gives scale and size
    scale = options.cells / (2 * max(half))
    w, h = (int(2 * angle * scale) for angle in half)
    x, y = np.meshgrid((np.arange(w) - (w - 1) / 2) / scale, (np.arange(h) - (h - 1) / 2) / scale)
    away = np.hypot(x, y)
    # pixel of each cell
    sine = np.sinc(away / np.pi)
    pixel = camera.project(np.stack([x * sine, y * sine, np.cos(away)], axis=-1))
    pixel = np.nan_to_num(pixel, nan=-1e4).astype(np.float32)
    blur = 0.4 * width / w  # against aliasing
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur) if blur > 0.4 else image
    smooth = np.asarray(smooth, dtype=np.float32)
    grey = cv2.remap(
        smooth, np.ascontiguousarray(pixel[..., 0]), np.ascontiguousarray(pixel[..., 1]),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.sqrt(255.0 * np.asarray(grey)), scale


def _support(grey: Array, options: TubeChartOptions) -> Array:
    """Clarity of a pair at each point, (widths, directions, h, w), 0 to 1.

    Points are the options' spacing apart.
    """
    import cv2

    dx, dy = (
        cv2.Sobel(grey.astype(np.float32), cv2.CV_32F, *direction) / 8
        for direction in ((1, 0), (0, 1))
    )
    spacing = options.support_spacing
    height, width = (n // spacing for n in grey.shape)
    out = np.empty((len(options.widths), options.directions, height, width), dtype=np.float32)
    for k in range(options.directions):
        angle = np.pi * k / options.directions
        n = np.array([np.cos(angle), np.sin(angle)])
        # strength of rising and falling edges with normal n
        slope, other = dx * n[0] + dy * n[1], np.abs(dy * n[0] - dx * n[1])
        rising, falling = (
            _strength(sign * slope - options.along_weight * other, options) for sign in (1, -1)
        )
        for w, wide in enumerate(options.widths):
            # edges at x + n wide/2 and x - n wide/2: those of a bright tube rise inwards, of a dark
            # one fall
            step = np.rint(n * wide / 2).astype(int)
            bright = np.minimum(_shifted(falling, step), _shifted(rising, -step))
            dark = np.minimum(_shifted(rising, step), _shifted(falling, -step))
            pair = np.maximum(bright, dark)[: height * spacing, : width * spacing]
            # largest value of each block of cells, averaged along the pair
            rows = reduce(
                np.maximum,
                (pair[n::spacing] for n in range(spacing)),
            )
            pair = reduce(
                np.maximum,
                (rows[:, n::spacing] for n in range(spacing)),
            )
            out[w, k] = cv2.filter2D(pair, -1, _along_pair(options)[k][w])
    return out


def _strength(slope: Array, options: TubeChartOptions) -> Array:
    """Strength of edges, 0 to 1, from slopes (h, w); dilated by one cell."""
    import cv2

    up = np.square(np.maximum(slope, 0.0))
    wide = cv2.dilate(up / (up + options.half_slope**2), np.ones((3, 3), np.uint8))
    return np.asarray(wide, dtype=np.float32)


def _shifted(values: Array, step: Integers) -> Array:
    """Values (h, w) at x + step, zero outside."""
    x, y = (int(s) for s in step)
    height, width = values.shape
    out = np.zeros_like(values)
    out[max(-y, 0) : height - max(y, 0), max(-x, 0) : width - max(x, 0)] = values[
        max(y, 0) : height - max(-y, 0), max(x, 0) : width - max(-x, 0)
    ]
    return out


@cache
def _along_pair(options: TubeChartOptions) -> tuple[tuple[Array, ...], ...]:
    """Kernels that average along a pair of each direction and each width."""
    angles = np.pi * np.arange(options.directions) / options.directions
    lengths = np.maximum(options.support_widths * options.widths, options.least_length)
    return tuple(
        tuple(
            _line(np.array([-np.sin(angle), np.cos(angle)]), length / options.support_spacing)
            for length in lengths.tolist()
        )
        for angle in angles
    )


def _line(along: Array, length: float) -> Array:
    """Kernel that averages along a line of a direction (2,) and a length in cells."""
    half = int(np.ceil(length / 2))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    for place in np.linspace(-length / 2, length / 2, 8 * half):
        x, y = np.rint(half + place * along).astype(int)
        kernel[y, x] = 1.0
    return kernel / kernel.sum()


def _rarity(support: Array, options: TubeChartOptions) -> Integers:
    """Maps of :class:`TubeChart` from supports (W, D, h, w).

    A map cell takes the maximum over its surroundings and the neighbouring directions, the spacing
    of the hypotheses.
    """
    import cv2

    cell = options.map_cell // options.support_spacing
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
        # share of the points with at least this support
        count = np.bincount(level[place].ravel(), minlength=256)
        share = count[::-1].cumsum()[::-1] / count.sum()
        worth = np.minimum(-np.log(np.maximum(share, 1e-9)), options.most_surprisal)
        worth[: round(255 * options.least_support)] = 0.0
        out[place] = np.rint(options.steps * worth)[level[place]]
    return out
