"""Exported values of delta printers as their firmwares understand them, and where the tool then is.

Written from the firmwares' descriptions and from the mathematics, without pkmcal's formulas.
"""

from __future__ import annotations

import re
from configparser import ConfigParser
from dataclasses import dataclass, replace

import numpy as np

import printers


@dataclass(frozen=True)
class Ideal:
    """An ideal delta: mm and degrees; homed : carriages (3,) at their switches."""

    radius: float
    angle: np.ndarray
    rod: np.ndarray
    homed: np.ndarray

    def tool(self, carriages):
        """Tool (n, 3) mm where three spheres about the rods' upper ends meet, the lower place.

        Differences of the spheres' equations are two planes; their line meets the first sphere.
        carriages : (n, 3) mm.
        """
        a = np.deg2rad(self.angle)
        out = []
        for heights in carriages:
            at = np.column_stack([self.radius * np.cos(a), self.radius * np.sin(a), heights])
            normals = 2 * (at[1:] - at[0])
            square = np.sum(at**2, axis=1) - self.rod**2
            along = np.cross(*normals)
            foot = np.linalg.lstsq(normals, square[1:] - square[0], rcond=None)[0]
            b, c = along @ (foot - at[0]), np.sum((foot - at[0]) ** 2) - self.rod[0] ** 2
            root = np.sqrt(b**2 - (along @ along) * c)
            both = [foot + along * (-b + sign * root) / (along @ along) for sign in (-1, 1)]
            out.append(min(both, key=lambda p: p[2]))
        return np.array(out)


def commands(text):
    """Values by command and letter of G-code, the last of each; lists as arrays."""
    out = {}
    for line in text.splitlines():
        name, *words = line.partition(";")[0].split() or [""]
        for word in words:
            values = np.array([float(v) for v in word[1:].split(":")])
            out[name[1:] + word[0]] = values if len(values) > 1 else float(values[0])
    return out


def letters(values, code, names):
    return np.array([values[code + c] for c in names])


def klipper(text, _):
    """position_endstop is the nozzle's height with the carriage at its switch."""
    config = ConfigParser(delimiters=(":",), comment_prefixes=("#",))
    config.read_string(text)
    radius = config.getfloat("printer", "delta_radius")
    angle, rod, end = (
        np.array([config.getfloat(f"stepper_{s}", key) for s in "abc"])
        for key in ("angle", "arm_length", "position_endstop")
    )
    return Ideal(radius, angle, rod, end + np.sqrt(rod**2 - radius**2))


def reprap(text, _):
    """A positive adjustment is a switch that triggers higher."""
    values = commands(text)
    angle = np.array([210.0, 330.0, 90.0]) + letters(values, "665", "XYZ")
    radius, rod = values["665R"], values["665L"]
    homed = values["665H"] + np.sqrt(rod**2 - radius**2) + letters(values, "666", "XYZ")
    return Ideal(radius, angle, rod, homed)


def marlin(text, height_offset, ignored=6 / 40):
    """A negative offset retracts a carriage that triggered higher; Marlin 2 ignores small ones."""
    values = commands(text)
    angle = np.array([210.0, 330.0, 90.0]) + letters(values, "665", "XYZ")
    radius, rod = values["665R"], values["665L"] + letters(values, "665", "ABC")
    offset = letters(values, "666", "XYZ")
    offset = np.where(np.abs(offset) <= ignored, 0.0, offset)
    height = values["665H"] - height_offset
    return Ideal(radius, angle, rod, height + np.sqrt(rod**2 - radius**2) - offset)


def smoothie(text, _):
    """A negative trim is a switch that triggers higher; I, J and K are ignored."""
    values = commands(text)
    angle = np.array([210.0, 330.0, 90.0]) + letters(values, "665", "DEH")
    radius, rod = values["665R"], np.full(3, values["665L"])
    assert not letters(values, "665", "ABC").any()
    height = values["665Z"] + values["206Z"]
    homed = height + np.sqrt(rod**2 - radius**2) - letters(values, "666", "XYZ")
    return Ideal(radius, angle, rod, homed)


def repetier(text, _):
    """An offset is the steps by which a carriage goes down from its switch."""
    at = {
        int(p): float(v) for p, v in re.findall(r"^M206 T\d P(\d+) [SX](\S+)", text, re.MULTILINE)
    }
    angle, trim, steps = (np.array([at[p] for p in ps]) for ps in (
        (901, 905, 909), (933, 937, 941), (893, 895, 897),
    ))  # fmt: skip
    assert not any(at[p] for p in (913, 917, 921, 133, 137, 141))
    radius, rod = at[885], at[881] + trim
    return Ideal(radius, angle, rod, at[153] + np.sqrt(rod**2 - radius**2) + steps / at[11])


DIALECTS = {
    "klipper": klipper, "marlin": marlin, "repetier": repetier, "reprap": reprap,
    "smoothie": smoothie,
}  # fmt: skip
HEIGHT_OFFSET = -16.0
STEPS = 80.0


def perturbed(seed, scale=(1.0, 1.0, 1.0), to=""):
    """A printer that a firmware's values can describe, with entries that exports keep.

    Smoothieware has one length for all rods.
    """
    rng = np.random.default_rng(seed)
    settings = printers.Settings(
        radius=105 + rng.normal(),
        angle=tuple(np.array([210, 330, 90]) + 0.5 * rng.normal(size=3)),
        rod=tuple(270 + 0.5 * rng.normal(size=3)),
    )
    if to == "smoothie":
        settings = replace(settings, rod=3 * settings.rod[:1])
    machine = printers.machine(settings, scale=scale, endstops=0.7 * rng.normal(size=3))
    entries = {"height_offset": 1e-3 * HEIGHT_OFFSET, "steps_per_mm": 3 * (STEPS,)}
    return replace(machine, document=machine.document.model_copy(update=entries)), rng


def carried(machine, rng, n=30):
    """Travel (n, 3) m of the carriages from their switches, over the workspace."""
    common = rng.uniform(-0.25, -0.2, size=(n, 1))
    return common + rng.uniform(-0.04, 0.04, size=(n, 3))
