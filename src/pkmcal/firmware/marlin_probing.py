"""Heights of the bed in Marlin's output: points of G29 V4 and G30, grids of M420 V, and G33.

Semantics: Marlin's gcode/bedlevel/abl/G29.cpp, gcode/calibrate/G33.cpp and M48.cpp,
feature/bedlevel/abl/bbl.cpp and module/probe.h.

- ``G29 V4`` and ``G30`` print ``Bed X: 50.00 Y: 0.00 Z: -0.01``: the place under the probe, and the
  nozzle's height when the probe triggered plus the Z of M851. ``M48`` prints the standard
  deviation of the touches at one place.
- ``M420 V`` prints the heights of a grid without its places: column k is at L + k (R - L) / (n - 1)
  of the ``G29 L R F B`` (or ``G29 H``, a square) that probed it, row k likewise from F to B.
  Points that the probe does not reach are extrapolated from the others, without a mark. G29
  refuses bounds whose four points on the axes are out of reach, so a point is taken as probed where
  it is no farther from the middle, and the nozzle no farther, than at one of these four.
- ``G33 P3 V0`` probes the nozzle's places at a radius that it prints, or that of M665 B in versions
  up to 2.0.5, towards the towers and between them: x, xy, y, yz, z, zx at 210, 270, 330, 30, 90,
  150 degrees. The value c is the mean of three places at a tenth of that radius, where a bowl has a
  hundredth of its depth at the edge; it is taken for the middle's. With P4 and more all values are
  means over parts of circles.
"""

from __future__ import annotations

import re

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import quoted
from pkmcal.firmware.contract import (
    LARGEST_PRINTER_VALUE,
    NUMBER,
    Printer,
    Touches,
    means_by_position,
    root_mean_square,
    touches_at,
)
from pkmcal.firmware.towers import commands

MOST_GRID_POINTS = 100
"""Bound on the points of a grid's row or column."""
GRID_HEADING, DRY_RUN = "Bilinear Leveling Grid:", "(DRY-RUN)"
G33_DIRECTIONS = {"x": 210.0, "xy": 270.0, "y": 330.0, "yz": 30.0, "z": 90.0, "zx": 150.0}
"""Directions of G33's places, degrees."""
_BED_POINT = re.compile(rf"\bBed X:\s*{NUMBER}\s+Y:\s*{NUMBER}\s+Z:\s*{NUMBER}")
_REPEATED = re.compile(rf"\bStandard Deviation:\s*{NUMBER}")
_PLACELESS = {
    GRID_HEADING: "a grid of heights without its places",
    "Bed Topography Report": "a map of heights without its places",
    "Measured points:": "a mesh of heights without its places",
    "G33 Auto Calibrate": "the output of a G33 whose places or values in force it does not contain",
}
_G33_START = re.compile(rf"Checking\.\.\. AC(?: at radius:\s*{NUMBER})?")
_G33_VALUE = re.compile(r"(?<![A-Za-z])(c|xy?|yz?|zx?):\s*([-+]?\d{1,4}\.\d{1,6})")


def marlin_touches(text: str, label: str, printer: Printer) -> Touches | None:
    """Points of the bed in Marlin's output; None without any. Repeats at a place are averaged.

    Raises InputError for maps whose places are not known.
    """
    lines = text.splitlines()
    bed = [match.groups() for line in lines if (match := _BED_POINT.search(line))]
    if bed:
        points = np.array(bed, dtype=float) - _offset(printer, label)
        tool, height = means_by_position(points), -printer.offset[2]
        return touches_at(
            tool, height, printer, label, root_mean_square(_REPEATED.findall(text)[-1:])
        )
    for points in (_grid_points(text, label, printer), _g33_points(text, label, printer)):
        if points is not None:
            return touches_at(points, 0.0, printer, label)
    heading = next((heading for heading in _PLACELESS if heading in text), None)
    if heading is None:
        return None
    raise InputError(
        f"this is {_PLACELESS[heading]}",
        where=label,
        found=quoted(heading),
        expected="lines such as 'Bed X: 50.00 Y: 0.00 Z: -0.01'; or, with the command itself in the"
        " text, M420 V behind G29 L R F B, or G33 P3 V0 that prints its radius or follows M665"
        " with B",
        next_step="Probe with G29 V4, or with G30 X Y at each place, and save what it prints",
    )


def _offset(printer: Printer, label: str) -> Array:
    """Offset (3,) of the probe from the nozzle, mm. Raises InputError where it is not known."""
    if not np.isfinite(printer.offset).all():
        raise InputError(
            "where the probe is beside the nozzle is not known",
            where=printer.label,
            expected="M851 X Y Z, as M503 prints it, or NOZZLE_TO_PROBE_OFFSET",
            next_step=f"Add a line M851 with X, Y and Z; the points in {label} are those under"
            " the probe",
        )
    return np.array(printer.offset)


def _last_command(text: str, code: str, line: int) -> dict[str, float] | None:
    """Words of the last command of a code up to a line of the text; None without one.

    Marlin's answers begin with the code as well, but their words are no letters with numbers.
    """
    last = None
    for command in commands(text, (code,)):
        words = command.rest.upper().split()
        try:
            values = {word[0]: float(word[1:] or 0) for word in words}
        except ValueError:
            continue
        if command.line <= line:
            last = values
    return last


def _grid_points(text: str, label: str, printer: Printer) -> Array | None:
    """Tool positions (n, 3) mm of the last grid whose bounds are in the text; None without."""
    lines = text.splitlines()
    start = max((n for n, line in enumerate(lines) if GRID_HEADING in line), default=None)
    words = None if start is None else _last_command(text, "G29", start)
    if words is not None and "H" in words:
        words = _square(words["H"], printer)
    if start is None or words is None or not words.keys() >= set("LRFB"):
        return None
    rows: list[list[float]] = []
    for line in lines[start + 2 :]:
        row = _grid_row(line, len(rows))
        if not row or len(rows) == MOST_GRID_POINTS:
            break
        rows.append(row)
    left, right, front, back = (words[c] for c in "LRFB")
    sizes = {len(row) for row in rows}
    in_order = -LARGEST_PRINTER_VALUE < left < 0 < right < LARGEST_PRINTER_VALUE
    in_order &= -LARGEST_PRINTER_VALUE < front < 0 < back < LARGEST_PRINTER_VALUE
    if len(rows) < 2 or len(sizes) != 1 or min(sizes) < 2 or not in_order:
        raise InputError(
            "this grid of heights cannot be read",
            where=f"{label}, line {start + 1}",
            found=f"{len(rows)} rows with {' or '.join(map(str, sorted(sizes))) or 'no'} heights,"
            f" L{left:g} R{right:g} F{front:g} B{back:g}",
            expected="rows as M420 V prints them, and bounds of G29 around the middle of the bed",
        )
    z = np.array(rows)
    grid = np.stack(np.meshgrid(np.linspace(left, right, z.shape[1]),
                                np.linspace(front, back, z.shape[0])), axis=-1)  # fmt: skip
    beside = _offset(printer, label)[:2]
    on_axes = np.array([[left, 0.0], [right, 0.0], [0.0, front], [0.0, back]])
    probed = np.isfinite(z)
    for shift in (np.zeros(2), beside):
        most = np.linalg.norm(on_axes - shift, axis=-1).max()
        probed &= np.linalg.norm(grid - shift, axis=-1) <= most * (1 + 1e-9)
    return np.column_stack([grid[probed] - beside, z[probed]])


def _square(size: float, printer: Printer) -> dict[str, float] | None:
    """Bounds of a square grid by G29's H, in whole mm; None where Marlin may have made it smaller.

    Marlin cuts the square at the probe's reach, which is the print radius less a margin. A square
    whose corners are within the print radius is taken as whole.
    """
    whole = int(abs(size))
    if size <= 0 or printer.reach is None or whole > np.sqrt(2) * printer.reach:
        return None
    low = -float(whole // 2)
    return {"L": low, "R": low + whole, "F": low, "B": low + whole}


def _grid_row(line: str, number: int) -> list[float]:
    """Heights behind the row's number, NaN for marks of points without; none for another line."""
    _, _, heights = f" {line} ".partition(f" {number} ")
    try:
        return [np.nan if set(word) == {"="} else float(word) for word in heights.split()]
    except ValueError:
        return []


def _calibration_radius(text: str, line: int) -> float:
    """Radius, mm, of a G33 that does not print it, by the last M665 before; 0 without one.

    Such versions, up to 2.0.5, probe at M665's B, which later ones have beside A and C as a rod's
    trim.
    """
    words = _last_command(text, "M665", line) or {}
    return 0.0 if words.keys() & set("AC") else words.get("B", 0.0)


def _g33_points(text: str, label: str, printer: Printer) -> Array | None:
    """Tool positions (7, 3) mm of the last G33 P3 V0 in the text, or None where its radius is
    neither printed nor that of an M665 before it.

    Without V0 the printer's values change between the printed heights.
    """
    lines = text.splitlines()
    start = max((n for n, line in enumerate(lines) if _G33_START.search(line)), default=None)
    if start is None or DRY_RUN not in lines[start]:
        return None
    words = _last_command(text, "G33", start)
    if words is None or words.get("P") != 3:
        return None
    values: dict[str, float] = {}
    for line in lines[start + 1 :]:
        if "DRY-RUN" in line:
            break
        values.update({name: float(value) for name, value in _G33_VALUE.findall(line)})
    match = _G33_START.search(lines[start])
    radius = float(match[1]) if match and match[1] else _calibration_radius(text, start)
    if values.keys() != {"c", *G33_DIRECTIONS} or not 0 < radius < LARGEST_PRINTER_VALUE:
        return None
    angles = np.deg2rad(list(G33_DIRECTIONS.values()))
    places = radius * np.column_stack([np.cos(angles), np.sin(angles)])
    heights = [values[name] for name in ("c", *G33_DIRECTIONS)]
    tool = np.vstack([np.zeros((1, 2)), places])
    if "O" in words:  # the probe goes to these places, not the nozzle
        tool = tool - _offset(printer, label)[:2]
    return np.column_stack([tool, heights])
