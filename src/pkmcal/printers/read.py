"""Firmware of a printer's configuration file, and whether its delta can be built."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pkmcal.errors import InputError
from pkmcal.files import LARGEST_WRITTEN_FILE, quoted, read_text
from pkmcal.printers import klipper, reprap
from pkmcal.printers.printer import Printer


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
    if klipper.is_one(text):
        return buildable_delta(klipper.printer(text, label))
    if reprap.is_one(text):
        return buildable_delta(reprap.printer(text, label))
    first = next((line.strip() for line in text.splitlines() if line.strip()), "an empty file")
    raise InputError(
        "this is neither a Klipper nor a RepRapFirmware configuration of a delta",
        where=label,
        found=quoted(first),
        expected="a printer.cfg with a section [printer], or G-code with a line M665",
        next_step="Name the file that holds these values; files that it includes are not followed",
    )
