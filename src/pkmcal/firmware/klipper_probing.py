"""What Klipper measured: heights of the bed, and distances on a printed part.

Semantics: Klipper's klippy/extras/delta_calibrate.py, bed_mesh.py and probe.py.

- ``heightN_pos`` of [delta_calibrate] are steps of the three motors from their end switches,
  ``heightN`` is the height of the nozzle above the bed there, ``distanceN`` the distance between
  the tool's positions ``distanceN_pos1`` and ``distanceN_pos2``. These do not depend on the
  printer's values.
- ``points`` of [bed_mesh NAME] are heights of a grid from (min_x, min_y) on, rows along x: the Z at
  which the nozzle would touch the bed under the probe. On a round bed (mesh_radius) each row is
  continued to the grid's edge by its last probed height, and within a faulty region heights are
  means of its border: neither was probed.
- ``PROBE`` prints ``probe at X,Y is z=Z``, the tool's position when the probe triggered; newer
  versions print ``probe: at X,Y bed will contact at z=Z``, the point of the bed under the probe
  with the tool's height at which the nozzle would touch it. Samples before ``Probe samples exceed
  tolerance. Retrying...`` are dropped. ``PROBE_ACCURACY`` prints the standard deviation of its
  samples.
- ``DELTA_ANALYZE`` takes distances on Klipper's printed calibration object: from the inner to the
  outer edge of each of six arms (CENTER_DISTS), and between neighbouring arms (OUTER_DISTS), both
  including a pillar's width, which is subtracted. The object is printed around the bed's middle, in
  its own size times SCALE.
"""

from __future__ import annotations

import re
from itertools import count, takewhile

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.files import quoted
from pkmcal.firmware.contract import (
    LARGEST_PRINTER_VALUE,
    NUMBER,
    PrintedPart,
    Printer,
    Touches,
    means_by_position,
    reachable_carriages,
    root_mean_square,
    touches_at,
)
from pkmcal.firmware.klipper_config import KlipperConfig, Sections

MOST_CARRIAGE_STEPS = 1e9
"""Bound on steps from an end switch; more would be kilometres of carriage travel."""
LARGEST_MESH_HEIGHT = 1e3
"""Bound on the heights of a mesh, mm."""
MOST_MESH_POINTS = 200
"""Bound on the points of a mesh's row or column."""
KLIPPER_STEPPERS = ("a", "b", "c")
OBJECT_ANGLES = (210.0, 270.0, 330.0, 30.0, 90.0, 150.0)
"""Directions of the arms of Klipper's calibration object, degrees."""
PILLAR_RADIUS, RIDGE_RADIUS = 65.0, 4.5
"""Distances, mm, of the object's outer pillars from its middle, and of a pillar's ridge from the
pillar's middle."""
ANALYZED = {
    "CENTER_DISTS": 6, "CENTER_PILLAR_WIDTHS": 3, "OUTER_DISTS": 6, "OUTER_PILLAR_WIDTHS": 6,
}  # fmt: skip
"""Measurements of DELTA_ANALYZE and their numbers of values."""
_TRIGGERED = re.compile(rf"probe at {NUMBER},{NUMBER} is z={NUMBER}")
_CONTACT = re.compile(rf"probe: at {NUMBER},{NUMBER} bed will contact at z={NUMBER}")
_RETRY = "Probe samples exceed tolerance. Retrying"
_ACCURACY = re.compile(rf"\bstandard deviation {NUMBER}")
_ANALYZE = re.compile(r"\bDELTA_ANALYZE\s+([^\n;]*)")
_ANALYZE_WORD = re.compile(r"\b([A-Z]{5,6}(?:_[A-Z]+){0,2}) ?= ?[\[(]?([-0-9.][-0-9., ]*)")


def saved_touches(config: KlipperConfig, ends: Array, mm_a_step: Array | None) -> Touches | None:
    """Bed points that DELTA_CALIBRATE saved, and those entered by hand; None without any.

    ends : (3,) mm, carriages at the end switches. mm_a_step : (3,), None where unknown.
    """
    names = [name for kind in ("height", "manual_height") for name in _numbered(config, kind)]
    if not names:
        return None
    heights = [config.number("delta_calibrate", name) for name in names]
    carriages = _stable(config, [f"{name}_pos" for name in names], ends, mm_a_step)
    return Touches(carriages, np.array(heights), f"{config.label}, [delta_calibrate]")


def saved_distances(
    config: KlipperConfig, ends: Array, mm_a_step: Array | None
) -> PrintedPart | None:
    """Distances that DELTA_ANALYZE saved; arguments as for `saved_touches`."""
    names = _numbered(config, "distance")
    if not names:
        return None
    values = [config.positive("delta_calibrate", name) for name in names]
    first, second = (
        _stable(config, [f"{name}_pos{end}" for name in names], ends, mm_a_step) for end in (1, 2)
    )
    return PrintedPart.of_pairs(
        first, second, np.array(values), f"{config.label}, [delta_calibrate]"
    )


def _numbered(config: KlipperConfig, kind: str) -> list[str]:
    """Names of [delta_calibrate] of one kind, numbered from 0 without a gap."""
    entries = config.entries.get("delta_calibrate", {})
    return [f"{kind}{k}" for k in takewhile(lambda k: f"{kind}{k}" in entries, count())]


def _stable(config: KlipperConfig, names: list[str], ends: Array, mm_a_step: Array | None) -> Array:
    """Carriages (n, 3) mm at positions that are saved as steps from the end switches."""
    if mm_a_step is None:
        mm_a_step = np.array([config.step(f"stepper_{s}") for s in KLIPPER_STEPPERS])
    steps = [_motor_steps(config.entries["delta_calibrate"], config.label, name) for name in names]
    return ends - np.array(steps) * mm_a_step


def _motor_steps(entries: dict[str, tuple[str, str]], label: str, name: str) -> list[float]:
    """Three comma-separated motor positions, in steps. Raises InputError for anything else."""
    text, where = entries.get(name, ("", f"{label}, [delta_calibrate]"))
    try:
        values = [float(x) for x in text.split(",")]
    except ValueError:
        values = list[float]()
    if len(values) != 3 or not all(abs(x) <= MOST_CARRIAGE_STEPS for x in values):
        raise InputError(
            f"{name} does not give the three motors' positions",
            where=where,
            found=quoted(text),
            expected="three numbers, as SAVE_CONFIG wrote them",
        )
    return values


def probed_touches(text: str, label: str, printer: Printer) -> Touches | None:
    """Points of PROBE in a console's output or in klippy.log; repeats at one place are averaged.

    None without any. The standard deviation is that of PROBE_ACCURACY where the text has it.
    """
    # the tool's positions, of older versions, and the points of the bed, of newer ones
    triggered, contact = (list[tuple[float, float, float]]() for _ in range(2))
    for line in text.splitlines():
        if match := _TRIGGERED.search(line):
            triggered.append((float(match[1]), float(match[2]), float(match[3])))
        elif match := _CONTACT.search(line):
            contact.append((float(match[1]), float(match[2]), float(match[3])))
        elif _RETRY in line:
            # all samples at the place of the last one are taken again
            points = triggered or contact
            place = points[-1][:2] if points else None
            while points and points[-1][:2] == place:
                points.pop()
    if not triggered and not contact:
        return None
    dx, dy, dz = printer.offset
    offset, height = (np.zeros(3), dz) if triggered else (np.array([dx, dy, 0.0]), 0.0)
    tool = means_by_position(np.array(triggered or contact)) - offset
    return touches_at(tool, height, printer, label, root_mean_square(_ACCURACY.findall(text)))


def mesh_touches(config: KlipperConfig, printer: Printer) -> Touches | None:
    """Probed points of a bed mesh that was saved; None without one.

    Of several profiles the one with the name ``default``. Raises InputError for a mesh whose
    probed points or heights do not follow from the configuration.
    """
    names = [
        name
        for name, entries in config.entries.items()
        if name.startswith("bed_mesh ") and "points" in entries
    ]
    if not names:
        return None
    section = "bed_mesh default" if "bed_mesh default" in names else names[0]
    settings = config.entries.get("bed_mesh", {})
    where = f"{config.label}, [{section}]"
    if len(names) > 1 and section != "bed_mesh default":
        raise InputError(
            "there are several meshes of the bed",
            where=config.label,
            found=" and ".join(f"[{name}]" for name in names[:3]),
            expected="one mesh, or one with the name default",
            next_step="Copy the printer's file and remove the others",
        )
    if "bed_mesh" not in config.entries:
        raise InputError(
            "without the section [bed_mesh] nothing shows which points of the mesh were probed",
            where=where,
            expected="[bed_mesh] with mesh_radius, or with mesh_min and mesh_max",
        )
    relative = [name for name in ("zero_reference_position", "relative_reference_index")
                if name in settings]  # fmt: skip
    if relative:
        raise InputError(
            "the mesh's heights are relative to one of its points, which is not the bed's Z 0",
            where=settings[relative[0]][1],
            found=f"{relative[0]}: {settings[relative[0]][0]}",
            expected="heights as the probe measured them",
            next_step=f"Leave {relative[0]} out, probe the mesh again and save it; or probe with"
            " PROBE at fifteen places",
        )
    z = _mesh_heights(config.entries, section, where)
    x, y = (
        np.linspace(config.number(section, f"min_{c}"), config.number(section, f"max_{c}"), n)
        for c, n in zip("xy", z.T.shape, strict=True)
    )
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    probed = ~_faulty(config, grid)
    if "mesh_radius" in settings:
        half = (x[-1] - x[0]) / 2
        middle = np.array([x[0] + x[-1], y[0] + y[-1]]) / 2
        probed &= np.linalg.norm(grid - middle, axis=-1) <= half * (1 + 1e-9)
    points = np.column_stack([grid[probed], z[probed]]) - [*printer.offset[:2], 0.0]
    return touches_at(points, 0.0, printer, where)


def _mesh_heights(entries: Sections, section: str, where: str) -> Array:
    """Heights (rows along y, columns along x) of a mesh, mm."""
    text = entries[section].get("points", ("", where))[0]
    rows = [line.split(",") for line in text.splitlines() if line.strip()]
    heights = [[_height(word) for word in row] for row in rows]
    wrong = next(
        (word for row in rows for word in row if not abs(_height(word)) < LARGEST_MESH_HEIGHT), None
    )
    sizes = [entries[section].get(f"{c}_count", ("", ""))[0] for c in "xy"]
    z = np.array(heights) if len({len(row) for row in rows}) == 1 else np.zeros((0, 0))
    inside = all(2 <= n <= MOST_MESH_POINTS for n in z.shape)
    if wrong is not None or not inside or [str(n) for n in z.T.shape] != sizes:
        raise InputError(
            "the mesh cannot be read",
            where=where,
            found=f"a height {quoted(wrong.strip())}"
            if wrong is not None
            else f"{len(rows)} rows of points, x_count {sizes[0] or 'missing'}, y_count"
            f" {sizes[1] or 'missing'}",
            expected=f"y_count rows of x_count heights below {LARGEST_MESH_HEIGHT:g} mm, at most"
            f" {MOST_MESH_POINTS}, as SAVE_CONFIG wrote them",
        )
    return z


def _height(word: str) -> float:
    """Number of a text; NaN for another text."""
    try:
        return float(word)
    except ValueError:
        return np.nan


def _faulty(config: KlipperConfig, grid: Array) -> np.ndarray:
    """Whether points (..., 2) are in a region that Klipper does not probe."""
    inside = np.zeros(grid.shape[:-1], dtype=bool)
    settings = config.entries.get("bed_mesh", {})
    for k in range(1, 100):
        least, most = (settings.get(f"faulty_region_{k}_{end}") for end in ("min", "max"))
        if least is None or most is None:
            break
        try:
            low, high = (np.array([float(x) for x in one[0].split(",")]) for one in (least, most))
            inside |= ((grid >= low) & (grid <= high)).all(axis=-1)
        except ValueError:
            raise InputError(
                "this region of the mesh cannot be read",
                where=least[1],
                found=f"{least[0]} to {most[0]}",
                expected="x, y of two corners in mm",
            ) from None
    return inside


def analyzed_distances(text: str, label: str, printer: Printer) -> PrintedPart | None:
    """Distances of DELTA_ANALYZE in a console's output or in klippy.log; None without any.

    Raises InputError for an incomplete set of measurements.
    """
    words: dict[str, list[float]] = {}
    for arguments in _ANALYZE.findall(text):
        for name, values in _ANALYZE_WORD.findall(arguments):
            try:
                words[name] = [float(value) for value in values.strip(" ,").split(",")]
            except ValueError:
                words[name] = []
    if not words.keys() & ANALYZED.keys():
        return None
    # an object of 148 mm has a size of 1.5 mm or 15 m beyond these scales
    scale = words.get("SCALE", [1.0])
    wrong = [name for name, size in ANALYZED.items() if len(words.get(name, ())) != size]
    if wrong or len(scale) != 1 or not 0.01 < scale[0] < 100:
        name = (wrong or ["SCALE"])[0]
        raise InputError(
            "the measurements of the calibration object are not complete",
            where=label,
            found=f"{name}={','.join(f'{value:g}' for value in words.get(name, ()))}",
            expected=", ".join(f"{one} with {size}" for one, size in ANALYZED.items())
            + " values, and SCALE between 0.01 and 100 if the object was scaled",
        )
    angles = np.deg2rad(OBJECT_ANGLES)
    out = scale[0] * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    # center: along each arm, from the ridge around the middle to the ridge outside its pillar
    along = RIDGE_RADIUS * out, (PILLAR_RADIUS + RIDGE_RADIUS) * out
    # outer: from each pillar to its neighbour, which is in the direction of the arm after that
    towards = np.roll(out, -2, axis=0)
    across = (
        PILLAR_RADIUS * out + RIDGE_RADIUS * towards,
        PILLAR_RADIUS * out + (PILLAR_RADIUS + RIDGE_RADIUS) * towards,
    )
    first, second = (np.concatenate(ends) for ends in zip(along, across, strict=True))
    # the widths of the middle's pillar in the directions of arms 1, 3 and 2
    middle = np.array(words["CENTER_PILLAR_WIDTHS"])[[0, 2, 1, 0, 2, 1]]
    values = np.concatenate([
        np.array(words["CENTER_DISTS"]) - middle,
        np.array(words["OUTER_DISTS"]) - words["OUTER_PILLAR_WIDTHS"],
    ])  # fmt: skip
    if not ((values > 0) & (values <= LARGEST_PRINTER_VALUE)).all():
        raise InputError(
            "a distance on the calibration object is not longer than its pillar, or too long",
            where=label,
            found=f"{values.min():g} to {values.max():g} mm without the pillars",
            expected="distances over the pillars' outer edges, in mm",
        )
    ends = [reachable_carriages(points, printer, label) for points in (first, second)]
    return PrintedPart.of_pairs(ends[0], ends[1], values, label)
