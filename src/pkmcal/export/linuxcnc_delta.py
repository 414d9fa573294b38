"""Deltas for LinuxCNC: lineardeltakins (R, L) and rotarydeltakins (four lengths), fitted.

Both know ideal deltas alone: one radius, one length of rods, towers 120 degrees apart. Joint 0 of
lineardeltakins is the tower at (0, R), joints 1 and 2 are at 210 and 330 degrees; rotarydeltakins'
arms are at -90, 30 and 150 degrees, and turn downwards (lineardeltakins-common.h,
rotarydeltakins-common.h; some older rotarydeltakins exchange joints 1 and 2).
"""

from __future__ import annotations

import re

import numpy as np

from pkmcal.arrays import Array
from pkmcal.export.contract import Difference
from pkmcal.export.delta import DEGREE, Delta, delta_of
from pkmcal.export.delta_fit import Fit, Freedoms, fitted
from pkmcal.export.delta_text import about, degrees, follows, mm, tool_difference
from pkmcal.export.source import Source
from pkmcal.export.text import commented
from pkmcal.outcome import Finding

PROGRAM = "LinuxCNC"
LINEAR = Freedoms((90.0, 210.0, 330.0), angles=False, rods=False)
ROTARY = Freedoms((-90.0, 30.0, 150.0), angles=False, rods=False, arms=False, flat=True)
_PIN = re.compile(r"^setp \w+deltakins\.(\w+) (\S+)$", re.M)
_OFFSET = re.compile(r"^HOME_OFFSET = (\S+)$", re.M)


def _fit(source: Source) -> tuple[Delta, Fit]:
    delta = delta_of(source.machine, PROGRAM)
    return delta, fitted(delta, LINEAR if delta.kind == "linear" else ROTARY, PROGRAM)


def _joints(fit: Fit) -> tuple[Array, Array]:
    """Rate and zero (3,) of LinuxCNC's joints: its arms count downwards."""
    sign = 1.0 if fit.kind == "linear" else -1.0
    return sign * fit.rate, sign * fit.zero


def delta_files(source: Source) -> tuple[str, str]:
    """The HAL and the INI text."""
    delta, fit = _fit(source)
    rate, zero = _joints(fit)
    lines = about(source, delta, fit, "012", PROGRAM)
    if fit.kind == "rotary":
        lines.append("LinuxCNC's joints are the motors' angles with the other sign: downwards.")
    lines = [line for line in lines if not line.startswith("End switches")]
    name = f"{fit.kind}deltakins"
    hal = [commented(lines, "#"), f"loadrt {name}", *_pins(fit)]
    linear = fit.kind == "linear"
    word, number = ("LINEAR", mm) if linear else ("ANGULAR", degrees)
    ini = [
        commented(
            (
                *source.header(),
                f"Units: mm and degrees. Joint N = rate * reading + HOME_OFFSET; rates are"
                f" {', '.join(f'{r:.9g}' for r in rate)}, the encoders' scales.",
                "HOME_OFFSET holds for absolute encoders. With a home switch, set"
                " HOME_ABSOLUTE_ENCODER = 0 and add rate * the reading at the switch.",
            ),
            "#",
        ),
        f"[KINS]\nKINEMATICS = {name}\nJOINTS = 3\n",
        "[TRAJ]\nCOORDINATES = XYZ\nLINEAR_UNITS = mm\nANGULAR_UNITS = degree",
    ]
    ranges = delta.machine.joint_ranges[delta.joint][fit.order]
    for n in range(3):
        ends = np.sort(rate[n] * ranges[n] + zero[n])
        ini.append(f"\n[JOINT_{n}]\nTYPE = {word}\nHOME_ABSOLUTE_ENCODER = 2")
        ini.append(f"HOME_OFFSET = {number(zero[n])}")
        ini.append(f"MIN_LIMIT = {ends[0]:.4f}\nMAX_LIMIT = {ends[1]:.4f}")
    return "\n".join(hal) + "\n", "\n".join(ini) + "\n"


def _pins(fit: Fit) -> list[str]:
    if fit.kind == "linear":
        return [
            f"setp lineardeltakins.R {mm(fit.radius)}",
            f"setp lineardeltakins.L {mm(fit.rod[0])}",
        ]
    return [
        "# of platformradius and footradius the difference alone moves the machine",
        f"setp rotarydeltakins.platformradius {mm(fit.radius)}",
        "setp rotarydeltakins.footradius 0.0000",
        f"setp rotarydeltakins.thighlength {mm(fit.arm[0])}",
        f"setp rotarydeltakins.shinlength {mm(fit.rod[0])}",
    ]


def delta_check(hal: str, ini: str, source: Source) -> list[Difference]:
    """Pins and words read again, moved by LinuxCNC's formulas."""
    delta, fit = _fit(source)
    pins = {name: float(value) for name, value in _PIN.findall(hal)}
    offsets = np.array([float(word) for word in _OFFSET.findall(ini)])
    if fit.kind == "linear":
        return [tool_difference(hal, delta, fit, lambda p: linear_joints(pins, p), offsets)]
    # motors count upwards, LinuxCNC's joints downwards
    return [tool_difference(hal, delta, fit, lambda p: -rotary_joints(pins, p), -offsets)]


def delta_notes(source: Source) -> tuple[Finding, ...]:
    """How well the pins follow the machine."""
    return (follows(_fit(source)[1], PROGRAM),)


def linear_joints(pins: dict[str, float], points: Array) -> Array:
    """Joints (n, 3) mm at points (n, 3) mm."""
    half, side = 0.5 * pins["R"], np.sqrt(3) / 2 * pins["R"]
    towers = np.array([[0.0, pins["R"]], [-side, -half], [side, -half]])
    d = towers - points[:, None, :2]
    return points[:, 2:] + np.sqrt(pins["L"] ** 2 - d[..., 0] ** 2 - d[..., 1] ** 2)


def rotary_joints(pins: dict[str, float], points: Array) -> Array:
    """Joints (n, 3) degrees at points (n, 3) mm, downwards: joint 0 swings in the YZ plane, the
    others are it, the point turned.
    """
    pfr, thigh, shin, foot = (
        pins[name] for name in ("platformradius", "thighlength", "shinlength", "footradius")
    )
    z = points[:, 2]
    out: list[Array] = []
    for turn in (0.0, -120.0, 120.0):
        c, s = np.cos(turn / DEGREE), np.sin(turn / DEGREE)
        x, y = points[:, 0] * c - points[:, 1] * s, points[:, 0] * s + points[:, 1] * c
        a = 0.5 * (x**2 + (y - foot) ** 2 + z**2 + thigh**2 - shin**2 - pfr**2) / z
        b = (foot - pfr - y) / z
        knee = (pfr + a * b + np.sqrt(thigh**2 * (b**2 + 1) - (a - b * pfr) ** 2)) / (b**2 + 1)
        out.append(np.arctan2(b * knee - a, knee - pfr) * DEGREE)
    return np.stack(out, axis=1)
