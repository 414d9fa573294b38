"""Response of a camera: how grey levels depend on light.

Optics blur light, not grey levels. Sensors count light, and raw converters mostly store these
counts. Telephones, and most files made to be looked at, encode the counts: IEC 61966-2-1 (sRGB)
gives dark levels more room, so half the light has the level 188 of 255. In levels, a blurred edge
is then displaced towards its dark side by up to half the blur, and a bright leg appears wider than
it is.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np

from pkmcal.arrays import Array, Integers

Response = Literal["linear", "srgb"]
"""Encodings of light in grey levels."""
OTHER_RESPONSE: dict[Response, Response] = {"linear": "srgb", "srgb": "linear"}
JPEG_FILE_ENDINGS = frozenset({".jpg", ".jpeg"})
"""Suffixes of files whose standards (JFIF 1.02, CIPA DC-008) specify sRGB encoding."""


@cache
def light_of_levels(response: Response) -> Array:
    """Light (256,) of each of an image's 256 grey levels, 255 for the brightest."""
    level = np.arange(256) / 255
    if response == "srgb":
        level = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    light: Array = (255 * level).astype(np.float32)
    light.flags.writeable = False
    return light


def levels_of_light(light: Array, response: Response) -> Array:
    """Grey levels, not rounded, of light 0..255, any shape; inverse of :func:`light_of_levels`."""
    if response == "linear":
        return light
    part = np.clip(light / 255, 0, 1)
    curve = 1.055 * np.maximum(part, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(part <= 0.0031308, 12.92 * part, curve) * 255


def light_in(image: Integers, response: Response) -> Any:
    """Light of an image (height, width), uint8; the image itself for a linear response."""
    if response == "linear":
        return image
    import cv2

    return cv2.LUT(image, light_of_levels(response))
