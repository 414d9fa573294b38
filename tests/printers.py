"""Simulated delta printers: their firmware's values, the true machine, and the bed's heights."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pkmcal.files import parse_yaml, validated_document
from pkmcal.geometry.rigid import pose
from pkmcal.mechanisms import MechanismDocument, machine_from_document

STEP = 40.0 / (200 * 16)
"""mm a microstep: rotation_distance 40, 16 microsteps."""


@dataclass(frozen=True)
class Settings:
    """Firmware's values of a delta, mm and degrees."""

    radius: float = 105.0
    angle: tuple = (210.0, 330.0, 90.0)
    rod: tuple = (270.0, 270.0, 270.0)
    endstop: tuple = (300.0, 300.0, 300.0)

    @property
    def homed(self):
        return np.array(self.endstop) + np.sqrt(np.square(self.rod) - self.radius**2)

    def carriages(self, points):
        """Heights (n, 3) mm at points (n, 3) mm."""
        a = np.deg2rad(self.angle)
        towers = self.radius * np.stack([np.cos(a), np.sin(a)], axis=1)
        off = points[:, None, :2] - towers
        return points[:, 2:] + np.sqrt(np.square(self.rod) - np.sum(off**2, axis=-1))


def machine(settings, lean=None, scale=(1.0, 1.0, 1.0), endstops=(0.0, 0.0, 0.0)):
    """The true machine of settings; readings are carriages by its firmware's own account, m.

    lean : (3, 2) of the towers. endstops : mm by which carriages are higher than that account.
    """
    lean = np.zeros((3, 2)) if lean is None else lean
    a = np.deg2rad(settings.angle)
    legs = [
        {
            "base": {
                "joint": "slider",
                "center": [1e-3 * settings.radius * np.cos(a[k]),
                           1e-3 * settings.radius * np.sin(a[k]), 1e-3 * endstops[k]],
                "axis": [*lean[k], 1.0],
                "range": [0.1, 0.8],
            },
            "platform": {"joint": "spherical", "center": [0.0, 0.0, 0.0]},
            "length": {"actuated": False, "constant": 1e-3 * settings.rod[k]},
            "scale": scale[k],
        }
        for k in range(3)
    ]  # fmt: skip
    nominal = {
        "name": "printer",
        "motion": "translation",
        "legs": legs,
        "home": {"position": [0.0, 0.0, 0.1]},
    }
    text = json.dumps(nominal, default=float)
    return machine_from_document(
        validated_document(parse_yaml(text, Path("m.yaml")), MechanismDocument)
    )


def bed(n, radius=90.0):
    """Places (n, 2) mm: the middle, then Klipper's six, then more on a spiral."""
    scatter = np.array([0.95, 0.90, 0.85, 0.70, 0.75, 0.80])
    a = np.deg2rad(90 + 60 * np.arange(6))
    seven = np.concatenate([np.zeros((1, 2)), (radius * scatter * [np.cos(a), np.sin(a)]).T])
    k = np.arange(max(n - 7, 0))
    r, turn = radius * np.sqrt((k + 0.5) / max(len(k), 1)), k * np.pi * (3 - np.sqrt(5))
    return np.concatenate([seven, np.stack([r * np.cos(turn), r * np.sin(turn)], axis=1)])[:n]


def felt(true, places, noise, rng):
    """Readings (n, 3) mm of a machine whose tool touches a level bed at places (n, 2) mm."""
    points = np.column_stack([places, noise * rng.normal(size=len(places))])
    joints = true.inverse(pose(np.eye(3), 1e-3 * points))
    assert np.isfinite(joints).all()
    return 1e3 * joints


def printer_cfg(settings, readings=None, height=0.0):
    """Klipper's printer.cfg, with what DELTA_CALIBRATE keeps where readings are given."""
    lines = ["[mcu]", "serial: /dev/ttyACM0", "", "[printer]", "kinematics: delta",
             "max_velocity: 300  # mm/s", f"delta_radius: {settings.radius}",
             "print_radius: 90"]  # fmt: skip
    for k, name in enumerate("abc"):
        lines += [
            "", f"[stepper_{name}]", "step_pin: PF0", "microsteps: 16", "rotation_distance: 40",
            f"arm_length: {settings.rod[k]}", f"angle: {settings.angle[k]}",
        ]  # fmt: skip
    lines += ["", "[gcode_macro START]", "gcode:", "  G28 ; home", "  {% set x = 1 %}", ""]
    lines += ["#*# <---------------------- SAVE_CONFIG ---------------------->",
              "#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated."]  # fmt: skip
    for k, name in enumerate("abc"):
        lines += ["#*#", f"#*# [stepper_{name}]", f"#*# position_endstop = {settings.endstop[k]}"]
    if readings is not None:
        steps = (settings.homed - readings) / STEP
        lines += ["#*#", "#*# [delta_calibrate]"]
        for k, row in enumerate(steps):
            lines += [f"#*# height{k} = {height}",
                      f"#*# height{k}_pos = {row[0]:.3f},{row[1]:.3f},{row[2]:.3f}"]  # fmt: skip
    return "\n".join(lines) + "\n"


BUILT = Settings(radius=105.4, angle=(210.2, 329.9, 90.1), rod=(270.2, 269.9, 270.1))


def workshop(n=7):
    """Carriages of a printer that differs from its firmware's values, at n points of its bed."""
    true = machine(BUILT, endstops=(0.5, -0.3, 0.2))
    return felt(true, bed(n), 0.015, np.random.default_rng(4))


def calibrated_cfg():
    """The printer's printer.cfg after DELTA_CALIBRATE."""
    return printer_cfg(Settings(), workshop())


def console(n):
    """Output of its console while it probes n points."""
    there = 1e3 * machine(Settings()).forward(1e-3 * workshop(n))[:, :3, 3]
    return "".join(f"// probe at {x:.3f},{y:.3f} is z={z:.6f}\n" for x, y, z in there)
