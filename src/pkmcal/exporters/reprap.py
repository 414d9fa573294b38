"""``reprap``: RepRapFirmware's M665 and M666 for linear deltas, M669 K10 and M666 for rotary ones.

Semantics: Duet3D's G-code reference, and the firmware's LinearDeltaKinematics and
RotaryDeltaKinematics. Towers X, Y, Z are at -150, -30 and 90 degrees, with corrections counted
anticlockwise. A homed carriage is at ``H + sqrt(L^2 - R^2)`` plus its endstop adjustment, a homed
arm at the larger angle of A plus its adjustment. B is the print radius, beyond which the firmware
accepts no position; if omitted it remains as it was, 80 mm by default.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import Difference, Exporter, commented, largest
from pkmcal.exporters.delta import (
    DEGREES_A_RADIAN,
    MM_A_METRE,
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
from pkmcal.outcome.finding import Finding

FILE = "pkmcal_delta.g"
PROGRAM = "RepRapFirmware"
REPRAP_TOWER_ANGLES = (-150.0, -30.0, 90.0)
STEEPEST_ARM_ANGLE = 90.0
NO_REPRAP_PRINT_RADIUS = (
    "There is no print radius, B: it stays the printer's own; where none was set it is 80 mm."
)
_WORD = re.compile(r"([A-Z])(-?[0-9.]+(?::-?[0-9.]+)*)")


def _fit(source: MachineSource) -> Fit:
    """RepRapFirmware's parameters of a source's machine."""
    return fit_of(source, PROGRAM, Freedoms(REPRAP_TOWER_ANGLES), Freedoms(REPRAP_TOWER_ANGLES))


@final
class RepRap(Exporter):
    """Commands for config.g."""

    name: ClassVar = "reprap"
    title: ClassVar = "RepRapFirmware: lines for config.g"

    def files(self, source: MachineSource) -> dict[str, str]:
        """One file of G-code."""
        fit = _fit(source)
        unit = "mm" if fit.kind == "linear" else "degree"
        correcting = f"Divide its steps per {unit} (M92) by that."
        lines = about(source, fit, "XYZ", correcting)
        names = [f"M666 {letter}" for letter in "XYZ"]
        lines += [end_switches(fit), *proportional_switches(fit, names, _adjustments(fit))]
        radius = workspace_radius(source)
        if radius is None:
            lines.append(NO_REPRAP_PRINT_RADIUS)
        commands = (_linear if fit.kind == "linear" else _rotary)(fit, radius)
        return {FILE: commented(lines, ";") + "\n".join(commands) + "\n"}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences by the firmware's formulas, with values read as the firmware reads them."""
        fit = _fit(source)
        text = files[FILE]
        words = read_words(text)
        ends = fit.rate * fit.delta.ends[fit.order]
        linear = fit.kind == "linear"
        homed = (homed_carriages if linear else homed_arms)(words)
        move = reprap_carriage_heights if linear else reprap_arm_angles
        # switches at other readings: homing with the value that the text gives for them
        elsewhere = [
            (homed_carriages if linear else homed_arms)(
                {**words, **{f"666{c}": np.array([v]) for c, v in zip("XYZ", values, strict=True)}}
            )
            - (fit.rate * readings + fit.zero)
            for readings in readings_elsewhere(fit)
            for values in [switch_values(text, readings)]
        ]
        radius = workspace_radius(source)
        read_radius = [*words.get("665B", words.get("669B", []))]
        same = read_radius == ([] if radius is None else [float(radius)])
        return [
            firmware_tool_difference(text, fit, lambda points: move(words, points), homed - ends),
            Difference(
                "motors at end switches elsewhere",
                largest(elsewhere),
                SWITCH_ROUNDING,
                "mm or degrees",
            ),
            Difference("print radius", 0.0 if same else np.inf, 0.0, "mm"),
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Agreement of settings and machine, and the steps after installing them."""
        return (_fit(source).following, *redo(source))


def _adjustments(fit: Fit) -> Array:
    """Endstop adjustments (3,), mm or degrees, relative to H or to the larger angle of A."""
    homed = fit.end_motors
    if fit.kind == "linear":
        homed = homed - np.sqrt(fit.rod**2 - fit.radius**2)
    return homed - homed.mean()


def _linear(fit: Fit, radius: str | None) -> list[str]:
    """Commands of a linear delta."""
    heights = fit.end_motors - np.sqrt(fit.rod**2 - fit.radius**2)
    homed = float(heights.mean())
    corrections = fit.angle - np.array(REPRAP_TOWER_ANGLES)
    return [
        "M669 K3 ; linear delta",
        f"M665 L{_by_tower(fit.rod)} R{firmware_length(fit.radius)} H{firmware_length(homed)}"
        + ("" if radius is None else f" B{radius}")
        + f" {_letters(corrections, firmware_angle)}"
        " ; L rods, R radius, H homed height"
        + ("" if radius is None else ", B the printer's own print radius"),
        f"M666 {_letters(_adjustments(fit), firmware_length)} A0 B0"
        " ; endstop adjustments, mm; no tilt",
    ]


def _rotary(fit: Fit, radius: str | None) -> list[str]:
    """Commands of a rotary delta. Raises InputError for arms beyond 90 degrees."""
    delta = fit.delta
    homed = float(fit.end_motors.mean())
    ranges = delta.machine.joint_ranges[delta.joint][fit.order]
    lowest = float((fit.rate[:, None] * ranges + fit.zero[:, None]).min())
    if lowest < -STEEPEST_ARM_ANGLE or homed > STEEPEST_ARM_ANGLE:
        raise InputError(
            "RepRapFirmware's rotary delta takes arms up to 90 degrees from the horizontal",
            found=f"arms from {lowest:.1f} to {homed:.1f} degrees",
            next_step="Give the cranks a smaller range in the mechanism file",
        )
    corrections = fit.angle - np.array(REPRAP_TOWER_ANGLES)
    low = float(MM_A_METRE * delta.positions[:, 2].min() + MM_A_METRE * fit.T_firmware_base[2, 3])
    high = float(MM_A_METRE * delta.positions[:, 2].max() + MM_A_METRE * fit.T_firmware_base[2, 3])
    return [
        f"M669 K10 U{_by_tower(fit.arm)} L{_by_tower(fit.rod)} H{_by_tower(fit.height)}"
        f" R{firmware_length(fit.radius)} A{firmware_angle(lowest)}:{firmware_angle(homed)}"
        + ("" if radius is None else f" B{radius}")
        + f" {_letters(corrections, firmware_angle)}"
        " ; U arms, L rods, H bearings' heights, R radius",
        f"M666 {_letters(_adjustments(fit), firmware_angle)}"
        " ; homed angles beyond A's larger one, degrees",
        f"; M208 Z{firmware_length(max(low, 0.0))}:{firmware_length(high)}"
        " ; Z of the workspace at most; set your own",
        "; M92: microsteps per degree of the arm, on X, Y and Z",
    ]


def _by_tower(values: Array) -> str:
    """Three lengths, separated by colons."""
    return ":".join(firmware_length(v) for v in values)


def _letters(values: Array, write: Callable[[float], str]) -> str:
    """Values after the letters X, Y and Z."""
    return " ".join(f"{letter}{write(float(v))}" for letter, v in zip("XYZ", values, strict=True))


def read_words(text: str) -> dict[str, Array]:
    """Values by command and letter, as ``665L``; text after a semicolon is a comment."""
    out: dict[str, Array] = {}
    for line in text.splitlines():
        command, _, rest = line.partition(";")[0].strip().partition(" ")
        for letter, values in _WORD.findall(rest):
            out[command[1:] + letter] = np.array([float(v) for v in values.split(":")])
    return out


def _xyz(words: dict[str, Array], command: str) -> Array:
    """Values (3,) of the letters X, Y and Z."""
    return np.array([words[command + letter][0] for letter in "XYZ"])


def homed_arms(words: dict[str, Array]) -> Array:
    """Arm angles (3,) degrees at the end switches."""
    return words["669A"][1] + _xyz(words, "666")


def homed_carriages(words: dict[str, Array]) -> Array:
    """Carriage heights (3,) mm at the end switches."""
    rise = np.sqrt(words["665L"] ** 2 - words["665R"] ** 2)
    return words["665H"] + rise + _xyz(words, "666")


def reprap_carriage_heights(words: dict[str, Array], points: Array) -> Array:
    """Carriage heights (n, 3) mm at points (n, 3) mm, by the firmware's linear Transform."""
    x, y, z, tower = *_xyz(words, "665"), words["665R"][0]
    towers = tower * np.array(
        [
            [-np.cos((30 + x) / DEGREES_A_RADIAN), -np.sin((30 + x) / DEGREES_A_RADIAN)],
            [np.cos((30 - y) / DEGREES_A_RADIAN), -np.sin((30 - y) / DEGREES_A_RADIAN)],
            [-np.sin(z / DEGREES_A_RADIAN), np.cos(z / DEGREES_A_RADIAN)],
        ]
    )
    d = points[:, None, :2] - towers
    tilt = points[:, 0] * words["666A"][0] / 100 + points[:, 1] * words["666B"][0] / 100
    rise = np.sqrt(words["665L"] ** 2 - d[..., 0] ** 2 - d[..., 1] ** 2)
    return rise + points[:, 2:] + tilt[:, None]


def reprap_arm_angles(words: dict[str, Array], points: Array) -> Array:
    """Arm angles (n, 3) degrees at points (n, 3) mm, by the firmware's rotary Transform.

    The arcsine limits angles to 90 degrees from the horizontal.
    """
    angle = (np.array(REPRAP_TOWER_ANGLES) + _xyz(words, "669")) / DEGREES_A_RADIAN
    along = points[:, :1] * np.cos(angle) + points[:, 1:2] * np.sin(angle)
    across = points[:, 1:2] * np.cos(angle) - points[:, :1] * np.sin(angle)
    r, h = words["669R"] - along, words["669H"] - points[:, 2:]
    a, b = 2 * words["669U"] * r, 2 * words["669U"] * h
    c = words["669L"] ** 2 - words["669U"] ** 2 - (h**2 + r**2 + across**2)
    square = a**2 + b**2
    return np.arcsin((b * c - a * np.sqrt(square - c**2)) / square) * DEGREES_A_RADIAN
