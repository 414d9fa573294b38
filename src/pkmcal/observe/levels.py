"""Grey levels of a photograph, or the light that they code, at places between its pixels.

Only the part of the photograph that the places lie in is worked on: a machine fills a quarter of
it, and what is worked out of a whole one does not stay in the processor's cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.response import Response, light_in

INTERPOLATION_MARGIN = 2
"""Pixels about a place whose levels an interpolation takes."""
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
    """Light (m, n) in a photograph (height, width) at columns and rows (m, n), interpolated.

    m, n : fewer than 2**15, as cv2.remap wants it. blur : standard deviation (px) of a Gaussian
    that goes over the light first. response : how the levels code it; linear leaves them as they
    are. Places outside have the light of its border, places that are no numbers any light.
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
    across: Any = x - np.float32(columns.start)
    down: Any = y - np.float32(rows.start)
    found: Any = cv2.remap(levels, across, down, how, borderMode=cv2.BORDER_REPLICATE)
    return found


def _spanned(places: Array, around: int, size: int) -> tuple[Array, slice]:
    """Places (m, n) in single precision, 0 where they are no numbers, and the pixels, of so many in
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
