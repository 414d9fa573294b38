"""Grey levels of a photograph, or the light that they code, at places between its pixels; and what
any picture has at places.

Of a photograph only the part that the places lie in is worked on: a machine fills a quarter of it,
and what is worked out of a whole one does not stay in the processor's cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.response import Response, light_in

INTERPOLATION_MARGIN = 2
"""Pixels about a place whose levels an interpolation takes."""
MOST_ROWS_INTERPOLATED = 32_000
"""Rows, or columns, of a picture that cv2.remap takes, and of the places in it: a little fewer than
2**15."""
PLACES_A_ROW = 512
"""Places that it is given in a row: of shorter rows it takes half as much time again."""
PLACES_IN_ONE_ROW = 2**14
"""Places up to which all are one row: rows are shared out among threads, and to wake these costs
more than so few places take."""
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
    """Light (...) in a photograph (height, width) at columns and rows (...), interpolated.

    blur : standard deviation (px) of a Gaussian that goes over the light first. response : how the
    levels code it; linear leaves them as they are. Places outside have the light of its border,
    places that are no numbers any light.
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
    """What a picture (height, width) has at columns and rows (...), of the nearest pixel or between
    pixels as cv2 interpolates; that of its border outside.

    Neither side of the picture is longer than MOST_ROWS_INTERPOLATED; places are no more than so
    many rows of PLACES_A_ROW, 16 million.
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
    """Places (...) in single precision, 0 where they are no numbers, and the pixels, of so many in
    a row, in which they lie, with so many to both sides.
    """
    places = places.astype(np.float32, copy=False)
    low, high = places.min(), places.max()
    if not (np.isfinite(low) and np.isfinite(high)):  # of any that is no number, one is none
        places = np.where(np.isfinite(places), places, np.float32(0))
        low, high = places.min(), places.max()
    first = min(max(int(low) - around, 0), size - 1)
    last = min(max(int(high) + 1 + around, first), size - 1)
    return places, slice(first, last + 1)
