"""Images as greyscale JPEG files, base64-encoded within a budget of characters for a page."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from pkmcal.arrays import THREADS, Integers
from pkmcal.errors import InputError

FULL_JPEGS, FULL_JPEG_WIDTH, JPEG_WIDTH = 12, 2048, 640
"""Number of the first images, which keep their pixels, their largest width, and that of the others,
px: a page with 45 images has less than 3 MB."""
PAGE_JPEG_CHARACTERS = 8_000_000
"""Characters of all JPEGs of a page."""
SMALL_JPEG_WIDTH = 256
"""Width (px) of an image for which the budget holds no more."""
PAGE_JPEG_QUALITY = 70
JPEGS_DECODED_AT_ONCE = 32
"""Images decoded before the remaining budget is checked again."""


def jpegs_within(images: Sequence[tuple[Sequence[Integers], int]], room: int) -> Iterator[str]:
    """Base64 JPEG of each image, within ``room`` characters in all.

    A small one where the budget does not suffice for more, empty where the file cannot be read.
    Iteration ends where the budget does not hold even a small one.

    images : a station's images, and the index of one of them, for each image.
    """
    remainder, waiting = room, len(images)
    with ThreadPoolExecutor(THREADS) as pool:
        for first in range(0, len(images), JPEGS_DECODED_AT_ONCE):
            some = images[first : first + JPEGS_DECODED_AT_ONCE]
            widths = [
                FULL_JPEG_WIDTH if k < FULL_JPEGS else JPEG_WIDTH
                for k in range(first, first + len(some))
            ]
            for small, large in pool.map(
                lambda one, width: _base64_jpegs(one[0], one[1], (SMALL_JPEG_WIDTH, width)),
                some,
                widths,
            ):
                if len(small) > remainder:
                    return
                # keep room for the small versions of all images that follow
                fits = len(small) * (waiting - 1) + len(large) <= remainder
                chosen = large if fits else small
                remainder, waiting = remainder - len(chosen), waiting - 1
                yield chosen


def base64_jpeg(image: Integers, quality: int = PAGE_JPEG_QUALITY) -> str:
    """Image (h, w) as a base64 JPEG."""
    return base64.b64encode(coded(image, quality)).decode("ascii")


def _base64_jpegs(images: Sequence[Integers], number: int, widths: Sequence[int]) -> list[str]:
    """Base64 JPEGs of an image in several widths.

    Never enlarged; empty texts if the image cannot be read.
    """
    try:
        image = images[number]
    except InputError:
        return [""] * len(widths)
    out: dict[int, str] = {}
    # from large to small, each scaled from the previous one
    for width in sorted(widths, reverse=True):
        image = narrowed(image, width)
        out[width] = base64_jpeg(image)
    return [out[width] for width in widths]


def narrowed(image: Any, width: int) -> Any:
    """Image (h, w) scaled down to a width of at most ``width`` px."""
    import cv2

    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    # linear interpolation costs an eighth, and skips no pixels up to a factor of two
    how = cv2.INTER_LINEAR if image.shape[1] <= 2 * width else cv2.INTER_AREA
    return cv2.resize(image, (width, height), interpolation=how)


def coded(image: Any, quality: int) -> bytes:
    """Image as the bytes of a JPEG file."""
    import cv2

    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
