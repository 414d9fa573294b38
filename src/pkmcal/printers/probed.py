"""Bed points as a printer's console or files report them: the commanded tool position at contact.

- Klipper's ``PROBE`` prints ``probe at X,Y is z=Z``, the tool's position when the probe triggered;
  newer versions print ``probe: at X,Y bed will contact at z=Z``, the point of the bed under the
  probe with the tool's height at which the nozzle would touch it.
- RepRapFirmware's ``G29`` writes heightmap.csv, and a sequence of ``G30 Pn X Y Z-99999`` that ends
  with S-1 prints ``G32 bed probe heights: ...``: tool heights at contact.
- A table ``configuration,x [mm],y [mm],z [mm]`` of such positions from any source.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.delta import MM_A_METRE
from pkmcal.files import read_csv, read_text
from pkmcal.printers.printer import LARGEST_PRINTER_VALUE, Printer, Touches
from pkmcal.wording import listed

FEWEST_BED_POINTS = 7
"""Fewest points that determine more than the bed's height and tilt; DELTA_CALIBRATE probes as many.
"""
HEIGHT_MAP_TITLE = "RepRapFirmware height map file"
_NUMBER = r"(-?\d+(?:\.\d+)?)"
_TRIGGERED = re.compile(rf"probe at {_NUMBER},{_NUMBER} is z={_NUMBER}")
_CONTACT = re.compile(rf"probe: at {_NUMBER},{_NUMBER} bed will contact at z={_NUMBER}")
_G30 = re.compile(r"^[^\S\n]*G30\b([^;\n]*)", re.MULTILINE | re.IGNORECASE)
_WORD = re.compile(rf"([PXY])\s*{_NUMBER}", re.IGNORECASE)
_HEIGHTS = re.compile(rf"bed probe heights:((?:\s+{_NUMBER})+)", re.IGNORECASE)


def read_touches(path: Path, printer: Printer) -> Touches:
    """Read probed bed points; repeats of Klipper's probe at one place are averaged.

    The format follows from the contents of the file. The printer's values must be those in force
    while it probed. Raises InputError for a file without points, and for points out of the
    printer's reach.
    """
    label = path.name
    text = read_text(path)
    dx, dy, dz = printer.offset
    # the format, and the tool's positions (n, 3) at contact with the tool's height above the bed
    # there
    if text.startswith("configuration,"):
        points, heights = _table_points(path, label), 0.0
    elif text.startswith(HEIGHT_MAP_TITLE):
        points, heights = _height_map_points(text, label), 0.0
    elif values := _TRIGGERED.findall(text):
        points, heights = _means_by_position(np.array(values, dtype=float)), dz
    elif values := _CONTACT.findall(text):
        points, heights = _means_by_position(np.array(values, dtype=float)) - [dx, dy, 0.0], 0.0
    elif values := _HEIGHTS.findall(text):
        points, heights = _sequence_points(text, label, values[-1][0]), 0.0
    else:
        raise InputError(
            "there is no point of a bed in this file",
            where=label,
            expected="Klipper's lines 'probe at X,Y is z=Z', RepRapFirmware's heightmap.csv or"
            " 'bed probe heights:' with the lines G30 P0 X Y Z-99999, or a table"
            " configuration,x [mm],y [mm],z [mm]",
        )
    # carriages at these positions, by the printer's own formulas
    with np.errstate(all="ignore"):
        carriages = printer.carriages(points)
    bad = np.flatnonzero(~(np.abs(carriages) <= LARGEST_PRINTER_VALUE).all(axis=1))
    if bad.size:
        x, y, z = points[bad[0]]
        raise InputError(
            "the printer does not reach this point",
            where=label,
            found=f"x {x:g}, y {y:g}, z {z:g} mm",
            expected="the tool's own places, in mm, of the printer described in " + printer.label,
        )
    return Touches(carriages, np.full(len(points), heights), label)


def _table_points(path: Path, label: str) -> Array:
    """Points (n, 3) of a table, mm; as in every table, columns without a unit are in metres."""
    table = read_csv(path, label=label, columns=("x", "y", "z"))
    table.check_kinds(["m", "m", "m"])
    return MM_A_METRE * table.values[:, [table.columns.index(c) for c in "xyz"]]


def _means_by_position(points: Array) -> Array:
    """Mean points (m, 3) of the points (n, 3) with equal x and y, in the order of first contact."""
    places = list(dict.fromkeys(map(tuple, points[:, :2].tolist())))
    return np.array([points[(points[:, :2] == place).all(axis=1)].mean(axis=0) for place in places])


def _height_map_points(text: str, label: str) -> Array:
    """Points (n, 3) of heightmap.csv, mm. Raises InputError for a map without a valid grid."""
    lines = [line for line in text.splitlines()[1:] if line.strip()]
    names = [word.strip() for word in (lines[0] if lines else "").split(",")]
    values = [word.strip() for word in (lines[1] if len(lines) > 1 else "").split(",")]
    numbers = dict(zip(names, values, strict=False))

    def number_under(*called: str, above: float = -LARGEST_PRINTER_VALUE) -> float:
        """Number of the map's grid, under the first of several names that the map has."""
        text = next((numbers[name] for name in called if name in numbers), "")
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not above < value <= LARGEST_PRINTER_VALUE:
            raise InputError(
                "the height map does not define its grid",
                where=f"{label}, line 3",
                found=", ".join(values) or "nothing",
                expected=f"a number{'' if above else ' above zero'} under {called[0]}",
            )
        return value

    # names of newer and older versions of RepRapFirmware
    x0, y0 = number_under("xmin", "min0"), number_under("ymin", "min1")
    dx = number_under("xspacing", "spacing0", "spacing", above=0.0)
    dy = number_under("yspacing", "spacing1", "spacing", above=0.0)
    # RepRapFirmware writes a plain 0 for a point that was not probed
    out: list[tuple[float, float, float]] = []
    for row, line in enumerate(lines[2:]):
        for column, word in enumerate(line.split(",")):
            if word.strip() in ("0", ""):
                continue
            try:
                out.append((x0 + column * dx, y0 + row * dy, float(word)))
            except ValueError:
                raise InputError(
                    "a height is no number",
                    where=f"{label}, row {row + 1} of heights",
                    found=word.strip(),
                    expected="millimetres",
                ) from None
    return np.array(out).reshape(-1, 3)


def _sequence_points(text: str, label: str, heights: str) -> Array:
    """Points (n, 3), mm, from the lines ``G30 Pn`` and the heights of the last reply.

    Raises InputError if the numbers of the points do not match the heights.
    """
    z = [float(word) for word in heights.split()]
    places: dict[int, tuple[float, float]] = {}
    for words in _G30.findall(text):
        word_values = {letter.upper(): float(number) for letter, number in _WORD.findall(words)}
        if word_values.keys() >= {"P", "X", "Y"}:
            places[int(word_values["P"])] = word_values["X"], word_values["Y"]
    if sorted(places) != list(range(len(z))):
        raise InputError(
            "heights and points do not belong together",
            where=label,
            found=f"{len(z)} heights, and lines G30 of the points"
            f" {listed([str(p) for p in sorted(places)]) or 'none'}",
            expected=f"lines G30 P0 to P{len(z) - 1} with X and Y, as in bed.g",
        )
    return np.array([(*places[k], height) for k, height in enumerate(z)])
