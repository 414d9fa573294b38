"""Delta printer as its firmware's files describe it, and the points at which it probed its bed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pkmcal.arrays import Array, short_repr

CARRIAGE_STEP = 1 / 80
"""Default carriage travel per step, mm.

200 full steps of 16 microsteps, belts of 2 mm pitch on 20 teeth, as on most printers.
"""
LARGEST_PRINTER_VALUE = 1e6
"""Bound on lengths (mm) and angles (degrees); larger values would overflow when squared."""


@dataclass(frozen=True)
class Touches:
    """Probed points of the bed.

    carriages : (n, 3) mm, positions of the carriages at contact.
    heights : (n,) mm, height of the tool's tip above the bed at these positions.
    origin : the file they were read from, for messages.
    """

    carriages: Array
    heights: Array
    origin: str

    __repr__ = short_repr


@dataclass(frozen=True)
class Printer:
    """Geometry of a linear delta in its firmware's own numbers, mm and degrees.

    program : name of the firmware.
    label : name of the file, for messages.
    motors : names of the motors.
    radius : radius of the towers' circle less that of the effector.
    angle : (3,) directions of the towers.
    rod : (3,) lengths of the rods.
    homed : (3,) heights of the carriages at their end switches.
    reach : print radius.
    carriages : map from tool points (n, 3) to carriage heights (n, 3), by the firmware's formulas.
    offset : (x, y, z) of the probe from the nozzle.
    touches : probed points in the same file, None for none.
    step : carriage travel per motor step.
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
