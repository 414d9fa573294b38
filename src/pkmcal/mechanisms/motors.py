"""Which column of the readings moves which leg, and over which range."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.mechanisms.carriers.contract import base_carriers
from pkmcal.mechanisms.rods import ActuatedLength
from pkmcal.mechanisms.schema import Leg, MechanismDocument


def motor_columns(document: MechanismDocument) -> Integers:
    """The reading's column of each leg, (L,); -1 for a leg without a reading.

    A leg that names no motor has the column after the last one in use.
    """
    out = np.full(len(document.legs), -1)
    for j, leg in enumerate(document.legs):
        if is_driven(leg):
            motor = getattr(leg.base, "motor", None)
            out[j] = out.max() + 1 if motor is None else motor - 1
    return out


def is_driven(leg: Leg) -> bool:
    """Whether a reading belongs to the leg, of its rod's length or of its carrier's motion."""
    return isinstance(leg.length, ActuatedLength) or base_carriers()[leg.base.joint].driven


def reading_range(leg: Leg) -> tuple[float, float]:
    """Smallest and largest reading by the file, m or rad; NaN where it is silent.

    A rod's ``range`` bounds its length, so the drawing's offset is taken off.
    """
    none = (np.nan, np.nan)
    length: Any = leg.length
    if isinstance(length, ActuatedLength):
        low, high = length.range or none
        return low - length.offset, high - length.offset
    return getattr(leg.base, "range", None) or none


def motor_ranges(document: MechanismDocument) -> Array:
    """Ranges (m, 2) of the readings; legs on one motor narrow each other's."""
    columns = motor_columns(document)
    ranges = np.array([reading_range(leg) for leg in document.legs])
    out = np.full((columns.max(initial=-1) + 1, 2), np.nan)
    for column, (low, high) in zip(columns, ranges, strict=True):
        if column >= 0:
            out[column] = np.fmax(out[column, 0], low), np.fmin(out[column, 1], high)
    return out


def motor_units(document: MechanismDocument) -> tuple[str, ...]:
    """``m`` or ``rad`` of each reading: a driven carrier with an angle among its numbers turns."""
    columns = motor_columns(document)
    out = ["m"] * (int(columns.max(initial=-1)) + 1)
    for leg, column in zip(document.legs, columns.tolist(), strict=True):
        carrier = base_carriers()[leg.base.joint]
        if column >= 0 and carrier.driven and any(p.unit == "rad" for p in carrier.parameters):
            out[column] = "rad"
    return tuple(out)


def middles(document: MechanismDocument) -> Array:
    """Mid-range reading of each leg, (L,); zero where the file is silent."""
    columns = motor_columns(document)
    middle = np.nan_to_num(motor_ranges(document).mean(axis=1))
    return np.where(columns >= 0, np.append(middle, 0.0)[columns], 0.0)
