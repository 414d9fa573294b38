"""Bed points that a printer probed: the commanded tool position at contact.

A firmware's own console output or files are read by the firmware
(:meth:`~pkmcal.firmware.contract.Firmware.touched`); a table ``configuration,x [mm],y [mm],z [mm]``
of such positions from any source.
"""

from __future__ import annotations

from pathlib import Path

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.delta import MM_A_METRE
from pkmcal.files import read_csv, read_text
from pkmcal.firmware.contract import Printer, Touches, firmwares, touches_at

FEWEST_BED_POINTS = 7
"""Fewest points that determine more than the bed's height and tilt; DELTA_CALIBRATE probes as many.
"""


def read_touches(path: Path, printer: Printer) -> Touches:
    """Read probed bed points; repeats of Klipper's probe at one place are averaged.

    The format follows from the contents of the file. The printer's values must be those in force
    while it probed. Raises InputError for a file without points, and for points out of the
    printer's reach.
    """
    label = path.name
    text = read_text(path)
    # the tool's positions (n, 3) at contact with the tool's height above the bed there
    if text.startswith("configuration,"):
        values = _table_points(path, label), 0.0
    else:
        each = (firmware.touched(text, label, printer) for firmware in firmwares())
        values = next((points for points in each if points is not None), None)
    if values is None:
        raise InputError(
            "there is no point of a bed in this file",
            where=label,
            expected="Klipper's lines 'probe at X,Y is z=Z', Marlin's 'Bed X: X Y: Y Z: Z',"
            " RepRapFirmware's heightmap.csv or 'bed probe heights:' with the lines"
            " G30 P0 X Y Z-99999, or a table"
            " configuration,x [mm],y [mm],z [mm]",
        )
    return touches_at(*values, printer, label)


def _table_points(path: Path, label: str) -> Array:
    """Points (n, 3) of a table, mm; as in every table, columns without a unit are in metres."""
    table = read_csv(path, label=label, columns=("x", "y", "z"))
    table.check_kinds(["m", "m", "m"])
    return MM_A_METRE * table.values[:, [table.columns.index(c) for c in "xyz"]]
