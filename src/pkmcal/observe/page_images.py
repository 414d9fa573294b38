"""Images of a page: greyscale WebP files, base64-encoded within a budget of characters.

At equal error a WebP file is half as large as a JPEG file, and all browsers read it.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from typing import Any

from pkmcal.arrays import THREADS, Integers
from pkmcal.errors import InputError
from pkmcal.observe.jpegs import narrowed

FULL_IMAGES, FULL_WIDTH, USUAL_WIDTH = 12, 2048, 640
"""Number of the first images, which keep their pixels, their largest width, and that of the others,
px."""
PAGE_IMAGE_CHARACTERS = 8_000_000
"""Characters of all images of a page."""
SMALL_WIDTH = 256
"""Width (px) of an image for which the budget holds no more."""
WEBP_QUALITY = 80
NARROWED_WEBP_QUALITY = 75
"""Likewise of an image that has lost its pixels: the encoder's default."""
WEBP_METHOD = 4
"""Effort of the encoder, 0 to 6: less costs a fifteenth of the size, more twice the time."""
DECODED_AT_ONCE = 32
"""Images decoded before the remaining budget is checked again."""


def images_within(images: Sequence[tuple[Sequence[Integers], int]], room: int) -> Iterator[str]:
    """Base64 file of each image, within ``room`` characters in all.

    A small one where the budget does not suffice for more, empty where the file cannot be read.
    Iteration ends where the budget does not hold even a small one.

    images : a station's images, and the index of one of them, for each image.
    """
    remainder, waiting = room, len(images)
    with ThreadPoolExecutor(THREADS) as pool:
        for first in range(0, len(images), DECODED_AT_ONCE):
            some = images[first : first + DECODED_AT_ONCE]
            widths = [
                FULL_WIDTH if k < FULL_IMAGES else USUAL_WIDTH
                for k in range(first, first + len(some))
            ]
            for small, large in pool.map(
                lambda one, width: _in_widths(one[0], one[1], (SMALL_WIDTH, width)),
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


def base64_webp(image: Any, quality: int = WEBP_QUALITY) -> str:
    """Image (h, w) as a base64 WebP file."""
    from PIL import Image

    content = BytesIO()
    Image.fromarray(image).save(content, "WEBP", quality=quality, method=WEBP_METHOD)
    return base64.b64encode(content.getvalue()).decode("ascii")


def _in_widths(images: Sequence[Integers], number: int, widths: Sequence[int]) -> list[str]:
    """Base64 files of an image in several widths.

    Never enlarged; empty texts if the image cannot be read.
    """
    try:
        image = images[number]
    except InputError:
        return [""] * len(widths)
    out, full = dict[int, str](), image.shape[1]
    # from large to small, each scaled from the previous one
    for width in sorted(widths, reverse=True):
        image = narrowed(image, width)
        whole = image.shape[1] == full
        out[width] = base64_webp(image, WEBP_QUALITY if whole else NARROWED_WEBP_QUALITY)
    return [out[width] for width in widths]
