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
from pkmcal.files import read_csv, read_log
from pkmcal.firmware.contract import PrintedPart, Printer, Touches, firmwares, touches_at

FEWEST_BED_POINTS = 7
"""Fewest points that determine more than the bed's height and tilt; DELTA_CALIBRATE probes as many.
"""


def read_measured(
    path: Path, printer: Printer, *, own: bool = False
) -> tuple[Touches | None, PrintedPart | None]:
    """Read probed bed points, and distances on a printed part, of a file; None without any.

    The format follows from the contents of the file. The printer's values must be those in force
    while it probed and printed. own : whether the file is the printer's own configuration. Raises
    InputError for another file without points or distances, and for points out of the printer's
    reach.
    """
    label = path.name
    text = read_log(path)
    if text.startswith("configuration,"):
        return touches_at(_table_points(path, label), 0.0, printer, label), None
    readers = [printer.firmware] if own else firmwares()
    each = (firmware.touched(text, path, printer) for firmware in readers)
    touches = next((one for one in each if one is not None), None)
    each_part = (firmware.distances(text, label, printer) for firmware in readers)
    distances = next((one for one in each_part if one is not None), None)
    if touches is None and distances is None and not own:
        raise InputError(
            "there is no point of a bed in this file",
            where=label,
            expected="Klipper's lines 'probe at X,Y is z=Z', Marlin's 'Bed X: X Y: Y Z: Z',"
            " Smoothieware's G29.1, RepRapFirmware's heightmap.csv or 'bed probe heights:' with the"
            " lines G30 P0 X Y Z-99999, or a table configuration,x [mm],y [mm],z [mm]",
        )
    return touches, distances


def _table_points(path: Path, label: str) -> Array:
    """Points (n, 3) of a table, mm; as in every table, columns without a unit are in metres."""
    table = read_csv(path, label=label, columns=("x", "y", "z"))
    table.check_kinds(["m", "m", "m"])
    return MM_A_METRE * table.values[:, [table.columns.index(c) for c in "xyz"]]
