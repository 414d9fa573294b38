"""Texts of a delta's fit in firmwares' files: header lines, values' digits, and the comparison of a
text with the machine.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.exporters.contract import Difference
from pkmcal.exporters.delta import (
    DEGREES_A_RADIAN,
    LEAST_DELTA_SINGULARITY,
    MM_A_METRE,
    Fit,
)
from pkmcal.geometry.rigid import apply
from pkmcal.mechanisms import Machine

UNTOLD_SCALE_DIFFERENCE = 1e-9
"""Least difference of a scale from 1 that is reported: beyond the digits of the files."""
SWITCH_READINGS = 11
"""Readings of each motor at which an end switch's value is compared or tabulated."""
SWITCH_ROUNDING = 1e-3
"""Tolerance of a motor's position at its end switch, mm or degrees; of an arm 2 µm.

Values are written to 0.1 µm, and the height depends weakly on the angle of an arm that is nearly
upright.
"""
STEPS_ROUNDING = 1e-4
"""Tolerance of motor steps per mm."""
TOOL_ROUNDING = 2e-6
"""Tolerance at the tool, m: settings have 0.1 µm and 0.00001 degrees, amplified up to eightfold."""
_ROW = re.compile(r"firmware_from_base row [123]: ([^\n]*)")
_STATED = re.compile(r"off by ([0-9.]+) mm at most")

Inverse = Callable[[Array], Array]
"""Inverse kinematics of a firmware: points (n, 3) mm to motor positions (n, 3)."""


def firmware_length(value: float) -> str:
    """Length in the digits that firmwares read."""
    return _number(value, 4)


def firmware_angle(value: float) -> str:
    """Angle in the digits that firmwares read."""
    return _number(value, 5)


def _number(value: float, digits: int) -> str:
    """Number with fixed digits, without a negative zero."""
    text = f"{value:.{digits}f}"
    return text[1:] if float(text) == 0 and text.startswith("-") else text


def scales_of(fit: Fit) -> Array:
    """Scales of the readings (3,), in the firmware's order."""
    return np.abs(fit.rate) / (MM_A_METRE if fit.kind == "linear" else DEGREES_A_RADIAN)


def about(source: MachineSource, fit: Fit, names: str, correcting: str) -> list[str]:
    """Header lines: conventions, legs of the motors, the frame, and the remaining error.

    names : letters of the motors, in the firmware's order.
    correcting : instruction for a motor whose reading has a scale other than 1.
    """
    delta = fit.delta
    unit, word = ("mm", "m") if fit.kind == "linear" else ("degrees", "rad")
    motors = [
        f"Motor {name} is leg {j + 1}, joint {delta.joint[j] + 1}:"
        f" motor position ({unit}) = {rate:.9g} * reading ({word}) {round(zero, 6) + 0.0:+.6f}."
        for name, j, rate, zero in zip(names, fit.order, fit.rate, fit.zero, strict=True)
    ]
    in_mm = fit.T_firmware_base * np.array([1.0, 1.0, 1.0, MM_A_METRE])
    rows = [
        f"firmware_from_base row {k + 1}: {' '.join(f'{v:.12g}' for v in np.round(row, 12) + 0.0)}"
        for k, row in enumerate(in_mm[:3])
    ]
    factors = [
        f"Motor {name} goes {factor:.9g} times as far as its reading."
        for name, factor in zip(names, scales_of(fit), strict=True)
        if abs(factor - 1) > UNTOLD_SCALE_DIFFERENCE
    ]
    tip = (
        "The point that moves is the platform frame's origin; a tool's length below it is not in"
        " these values."
    )
    if delta.bed is not None and abs(fit.T_firmware_base[2, 3] + delta.bed) < TOOL_ROUNDING:
        tip = "Z is 0 where a height of 0 was measured."
    sort = "Towers" if fit.kind == "linear" else "Arms' angles above the horizontal"
    return [
        *source.header(),
        f"For {delta.program}. Units: mm and degrees. {sort}; the rod's length is a value of its"
        " own.",
        *motors,
        *factors,
        *([correcting] if factors else []),
        f"The firmware's frame: p_firmware = firmware_from_base p_base, mm. {tip}",
        *rows,
        f"{fit.following.text} Compared over {len(delta.poses)} poses of the workspace.",
    ]


def workspace_radius(machine: Machine) -> str | None:
    """Print radius of the mechanism file, mm, as firmwares read it; None without one.

    The radius is a limit rather than a property of the machine, so no export invents it.
    """
    radius = machine.document.workspace_radius
    return None if radius is None else _digits(MM_A_METRE * radius)


def height_offset(machine: Machine) -> float | None:
    """``height_offset`` of the mechanism file, mm; None without one."""
    offset = machine.document.height_offset
    return None if offset is None else MM_A_METRE * offset


def corrected_steps(fit: Fit) -> Array | None:
    """Motor steps per mm (3,) with which every reading's scale is 1.

    None if the scales are 1 already, or if the mechanism file has no ``steps_per_mm``.
    """
    own = fit.delta.machine.document.steps_per_mm
    scales = scales_of(fit)
    exact = np.abs(scales - 1).max() <= UNTOLD_SCALE_DIFFERENCE
    if own is None or fit.kind != "linear" or exact:
        return None
    return np.array(own)[fit.order] / scales


def steps_correction(steps: Array | None, unit: str = "mm") -> str:
    """Instruction on the steps of a motor whose reading has a scale other than 1.

    steps : those that a file sets, None for none.
    """
    if steps is None:
        return f"Divide its steps per {unit} (M92) by that."
    return "M92 below has the mechanism file's steps per mm, divided by that."


def end_switches(fit: Fit) -> str:
    """Sentence on the assumed readings at the end switches."""
    word = "m" if fit.kind == "linear" else "rad"
    ends = ", ".join(f"{q:.9g}" for q in fit.delta.ends[fit.order])
    return (
        "End switches are taken to be at the upper end of each motor's range in the mechanism file:"
        f" readings {ends} {word}. Where a switch triggers at another reading, its value is:"
    )


def proportional_switches(fit: Fit, names: Sequence[str], values: Array) -> list[str]:
    """Line for each motor: its end switch's value as a linear function of the reading there.

    values : (3,) at the upper ends of the ranges. :func:`switch_values` reads the lines.
    """
    ends = fit.delta.ends[fit.order]
    return [
        f"{name} = {_digits(value)} {'-' if rate < 0 else '+'} {abs(rate):.9g}"
        f" * (reading - {end:.9g})"
        for name, value, rate, end in zip(names, values, fit.rate, ends, strict=True)
    ]


def switch_values(text: str, readings: Array) -> Array:
    """Values (3,) by the lines of :func:`proportional_switches` at readings (3,)."""
    lines = (line.partition(" * (reading - ") for line in text.splitlines())
    terms = [
        (*head.replace("+ ", "+").replace("- ", "-").split()[-2:], tail.partition(")")[0])
        for head, times, tail in lines
        if times
    ]
    value, rate, end = np.array(terms, dtype=float).T
    return value + rate * (readings - end)


def readings_elsewhere(fit: Fit) -> Array:
    """Readings (n, 3) of end switches other than the assumed ones.

    From the upper end of each range down to its middle.
    """
    machine = fit.delta.machine
    ranges = machine.joint_ranges[fit.delta.joint][fit.order]
    ends = fit.delta.ends[fit.order]
    shares = np.linspace(0.0, 0.5, SWITCH_READINGS)[:, None]
    return ends + shares * (ranges.sum(axis=1) - 2 * ends)


def _digits(value: float) -> str:
    """Number with up to six decimals."""
    return f"{value:.6f}".rstrip("0").rstrip(".") if abs(value) > 5e-7 else "0"


def read_firmware_from_base(text: str) -> Array:
    """``firmware_from_base`` (4, 4) of a text, translation in m."""
    out = np.eye(4)
    rows = _ROW.findall(text)
    out[:3] = [[float(word) for word in row.split()] for row in rows]
    out[:3, 3] /= MM_A_METRE
    return out


def stated(text: str) -> float:
    """Tool error that a text states, m; 0 without one."""
    match = _STATED.search(text)
    return float(match.group(1)) / MM_A_METRE if match else 0.0


def firmware_tool_difference(
    text: str, fit: Fit, inverse: Inverse, zero: Array, end_rounding: float = 0.0
) -> Difference:
    """Tool error by the firmware's formulas with the text's values, over the workspace.

    The machine's forward kinematics follows the firmware's inverse.

    zero : (3,) motor positions at reading zero by the text's end switches.
    end_rounding : of these positions, mm or degrees, beyond that of lengths.
    """
    delta = fit.delta
    points = MM_A_METRE * apply(read_firmware_from_base(text), delta.positions)
    # readings at the commanded motor positions, and the tool there by the machine's kinematics
    readings = np.zeros_like(delta.readings)
    readings[:, delta.joint[fit.order]] = (inverse(points) - zero) / fit.rate
    result = delta.machine.forward_result(np.nan_to_num(readings, nan=1e3), delta.poses)
    off = np.linalg.norm(result.T_base_platform[:, :3, 3] - delta.positions, axis=1)
    largest = float(np.where(result.converged, off, np.inf).max())
    stated_error = stated(text)
    return Difference(
        f"tool over {len(delta.poses)} poses by the firmware's formulas",
        largest,
        # the fit's error is of first order, so a large one may be 2 % larger
        1.02 * stated_error + TOOL_ROUNDING + end_rounding / LEAST_DELTA_SINGULARITY / MM_A_METRE,
    )
