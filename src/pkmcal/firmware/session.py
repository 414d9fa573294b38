"""Session of a delta printer: nominal model from its firmware, with bed heights or a board."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError, legible
from pkmcal.files import csv_text, parse_yaml, validated_document
from pkmcal.firmware.contract import CARRIAGE_STEP, PrintedPart, Printer, Touches, read_printer
from pkmcal.firmware.part import read_part
from pkmcal.firmware.probed import FEWEST_BED_POINTS, read_measured
from pkmcal.measurements.contract import MeasurementKind
from pkmcal.measurements.distances import Distances
from pkmcal.measurements.heights import Heights
from pkmcal.mechanisms import MechanismDocument, checked_machine
from pkmcal.starter import (
    board_text,
    example_readings,
    session_texts,
    write_texts,
)
from pkmcal.wording import count

LARGEST_BED_OFFSET = 3.0
"""Distance, mm, of the bed from the firmware's Z 0 above which a remark reports it: a printer that
was levelled with paper, or by its probe, is within a fraction of a millimetre."""
CARRIAGE_MARGIN_BELOW = 5.0
"""Margin below the lowest carriage position that the bed's edge needs, mm.

The bed may hang lower than the firmware's values place it.
"""
PRINTER_NOMINAL_TEXT = """\
# {name}, a linear delta, by the values in {label}. A firmware has only the difference
# of the towers' radius and the tool's, so the rods' lower ends stand in the platform's origin, the
# nozzle. Readings are the carriages' heights by these values, their range ends at the end switches.
name: {name}
motion: translation
legs:
{legs}
home: {{position: [0, 0, {home} mm]}}
{kept}
# Standard deviations of the firmware's values: of radius and towers (a radius that was measured
# from joint to joint is off by one or two millimetres), of end switches and of rods. Rods measured
# to 0.1 mm, hole to hole, determine sizes along x and y better.
tolerance: {{center: 2 mm, offset: 0.5 mm, axis: 0.3 deg, scale: 0.05 %}}
"""
PRINTER_LEG_TEXT = """\
  - base:
      joint: slider
      center: [{x} mm, {y} mm, 0]
      axis: [0, 0, 1]
      range: [{low} mm, {high} mm]
    platform: {{joint: spherical, center: [0, 0, 0]}}
    length: {{actuated: false, constant: {rod} mm}}"""
CARRIED_BOARD_SESSION_TEXT = """\
# A calibration session of a delta printer, by a camera and a board that its tool carries.
#
# What to do, in this order:
#   1. mechanism.yaml      the printer by its firmware: see whether its tolerances are right
#   2. board.yaml          pkmcal board prints it, in {size}:
#                          measure it, and fix it to the effector, flat, facing the camera
#   3. cameras/front.yaml  the calibration of your camera
#   4. Put the camera in place. Home. Move to 25 places over the whole bed and half of the height,
#      also where a carriage is near its lowest or highest; wait until the tool hangs still, take a
#      image and note where the carriages are. Do not touch the camera in between.
#   5. images/front/       the images, each under the name of its configuration
#   6. joints.csv          the carriages' heights in mm, one row a configuration: {where}
#   7. pkmcal check, in this folder's place, until it finds nothing wrong; then pkmcal calibrate
pkmcal: 1                     # the format's version; leave it
mechanism: mechanism.yaml

joints:
  file: joints.csv
  noise: {noise} mm             # {steps}

# Your own words, which stand on the report: who, when, which machine, what was changed.
# notes: |
#   New belts.

"""
FIRMWARE_FIXED_TEXT = """\
# What the firmware can hold: towers upright, motors that move as far as it commands.
fixed: ["legs[*].platform.center", "legs[*].base.axis", "legs[*].scale"]
# pkmcal calibrate --model leaning estimates the towers' directions as well, two angles each.
models:
  leaning: {fixed: ["legs[*].platform.center", "legs[*].scale"]}
"""
PLATFORM_FIXED_TEXT = """\
fixed: ["legs[*].platform.center"]
"""
PROBED_SESSION_TEXT = """\
# The bed of a delta printer, felt at {n} points; where they come from: {origin}.
# pkmcal calibrate, and then pkmcal export --to {to}.
pkmcal: 1
mechanism: mechanism.yaml

joints:
  file: joints.csv            # the carriages when the bed was probed
  noise: {noise} mm             # {steps}

stations:
  probe:
    tracker:
      poses: poses.csv        # the tool's height above the bed
{probe_noise}      # A bed that is not flat to that counts as well, and is reported.
      level: true             # the firmware's Z is counted from the bed

"""
DEFAULT_PROBE_TEXT = """\
      # Standard deviation of the probe: Klipper's PROBE_ACCURACY and Marlin's M48 print yours;
      # {sigma} is pkmcal's default.
      # noise: {{position: {sigma}}}
"""
PROBE_TEXT = """\
      noise: {{position: {sigma}}}  # standard deviation of the probe, as that file has it
"""
NO_PART_TEXT = """\
# Heights do not determine how large a part comes out. Distances on a printed part do: write them
# into a file, and make the session again with --part FILE.
"""
PART_TEXT = """\
# Distances on a printed part, by {label}{shrinkage}.
# Further rows of joints.csv are the carriages at its marks, by the firmware's values.
distances:
  file: distances.csv
"""
DEFAULT_CALIPER_TEXT = """\
  # Standard deviation of a distance; {sigma} is pkmcal's default.
  # noise: {sigma}
"""


def write_printer_session(
    folder: Path | str,
    printer: Path,
    probed: Path | None = None,
    in_view: Literal["board"] | None = None,
    places: int = 1,
    firmware: str | None = None,
    part: Path | None = None,
) -> tuple[str, ...]:
    """Write a printer's session into a new or empty folder and return the names of its files.

    printer : its configuration file.
    probed : file with bed points; None for the points in the configuration file.
    in_view : ``board`` for a session with a board on the tool; None for a session of heights.
    places : number of stations of a session with a board.
    firmware : the firmware's name, for a file that does not show it.
    part : file of a printed part, beside heights.

    Raises InputError for files that lack necessary values.
    """
    texts, _ = printer_session_texts(printer, probed, in_view, places, firmware, part)
    return write_texts(folder, texts)


def printer_session_texts(
    printer: Path,
    probed: Path | None = None,
    in_view: Literal["board"] | None = None,
    places: int = 1,
    firmware: str | None = None,
    part: Path | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Files of a printer's session by name, and remarks on its configuration; arguments as for
    `write_printer_session`.
    """
    delta = read_printer(printer, firmware)
    if in_view is None:
        # of the printer's own file, points that do not depend on its values come first
        touches, printed = delta.touches, delta.part
        if probed is not None:
            points, measured = read_measured(probed, delta)
            touches, printed = points or touches, measured or printed
        elif touches is None:
            touches, measured = read_measured(printer, delta, own=True)
            printed = measured or printed
        if part is not None:
            printed = read_part(part, delta)
        touches = _checked_touches(delta, touches)
        texts = heights_texts(delta, touches, printed)
        return texts, (*delta.remarks, *_bed_remarks(delta, touches))
    return carried_texts(delta, places), delta.remarks


def carried_texts(printer: Printer, places: int = 1) -> dict[str, str]:
    """Files by name of a session with a board on the tool, to be filled in by the user."""
    texts = session_texts("linear-delta", "board", places)
    nominal = nominal_text(printer) + PLATFORM_FIXED_TEXT
    document = parse_yaml(nominal, Path("mechanism.yaml"))
    machine = checked_machine(validated_document(document, MechanismDocument), document)
    heads = [f"{motor} [mm]" for motor in printer.firmware.motors]
    # the corners of 7 by 5 squares stay within the print radius while the tool goes half as far:
    # only there no tower is in the way
    reach = printer.reach
    head = CARRIED_BOARD_SESSION_TEXT.format(
        where=printer.firmware.carriage_source.replace("\n", "\n#" + 26 * " "),
        size="the smallest size, since the file has no print radius"
        if reach is None
        else f"a size for a print radius of {_mm(reach)} mm",
        **_resolution(printer),
    )
    session = texts["session.yaml"]
    texts["session.yaml"] = head + session[session.index("# One entry") :]
    texts["mechanism.yaml"] = nominal
    texts["joints.csv"] = example_readings(machine, heads)
    texts["board.yaml"] = board_text(0.0 if reach is None else reach / 1e3)
    return texts


def _resolution(printer: Printer) -> dict[str, str]:
    """Standard deviation and step of the carriages, in words: at least that of a motor step."""
    step = max(printer.step, CARRIAGE_STEP)
    return {
        "noise": f"{step / np.sqrt(12):.1g}",
        "steps": f"a step of {step:.3g} mm, of which a carriage is anywhere",
    }


def _checked_touches(printer: Printer, touches: Touches | None) -> Touches:
    """The points, unchanged.

    Raises InputError for too few points, and for points that contradict the printer's values.
    """
    if touches is None:
        raise InputError(
            "there is no probed point of the bed",
            where=printer.label,
            expected="a section [delta_calibrate] with height0 and height0_pos, which Klipper's"
            " DELTA_CALIBRATE and SAVE_CONFIG write, a mesh that Klipper saved, or Marlin's lines"
            " 'Bed X: Y: Z:'",
            next_step="Name the printer's console output of a probing with --probed FILE; or"
            " --board, for a session with a camera",
        )
    if len(touches.heights) < FEWEST_BED_POINTS:
        raise InputError(
            "too few points of the bed",
            where=touches.origin,
            found=count(len(touches.heights), "point"),
            expected=f"{FEWEST_BED_POINTS} or more, spread to the edge of the bed",
        )
    # the upper end of a rod is above the bed when the lower one touches it; a bed may hang lower
    # than the origin, but by less than a rod
    lowest = touches.carriages.min(axis=0)
    above, below = touches.carriages.max(axis=0) - printer.homed, -lowest - printer.rod
    for beyond, where, distance in (
        (above, "above its end switch", above),
        (below, "far below the bed", -lowest),
    ):
        if beyond.max() > 0:
            motor = int(np.argmax(beyond))
            raise InputError(
                f"a carriage would have been {where} when the bed was probed",
                where=touches.origin,
                found=f"{printer.firmware.motors[motor]} {distance[motor]:.4g} mm"
                f" {where.removeprefix('far ')}",
                expected=f"points that belong to the values in {printer.label}",
            )
    return touches


def _bed_remarks(printer: Printer, touches: Touches) -> tuple[str, ...]:
    """Sentence on a bed that is far from the firmware's Z 0, as by a wrong offset of the probe."""
    document = parse_yaml(nominal_text(printer, touches.carriages), Path("mechanism.yaml"))
    machine = checked_machine(validated_document(document, MechanismDocument), document)
    z = 1e3 * machine.forward(1e-3 * touches.carriages)[:, 2, 3] - touches.heights
    off = float(np.mean(z))
    if not abs(off) > LARGEST_BED_OFFSET:
        return ()
    probe = printer.offset[2]
    offset = (
        f" (the probe's offset is {_mm(probe)} mm in Z)" if probe and np.isfinite(probe) else ""
    )
    return (
        f"By the values in {legible(printer.label)} the bed is at Z {_mm(off)} mm, not 0{offset}:"
        " check the probe's offset and that these values were in force. The exported height at home"
        " takes up this difference, so begin with the nozzle high.",
    )


def heights_texts(
    printer: Printer, touches: Touches, part: PrintedPart | None = None
) -> dict[str, str]:
    """Files by name of a session of bed heights, and of distances on a printed part."""
    heights = [f"{k + 1:03d}" for k in range(len(touches.heights))]
    heads = [f"{motor} [mm]" for motor in printer.firmware.motors]
    names, carriages, distances = heights, touches.carriages, dict[str, str]()
    if part is not None:
        names, carriages = [*heights, *part.names], np.concatenate([carriages, part.carriages])
        rows = zip(part.between.tolist(), part.distance.round(6).tolist(), strict=True)
        lines = [f"{part.names[a]},{part.names[b]},{value!r}" for (a, b), value in rows]
        distances["distances.csv"] = "\n".join(["from,to,distance [mm]", *lines]) + "\n"
    session = PROBED_SESSION_TEXT.format(
        n=len(heights),
        origin=legible(touches.origin),
        to=printer.firmware.name,
        probe_noise=DEFAULT_PROBE_TEXT.format(sigma=_default_sigma(Heights))
        if touches.sigma is None
        else PROBE_TEXT.format(sigma=f"{touches.sigma:.3g} mm"),
        **_resolution(printer),
    )
    return {
        "session.yaml": session + (NO_PART_TEXT if part is None else _part_text(part)),
        "mechanism.yaml": nominal_text(printer, carriages) + FIRMWARE_FIXED_TEXT,
        "joints.csv": csv_text(heads, names, carriages.round(6)),
        "poses.csv": csv_text(["z [mm]"], heights, touches.heights[:, None]),
        **distances,
    }


def _part_text(part: PrintedPart) -> str:
    """Entry ``distances`` of session.yaml."""
    shrinkage = (
        f", whose shrinkage of {100 * part.shrinkage:g} % is undone" if part.shrinkage else ""
    )
    text = PART_TEXT.format(label=legible(part.label), shrinkage=shrinkage)
    if part.noise is None:
        return text + DEFAULT_CALIPER_TEXT.format(sigma=_default_sigma(Distances))
    return text + f"  noise: {part.noise:g} mm\n"


def _default_sigma(kind: type[MeasurementKind]) -> str:
    """Default standard deviation of a kind, mm, in words."""
    return f"{1e3 * (kind.default_sigma or 0.0):g} mm"


def nominal_text(printer: Printer, reached: Array | None = None) -> str:
    """Nominal model of the printer as a mechanism file, without its key ``fixed``.

    reached : (n, 3) mm, heights of the carriages that their ranges have to include. Raises
    InputError for a print radius out of reach.
    """
    angle = np.deg2rad(printer.angle)
    towers = printer.radius * np.column_stack([np.cos(angle), np.sin(angle)])
    # without a print radius the tool stays within the towers
    reach = printer.radius if printer.reach is None else printer.reach
    edge = reach * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    # lowest carriages at the bed's edge, towards the towers and away from them, and at the touches
    with np.errstate(invalid="ignore"):
        carriages = [printer.carriages(s * edge) for s in (-1.0, 1.0)]
    carriages += [] if reached is None else [reached]
    if not np.isfinite(np.concatenate(carriages)).any():
        raise InputError(
            "the rods do not reach the print radius",
            where=printer.label,
            found=f"a print radius of {reach:g} mm, rods of {printer.rod.min():g} mm",
            expected="a print radius within the towers",
        )
    lowest = float(np.nanmin(np.concatenate(carriages))) - CARRIAGE_MARGIN_BELOW
    # tool height at which the first carriage reaches its end switch, on the axis
    top = float((printer.homed - np.sqrt(printer.rod**2 - printer.radius**2)).min())
    legs = [
        PRINTER_LEG_TEXT.format(x=_mm(x), y=_mm(y), low=_mm(lowest), high=_mm(high), rod=_mm(rod))
        for (x, y), high, rod in zip(towers, printer.homed, printer.rod, strict=True)
    ]
    return PRINTER_NOMINAL_TEXT.format(
        name=printer.firmware.program.lower() + "-delta",
        label=legible(printer.label),
        legs="\n".join(legs),
        home=_mm(top / 2),
        kept=_controller_values(printer),
    )


def _controller_values(printer: Printer) -> str:
    """Entries that calibrate nothing and that exports keep, with comments."""
    lines = [f"# {legible(remark)}" for remark in printer.remarks]
    if printer.reach is not None:
        lines += [
            "# The printer's own print radius, by the same file; it calibrates nothing, and exports"
            " keep it.",
            f"workspace_radius: {_mm(printer.reach)} mm",
        ]
    if printer.height_offset is not None:
        lines += [
            f"# {printer.firmware.program}'s height at home contains this beyond the nozzle's own"
            " height; exports keep it.",
            f"height_offset: {_mm(printer.height_offset)} mm",
        ]
    if printer.steps is not None:
        steps = ", ".join(_mm(value) for value in printer.steps)
        lines += ["# Motor steps per mm, by the same file.", f"steps_per_mm: [{steps}]"]
    return "\n".join(lines)


def _mm(value: float) -> str:
    """Length in mm with four decimals, trailing zeros dropped."""
    return f"{value:.4f}".rstrip("0").rstrip(".")
