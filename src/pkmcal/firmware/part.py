"""Printed part: where a printer was commanded to print some marks, and distances that calipers
measured between them.

A person writes the file from the part's drawing. The motors followed the firmware's formulas with
the values of its configuration, so the carriages at a mark are those of the commanded position
(x, y, z) by the nominal model.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pkmcal.errors import InputError
from pkmcal.files import (
    Document,
    Keys,
    Schema,
    Share,
    closest,
    quoted,
    read_yaml,
    validated_document,
)
from pkmcal.firmware.contract import PrintedPart, Printer, reachable_carriages
from pkmcal.wording import listed, percentage

MOST_MARKS, MOST_DISTANCES = 200, 1000
MOST_DEVIATION = 0.1
"""Largest plausible difference of a distance from the drawing's, as a share of that."""
MOST_SHRINKAGE = 0.05
"""Largest plausible shrinkage: common plastics shrink by less than 3 %."""

LONGEST_MARK = 40
Millimetres = Annotated[float, Field(gt=0, lt=1e4)]


class DistanceEntry(Schema):
    """Distance between two marks: from middle to middle, or outside to outside and inside to
    inside, whose mean is that.
    """

    between: tuple[str, str] = Field(description="the names of two marks, [middle, a]")
    apart: Millimetres | None = None
    outside: Millimetres | None = None
    inside: Millimetres | None = None


class PartDocument(Schema):
    """File of a printed part."""

    unit: Literal["mm"] = Field(description="unit: mm, of all positions and distances")
    marks: dict[str, tuple[float, float, float]] = Field(
        min_length=2,
        max_length=MOST_MARKS,
        description="the commanded positions [x, y, z] of two or more marks, in mm, by name",
    )
    distances: tuple[DistanceEntry, ...] = Field(
        min_length=1,
        max_length=MOST_DISTANCES,
        description="the measured distances, such as {between: [middle, a], apart: 64.87}",
    )
    noise: Annotated[float, Field(gt=0, lt=10)] | None = None
    shrinkage: Annotated[Share, Field(ge=-MOST_SHRINKAGE, le=MOST_SHRINKAGE)] = 0.0


def read_part(path: Path, printer: Printer) -> PrintedPart:
    """Read a printed part.

    printer : with the values in force when the part was printed.

    Raises InputError for unknown marks, for marks that the printer does not reach, and for
    distances that cannot be those of the drawing.
    """
    document = read_yaml(path)
    schema = validated_document(document, PartDocument)
    names = tuple(schema.marks)
    _check_names(document, names)
    points = np.array(list(schema.marks.values()))
    carriages = reachable_carriages(points, printer, document.label)
    between = np.array(
        [_marks(document, k, entry, names) for k, entry in enumerate(schema.distances)]
    )
    shrunk = 1 - schema.shrinkage
    drawn = np.linalg.norm(points[between[:, 1]] - points[between[:, 0]], axis=1)
    measured = np.array(
        [
            _apart(document, k, entry, shrunk * float(drawn[k]))
            for k, entry in enumerate(schema.distances)
        ]
    )
    return PrintedPart(
        label=document.label,
        names=names,
        carriages=carriages,
        between=between,
        distance=measured / shrunk,
        noise=schema.noise,
        shrinkage=schema.shrinkage,
    )


def _check_names(document: Document, names: tuple[str, ...]) -> None:
    """Raise InputError for a mark's name that could be that of a height, or that a table cannot
    hold.
    """
    for name in names:
        plain = name.isascii() and name.replace("_", "a").replace("-", "a").isalnum()
        if not (plain and name[0].isalpha() and len(name) <= LONGEST_MARK):
            raise InputError(
                "this name of a mark cannot be used",
                where=document.where("marks", name),
                found=quoted(name),
                expected=f"letters, digits, - and _, a letter first, {LONGEST_MARK} at most",
            )


def _marks(
    document: Document, number: int, entry: DistanceEntry, names: tuple[str, ...]
) -> tuple[int, int]:
    """Indices of an entry's marks. Raises InputError for unknown and for equal ones."""
    keys: Keys = ("distances", number, "between")
    for name in entry.between:
        if name not in names:
            raise InputError(
                "there is no such mark",
                where=document.where(*keys),
                found=name,
                expected=closest(name, names) or f"one of {listed(names, 12)}",
            )
    first, second = (names.index(name) for name in entry.between)
    if first == second:
        raise InputError(
            "a distance leads from one mark to another",
            where=document.where(*keys),
            found=f"{entry.between[0]} twice",
            expected="two different marks",
        )
    return first, second


def _apart(document: Document, number: int, entry: DistanceEntry, drawn: float) -> float:
    """Distance from middle to middle, mm. Raises InputError for an entry without it, and for one
    that is far from that of the drawing, shrunk.
    """
    where = document.where("distances", number)
    given = {name for name in ("apart", "outside", "inside") if getattr(entry, name) is not None}
    if given not in ({"apart"}, {"outside", "inside"}):
        raise InputError(
            "this distance cannot be used",
            where=where,
            found=" and ".join(sorted(given)) or "no number",
            expected="apart, from middle to middle; or outside and inside, whose mean is that",
        )
    if entry.apart is not None:
        value = entry.apart
    else:
        outside, inside = entry.outside or 0.0, entry.inside or 0.0
        if inside >= outside:
            raise InputError(
                "a distance from inside to inside is shorter than that from outside to outside",
                where=where,
                found=f"inside {inside:g}, outside {outside:g}",
                expected="the smaller number as inside",
            )
        value = (outside + inside) / 2
    if abs(value - drawn) > MOST_DEVIATION * drawn:
        raise InputError(
            "this distance is far from that of the commanded positions",
            where=where,
            found=f"{value:g} mm",
            expected=f"{drawn:.4g} mm, to {percentage(MOST_DEVIATION)}",
            next_step="Check both marks and the number; distances are from middle to middle",
        )
    return value
