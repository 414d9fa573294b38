"""Quantities with units in files: lengths, angles and shares such as 269.3 mm, 30 deg, 0.1 %.

A number without a unit is in metres, radians or parts of one. :data:`Metres`, :data:`Radians`,
:data:`Share` and :data:`Reading` are the field types of a file's schema. In a table, the head of a
column may name its unit, ``leg1 [mm]``. Options of commands take units of px, time, temperature and
speed as well.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal
from functools import cache, partial
from math import radians
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator

from pkmcal.errors import InputError
from pkmcal.files.documents import quoted
from pkmcal.files.schema import FieldError

LARGEST_UNITLESS_LENGTH = 50.0
"""Length (m) above which a number without a unit was written in millimetres."""
_QUANTITY = re.compile(
    r"([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*([A-Za-zµμ°%][A-Za-zµμ°%/]{0,19})"
)
_HEAD = re.compile(r"(.*\S)\s*(?:\[([A-Za-zµμ°%]{1,20})\]|\(([A-Za-zµμ°%]{1,20})\))")
SHARE_UNIT_NAMES = ("%", "percent", "ppm")
_ROOTS = {
    "meter": "m",
    "radian": "rad",
    "dimensionless": "",
    "pixel": "px",
    "second": "s",
    "1 / second": "1/s",
    "kelvin": "K",
    "meter / second": "m/s",
    "radian / second": "rad/s",
}
KINDS_IN_FILES = ("m", "rad", "")
_KINDS = {
    "m": ("a length", "metres", "269.3 mm"),
    "rad": ("an angle", "radians", "30 deg"),
    "": ("a share", "parts of one", "0.1 %"),
    "m or rad": ("a length or an angle", "metres or radians", "0.01 mm"),
}
_JOINT_EXAMPLES = {"m": "3 um", "rad": "0.001 deg", "m/s": "100 mm/s", "rad/s": "30 deg/s"}


class Unit(NamedTuple):
    """Factor of a unit to the SI unit ``kind``, such as "m", "rad" or "" (parts of 1).

    name : as it is written.
    """

    factor: float
    kind: str
    name: str


def unit(name: str) -> Unit | None:
    """Unit in files of a name such as mm, in, deg or %; None for units of other quantities."""
    one = _any_unit(name)
    return one if one and one.kind in KINDS_IN_FILES else None


@cache
def _any_unit(name: str) -> Unit | None:
    """Unit of a name; None for units of quantities that are not in ``_ROOTS``."""
    import pint

    if name == "px":  # the library's px is 1/96 inch
        name = "pixel"
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


def read_quantity(text: str, unit_name: str) -> float:
    """Number of a text, with or without a unit, in ``unit_name``; arguments and ValueError as for
    :func:`read_with_unit`.
    """
    return read_with_unit(text, unit_name)[0]


def read_with_unit(text: str, unit_name: str) -> tuple[float, Unit | None]:
    """Number of a text in ``unit_name``, and the unit that is written, with its factor to
    ``unit_name``; None for a number without a unit.

    unit_name : px, s, 1/s, K, share, deg, a kind of :class:`Unit`, or several with "or" between.
    Raises ValueError for a text that is no number, or has another unit.
    """
    match = _QUANTITY.fullmatch(text.strip())
    if not match:
        return float(text), None
    kinds = {"share": [""], "deg": ["rad"]}.get(unit_name) or unit_name.split(" or ")
    stated_unit = _any_unit(match[2])
    if stated_unit is None or stated_unit.kind not in kinds:
        raise ValueError(f"{match[2]} is not a unit of {unit_name}")
    factor = stated_unit.factor / (radians(1) if unit_name == "deg" else 1)
    # decimal arithmetic, so that 269.3 mm equals 0.2693
    number = float(Decimal(match[1]) * Decimal(repr(factor)))
    return number, Unit(factor, stated_unit.kind, match[2])


def in_joint_units(
    value: float | str, unit_name: str, joint_units: Sequence[str], where: str
) -> float:
    """Number in ``unit_name``, "m or rad" or "m/s or rad/s", of a value for a machine's joints.

    value : a number, which is returned, or a text with a unit. joint_units : "m" or "rad" of each
    joint. where : option in the message. Raises InputError for a text without a unit, or with one
    that no joint has.
    """
    if not isinstance(value, str):
        return value
    per_second = unit_name.removeprefix("m").partition(" ")[0]
    names = list(dict.fromkeys(f"{one}{per_second}" for one in joint_units))
    with suppress(ValueError):
        number, stated_unit = read_with_unit(value, " or ".join(names))
        if stated_unit:
            return number
    raise InputError(
        "this number cannot be used for this machine's joints",
        where=where,
        found=value,
        expected=f"a number in {' or '.join(names)}, or with its unit, such as"
        f" {' or '.join(_JOINT_EXAMPLES[name] for name in names)}",
        code="option.unit",
    )


Metres = Annotated[float, BeforeValidator(partial(_read, "m"))]
Radians = Annotated[float, BeforeValidator(partial(_read, "rad"))]
Share = Annotated[float, BeforeValidator(partial(_read, ""))]
Reading = Annotated[float, BeforeValidator(partial(_read, "m or rad"))]
Point = tuple[Metres, Metres, Metres]
"""[x, y, z], each with or without a unit."""
