"""Interpolation of images between pixels: grey levels, or the light that they encode, and tables.

Only the part of an image that contains the points is processed. A machine fills about a quarter of
an image, and intermediate results of a whole image do not fit into the processor's cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.response import Response, light_in

INTERPOLATION_MARGIN = 2
"""Pixels around a point that an interpolation reads."""
MOST_ROWS_INTERPOLATED = 32_000
"""Largest number of rows or columns, of the image and of the array of points, that cv2.remap
accepts: slightly less than 2**15."""
POINTS_A_ROW = 512
"""Row length of the array of points passed to cv2.remap; shorter rows take half as much time
again."""
POINTS_IN_ONE_ROW = 2**14
"""Largest number of points passed as one row. Rows are distributed among threads, and waking
these costs more than so few points take."""
BLUR_KERNEL_END = 4.0
"""Half length of a Gaussian kernel, in its standard deviations."""


def levels_at(
    image: Any,
    x: Array,
    y: Array,
    *,
    cubic: bool = False,
    blur: float = 0.0,
    response: Response = "linear",
) -> Array:
    """Light (...) in an image (height, width) at columns x and rows y (...), interpolated.

    Outside the image the value at its border is returned, at points that are not finite any value.

    cubic : bicubic instead of bilinear interpolation.
    blur : standard deviation (px) of a Gaussian applied to the light first.
    response : how grey levels encode light; linear returns the grey levels.
    """
    import cv2

    if not x.size:
        return np.zeros(x.shape, np.float32)
    half = round(BLUR_KERNEL_END * blur)
    height, width = image.shape
    # crop to the points and the reach of kernel and interpolation
    x, columns = _spanned(x, INTERPOLATION_MARGIN + half, width)
    y, rows = _spanned(y, INTERPOLATION_MARGIN + half, height)
    part = light_in(image[rows, columns], response)
    if blur:
        kernel = cv2.getGaussianKernel(2 * half + 1, blur, cv2.CV_32F)
        levels: Any = cv2.sepFilter2D(part, cv2.CV_32F, kernel, kernel)
    else:  # floats: cv2 rounds interpolated bytes to whole grey levels
        levels = part.astype(np.float32, copy=False)
    how = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    return interpolated(levels, x - np.float32(columns.start), y - np.float32(rows.start), how)


def interpolated(picture: Any, x: Array, y: Array, how: int) -> Array:
    """Values of an array (height, width) at columns x and rows y (...), interpolated by cv2.remap.

    Outside the array the value at its border is returned. No side of the array may be longer than
    MOST_ROWS_INTERPOLATED, and the points may be no more than as many rows of POINTS_A_ROW, 16
    million.

    how : cv2.INTER_NEAREST, INTER_LINEAR or INTER_CUBIC.
    """
    import cv2

    if not x.size:
        return np.zeros(x.shape, dtype=np.float32)
    # arrange the points in rows, the last one padded with zeros
    rows = -(-x.size // POINTS_A_ROW) if x.size > POINTS_IN_ONE_ROW else 1
    flat = np.empty((2, rows * POINTS_A_ROW if rows > 1 else x.size), dtype=np.float32)
    flat[0, : x.size], flat[1, : x.size] = x.ravel(), y.ravel()
    flat[:, x.size :] = 0.0
    across, down = flat.reshape(2, rows, -1)
    value: Any = cv2.remap(picture, across, down, how, borderMode=cv2.BORDER_REPLICATE)
    return value.reshape(-1)[: x.size].reshape(x.shape)


def _spanned(places: Array, around: int, size: int) -> tuple[Array, slice]:
    """Coordinates (...) in single precision, 0 where not finite, and the slice of pixels around
    them.

    The slice extends by ``around`` pixels beyond the coordinates, within 0 to ``size``.
    """
    places = places.astype(np.float32, copy=False)
    low, high = places.min(), places.max()
    if not (np.isfinite(low) and np.isfinite(high)):  # minimum and maximum propagate NaN
        places = np.where(np.isfinite(places), places, np.float32(0))
        low, high = places.min(), places.max()
    first = min(max(int(low) - around, 0), size - 1)
    last = min(max(int(high) + 1 + around, first), size - 1)
    return places, slice(first, last + 1)
