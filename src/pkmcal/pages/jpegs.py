"""Photographs as small JPEG files: in a page base64, in grey, within a number of bytes."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from pkmcal.arrays import THREADS, Integers
from pkmcal.errors import InputError
from pkmcal.observe.images import Pictures

LARGE_JPEG_WIDTH, SMALL_JPEG_WIDTH = 640, 256
"""Widths, px: to look at one, and to look over all."""
PAGE_JPEG_QUALITY = 70
JPEGS_DECODED_AT_ONCE = 32
"""Photographs that are decoded before it is asked whether there is room for more."""


def jpeg(path: Path | None, size: tuple[int, int]) -> str:
    """A photograph, ``LARGE_JPEG_WIDTH`` or as wide as it is; empty where it is not there any
    more.
    """
    return _packed(Pictures([path], size, [path.name]), 0, (LARGE_JPEG_WIDTH,))[0] if path else ""


def small_and_large(
    photographs: Sequence[tuple[Sequence[Integers], int]], room: int
) -> Iterator[tuple[str, str]]:
    """Each photograph small, and large as long as there is room for ``room`` characters of both;
    empty where its file cannot be read. Ends where there is no room for small ones either.

    photographs : each as a station's, and its number among them.
    """
    remainder, waiting = room, len(photographs)
    with ThreadPoolExecutor(THREADS) as pool:
        for first in range(0, len(photographs), JPEGS_DECODED_AT_ONCE):
            some = photographs[first : first + JPEGS_DECODED_AT_ONCE]
            for small, large in pool.map(
                lambda one: _packed(one[0], one[1], (SMALL_JPEG_WIDTH, LARGE_JPEG_WIDTH)), some
            ):
                if len(small) > remainder:
                    return
                # that of this one and those that follow come before a large one
                fits = len(small) * waiting + len(large) <= remainder
                remainder, waiting = (
                    remainder - len(small) - (len(large) if fits else 0),
                    waiting - 1,
                )
                yield small, large if fits else ""


def _packed(images: Sequence[Integers], number: int, widths: Sequence[int]) -> list[str]:
    """A photograph in several widths, none more than its own."""
    try:
        image = images[number]
    except InputError:
        return [""] * len(widths)
    out: dict[int, str] = {}
    for width in sorted(widths, reverse=True):
        image = narrowed(image, width)
        out[width] = base64.b64encode(coded(image, PAGE_JPEG_QUALITY)).decode("ascii")
    return [out[width] for width in widths]


def narrowed(image: Any, width: int) -> Any:
    """A picture (h, w), no wider than ``width`` px."""
    import cv2

    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    # between neighbours, at an eighth of the price, as long as these leave none out
    how = cv2.INTER_LINEAR if image.shape[1] <= 2 * width else cv2.INTER_AREA
    return cv2.resize(image, (width, height), interpolation=how)


def coded(image: Any, quality: int) -> bytes:
    """A picture as a JPEG file."""
    import cv2

    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
