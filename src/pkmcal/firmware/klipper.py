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

SAVE_CONFIG writes lines that begin with ``#*#``. A value that also occurs above SAVE_CONFIG's block
is taken from above. If a line below SAVE_CONFIG's header lacks the mark, or a marked line precedes
the header, Klipper ignores the whole saved block (klippy/configfile.py, _find_autosave_data).
``heightN_pos`` are steps of the three motors from their end switches, ``heightN`` is the height of
the nozzle above the bed there. ``PROBE`` prints ``probe at X,Y is z=Z``, the tool's position when
the probe triggered; newer versions print ``probe: at X,Y bed will contact at z=Z``, the point of
the bed under the probe with the tool's height at which the nozzle would touch it.
"""

from __future__ import annotations

import math
import re
from configparser import ConfigParser
from functools import partial
from itertools import count, takewhile
from math import prod
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import ExportedValue, commented
from pkmcal.exporters.delta import (
    DEGREES_A_RADIAN,
    SWITCH_ROUNDING,
    Fit,
    Freedoms,
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
    LARGEST_PRINTER_VALUE,
    NUMBER,
    Firmware,
    Printer,
    Touches,
    WrittenValues,
    means_by_position,
)
from pkmcal.outcome.finding import Finding, note

KLIPPER_STEPPERS = "abc"
NO_KLIPPER_PRINT_RADIUS = (
    "There is no print_radius: keep the printer's own. Klipper takes delta_radius where none"
    " stands; then write the former delta_radius there."
)


SAVED_LINE_MARK = "#*#"
_HEADER = re.compile(r"#\*# <-+ SAVE_CONFIG -+>")
FULL_STEPS = 200.0
"""Default full steps per motor revolution, as in Klipper."""
MOST_CARRIAGE_STEPS = 1e9
"""Bound on steps from an end switch; more would be kilometres of carriage travel."""
_TRIGGERED = re.compile(rf"probe at {NUMBER},{NUMBER} is z={NUMBER}")
_CONTACT = re.compile(rf"probe: at {NUMBER},{NUMBER} bed will contact at z={NUMBER}")
_SECTION = re.compile(r"\[([^\]]+)\]")
_ENTRY = re.compile(r"([A-Za-z_]\w*)\s*[:=](.*)")


Sections = dict[str, dict[str, tuple[str, str]]]
"""Entries by section and name: the text of each, and its place in the file."""


@final
class Klipper(Firmware):
    """Klipper's printer.cfg."""

    name: ClassVar = "klipper"
    title: ClassVar = "Klipper: values for printer.cfg"
    program: ClassVar = "Klipper"
    configuration: ClassVar = "a printer.cfg with a section [printer] (Klipper)"
    file: ClassVar = "pkmcal_printer.cfg"
    comment: ClassVar = "#"
    motors: ClassVar = ("stepper_a", "stepper_b", "stepper_c")
    rotary: ClassVar = Freedoms((30.0, 150.0, 270.0), heights=False)
    carriage_source: ClassVar = "what Klipper's\nGET_POSITION prints behind stepper:"

    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """The section [printer]."""
        return ("it has a section [printer]",) if "printer" in sections(text, label) else ()

    def printer(self, text: str, label: str) -> Printer:
        """Printer of a printer.cfg.

        Raises InputError for kinematics other than delta, for missing or impossible values, and
        for a saved block that Klipper would ignore.
        """
        _check_saved(text, label)
        entries = sections(text, label)
        kinematics = entries.get("printer", {}).get("kinematics", ("", f"{label}, [printer]"))
        if kinematics[0] != "delta":
            raise InputError(
                "heights of a bed are read of linear deltas",
                where=kinematics[1],
                found=quoted(kinematics[0]),
                expected="kinematics: delta",
            )
        # checked values: one radius, and rod, end switch and direction of each tower; rods and end
        # switches of the second and the third tower default to the first's
        radius = _positive(entries, label, "printer", "delta_radius")
        by_tower = {
            name: [
                value(
                    entries, label, f"stepper_{s}", name, value(entries, label, "stepper_a", name)
                )
                for s in KLIPPER_STEPPERS
            ]
            for name, value in (("arm_length", _positive), ("position_endstop", _number))
        }
        by_tower["angle"] = [
            _number(entries, label, f"stepper_{s}", "angle", default)
            for s, default in zip(KLIPPER_STEPPERS, self.linear.nominal, strict=True)
        ]
        # the export's formulas read a ConfigParser; values are text there
        config = ConfigParser()
        config.read_dict(
            {
                "printer": {"kinematics": "delta", "delta_radius": repr(radius)},
                **{
                    f"stepper_{s}": {name: repr(values[k]) for name, values in by_tower.items()}
                    for k, s in enumerate(KLIPPER_STEPPERS)
                },
            }
        )
        # without the settings of its motors a printer has the usual carriage step
        steps_stated = {"rotation_distance", "microsteps"} <= entries.get("stepper_a", {}).keys()
        with np.errstate(invalid="ignore"):
            homed_heights = homed(config)
        return Printer(
            firmware=self,
            label=label,
            radius=radius,
            angle=np.array(by_tower["angle"]),
            rod=np.array(by_tower["arm_length"]),
            homed=homed_heights,
            reach=_positive(entries, label, "printer", "print_radius", radius),
            carriages=partial(klipper_carriage_heights, config),
            offset=_probe_offset(entries, label),
            touches=_touches(entries, label, homed_heights),
            step=max(_mm_a_step(entries, label, f"stepper_{s}") for s in KLIPPER_STEPPERS)
            if steps_stated
            else CARRIAGE_STEP,
        )

    def touched(self, text: str, label: str, printer: Printer) -> tuple[Array, float] | None:
        """Points of PROBE; repeats at one place are averaged."""
        del label
        dx, dy, dz = printer.offset
        if values := _TRIGGERED.findall(text):
            return means_by_position(np.array(values, dtype=float)), dz
        if values := _CONTACT.findall(text):
            return means_by_position(np.array(values, dtype=float)) - [dx, dy, 0.0], 0.0
        return None

    def text(self, fit: Fit, source: MachineSource) -> str:
        """Sections of printer.cfg under a header of comments."""
        word = "Multiply its rotation_distance" if fit.kind == "linear" else "Divide its gear_ratio"
        lines = about(source, fit, KLIPPER_STEPPERS, f"{word} by that.")
        lines.append("Put these values into the sections of the printer's own configuration.")
        lines.append(note("export.klipper_saved").text)
        lines.append(end_switches(fit))
        radius = self.print_radius(fit)
        if fit.kind == "linear":
            names = [f"stepper_{s}.position_endstop" for s in KLIPPER_STEPPERS]
            lines += proportional_switches(fit, names, _tower_endstops(fit))
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

    def print_radius(self, fit: Fit) -> str | None:
        """Print radius, which Klipper has for linear deltas alone."""
        return super().print_radius(fit) if fit.kind == "linear" else None

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
                    ("position_endstop", _tower_endstops(fit), "mm"))  # fmt: skip
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
        following, *others = super().notes(source)
        return (following, note("export.klipper_saved"), *others)


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


def _check_saved(text: str, label: str) -> None:
    """Raise InputError if Klipper would ignore the block that SAVE_CONFIG wrote."""
    lines = [line.rstrip("\r") for line in text.rstrip().splitlines()]
    header = next((n for n, line in enumerate(lines) if _HEADER.match(line)), len(lines))
    for n, line in enumerate(lines):
        marked = line == SAVED_LINE_MARK or line.startswith(SAVED_LINE_MARK + " ")
        if marked == (n >= header):
            continue
        raise InputError(
            "Klipper drops all that SAVE_CONFIG wrote, for this line "
            + (
                "is marked and not below its header" if marked else "below its header is not marked"
            ),
            where=f"{label}, line {n + 1}",
            found=quoted(line),
            expected=f"'{SAVED_LINE_MARK} ' before each line below SAVE_CONFIG's header,"
            " and no other",
            next_step="Put the header back"
            if marked
            else f"Put '{SAVED_LINE_MARK} ' before it, remove it if it is empty, or move it"
            " above the header; then restart Klipper",
        )


def sections(text: str, label: str) -> Sections:
    """Entries of a configuration; the user's own lines take precedence over SAVE_CONFIG's."""
    lines = [(n, line.rstrip()) for n, line in enumerate(text.splitlines(), 1)]
    own = [(n, line) for n, line in lines if not line.startswith(SAVED_LINE_MARK)]
    saved = [
        (n, line.removeprefix(SAVED_LINE_MARK).strip())
        for n, line in lines
        if line.startswith(SAVED_LINE_MARK)
    ]
    out: Sections = {}
    section = ""
    # SAVE_CONFIG's lines first, so that the user's own override them
    for n, line in (*saved, *own):
        plain = re.split(r"(?:^|\s)[#;]", line)[0].rstrip()
        if head := _SECTION.fullmatch(plain.strip()):
            section = head[1].strip()
            out.setdefault(section, {})
        elif section and (entry := _ENTRY.fullmatch(plain)):
            out[section][entry[1].lower()] = entry[2].strip(), f"{label}, line {n}, [{section}]"
    return out


def _number(
    config: Sections, label: str, section: str, name: str, default: float | None = None
) -> float:
    """Number in a section.

    Raises InputError if it is not a number within bounds, or missing without a default.
    """
    if name not in config.get(section, {}):
        if default is not None:
            return default
        raise InputError(
            f"this value of the printer is missing: {name}",
            where=f"{label}, [{section}]",
            expected=f"{name}: a number",
            next_step="If it stands in a file that this one includes, copy it here",
        )
    text, where = config[section][name]
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) <= LARGEST_PRINTER_VALUE:
        raise InputError(
            f"{name} is no number that a printer can have",
            where=where,
            found=quoted(text),
            expected="a number in mm, or degrees",
        )
    return value


def _positive(
    config: Sections, label: str, section: str, name: str, default: float | None = None
) -> float:
    """Number in a section that must be positive. Raises InputError otherwise."""
    value = _number(config, label, section, name, default)
    if value <= 0:
        text, where = config[section][name]
        raise InputError(
            f"{name} is no number that a printer can have",
            where=where,
            found=quoted(text),
            expected="a number above zero",
        )
    return value


def _probe_offset(config: Sections, label: str) -> tuple[float, float, float]:
    """Offset (x, y, z) of the probe from the nozzle, mm; zeros without a probe."""
    for section, entries in config.items():
        if "z_offset" in entries:
            x, y = (_number(config, label, section, f"{c}_offset", 0.0) for c in "xy")
            return x, y, _number(config, label, section, "z_offset")
    return 0.0, 0.0, 0.0


def _touches(config: Sections, label: str, ends: Array) -> Touches | None:
    """Bed points that DELTA_CALIBRATE saved, and those entered by hand; None without any."""
    section = "delta_calibrate"
    entries = config.get(section, {})
    names = [
        f"{kind}{k}"
        for kind in ("height", "manual_height")
        for k in takewhile(lambda k, kind=kind: f"{kind}{k}" in entries, count())
    ]
    if not names:
        return None
    mm_a_step = np.array([_mm_a_step(config, label, f"stepper_{s}") for s in KLIPPER_STEPPERS])
    heights = [_number(config, label, section, name) for name in names]
    steps = [_motor_steps(entries, label, f"{name}_pos") for name in names]
    origin = f"{label}, [{section}]"
    return Touches(ends - np.array(steps) * mm_a_step, np.array(heights), origin)


def _mm_a_step(config: Sections, label: str, section: str) -> float:
    """Carriage travel per motor step, mm."""
    # the second and the third stepper default to the first
    own = {**config.get("stepper_a", {}), **config.get(section, {})}
    both = {section: own}
    turn = _positive(both, label, section, "rotation_distance")
    micro = _positive(both, label, section, "microsteps")
    full = _positive(both, label, section, "full_steps_per_rotation", FULL_STEPS)
    text, where = own.get("gear_ratio", ("1:1", ""))
    try:
        pairs = [[float(x) for x in part.split(":")] for part in text.split(",") if part.strip()]
    except ValueError:
        pairs = [[math.nan]]
    if any(len(p) != 2 or not all(0 < x <= LARGEST_PRINTER_VALUE for x in p) for p in pairs):
        raise InputError(
            "the gears cannot be read", where=where, found=quoted(text), expected="such as 80:20"
        )
    return turn / (full * micro * prod(a / b for a, b in pairs))


def _motor_steps(entries: dict[str, tuple[str, str]], label: str, name: str) -> list[float]:
    """Three comma-separated motor positions, in steps. Raises InputError for anything else."""
    text, where = entries.get(name, ("", f"{label}, [delta_calibrate]"))
    try:
        values = [float(x) for x in text.split(",")]
    except ValueError:
        values = list[float]()
    if len(values) != 3 or not all(abs(x) <= MOST_CARRIAGE_STEPS for x in values):
        raise InputError(
            f"{name} does not give the three motors' positions",
            where=where,
            found=quoted(text),
            expected="three numbers, as SAVE_CONFIG wrote them",
        )
    return values


# Writing


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
