"""How a camera's grey levels follow from light.

Optics blur light, not levels. Sensors count it, and what their makers' programs store is mostly
these counts. What telephones write, and whatever wants to be looked at, is coded: IEC 61966-2-1
(sRGB) gives dark levels more room, so that half the light has the level 188 of 255. There a blurred
edge leans to its dark side, by up to half its blur, and a bright leg looks wider than it is.
"""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np

from pkmcal.arrays import Array, Integers

Response = Literal["linear", "srgb"]
OTHER_RESPONSE: dict[Response, Response] = {"linear": "srgb", "srgb": "linear"}
JPEG_FILE_ENDINGS = frozenset({".jpg", ".jpeg"})
"""Of files whose standards (JFIF 1.02, CIPA DC-008) say that they are coded to be looked at."""


@cache
def light_of_levels(response: Response) -> Array:
    """Light (256,) that each of a photograph's 256 levels stands for, 255 the brightest."""
    level = np.arange(256) / 255
    if response == "srgb":
        level = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    light: Array = (255 * level).astype(np.float32)
    light.flags.writeable = False
    return light


def levels_of_light(light: Array, response: Response) -> Array:
    """The inverse of :func:`light_of_levels`, not rounded; light 0..255 of any shape."""
    if response == "linear":
        return light
    part = np.clip(light / 255, 0, 1)
    curve = 1.055 * np.maximum(part, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(part <= 0.0031308, 12.92 * part, curve) * 255


def light_in(image: Integers, response: Response) -> Any:
    """The light in a photograph (height, width), uint8; itself where levels are light."""
    if response == "linear":
        return image
    import cv2

    return cv2.LUT(image, light_of_levels(response))
