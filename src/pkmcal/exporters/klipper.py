"""``klipper``: printer.cfg sections of linear and rotary deltas.

The sections are [printer] and [stepper_a] to [stepper_c], for kinematics delta and rotary_delta.
Semantics: Klipper's configuration reference, klippy/kinematics/delta.py, rotary_delta.py and
chelper/kin_rotary_delta.c. A tower's carriage is at ``position_endstop + sqrt(arm_length^2 -
delta_radius^2)`` where its switch triggers. An arm's switch is given by the height of the nozzle
on the central axis if all arms were at that arm's angle. ``print_radius``, beyond which Klipper
accepts no position, defaults to ``delta_radius``.
"""

from __future__ import annotations

from configparser import ConfigParser
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import Difference, Exporter, commented, largest
from pkmcal.exporters.delta import (
    DEGREES_A_RADIAN,
    SWITCH_ROUNDING,
    Fit,
    Freedoms,
    about,
    end_switches,
    firmware_angle,
    firmware_length,
    firmware_tool_difference,
    fit_of,
    proportional_switches,
    readings_elsewhere,
    redo,
    switch_values,
    workspace_radius,
)
from pkmcal.outcome.finding import Finding, note

FILE = "pkmcal_printer.cfg"
PROGRAM = "Klipper"
KLIPPER_LINEAR_FREEDOMS = Freedoms((210.0, 330.0, 90.0))
KLIPPER_ROTARY_FREEDOMS = Freedoms((30.0, 150.0, 270.0), heights=False)
KLIPPER_STEPPERS = "abc"
NO_KLIPPER_PRINT_RADIUS = (
    "There is no print_radius: keep the printer's own. Klipper takes delta_radius where none"
    " stands; then write the former delta_radius there."
)


def _fit(source: MachineSource) -> Fit:
    """Klipper's parameters of a source's machine."""
    return fit_of(source, PROGRAM, KLIPPER_LINEAR_FREEDOMS, KLIPPER_ROTARY_FREEDOMS)


@final
class Klipper(Exporter):
    """Sections for printer.cfg."""

    name: ClassVar = "klipper"
    title: ClassVar = "Klipper: values for printer.cfg"

    def files(self, source: MachineSource) -> dict[str, str]:
        """Configuration file; pins, speeds and the like remain the printer's own."""
        fit = _fit(source)
        word = "Multiply its rotation_distance" if fit.kind == "linear" else "Divide its gear_ratio"
        lines = about(source, fit, KLIPPER_STEPPERS, f"{word} by that.")
        lines.append("Put these values into the sections of the printer's own configuration.")
        lines.append(note("export.klipper_saved").text)
        lines.append(end_switches(fit))
        if fit.kind == "linear":
            names = [f"stepper_{s}.position_endstop" for s in KLIPPER_STEPPERS]
            lines += proportional_switches(fit, names, _tower_endstops(fit))
            radius = workspace_radius(source)
            if radius is None:
                lines.append(NO_KLIPPER_PRINT_RADIUS)
            sections = _linear(fit, radius)
        else:
            sections = _rotary(fit)
            lines += _arm_endstop_lines(fit, sections)
        body = "".join(
            f"\n[{name}]\n" + "".join(f"{key}: {value}\n" for key, value in values.items())
            for name, values in sections.items()
        )
        return {FILE: commented(lines, "#") + body}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences by Klipper's formulas, with the values read as Klipper reads them."""
        fit = _fit(source)
        text = files[FILE]
        config = ConfigParser(delimiters=(":",), comment_prefixes=("#",))
        config.read_string(text)
        move = klipper_carriage_heights if fit.kind == "linear" else klipper_arm_angles
        zero = homed(config) - fit.rate * fit.delta.ends[fit.order]
        # switches at other readings: homing with the value that the text gives for them
        elsewhere = [
            np.where(
                np.isnan(readings),
                0.0,
                _homed_by(config, values) - (fit.rate * readings + fit.zero),
            )
            for readings, values in _endstops_elsewhere(text, fit)
        ]
        radius = workspace_radius(source) if fit.kind == "linear" else None
        own = config.getfloat("printer", "print_radius", fallback=None)
        same = own == (None if radius is None else float(radius))
        return [
            firmware_tool_difference(text, fit, lambda points: move(config, points), zero),
            Difference(
                f"motors at end switches elsewhere, {len(elsewhere)} readings",
                largest(elsewhere) if elsewhere else np.inf,
                SWITCH_ROUNDING,
                "mm or degrees",
            ),
            Difference("print radius", 0.0 if same else np.inf, 0.0, "mm"),
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Agreement of settings and machine, and the steps after installing them."""
        return (_fit(source).following, note("export.klipper_saved"), *redo(source))


def _tower_endstops(fit: Fit) -> Array:
    """Heights (3,) mm of the tool at which the towers' switches trigger."""
    return fit.end_motors - np.sqrt(fit.rod**2 - fit.radius**2)


def _linear(fit: Fit, radius: str | None) -> dict[str, dict[str, str]]:
    """Sections of a linear delta."""
    endstops = _tower_endstops(fit)
    sections = {
        "printer": {
            "kinematics": "delta",
            "delta_radius": firmware_length(fit.radius),
        }
    }
    if radius is not None:
        sections["printer"]["print_radius"] = radius
    for k, name in enumerate(KLIPPER_STEPPERS):
        sections[f"stepper_{name}"] = {
            "arm_length": firmware_length(fit.rod[k]),
            "angle": firmware_angle(fit.angle[k]),
            "position_endstop": firmware_length(endstops[k]),
        }
    return sections


def _arm_endstops(fit: Fit, motors: Array) -> Array:
    """Tool heights (..., 3) mm on the central axis with all arms at the angle of each.

    motors : (..., 3) degrees. NaN where the rod does not reach the axis.
    """
    angle = motors / DEGREES_A_RADIAN
    below = fit.rod**2 - (fit.radius + fit.arm * np.cos(angle)) ** 2
    return fit.height + fit.arm * np.sin(angle) - np.sqrt(np.where(below > 0, below, np.nan))


def _arm_endstop_lines(fit: Fit, sections: dict[str, dict[str, str]]) -> list[str]:
    """Line for each arm with the end switch's heights for a table of readings.

    The relation is not linear. Only readings are listed at which Klipper recovers the arm's angle
    from the height.
    """
    config = ConfigParser()
    config.read_dict(sections)
    readings = readings_elsewhere(fit)
    motors = fit.rate * readings + fit.zero
    heights = _arm_endstops(fit, motors)
    back = np.array([_homed_by(config, row) for row in heights])
    lines: list[str] = []
    for k, name in enumerate(KLIPPER_STEPPERS):
        recovered = np.flatnonzero(np.abs(back[:, k] - motors[:, k]) < SWITCH_ROUNDING)
        pairs = [f"{firmware_length(heights[n, k])} at {readings[n, k]:.9g} rad" for n in recovered]
        lines.append(f"stepper_{name}.position_endstop = {', '.join(pairs)}")
    return lines


def _endstops_elsewhere(text: str, fit: Fit) -> list[tuple[Array, Array]]:
    """Readings of switches elsewhere and their values by the text, (3,) each.

    For tables one motor at a time, NaN for the others.
    """
    if fit.kind == "linear":
        return [(q, switch_values(text, q)) for q in readings_elsewhere(fit)]
    out: list[tuple[Array, Array]] = []
    for k, name in enumerate(KLIPPER_STEPPERS):
        pairs = text.partition(f"stepper_{name}.position_endstop = ")[2].partition("\n")[0]
        for height, _, reading, _ in (pair.split() for pair in pairs.split(", ") if pair):
            both = np.full((2, 3), np.nan)
            both[:, k] = float(reading), float(height)
            out.append((both[0], both[1]))
    return out


def _homed_by(config: ConfigParser, endstops: Array) -> Array:
    """Motor positions (3,) with other end switch values; NaN where a value is NaN."""
    other = ConfigParser()
    other.read_dict(config)
    for name, value in zip(KLIPPER_STEPPERS, endstops, strict=True):
        other[f"stepper_{name}"]["position_endstop"] = repr(float(value))
    return homed(other)


def _rotary(fit: Fit) -> dict[str, dict[str, str]]:
    """Sections of a rotary delta.

    Raises InputError for an arm that no end switch height describes.
    """
    endstops = _arm_endstops(fit, fit.end_motors)
    if not np.isfinite(endstops).all() or fit.radius <= 0:
        out = fit.radius + fit.arm * np.cos(fit.end_motors / DEGREES_A_RADIAN)
        raise InputError(
            "Klipper gives an arm's end switch by a height in the middle, and none belongs to it",
            found=f"an arm that reaches {out.max():.1f} mm out, a rod of {fit.rod.min():.1f} mm",
            next_step="Give the cranks a smaller range in the mechanism file",
        )
    sections = {
        "printer": {
            "kinematics": "rotary_delta",
            "shoulder_radius": firmware_length(fit.radius),
            "shoulder_height": firmware_length(fit.height[0]),
        }
    }
    for k, name in enumerate(KLIPPER_STEPPERS):
        sections[f"stepper_{name}"] = {
            "upper_arm_length": firmware_length(fit.arm[k]),
            "lower_arm_length": firmware_length(fit.rod[k]),
            "angle": firmware_angle(fit.angle[k]),
            "position_endstop": firmware_length(endstops[k]),
        }
    return sections


def _each(config: ConfigParser, key: str) -> Array:
    """Values (3,) of a key in the steppers' sections."""
    return np.array([config.getfloat(f"stepper_{name}", key) for name in KLIPPER_STEPPERS])


def homed(config: ConfigParser) -> Array:
    """Motor positions (3,), mm or degrees, at which the end switches trigger."""
    ends = _each(config, "position_endstop")
    if config.get("printer", "kinematics") == "delta":
        radius = config.getfloat("printer", "delta_radius")
        return ends + np.sqrt(_each(config, "arm_length") ** 2 - radius**2)
    middle = np.zeros((3, 3))
    middle[:, 2] = ends
    return np.diag(klipper_arm_angles(config, middle))


def klipper_carriage_heights(config: ConfigParser, points: Array) -> Array:
    """Carriage heights (n, 3) mm at points (n, 3) mm."""
    radius = config.getfloat("printer", "delta_radius")
    angle = _each(config, "angle") / DEGREES_A_RADIAN
    dx = radius * np.cos(angle) - points[:, :1]
    dy = radius * np.sin(angle) - points[:, 1:2]
    return np.sqrt(_each(config, "arm_length") ** 2 - dx**2 - dy**2) + points[:, 2:]


def klipper_arm_angles(config: ConfigParser, points: Array) -> Array:
    """Arm angles (n, 3) degrees at points (n, 3) mm.

    Intersection of a circle with a line, as in Klipper.
    """
    angle = _each(config, "angle") / DEGREES_A_RADIAN
    c, s = np.cos(angle), np.sin(angle)
    across = points[:, 1:2] * c - points[:, :1] * s
    dx = points[:, :1] * c + points[:, 1:2] * s - config.getfloat("printer", "shoulder_radius")
    dy = points[:, 2:] - config.getfloat("printer", "shoulder_height")
    upper = _each(config, "upper_arm_length") ** 2
    lower = _each(config, "lower_arm_length") ** 2 - across**2
    first = (dx**2 + dy**2 + upper - lower) / (2 * dy)
    slope = dx / dy
    scale = slope**2 + 1
    x = first * slope + np.sqrt(scale * upper - first**2)
    return np.arctan2(first * scale - slope * x, x) * DEGREES_A_RADIAN
