"""``cameras.txt`` of COLMAP: one camera a line, CAMERA_ID MODEL WIDTH HEIGHT PARAMS.

COLMAP's upper left pixel has its centre at (0.5, 0.5), so the principal point moves by half a
pixel.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from pkmcal.cameras.foreign import Intrinsics, named_entry
from pkmcal.errors import InputError
from pkmcal.files import quoted
from pkmcal.wording import listed

_PIXEL_CENTER = 0.5
"""Coordinate of the first pixel's centre in COLMAP."""
_LINE = re.compile(r"(\d+)\s+([A-Z][A-Z_]+)\s+(\d{1,9})\s+(\d{1,9})\s+(\S.*)")


class _Model(NamedTuple):
    """pkmcal's model, number of focal lengths (1 or 2), and of coefficients behind the centre."""

    model: str
    focals: int
    coefficients: int


_MODELS = {
    "SIMPLE_PINHOLE": _Model("pinhole", 1, 0),
    "PINHOLE": _Model("pinhole", 2, 0),
    "SIMPLE_RADIAL": _Model("pinhole", 1, 1),
    "RADIAL": _Model("pinhole", 1, 2),
    "OPENCV": _Model("pinhole", 2, 4),
    "FULL_OPENCV": _Model("rational", 2, 8),
    "OPENCV_FISHEYE": _Model("fisheye", 2, 4),
    "SIMPLE_RADIAL_FISHEYE": _Model("fisheye", 1, 1),
    "RADIAL_FISHEYE": _Model("fisheye", 1, 2),
}


def is_colmap(text: str) -> bool:
    """Whether a text is COLMAP's cameras.txt."""
    first = next(iter(_lines(text)), "")
    return _LINE.fullmatch(first) is not None or "CAMERA_ID, MODEL, WIDTH, HEIGHT" in text


def read_colmap(text: str, label: str, name: str | None) -> Intrinsics:
    """Intrinsics of one camera of cameras.txt.

    name : CAMERA_ID; may be None if the file has one camera. Raises InputError.
    """
    entries = {line.split()[0]: line for line in _lines(text)}
    line = named_entry(entries, name, label)
    where = f"{label}, camera {line.split()[0]}"
    match = _LINE.fullmatch(line)
    if match is None:
        raise InputError(
            "not a camera as COLMAP writes it",
            where=where,
            found=quoted(line),
            expected="CAMERA_ID MODEL WIDTH HEIGHT PARAMS",
        )
    _, word, width, height, rest = match.groups()
    if word not in _MODELS:
        raise InputError(
            "this camera or lens model is not supported",
            where=where,
            found=word,
            expected=listed(list(_MODELS)),
            next_step="Calibrate again from images of a board: pkmcal camera",
        )
    model, focals, coefficients = _MODELS[word]
    numbers: list[float] = []
    try:
        numbers.extend(float(v) for v in rest.split())
    except ValueError:
        numbers.clear()
    if len(numbers) != focals + 2 + coefficients or not np.all(np.isfinite(numbers)):
        raise InputError(
            "this is not the expected list of numbers",
            where=where,
            found=quoted(rest),
            expected=f"{focals + 2 + coefficients} numbers for {word}",
        )
    x, y = numbers[focals : focals + 2]
    return Intrinsics(
        model=model,
        image_size=(int(width), int(height)),
        focal=(numbers[0], numbers[focals - 1]),
        center=(x - _PIXEL_CENTER, y - _PIXEL_CENTER),
        distortion=tuple(numbers[focals + 2 :]),
        where=where,
    )


def _lines(text: str) -> list[str]:
    """Lines of a text without comments and empty lines."""
    stripped = (line.strip() for line in text.splitlines())
    return [line for line in stripped if line and not line.startswith("#")]
