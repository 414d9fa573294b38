"""What every firmware's delta settings say of themselves, and how they are compared."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np

from pkmcal.arrays import Array
from pkmcal.export.contract import Difference
from pkmcal.export.delta import MM, Delta
from pkmcal.export.delta_fit import FOLLOWS, Fit
from pkmcal.export.source import Source
from pkmcal.geometry.rigid import apply
from pkmcal.outcome import Finding, Level

ROUNDING = 2e-6
"""m at the tool: settings have 0.1 µm and 0.00001 degrees, and weak poses enlarge that by eight."""
_ROW = re.compile(r"firmware_from_base row [123]: ([^\n]*)")
_STATED = re.compile(r"off by ([0-9.]+) mm at most")

Inverse = Callable[[Array], Array]
"""A firmware's own inverse kinematics: points (n, 3) mm to motor positions (n, 3)."""


def mm(value: float) -> str:
    """A length as firmwares read it."""
    return _number(value, 4)


def degrees(value: float) -> str:
    """An angle as firmwares read it."""
    return _number(value, 5)


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return text[1:] if float(text) == 0 and text.startswith("-") else text


def about(source: Source, delta: Delta, fit: Fit, names: str, program: str) -> list[str]:
    """Header lines: conventions, which leg is which motor, the frame, and the error that is left.

    names : the motors' letters, in the firmware's order.
    """
    unit, word = ("mm", "m") if fit.kind == "linear" else ("degrees", "rad")
    motors = [
        f"Motor {name} is leg {j + 1}, joint {delta.joint[j] + 1}:"
        f" motor position ({unit}) = {rate:.9g} * reading ({word}) {zero + 0.0:+.6f}."
        for name, j, rate, zero in zip(names, fit.order, fit.rate, fit.zero, strict=True)
    ]
    rows = [
        f"firmware_from_base row {k + 1}: {' '.join(f'{v:.12g}' for v in np.round(row, 12) + 0.0)}"
        for k, row in enumerate(_in_mm(fit.T_firmware_base)[:3])
    ]
    sort = "Towers" if fit.kind == "linear" else "Arms' angles above the horizontal"
    return [
        *source.header(),
        f"For {program}. Units: mm and degrees. {sort}; the rod's length is a value of its own.",
        *motors,
        "The firmware's frame: p_firmware = firmware_from_base p_base, mm. The point that moves is"
        " the platform frame's origin; a tool's length below it is not in these values.",
        *rows,
        f"{error_sentence(fit, program)} Compared over {len(delta.poses)} poses of the workspace.",
        "End switches are taken to be at the upper end of each motor's range in the mechanism"
        f" file: readings {', '.join(f'{q:.6g}' for q in delta.ends[fit.order])} {word}."
        " Where a switch is elsewhere, add the difference to that motor's value below.",
    ]


def _in_mm(transform: Array) -> Array:
    out = np.array(transform)
    out[:3, 3] *= MM
    return out


def error_sentence(fit: Fit, program: str) -> str:
    """How well the settings follow the machine; rounded up, so that it holds."""
    largest = math.ceil(fit.largest * 1e3) / 1e3
    return (
        f"{program}'s model follows this machine with the tool off by {largest:.3f} mm at most,"
        f" {fit.rms:.3f} mm root mean square."
    )


def end_motors(delta: Delta, fit: Fit) -> Array:
    """Motor positions (3,) at the end switches, in the firmware's order."""
    return fit.rate * delta.ends[fit.order] + fit.zero


def placed(text: str) -> Array:
    """``firmware_from_base`` read again from a text, (4, 4), its shift in m."""
    out = np.eye(4)
    rows = _ROW.findall(text)
    out[:3] = [[float(word) for word in row.split()] for row in rows]
    out[:3, 3] /= MM
    return out


def stated(text: str) -> float:
    """The error that a text admits, m."""
    found = _STATED.search(text)
    return float(found.group(1)) / MM if found else 0.0


def tool_difference(text: str, delta: Delta, fit: Fit, inverse: Inverse, zero: Array) -> Difference:
    """The firmware's formulas on the text's values, the machine's own forward kinematics after.

    zero : (3,) motor positions at reading zero by the text's end switches.
    """
    points = MM * apply(placed(text), delta.positions)
    readings = np.zeros_like(delta.readings)
    readings[:, delta.joint[fit.order]] = (inverse(points) - zero) / fit.rate
    result = delta.machine.forward_result(np.nan_to_num(readings, nan=1e3), delta.poses)
    off = np.linalg.norm(result.T_base_platform[:, :3, 3] - delta.positions, axis=1)
    largest = float(np.where(result.converged, off, np.inf).max())
    told = stated(text)
    return Difference(
        f"tool over {len(delta.poses)} poses by the firmware's formulas",
        largest,
        # the fit is judged to first order, so a large error may be a fiftieth larger
        1.02 * told + ROUNDING,
    )


def follows(fit: Fit, program: str) -> Finding:
    """The note on how well, a doubt where it is not well."""
    text = error_sentence(fit, program)
    if fit.largest > FOLLOWS:
        cause = "towers that are not parallel" if fit.kind == "linear" else "tilted arms"
        text += f" It has no values for {cause} and the like; --to c has them all."
        return Finding(Level.DOUBTFUL, text)
    return Finding(Level.NOTE, text)
