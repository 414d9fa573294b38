"""Motors: which reading moves which leg, over which range, and what legs of one motor share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.mechanisms.carriers.contract import PLANAR_MOTIONS, base_carriers, platform_carriers
from pkmcal.mechanisms.document import (
    EXACT_TURNS,
    LEAD_TOLERANCE,
    ActuatedLength,
    Leg,
    MechanismDocument,
)


def motor_columns(document: MechanismDocument) -> Integers:
    """Column of each leg's reading, (L,); -1 for a leg without one.

    A leg that names no motor has the column after the last one in use.
    """
    out = np.full(len(document.legs), -1)
    for j, leg in enumerate(document.legs):
        if is_driven(leg):
            motor = getattr(leg.base, "motor", None)
            out[j] = out.max() + 1 if motor is None else motor - 1
    return out


def is_driven(leg: Leg) -> bool:
    """Whether the leg has a reading, of its rod's length or of its carrier's motion."""
    return isinstance(leg.length, ActuatedLength) or base_carriers()[leg.base.joint].driven


def reading_range(leg: Leg) -> tuple[float, float]:
    """Smallest and largest reading of a leg by its file, m or rad; NaN if not stated.

    A rod's ``range`` bounds its length, so the nominal offset is subtracted, and the rest divided
    by the nominal scale.
    """
    none = (np.nan, np.nan)
    length: Any = leg.length
    if isinstance(length, ActuatedLength):
        low, high = length.range or none
        return (low - length.offset) / leg.scale, (high - length.offset) / leg.scale
    return getattr(leg.base, "range", None) or none


def motor_ranges(document: MechanismDocument) -> Array:
    """Ranges (m, 2) of the readings, intersected over the legs of a motor."""
    columns = motor_columns(document)
    ranges = np.array([reading_range(leg) for leg in document.legs])
    out = np.full((columns.max(initial=-1) + 1, 2), np.nan)
    for column, (low, high) in zip(columns, ranges, strict=True):
        if column >= 0:
            out[column] = np.fmax(out[column, 0], low), np.fmin(out[column, 1], high)
    return out


def motor_units(document: MechanismDocument) -> tuple[str, ...]:
    """Unit of each reading, ``m`` or ``rad``: m for rods, else the driven carrier's unit."""
    columns = motor_columns(document)
    out = ["m"] * (int(columns.max(initial=-1)) + 1)
    for leg, column in zip(document.legs, columns.tolist(), strict=True):
        carrier = base_carriers()[leg.base.joint]
        if column >= 0 and carrier.driven:
            out[column] = carrier.unit
    return tuple(out)


def scale_tolerances(document: MechanismDocument) -> Array:
    """Prior sigma of the scale of each leg's reading, (L,).

    The file's, or the default for the reading's unit; 0 for exact scales and for legs without a
    reading.
    """
    tolerance, columns = document.tolerance.scale, motor_columns(document)
    usual = [LEAD_TOLERANCE if unit == "m" else EXACT_TURNS for unit in motor_units(document)]
    by_motor = np.append(usual if tolerance is None else np.full(len(usual), tolerance), 0.0)
    return by_motor[columns]


def bodies(document: MechanismDocument) -> Integers:
    """Index of the body of an articulated platform on which each leg ends, (L,), in the order of
    their numbers in the file; -1 for the platform itself.
    """
    fields = [platform_carriers()[leg.platform.joint].body for leg in document.legs]
    own = [
        (field, getattr(leg.platform, field)) if field else None
        for field, leg in zip(fields, document.legs, strict=True)
    ]
    names = sorted({body for body in own if body is not None})
    return np.array([-1 if body is None else names.index(body) for body in own], dtype=int)


def middles(document: MechanismDocument) -> Array:
    """Mid-range reading of each leg, (L,); zero if not stated."""
    columns = motor_columns(document)
    middle = np.nan_to_num(motor_ranges(document).mean(axis=1))
    return np.where(columns >= 0, np.append(middle, 0.0)[columns], 0.0)


Group = tuple[str, ...]
"""Names of parameters that are tied."""


def built_in_ties(document: MechanismDocument) -> tuple[Group, ...]:
    """Groups of parameters that are equal by construction.

    Legs on one motor share an axis and a reading, hence a scale; legs on one body of the platform
    share a hinge. A leg of a planar machine stays in its plane, so both of its ends have one
    height.
    """
    shared = tuple(
        tuple(f"legs[{j + 1}].{side}.{field}" for j in legs)
        for side, legs, fields in sharing(document)
        for field in fields
        if all(getattr(getattr(document.legs[j], side), field) is not None for j in legs)
    )
    columns, free = motor_columns(document), scale_tolerances(document) > 0
    motors = [np.flatnonzero(free & (columns == k)) for k in range(columns.max(initial=-1) + 1)]
    shared += tuple(tuple(f"legs[{j + 1}].scale" for j in legs) for legs in motors if len(legs) > 1)
    if document.motion not in PLANAR_MOTIONS:
        return shared
    numbers = range(1, len(document.legs) + 1)
    heights = ((f"legs[{j}].base.center.z", f"legs[{j}].platform.center.z") for j in numbers)
    return (*heights, *shared)


def built_in_fixed(document: MechanismDocument) -> tuple[str, ...]:
    """Parameters fixed by construction: those that would leave a planar machine's plane."""
    if document.motion not in PLANAR_MOTIONS:
        return ()
    return tuple(
        f"legs[{j}].{side}.{field}"
        for j, leg in enumerate(document.legs, start=1)
        for side, carriers in (("base", base_carriers()), ("platform", platform_carriers()))
        for field in carriers[getattr(leg, side).joint].held_in_plane
    )


def sharing(document: MechanismDocument) -> Iterator[tuple[str, tuple[int, ...], tuple[str, ...]]]:
    """Groups of legs (from 0) on one motor, or on one body of the platform, as
    (side, legs, fields shared).
    """
    columns = motor_columns(document)
    for column in range(columns.max(initial=-1) + 1):
        legs = tuple(j for j in range(len(columns)) if columns[j] == column)
        kinds = {base_carriers()[document.legs[j].base.joint] for j in legs}
        if len(legs) > 1 and len(kinds) == 1:
            yield "base", legs, kinds.pop().shared
    on = bodies(document)
    for body in dict.fromkeys(on.tolist()):
        legs = tuple(np.flatnonzero(on == body).tolist())
        if body >= 0 and len(legs) > 1:
            joint = document.legs[legs[0]].platform.joint
            yield "platform", legs, platform_carriers()[joint].shared
