"""Contract of firmwares of delta printers, whose configurations pkmcal reads and writes.

A firmware is one file in this folder with a subclass of :class:`Firmware`: an export format that
also reads a printer's own configuration and the points of the bed that it probed. Reading and
writing share the firmware's names, units, signs and formulas.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import Difference, Exporter, exporters, largest
from pkmcal.exporters.delta import (
    SWITCH_ROUNDING,
    Fit,
    Freedoms,
    Inverse,
    firmware_tool_difference,
    fit_of,
    readings_elsewhere,
    redo,
    switch_values,
    workspace_radius,
)
from pkmcal.files import LARGEST_WRITTEN_FILE, quoted, read_text
from pkmcal.outcome.finding import Finding

CARRIAGE_STEP = 1 / 80
"""Default carriage travel per step, mm.

200 full steps of 16 microsteps, belts of 2 mm pitch on 20 teeth, as on most printers.
"""
LARGEST_PRINTER_VALUE = 1e6
"""Bound on lengths (mm) and angles (degrees); larger values would overflow when squared."""
NUMBER = r"(-?\d+(?:\.\d+)?)"
"""Pattern of a number that a console prints."""


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

    label : name of the file, for messages.
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

    firmware: Firmware
    label: str
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


@dataclass(frozen=True)
class WrittenValues:
    """Values of a written file as the firmware reads them; motor positions in mm or degrees.

    inverse : motor positions (n, 3) at points (n, 3) mm, by the firmware's formulas.
    homed : (3,) motor positions at the end switches.
    homed_by : the same for other values (3,) of the end switches.
    print_radius : mm, None without one.
    switches : readings of end switches elsewhere and the values that the text gives for them, (3,)
        each and NaN for a motor without; None for a text with values proportional to readings.
    """

    inverse: Inverse
    homed: Array
    homed_by: Callable[[Array], Array]
    print_radius: float | None
    switches: list[tuple[Array, Array]] | None = None


class Firmware(Exporter, ABC):
    """Firmware of delta printers. Firmwares are stateless, as all exporters.

    program : its name.
    file : name of the exported file.
    motors : names of the motors.
    carriage_source : where a user reads the heights of the carriages, in two lines.
    linear, rotary : free parameters of its kinematics.
    """

    program: ClassVar[str]
    file: ClassVar[str]
    motors: ClassVar[tuple[str, str, str]]
    carriage_source: ClassVar[str]
    linear: ClassVar[Freedoms]
    rotary: ClassVar[Freedoms]

    @abstractmethod
    def reads(self, text: str) -> bool:
        """Whether a text is a configuration of this firmware."""

    @abstractmethod
    def printer(self, text: str, label: str) -> Printer:
        """Printer of a configuration; label : name of its file.

        Raises InputError for missing, malformed or impossible values.
        """

    @abstractmethod
    def touched(self, text: str, label: str, printer: Printer) -> tuple[Array, float] | None:
        """Probed points of the bed in a console's output or a file of the firmware.

        Tool positions (n, 3) mm at contact, and the height of the tool's tip above the bed there;
        None for a text without any. Raises InputError for points that cannot be read.
        """

    @abstractmethod
    def text(self, fit: Fit, source: MachineSource) -> str:
        """Text of the exported file. Raises InputError for values that the firmware refuses."""

    @abstractmethod
    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values of an exported text."""

    def print_radius(self, source: MachineSource, kind: str) -> str | None:
        """Print radius of a machine, linear or rotary, mm, as written; None without one."""
        del kind
        return workspace_radius(source)

    def fit(self, source: MachineSource) -> Fit:
        """The firmware's parameters of a source's machine."""
        return fit_of(source, self.program, self.linear, self.rotary)

    def files(self, source: MachineSource) -> dict[str, str]:
        """The exported file; pins, speeds and the like remain the printer's own."""
        return {self.file: self.text(self.fit(source), source)}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences by the firmware's formulas, with values read as the firmware reads them."""
        fit, text = self.fit(source), files[self.file]
        values = self.written(text, fit)
        zero = values.homed - fit.rate * fit.delta.ends[fit.order]
        # homing with the values that the text gives for switches at other readings
        switches = values.switches
        if switches is None:
            switches = [(q, switch_values(text, q)) for q in readings_elsewhere(fit)]
        off = [
            np.where(np.isnan(q), 0.0, values.homed_by(value) - (fit.rate * q + fit.zero))
            for q, value in switches
        ]
        radius = self.print_radius(source, fit.kind)
        same = values.print_radius == (None if radius is None else float(radius))
        return [
            firmware_tool_difference(text, fit, values.inverse, zero),
            Difference(
                f"motors at end switches elsewhere, {len(off)} readings",
                largest(off) if off else np.inf,
                SWITCH_ROUNDING,
                "mm or degrees",
            ),
            Difference("print radius", 0.0 if same else np.inf, 0.0, "mm"),
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Agreement of settings and machine, and the steps after installing them."""
        return (self.fit(source).following, *redo(source))


def firmwares() -> list[Firmware]:
    """All firmwares, in alphabetical order."""
    return [one for one in exporters().values() if isinstance(one, Firmware)]


def buildable_delta(printer: Printer) -> Printer:
    """The printer, unchanged. Raises InputError if no delta with these values can be built."""
    if not 0 < printer.radius < printer.rod.min():
        raise InputError(
            "a rod has to be longer than the delta radius",
            where=printer.label,
            found=f"rods of {printer.rod.min():g} mm, a radius of {printer.radius:g} mm",
            expected="both in mm, as the firmware has them",
        )
    # towers closer than half of their regular spacing of 120 degrees
    apart = np.sort(np.mod(printer.angle, 360))
    gaps = np.diff(np.append(apart, apart[0] + 360))
    if gaps.min() < 60:
        raise InputError(
            "two towers stand in nearly one direction",
            where=printer.label,
            found=", ".join(f"{a:g}" for a in printer.angle) + " degrees",
            expected="three directions about 120 degrees apart",
        )
    return printer


def read_printer(path: Path) -> Printer:
    """Read a printer from printer.cfg (Klipper), or config.g or config-override.g (RepRapFirmware).

    Raises InputError for any other file, and for a printer that is not a linear delta.
    """
    label = path.name
    text = read_text(path, largest=LARGEST_WRITTEN_FILE)
    for firmware in firmwares():
        if firmware.reads(text):
            return buildable_delta(firmware.printer(text, label))
    first = next((line.strip() for line in text.splitlines() if line.strip()), "an empty file")
    raise InputError(
        "this is neither a Klipper nor a RepRapFirmware configuration of a delta",
        where=label,
        found=quoted(first),
        expected="a printer.cfg with a section [printer], or G-code with a line M665",
        next_step="Name the file that holds these values; files that it includes are not followed",
    )


def means_by_position(points: Array) -> Array:
    """Mean points (m, 3) of the points (n, 3) with equal x and y, in the order of first contact."""
    places = list(dict.fromkeys(map(tuple, points[:, :2].tolist())))
    return np.array([points[(points[:, :2] == place).all(axis=1)].mean(axis=0) for place in places])
