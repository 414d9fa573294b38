"""A delta printer as its firmware's own files describe it, and points at which it felt its bed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pkmcal.arrays import Array, short_repr

CARRIAGE_STEP = 1 / 80
"""mm of a carriage a step: 200 full steps of 16, belts of 2 mm on 20 teeth, as on most printers."""
LARGEST_PRINTER_VALUE = 1e6
"""mm, or degrees: what is larger is no printer's, and would overflow where it is squared."""


@dataclass(frozen=True)
class Touches:
    """Where a tool felt the bed: carriages (n, 3) mm, and heights (n,) mm of the tool's tip there
    above the bed. origin : where they were read, for people.
    """

    carriages: Array
    heights: Array
    origin: str

    __repr__ = short_repr


@dataclass(frozen=True)
class Printer:
    """What a firmware holds of a linear delta, mm and degrees.

    program : the firmware. motors : their names. radius : of the towers' circle less the tool's.
    angle, rod : (3,). homed : (3,) carriages at their end switches. reach : radius of the bed.
    carriages : points (n, 3) mm of the tool to carriages (n, 3) mm, by the firmware's formulas.
    offset : (x, y, z) mm of a probe from the nozzle. touches : saved in the same file. step : of a
    carriage, mm.
    """

    program: str
    label: str
    motors: tuple[str, str, str]
    radius: float
    angle: Array
    rod: Array
    homed: Array
    reach: float
    carriages: Callable[[Array], Array]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    touches: Touches | None = None
    step: float = CARRIAGE_STEP

    __repr__ = short_repr
