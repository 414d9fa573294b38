"""Klipper: sections of printer.cfg for deltas, read from a printer's own file and written by
``export --to klipper``, and bed points of DELTA_CALIBRATE and PROBE.

The sections are [printer] and [stepper_a] to [stepper_c], for kinematics delta and rotary_delta;
only printers of the first are read. Semantics: Klipper's configuration reference,
klippy/kinematics/delta.py, rotary_delta.py, chelper/kin_rotary_delta.c and
klippy/extras/delta_calibrate.py.

A tower's carriage is at ``position_endstop + sqrt(arm_length^2 - delta_radius^2)`` where its switch
triggers. An arm's switch is given by the height of the nozzle on the central axis if all arms were
at that arm's angle. ``print_radius``, beyond which Klipper accepts no position, defaults to
``delta_radius``.
"""

from __future__ import annotations

import re
from configparser import ConfigParser
from functools import partial
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import ExportedValue, commented
from pkmcal.exporters.delta import DEGREES_A_RADIAN, Fit, Freedoms
from pkmcal.exporters.delta_texts import (
    SWITCH_ROUNDING,
    about,
    end_switches,
    firmware_angle,
    firmware_length,
    proportional_switches,
    readings_elsewhere,
)
from pkmcal.files import quoted
from pkmcal.firmware.contract import (
    CARRIAGE_STEP,
    Firmware,
    PrintedPart,
    Printer,
    Touches,
    WrittenValues,
)
from pkmcal.firmware.klipper_config import KlipperConfig, console_of, read_config
from pkmcal.firmware.klipper_probing import (
    KLIPPER_STEPPERS,
    analyzed_distances,
    mesh_touches,
    probed_touches,
    saved_distances,
    saved_touches,
)
from pkmcal.firmware.towers import nozzle_heights
from pkmcal.outcome.finding import Finding, note

ROTARY_ANGLES = (30.0, 150.0, 270.0)
"""Default directions of the arms of a rotary delta, degrees."""
NO_KLIPPER_PRINT_RADIUS = (
    "There is no print_radius: keep the printer's own. Klipper takes delta_radius where none"
    " stands; then write the former delta_radius there."
)
PROBE_SECTIONS = ("probe", "bltouch", "smart_effector")
_HEADS = re.compile(r"^\[([^\]\n]+)\]", re.MULTILINE)


@final
class Klipper(Firmware):
    """Klipper's printer.cfg."""

    name: ClassVar = "klipper"
    title: ClassVar = "Klipper: values for printer.cfg"
    program: ClassVar = "Klipper"
    configuration: ClassVar = "a printer.cfg with a section [printer], or klippy.log (Klipper)"
    file: ClassVar = "pkmcal_printer.cfg"
    comment: ClassVar = "#"
    motors: ClassVar = ("stepper_a", "stepper_b", "stepper_c")
    rotary: ClassVar = Freedoms(ROTARY_ANGLES, heights=False)
    carriage_source: ClassVar = "what Klipper's\nGET_POSITION prints behind stepper:"

    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """The section [printer], or an included file."""
        del label
        heads = (head[1].split() for head in _HEADS.finditer(text))
        names = {words[0]: " ".join(words) for words in heads if words}
        own = next((names[name] for name in ("printer", "include") if name in names), None)
        return () if own is None else (f"it has a section [{own}]",)

    def printer(self, text: str, path: Path) -> Printer:
        """Printer of a printer.cfg and the files that it includes.

        Raises InputError for kinematics other than delta, for missing or impossible values, for
        includes that cannot be followed, and for a saved block that Klipper would ignore.
        """
        config = read_config(text, path)
        label = config.label
        _check_kinematics(config)
        # one radius, and rod, end switch and direction of each tower
        radius = config.positive("printer", "delta_radius")
        by_tower = {
            "arm_length": config.by_stepper(KLIPPER_STEPPERS, "arm_length", positive=True),
            "position_endstop": config.by_stepper(
                KLIPPER_STEPPERS, "position_endstop", positive=False
            ),
            "angle": [
                config.number(f"stepper_{s}", "angle", default)
                for s, default in zip(KLIPPER_STEPPERS, self.linear.nominal, strict=True)
            ],
        }
        # the export's formulas read a ConfigParser; values are text there
        parser = ConfigParser()
        parser.read_dict(
            {
                "printer": {"kinematics": "delta", "delta_radius": repr(radius)},
                **{
                    f"stepper_{s}": {name: repr(values[k]) for name, values in by_tower.items()}
                    for k, s in enumerate(KLIPPER_STEPPERS)
                },
            }
        )
        with np.errstate(invalid="ignore"):
            ends = homed(parser)
        # without the settings of its motors a printer has the usual carriage step
        mm_a_step = None
        if config.has_steps:
            mm_a_step = np.array([config.step(f"stepper_{s}") for s in KLIPPER_STEPPERS])
        return Printer(
            firmware=self,
            label=label,
            radius=radius,
            angle=np.array(by_tower["angle"]),
            rod=np.array(by_tower["arm_length"]),
            homed=ends,
            reach=config.positive("printer", "print_radius", radius),
            carriages=partial(klipper_carriage_heights, parser),
            offset=_probe_offset(config),
            touches=saved_touches(config, ends, mm_a_step),
            part=saved_distances(config, ends, mm_a_step),
            step=CARRIAGE_STEP if mm_a_step is None else float(mm_a_step.max()),
            remarks=(*config.remarks(), *_probe_remarks(config)),
        )

    def touched(self, text: str, path: Path, printer: Printer) -> Touches | None:
        """Points of PROBE in a console's output or klippy.log, or of a saved mesh of the bed."""
        touches = probed_touches(console_of(text), path.name, printer)
        if touches is None and "[bed_mesh" in text:
            return mesh_touches(read_config(text, path), printer)
        return touches

    def distances(self, text: str, label: str, printer: Printer) -> PrintedPart | None:
        """Distances of DELTA_ANALYZE."""
        return analyzed_distances(console_of(text), label, printer)

    def text(self, fit: Fit, source: MachineSource) -> str:
        """Sections of printer.cfg under a header of comments."""
        word = "Multiply its rotation_distance" if fit.kind == "linear" else "Divide its gear_ratio"
        lines = about(source, fit, "".join(KLIPPER_STEPPERS), f"{word} by that.")
        lines.append("Put these values into the sections of the printer's own configuration.")
        lines.append(note("export.klipper_saved").text)
        lines.append(end_switches(fit))
        radius = self.print_radius(fit)
        if fit.kind == "linear":
            names = [f"stepper_{s}.position_endstop" for s in KLIPPER_STEPPERS]
            lines += proportional_switches(fit, names, nozzle_heights(fit))
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
        return commented(lines, "#") + body

    def has_print_radius(self, fit: Fit) -> bool:
        """Whether the delta is linear: Klipper has none for rotary ones."""
        return fit.kind == "linear"

    def steps(self, fit: Fit) -> Array | None:
        """None: Klipper has rotation_distance instead, with the printer's gears."""
        del fit
        return None

    def named_values(self, fit: Fit, at: Fit) -> tuple[ExportedValue, ...]:
        """Options of [printer] and of the steppers."""
        del at
        if fit.kind == "linear":
            common = (("delta_radius", fit.radius),)
            each = (("arm_length", fit.rod, "mm"), ("angle", fit.angle, "degrees"),
                    ("position_endstop", nozzle_heights(fit), "mm"))  # fmt: skip
        else:
            common = (("shoulder_radius", fit.radius), ("shoulder_height", fit.height[0]))
            each = (("upper_arm_length", fit.arm, "mm"), ("lower_arm_length", fit.rod, "mm"),
                    ("angle", fit.angle, "degrees"),
                    ("position_endstop", _arm_endstops(fit, fit.end_motors), "mm"))  # fmt: skip
        return (
            *(ExportedValue(name, float(value), "mm") for name, value in common),
            *(
                ExportedValue(f"stepper_{s}.{name}", float(values[k]), unit)
                for k, s in enumerate(KLIPPER_STEPPERS)
                for name, values, unit in each
            ),
        )

    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values as Klipper reads them."""
        config = ConfigParser(delimiters=(":",), comment_prefixes=("#",))
        config.read_string(text)
        linear = fit.kind == "linear"
        return WrittenValues(
            partial(klipper_carriage_heights if linear else klipper_arm_angles, config),
            homed(config),
            partial(_homed_by, config),
            config.getfloat("printer", "print_radius", fallback=None),
            switches=None if linear else _arm_switches(text),
        )

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """As for any firmware, and how SAVE_CONFIG's lines are kept."""
        return (*super().notes(source), note("export.klipper_saved"))


# Klipper's formulas


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


# Reading


def _check_kinematics(config: KlipperConfig) -> None:
    """Raise InputError for kinematics other than delta."""
    text, where = config.entries.get("printer", {}).get("kinematics", ("", ""))
    if text == "delta":
        return
    raise InputError(
        "heights of a bed are read of linear deltas",
        where=where or f"{config.label}, [printer]",
        found=quoted(text),
        expected="kinematics: delta",
        next_step="Make a session of this machine with a camera: pkmcal new DIR --from FILE"
        if text in ("rotary_delta", "winch")
        else None,
    )


def _probe_offset(config: KlipperConfig) -> tuple[float, float, float]:
    """Offset (x, y, z) of the probe from the nozzle, mm; zeros without a probe."""
    for section, entries in config.entries.items():
        if "z_offset" in entries:
            x, y = (config.number(section, f"{c}_offset", 0.0) for c in "xy")
            return x, y, config.number(section, "z_offset")
    return 0.0, 0.0, 0.0


def _probe_remarks(config: KlipperConfig) -> tuple[str, ...]:
    """Sentence on each probe without z_offset, which Klipper requires."""
    return tuple(
        f"[{section}] has no z_offset: the probe is taken to be at the nozzle."
        for section, entries in config.entries.items()
        if section in PROBE_SECTIONS and "z_offset" not in entries
    )


# Writing


def _linear(fit: Fit, radius: str | None) -> dict[str, dict[str, str]]:
    """Sections of a linear delta."""
    endstops = nozzle_heights(fit)
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


def _arm_switches(text: str) -> list[tuple[Array, Array]]:
    """Readings and values of :func:`_arm_endstop_lines`, (3,) each, NaN for the other motors."""
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
