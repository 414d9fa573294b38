"""Quantities with units in files: lengths, angles and shares such as 269.3 mm, 30 deg, 0.1 %.

A number without a unit is in metres, radians or parts of one. :data:`Metres`, :data:`Radians`,
:data:`Share` and :data:`Reading` are the field types of a file's schema. In a table, the head of a
column may name its unit, ``leg1 [mm]``.
"""

from __future__ import annotations

import re
from decimal import Decimal
from functools import cache, partial
from math import degrees
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator

from pkmcal.files.documents import quoted
from pkmcal.files.schema import FieldError

LARGEST_UNITLESS_LENGTH = 50.0
"""Length (m) above which a number without a unit was written in millimetres."""
_QUANTITY = re.compile(
    r"([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*([A-Za-zµμ°%]{1,20})"
)
_HEAD = re.compile(r"(.*\S)\s*(?:\[([A-Za-zµμ°%]{1,20})\]|\(([A-Za-zµμ°%]{1,20})\))")
SHARE_UNIT_NAMES = ("%", "percent", "ppm")
_ROOTS = {"meter": "m", "radian": "rad", "dimensionless": ""}
_KINDS = {
    "m": ("a length", "metres", "269.3 mm"),
    "rad": ("an angle", "radians", "30 deg"),
    "": ("a share", "parts of one", "0.1 %"),
    "m or rad": ("a length or an angle", "metres or radians", "0.01 mm"),
}


class Unit(NamedTuple):
    """Factor of a unit to the SI unit ``kind``: "m", "rad" or "" (parts of 1).

    name : as it is written.
    """

    factor: float
    kind: str
    name: str


@cache
def unit(name: str) -> Unit | None:
    """Unit of a name such as mm, in, deg or %; None for units of other quantities."""
    import pint

    try:
        factor, root = _registry().get_root_units(name)
    except (pint.PintError, AssertionError):  # the latter for single signs
        return None
    kind = _ROOTS.get(str(root))
    # decibels and pi are dimensionless, too
    if kind is None or (kind == "" and name not in SHARE_UNIT_NAMES):
        return None
    return Unit(float(factor), kind, name)


@cache
def _registry() -> Any:
    """Registry of units."""
    import pint  # a third of a second: only where somebody writes a unit

    return pint.UnitRegistry()


def written_unit(value: object) -> Unit | None:
    """Unit of a value as written in a file, or None."""
    match = _QUANTITY.fullmatch(value.strip()) if isinstance(value, str) else None
    return unit(match[2]) if match else None


def any_unit(data: object) -> bool:
    """Whether any value of a file is written with a unit."""
    if isinstance(data, (dict, list)):
        return any(map(any_unit, data.values() if isinstance(data, dict) else data))
    return written_unit(data) is not None


def split_head(head: str) -> tuple[str, Unit | None]:
    """Name of a column and the unit in its head, if there is one."""
    match = _HEAD.fullmatch(head)
    column_unit = unit(match[2] or match[3]) if match else None
    return (match[1], column_unit) if match and column_unit else (head, None)


def no_such(kind: str, value: object) -> FieldError:
    """Error for a value whose unit is of another kind."""
    what, plain, example = _KINDS[kind]
    expected = f"{plain}, or a number with its unit, such as {example}"
    return FieldError(f"this is not {what}", found=quoted(value), expected=expected)


def _read(kind: str, value: Any) -> Any:
    """Convert a text with a unit to a number in SI; other values pass, for the schema to check."""
    match = _QUANTITY.fullmatch(value.strip()) if isinstance(value, str) else None
    if not match:
        return value
    stated_unit = unit(match[2])
    if stated_unit is None or stated_unit.kind not in kind.split(" or "):
        raise no_such(kind, value)
    # decimal arithmetic, so that 269.3 mm equals 0.2693
    return float(Decimal(match[1]) * Decimal(repr(stated_unit.factor)))


READABLE_UNITS = ("m", "rad", "m or rad", "deg")


def read_quantity(text: str, unit_name: str) -> float:
    """Number of a text, with or without a unit, in ``unit_name``, one of ``READABLE_UNITS``.

    Raises ValueError for other texts.
    """
    if unit_name != "deg":
        return float(_read(unit_name, text))
    return float(text) if not _QUANTITY.fullmatch(text.strip()) else degrees(_read("rad", text))


Metres = Annotated[float, BeforeValidator(partial(_read, "m"))]
Radians = Annotated[float, BeforeValidator(partial(_read, "rad"))]
Share = Annotated[float, BeforeValidator(partial(_read, ""))]
Reading = Annotated[float, BeforeValidator(partial(_read, "m or rad"))]
Point = tuple[Metres, Metres, Metres]
"""[x, y, z], each with or without a unit."""
