"""``klipper``: [printer] and [stepper_a] to [stepper_c] of kinematics delta and rotary_delta.

Meaning of the values: Klipper's configuration reference and its klippy/kinematics/delta.py,
rotary_delta.py and chelper/kin_rotary_delta.c. A tower's carriage is at ``position_endstop +
sqrt(arm_length^2 - delta_radius^2)`` where its switch triggers; an arm's switch is told by the
height at which the nozzle would be in the middle if all arms were at that arm's angle.
"""

from __future__ import annotations

from configparser import ConfigParser
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.source import MachineSource
from pkmcal.errors import InputError
from pkmcal.export.contract import Difference, Exporter, commented
from pkmcal.export.delta import (
    DEGREES_A_RADIAN,
    Fit,
    Freedoms,
    about,
    firmware_angle,
    firmware_length,
    firmware_tool_difference,
    fit_of,
    follows,
    redo,
)
from pkmcal.outcome import Finding, Level

FILE = "pkmcal_printer.cfg"
PROGRAM = "Klipper"
KLIPPER_LINEAR_FREEDOMS = Freedoms((210.0, 330.0, 90.0))
KLIPPER_ROTARY_FREEDOMS = Freedoms((30.0, 150.0, 270.0), heights=False)
KLIPPER_STEPPERS = "abc"
SAVED_MARK_ADVICE = (
    "Below SAVE_CONFIG's header keep the mark '#*# ' before each line: where one is without it,"
    " Klipper drops all that was saved."
)
"""klippy/configfile.py, _find_autosave_data."""


def _fit(source: MachineSource) -> Fit:
    return fit_of(source, PROGRAM, KLIPPER_LINEAR_FREEDOMS, KLIPPER_ROTARY_FREEDOMS)


@final
class Klipper(Exporter):
    """Sections for printer.cfg."""

    name: ClassVar = "klipper"
    title: ClassVar = "Klipper: values for printer.cfg"

    def files(self, source: MachineSource) -> dict[str, str]:
        """One file of configuration; pins, speeds and the like are the printer's own."""
        fit = _fit(source)
        word = "Multiply its rotation_distance" if fit.kind == "linear" else "Divide its gear_ratio"
        lines = about(source, fit, KLIPPER_STEPPERS, f"{word} by that.")
        lines.append("Put these values into the sections of the printer's own configuration.")
        lines.append(SAVED_MARK_ADVICE)
        sections = _linear(fit) if fit.kind == "linear" else _rotary(fit)
        body = "".join(
            f"\n[{name}]\n" + "".join(f"{key}: {value}\n" for key, value in values.items())
            for name, values in sections.items()
        )
        return {FILE: commented(lines, "#") + body}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Read as Klipper does, and moved by its formulas."""
        fit = _fit(source)
        text = files[FILE]
        found = ConfigParser(delimiters=(":",), comment_prefixes=("#",))
        found.read_string(text)
        move = klipper_carriage_heights if fit.kind == "linear" else klipper_arm_angles
        zero = homed(found) - fit.rate * fit.delta.ends[fit.order]
        return [firmware_tool_difference(text, fit, lambda points: move(found, points), zero)]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """How well the settings follow the machine, and what to do after they are in."""
        return (follows(_fit(source)), Finding(Level.NOTE, SAVED_MARK_ADVICE), *redo(source))


def _linear(fit: Fit) -> dict[str, dict[str, str]]:
    endstops = fit.end_motors - np.sqrt(fit.rod**2 - fit.radius**2)
    sections = {
        "printer": {
            "kinematics": "delta",
            "delta_radius": firmware_length(fit.radius),
        }
    }
    for k, name in enumerate(KLIPPER_STEPPERS):
        sections[f"stepper_{name}"] = {
            "arm_length": firmware_length(fit.rod[k]),
            "angle": firmware_angle(fit.angle[k]),
            "position_endstop": firmware_length(endstops[k]),
        }
    return sections


def _rotary(fit: Fit) -> dict[str, dict[str, str]]:
    angle = fit.end_motors / DEGREES_A_RADIAN
    out = fit.radius + fit.arm * np.cos(angle)
    below = fit.rod**2 - out**2
    if np.any(below <= 0) or fit.radius <= 0:
        raise InputError(
            "Klipper tells an arm's end switch by a height in the middle, and none belongs to it",
            found=f"an arm that reaches {out.max():.1f} mm out, a rod of {fit.rod.min():.1f} mm",
            next_step="Give the cranks a smaller range in the mechanism file",
        )
    endstops = fit.height + fit.arm * np.sin(angle) - np.sqrt(below)
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


def _each(found: ConfigParser, key: str) -> Array:
    return np.array([found.getfloat(f"stepper_{name}", key) for name in KLIPPER_STEPPERS])


def homed(found: ConfigParser) -> Array:
    """Motor positions (3,), mm or degrees, where the end switches trigger."""
    ends = _each(found, "position_endstop")
    if found.get("printer", "kinematics") == "delta":
        radius = found.getfloat("printer", "delta_radius")
        return ends + np.sqrt(_each(found, "arm_length") ** 2 - radius**2)
    middle = np.zeros((3, 3))
    middle[:, 2] = ends
    return np.diag(klipper_arm_angles(found, middle))


def klipper_carriage_heights(found: ConfigParser, points: Array) -> Array:
    """Carriages' heights (n, 3) mm at points (n, 3) mm."""
    radius = found.getfloat("printer", "delta_radius")
    angle = _each(found, "angle") / DEGREES_A_RADIAN
    dx = radius * np.cos(angle) - points[:, :1]
    dy = radius * np.sin(angle) - points[:, 1:2]
    return np.sqrt(_each(found, "arm_length") ** 2 - dx**2 - dy**2) + points[:, 2:]


def klipper_arm_angles(found: ConfigParser, points: Array) -> Array:
    """Arms' angles (n, 3) degrees at points (n, 3) mm: a circle cut by a line, as Klipper does."""
    angle = _each(found, "angle") / DEGREES_A_RADIAN
    c, s = np.cos(angle), np.sin(angle)
    across = points[:, 1:2] * c - points[:, :1] * s
    dx = points[:, :1] * c + points[:, 1:2] * s - found.getfloat("printer", "shoulder_radius")
    dy = points[:, 2:] - found.getfloat("printer", "shoulder_height")
    upper = _each(found, "upper_arm_length") ** 2
    lower = _each(found, "lower_arm_length") ** 2 - across**2
    first = (dx**2 + dy**2 + upper - lower) / (2 * dy)
    slope = dx / dy
    scale = slope**2 + 1
    x = first * slope + np.sqrt(scale * upper - first**2)
    return np.arctan2(first * scale - slope * x, x) * DEGREES_A_RADIAN
