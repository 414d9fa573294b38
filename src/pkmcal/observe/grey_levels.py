"""Interpolation of images: grey levels, or light, at points between pixels.

Only the part of an image that contains the points is processed: a machine fills a quarter of it,
and intermediate arrays of a whole image do not stay in the processor's cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.response import Response, light_in

INTERPOLATION_MARGIN = 2
"""Pixels about a point that an interpolation uses."""
MOST_ROWS_INTERPOLATED = 32_000
"""Most rows, or columns, of an array for cv2.remap, and of the points in it: a little fewer than
2**15."""
PLACES_A_ROW = 512
"""Points in a row for cv2.remap: with shorter rows it takes half as much time again."""
PLACES_IN_ONE_ROW = 2**14
"""Number of points up to which all are one row: rows are distributed over threads, and waking these
takes longer than so few points."""
BLUR_KERNEL_END = 4.0
"""Standard deviations of a blur at which its kernel ends."""


def levels_at(
    image: Any,
    x: Array,
    y: Array,
    *,
    cubic: bool = False,
    blur: float = 0.0,
    response: Response = "linear",
) -> Array:
    """Light (...) in an image (height, width) at columns and rows (...), interpolated.

    blur : standard deviation (px) of a Gaussian by which the light is smoothed first. response :
    curve from light to grey levels; linear leaves them unchanged. Points outside have the light of
    the border, points with NaN any light.
    """
    import cv2

    if not x.size:
        return np.zeros(x.shape, np.float32)
    half = round(BLUR_KERNEL_END * blur)
    height, width = image.shape
    x, columns = _spanned(x, INTERPOLATION_MARGIN + half, width)
    y, rows = _spanned(y, INTERPOLATION_MARGIN + half, height)
    part = light_in(image[rows, columns], response)
    if blur:
        kernel = cv2.getGaussianKernel(2 * half + 1, blur, cv2.CV_32F)
        levels: Any = cv2.sepFilter2D(part, cv2.CV_32F, kernel, kernel)
    else:  # floats, because cv2 rounds what it interpolates in bytes to whole grey levels
        levels = part.astype(np.float32, copy=False)
    how = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    return interpolated(levels, x - np.float32(columns.start), y - np.float32(rows.start), how)


def interpolated(picture: Any, x: Array, y: Array, how: int) -> Array:
    """Values of an array (height, width) at columns and rows (...), interpolated by cv2 in the way
    ``how``; those of the border outside.

    Neither side of the array is longer than MOST_ROWS_INTERPOLATED; points are at most so many rows
    of PLACES_A_ROW, 16 million.
    """
    import cv2

    if not x.size:
        return np.zeros(x.shape, dtype=np.float32)
    rows = -(-x.size // PLACES_A_ROW) if x.size > PLACES_IN_ONE_ROW else 1
    flat = np.empty((2, rows * PLACES_A_ROW if rows > 1 else x.size), dtype=np.float32)
    flat[0, : x.size], flat[1, : x.size] = x.ravel(), y.ravel()
    flat[:, x.size :] = 0.0
    across, down = flat.reshape(2, rows, -1)
    value: Any = cv2.remap(picture, across, down, how, borderMode=cv2.BORDER_REPLICATE)
    return value.reshape(-1)[: x.size].reshape(x.shape)


def _spanned(places: Array, around: int, size: int) -> tuple[Array, slice]:
    """Points (...) in single precision, 0 where NaN, and the slice of ``size`` pixels that contains
    them, with a margin of ``around`` to both sides.
    """
    places = places.astype(np.float32, copy=False)
    low, high = places.min(), places.max()
    if not (np.isfinite(low) and np.isfinite(high)):  # of any that is no number, one is none
        places = np.where(np.isfinite(places), places, np.float32(0))
        low, high = places.min(), places.max()
    first = min(max(int(low) - around, 0), size - 1)
    last = min(max(int(high) + 1 + around, first), size - 1)
    return places, slice(first, last + 1)
