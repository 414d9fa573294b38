"""``.cameramodel`` files of mrcal: a Python dictionary with lensmodel, intrinsics and imagersize.

mrcal's OpenCV models are OpenCV's with the same order of coefficients; pixel centres are at
integers.
"""

from __future__ import annotations

import ast
from math import isfinite
from typing import Any

from pkmcal.cameras.foreign import Intrinsics
from pkmcal.errors import InputError
from pkmcal.files import quoted
from pkmcal.wording import listed

_LENS_COEFFICIENTS = {
    "PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12,
}  # fmt: skip
"""Number of distortion coefficients by mrcal's lens model."""
_PREFIX = "LENSMODEL_"


def is_mrcal(text: str) -> bool:
    """Whether a text is a .cameramodel file."""
    lines = (line.strip() for line in text.splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    return first.startswith("{") and "lensmodel" in text


def read_mrcal(text: str, label: str) -> Intrinsics:
    """Intrinsics of a .cameramodel file; raises InputError for lens models that pkmcal lacks."""
    data, line, found = None, None, None
    try:
        tree = ast.parse(text.strip(), mode="eval")
        # a word without quotes, such as nan
        word = next((node for node in ast.walk(tree) if isinstance(node, ast.Name)), None)
        line, found = (word.lineno, word.id) if word else (None, None)
        data = ast.literal_eval(tree)
    except SyntaxError as error:
        line, found = error.lineno, error.text and error.text.strip()
    except (ValueError, TypeError, RecursionError, MemoryError):
        pass  # the line is known, or the text is none of mrcal's; TypeError: a list as a key
    if not isinstance(data, dict):
        raise InputError(
            "not valid as mrcal writes it",
            where=f"{label}, line {line}" if line else label,
            found=found and quoted(found),
            expected="a dictionary with lensmodel, intrinsics and imagersize, numbers and texts in"
            " quotes",
        )
    fields = {_text(key): value for key, value in data.items()}
    lens = _text(fields.get("lensmodel")).removeprefix(_PREFIX)
    if lens not in _LENS_COEFFICIENTS:
        splined = lens.startswith("SPLINED")
        raise InputError(
            "a splined lens model has more parameters than pkmcal's cameras"
            if splined
            else "this camera or lens model is not supported",
            where=f"{label}, lensmodel",
            found=_PREFIX + lens if lens else quoted(fields.get("lensmodel")),
            expected=listed([_PREFIX + name for name in _LENS_COEFFICIENTS]),
            next_step="Fit one with mrcal-convert-lensmodel, LENSMODEL_OPENCV8 for wide lenses, or"
            " calibrate again from images of a board: pkmcal camera",
        )
    count = 4 + _LENS_COEFFICIENTS[lens]
    numbers = _numbers(fields.get("intrinsics"), count, f"{label}, intrinsics")
    width, height = _numbers(fields.get("imagersize"), 2, f"{label}, imagersize")
    return Intrinsics(
        model="rational",
        image_size=(width, height),
        focal=(numbers[0], numbers[1]),
        center=(numbers[2], numbers[3]),
        distortion=tuple(numbers[4:]),
        where=label,
    )


def _text(value: Any) -> str:
    """Text of a string or of bytes, which mrcal reads as well; empty for others."""
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else ""


def _numbers(values: Any, count: int, where: str) -> list[float]:
    """List of finite numbers; raises InputError for another value or length."""
    numbers: list[float] = []
    try:
        numbers.extend(float(v) for v in values)
    except (TypeError, ValueError, OverflowError):
        numbers.clear()
    if len(numbers) != count or not all(map(isfinite, numbers)):
        raise InputError(
            "this is not the expected list of numbers",
            where=where,
            found=quoted(values),
            expected=f"{count} numbers",
        )
    return numbers
