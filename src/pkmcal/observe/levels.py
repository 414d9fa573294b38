"""Grey levels of a photograph at places between its pixels.

Only the part of the photograph that the places lie in is worked on: a machine fills a quarter of
it, and what is worked out of a whole one does not stay in the processor's cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array

INTERPOLATION_MARGIN = 2
"""Pixels about a place whose levels an interpolation takes."""
BLUR_KERNEL_END = 4.0
"""Standard deviations of a blur at which its kernel ends."""


def levels_at(image: Any, x: Array, y: Array, *, cubic: bool = False, blur: float = 0.0) -> Array:
    """Grey levels (m, n) of a photograph (height, width) at columns and rows (m, n), interpolated.

    m, n : fewer than 2**15, as cv2.remap wants it. blur : standard deviation (px) of a Gaussian
    that goes over the photograph first. Places outside have the levels of its border, places that
    are no numbers any level.
    """
    import cv2

    if not x.size:
        return np.zeros(x.shape, np.float32)
    x, y = (_numbers(v.astype(np.float32, copy=False)) for v in (x, y))
    half = round(BLUR_KERNEL_END * blur)
    height, width = image.shape
    columns, rows = (
        _span(v, INTERPOLATION_MARGIN + half, size) for v, size in ((x, width), (y, height))
    )
    part = image[rows, columns]
    if blur:
        kernel = cv2.getGaussianKernel(2 * half + 1, blur, cv2.CV_32F)
        levels: Any = cv2.sepFilter2D(part, cv2.CV_32F, kernel, kernel)
    else:  # floats, because cv2 rounds what it interpolates in bytes to whole grey levels
        levels = part.astype(np.float32)
    how = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    across: Any = x - np.float32(columns.start)
    down: Any = y - np.float32(rows.start)
    found: Any = cv2.remap(levels, across, down, how, borderMode=cv2.BORDER_REPLICATE)
    return found


def _numbers(places: Array) -> Array:
    """Places with 0 for what is no number."""
    if np.isfinite((places.min(), places.max())).all():  # of any that is none, one is none
        return places
    return np.where(np.isfinite(places), places, 0.0)


def _span(places: Array, around: int, size: int) -> slice:
    """The pixels, of so many in a row, in which places lie, and so many to both sides."""
    first = min(max(int(places.min()) - around, 0), size - 1)
    last = min(max(int(places.max()) + 1 + around, first), size - 1)
    return slice(first, last + 1)
