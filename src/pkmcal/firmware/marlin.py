"""Marlin: M665, M666, M92 and M851 of linear deltas, read from what M503 prints, from G-code or
from Configuration.h, written by ``export --to marlin``, and bed points of G29 and G30.

Semantics: Marlin's module/delta.cpp, module/motion.cpp, module/probe.cpp and
gcode/calibrate/M665.cpp, M666.cpp, G33.cpp. Towers X, Y, Z are at 210 + X, 330 + Y and 90 + Z
degrees, counted anticlockwise, on one circle of radius R. A rod has the length L plus its trim A, B
or C.

After its switch triggered, a carriage retracts by the amount of its M666 offset, which is never
positive. The three carriages are then where they belong with the nozzle in the middle, at its
height at home. So a carriage is at ``height + sqrt(rod^2 - R^2) - offset`` where its switch
triggers, while RepRapFirmware adds the adjustment of M666.

The nozzle's height at home is H less the Z of M851 in Marlin 2 with a probe (motion.cpp,
set_axis_is_at_home), and H without a probe and in earlier versions. What H contains beyond that
height is ``height_offset`` of the mechanism file: a printer is read and written with the same, so
that H is right even where the version is not known.

Versions of M665, by what M503 prints: L R S A B C (1.1.0, without the height); L R H S B X Y Z,
B the calibration radius (up to 2.0.5); L R H S X Y Z A B C, rod trims (since 2.0.6).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import Difference, ExportedValue, commented, largest
from pkmcal.exporters.delta import Fit
from pkmcal.exporters.delta_texts import (
    about,
    firmware_angle,
    firmware_length,
    height_offset,
    steps_correction,
)
from pkmcal.files import quoted
from pkmcal.firmware.contract import (
    CARRIAGE_STEP,
    TOWER_ANGLES,
    Firmware,
    Printer,
    Touches,
    WrittenValues,
    misspelt_remarks,
)
from pkmcal.firmware.definitions import Definitions
from pkmcal.firmware.marlin_probing import marlin_touches
from pkmcal.firmware.towers import (
    SettingNames,
    Settings,
    Words,
    commands,
    fitted_settings,
    impossible,
    lettered,
    named_settings,
    read_commands,
    stated_height,
    switch_lines,
    written_values,
    xyz_values,
)

LEAST_RETRACTION = 0.2
"""Least distance, mm, by which a carriage is made to retract from its switch, if it is at all.

Marlin 2 ignores an offset of at most MIN_STEPS_PER_SEGMENT motor steps, 6 by default: 0.075 mm with
80 steps per mm, 0.15 mm with 40.
"""
MOST_IGNORED_STEPS = 6
"""Default of MIN_STEPS_PER_SEGMENT."""
FIRST_WITH_ROD_TRIMS = "02000600"
"""CONFIGURATION_H_VERSION of 2.0.6, in eight digits."""
BED_PROBES = {
    "BD_SENSOR", "BIQU_MICROPROBE_V1", "BIQU_MICROPROBE_V2", "BLTOUCH", "FIX_MOUNTED_PROBE",
    "MAGLEV4", "MAG_MOUNTED_PROBE", "NOZZLE_AS_PROBE", "RACK_AND_PINION_PROBE",
    "SENSORLESS_PROBING", "SOLENOID_PROBE", "TOUCH_MI_PROBE", "Z_PROBE_ALLEN_KEY",
    "Z_PROBE_SERVO_NR", "Z_PROBE_SLED",
}  # fmt: skip
"""Definitions of which a printer with a probe has one; NOZZLE_TO_PROBE_OFFSET stands without."""

HOME_HEIGHTS = ("DELTA_HEIGHT", "MANUAL_Z_HOME_POS")
"""Names of the height at home; the second one until 1.1.0, and equal to the first since."""
PRINT_RADII = ("DELTA_PRINTABLE_RADIUS", "PRINTABLE_RADIUS")
"""Older and newer name of the print radius."""
DEFINES = (
    "DELTA_DIAGONAL_ROD", "DELTA_RADIUS", *HOME_HEIGHTS, "DELTA_ENDSTOP_ADJ",
    "DELTA_TOWER_ANGLE_TRIM", "DELTA_DIAGONAL_ROD_TRIM_TOWER", "DELTA_RADIUS_TRIM_TOWER",
    "NOZZLE_TO_PROBE_OFFSET", "DEFAULT_AXIS_STEPS_PER_UNIT", *PRINT_RADII,
)  # fmt: skip
"""Names of Configuration.h that are read."""
MARLIN_COMMANDS = ("M665", "M666", "M92", "M851", "M206")
_DELTA_HEADING = re.compile(r"echo:[\s;]*Delta settings|Delta settings: L[<=]", re.IGNORECASE)
_PROGRAM = re.compile(r"FIRMWARE_NAME:\s*Marlin|echo:\s*Marlin|For Marlin\.", re.IGNORECASE)
_DELTA_DEFINE = re.compile(
    r"^[^\S\n]*#[^\S\n]*define[^\S\n]+"
    r"(DELTA_(?:RADIUS|HEIGHT|ENDSTOP_ADJ|SMOOTH_ROD_OFFSET|TOWER_ANGLE_TRIM))\b",
    re.MULTILINE,
)
"""Definitions that Repetier-Firmware's Configuration.h has not."""
_DELTA_CONDITION = re.compile(r"\s*#\s*if.*\bDELTA\b")


@final
class Marlin(Firmware):
    """Marlin's commands, and its Configuration.h."""

    name: ClassVar = "marlin"
    title: ClassVar = "Marlin: commands to send"
    program: ClassVar = "Marlin"
    configuration: ClassVar = "the output of M503, or Configuration.h (Marlin)"
    file: ClassVar = "pkmcal_marlin.gcode"
    carriage_source: ClassVar = "what M114\nprints behind Count, divided by M92"

    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """Lines as Marlin prints or reads them."""
        del label
        geometry = list(commands(text, ("M665", "M666")))
        reasons: list[str] = []
        if define := _DELTA_DEFINE.search(text):
            line = text.count("\n", 0, define.start()) + 1
            reasons.append(f"line {line} defines {define[1]}")
        if not geometry:
            return tuple(reasons)
        if echoed := [c for c in geometry if c.echoed]:
            reasons.append(f"line {echoed[0].line} is {echoed[0].code} behind 'echo:'")
        headings = _DELTA_HEADING.search(text), _PROGRAM.search(text)
        for what, match in zip(("M503's heading", "Marlin's name"), headings, strict=True):
            if match:
                reasons.append(f"line {text.count(chr(10), 0, match.start()) + 1} has {what}")
        if probe := next((c for c in commands(text, ("M851",)) if c.rest), None):
            reasons.append(f"line {probe.line} is M851")
        for command in geometry:
            letters = {word[0].upper() for word in command.rest.split()}
            # Smoothieware's M665 has other letters beside A, B and C, RepRapFirmware's has lists
            if command.code != "M665" or letters & set("DEIJK") or ":" in command.rest:
                continue
            if "S" in letters:
                reasons.append(f"line {command.line} gives M665 segments per second, S")
            if letters & set("AC"):
                reasons.append(f"line {command.line} gives M665 rod trims, A and C")
            if letters & set("SAC"):
                break
        return tuple(reasons)

    def printer(self, text: str, path: Path) -> Printer:
        """Printer of what M503 printed, or of Configuration.h; of repeated values the last counts.

        Raises InputError for missing, malformed or impossible values, and for values whose meaning
        depends on what the file does not contain.
        """
        label = path.name
        if inches := next(commands(text, ("G20",)), None):
            raise InputError(
                "these values are in inches",
                where=f"{label}, line {inches.line}",
                expected="G21, millimetres",
                next_step="Send G21 before M503",
            )
        words = read_commands(text, label, MARLIN_COMMANDS)
        # the output of M503 without M665 has other commands, and no definitions
        by_command = any(name.startswith("665") for name in words) or (
            bool(words) and not _DELTA_DEFINE.search(text)
        )
        settings = _commanded(words, label) if by_command else _configured(text, label)
        return settings.printer(self, label)

    def touched(self, text: str, path: Path, printer: Printer) -> Touches | None:
        """Points of G29 V4, G30, G33 P3 V0, and of M420 V behind G29 L R F B."""
        return marlin_touches(text, path.name, printer)

    def text(self, fit: Fit, source: MachineSource) -> str:
        """Commands under a header of comments, and the same values for Configuration.h below it."""
        offset = height_offset(fit.delta.machine)
        steps = self.steps(fit)
        values = fitted_settings(fit, LEAST_RETRACTION)
        rule = "M666 is that height less each, and M665 H that height plus height_offset."
        lines = about(source, fit, "XYZ", steps_correction(steps))
        lines += switch_lines(fit, values.height, rule)
        if offset:
            lines.append(
                f"H contains height_offset, {firmware_length(offset)} mm, as the printer's own H:"
                " home moves with the Z of M851."
            )
        if offset is None:
            lines.append(
                "There is no H here, and no M500: H is the nozzle's height at home in Marlin"
                " without a probe and before 2.0, and that height plus the Z of M851 in Marlin 2"
                " with a probe. A wrong H drives the nozzle into the bed. Set H yourself, or write"
                " height_offset into the mechanism file: 0, or the Z of M851."
            )
        commands = _commands_text(values, offset, steps)
        defines = _defines_text(values, offset, steps, self.print_radius(fit))
        return (
            commented(lines, ";")
            + "\n".join(commands)
            + "\n"
            + commented(["The same in Configuration.h:", *defines], ";")
        )

    def named_values(self, fit: Fit, at: Fit) -> tuple[ExportedValue, ...]:
        """Letters of M665 and M666; without H where it is not written."""
        offset = height_offset(fit.delta.machine)
        letters = SettingNames(
            rod="M665 L",
            radius="M665 R",
            height="M665 H",
            angles=("M665 X", "M665 Y", "M665 Z"),
            trims=("M665 A", "M665 B", "M665 C"),
            switches=("M666 X", "M666 Y", "M666 Z"),
        )
        values = named_settings(letters, fit, at, LEAST_RETRACTION, offset or 0.0)
        return tuple(one for one in values if offset is not None or one.name != letters.height)

    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values as Marlin reads them; the print radius is one of Configuration.h alone."""
        words = read_commands(text, self.file, MARLIN_COMMANDS)
        defined = Definitions(text.replace("; #define", "#define"), self.file)
        radius = "DELTA_PRINTABLE_RADIUS"
        offset = height_offset(fit.delta.machine)
        settings = Settings(
            rod=words["665L"][0] + np.array([words["665" + c][0] for c in "ABC"]),
            radius=words["665R"][0],
            angle=np.array(TOWER_ANGLES) + [words["665" + c][0] for c in "XYZ"],
            offset=np.array([words["666" + c][0] for c in "XYZ"]),
            height=stated_height(text) if offset is None else words["665H"][0] - offset,
            reach=float(defined.numbers(radius, 1)[0]) if radius in defined.by_name else None,
            steps=xyz_values(words, "92"),
        )
        ignored = settings.offset[np.abs(settings.offset) < LEAST_RETRACTION]
        retraction = Difference("offsets that Marlin ignores", largest(ignored), 0.0, "mm")
        return written_values(text, settings, others=(retraction,))


# Reading commands


def _commanded(words: Words, label: str) -> Settings:
    """Settings of commands. Raises InputError for missing or impossible values."""

    def value(name: str, default: float | None = None) -> float:
        if name in words:
            return words[name][0]
        if default is not None:
            return default
        raise InputError(
            f"M{name[:-1]} has no value {name[-1]}",
            where=label,
            expected="the line M665 that M503 prints, with L, R and H",
        )

    if "665H" not in words and {"665L", "665R"} <= words.keys():
        raise InputError(
            "the height at home is not among these values",
            where=words["665R"][1],
            found="M665 without H, as Marlin 1.1.0 prints it",
            expected="H, the height of the nozzle at home in mm",
            next_step="Add H to this line: DELTA_HEIGHT or MANUAL_Z_HOME_POS of Configuration.h,"
            " plus Z of M206",
        )
    for name in ("665L", "665R", "665H", "92X", "92Y", "92Z"):
        if name in words and words[name][0] <= 0:
            raise impossible(words[name][1], f"M{name[:-1]} {name[-1]}", words[name][0], "above 0")
    # B is a rod's trim only where A or C are as well; alone it is the calibration radius
    trimmed = bool({"665A", "665C"} & words.keys())
    trims = [value("665" + c, 0.0) if trimmed else 0.0 for c in "ABC"]
    offset = np.array([value("666" + c, 0.0) for c in "XYZ"])
    _check_offsets(offset, [words.get("666" + c, (0.0, label))[1] for c in "XYZ"])
    for name in ("206X", "206Y", *(("206Z",) if trimmed else ())):
        if words.get(name, (0.0, ""))[0]:
            raise impossible(words[name][1], f"M206 {name[-1]}", words[name][0], "0",
                              "Send M206 X0 Y0 Z0 and M500, home, and probe again")  # fmt: skip
    probe = tuple(value("851" + c, math.nan) for c in "XYZ")
    steps = [value("92" + c, math.nan) for c in "XYZ"]
    if trimmed:
        height_offset = value("851Z", 0.0)
        remarks = () if "851Z" in words else (
            "The file has no M851: H is taken for the nozzle's height at home.",
        )  # fmt: skip
    else:
        height_offset = 0.0
        remarks = (
            "H is taken for the nozzle's height at home. Some versions of Marlin with a probe home"
            " it at H less the Z of M851; export --to marlin is right for both, another firmware"
            " needs that height measured.",
        )
    if not {"666X", "666Y", "666Z"} & words.keys():
        remarks += ("The file has no M666: end switches' offsets are taken for 0.",)
    return Settings(
        rod=value("665L") + np.array(trims),
        radius=value("665R"),
        angle=np.array(TOWER_ANGLES) + [value("665" + c, 0.0) for c in "XYZ"],
        offset=offset,
        height=value("665H") - height_offset,
        height_offset=height_offset,
        probe=(probe[0], probe[1], probe[2]),
        steps=None if np.isnan(steps).any() else np.array(steps),
        remarks=(*remarks, *_small_offsets(offset, steps)),
    )


def _check_offsets(offset: Array, places: list[str]) -> None:
    """Raise InputError for end switch offsets above zero."""
    for value, place in zip(offset, places, strict=True):
        if value > 0:
            raise impossible(
                place, "an end switch's offset, M666,", value, "at most 0, as Marlin takes it",
                "RepRapFirmware's M666 has the opposite sign: name the firmware that these values"
                " are of",
            )  # fmt: skip


def _small_offsets(offset: Array, steps: list[float]) -> tuple[str, ...]:
    """Remark on end switch offsets that some versions ignore."""
    least = MOST_IGNORED_STEPS / float(np.nan_to_num(np.min(steps), nan=1 / CARRIAGE_STEP))
    small = offset[(offset != 0) & (np.abs(offset) <= least)]
    if not small.size:
        return ()
    return (
        f"M666 has {', '.join(f'{v:g}' for v in small)} mm: Marlin 2 ignores offsets of at most"
        f" MIN_STEPS_PER_SEGMENT steps ({least:.3g} mm), and the export sets larger ones.",
    )


# Reading Configuration.h


def _configured(text: str, label: str) -> Settings:
    """Settings of Configuration.h. Raises InputError for missing or impossible values."""
    condition = next((one for one in text.splitlines() if _DELTA_CONDITION.match(one)), None)
    values = Definitions(text, label, DEFINES)
    if condition is not None and "DELTA" not in values.by_name:
        raise InputError(
            "this configuration is not of a delta: its values are those of an example",
            where=label,
            found=f"{quoted(condition.strip())} without #define DELTA",
            expected="#define DELTA",
        )

    def positive(name: str) -> float:
        value = float(values.numbers(name, 1)[0])
        if value <= 0:
            raise impossible(values.place(name), name, value, "above 0")
        return value

    zeros = (0.0, 0.0, 0.0)
    by_tower = values.numbers("DELTA_RADIUS_TRIM_TOWER", 3, *zeros)
    if by_tower.any():
        raise InputError(
            "towers on circles of their own are not read",
            where=values.place("DELTA_RADIUS_TRIM_TOWER"),
            found=", ".join(f"{value:g}" for value in by_tower) + " mm",
            expected="DELTA_RADIUS_TRIM_TOWER { 0.0, 0.0, 0.0 }",
            next_step="Remove it and build Marlin anew: tower angles and rods take its place",
        )
    offset = values.numbers("DELTA_ENDSTOP_ADJ", 3, *zeros)
    if offset.any():
        _check_offsets(offset, 3 * [values.place("DELTA_ENDSTOP_ADJ")])
    probe = values.numbers("NOZZLE_TO_PROBE_OFFSET", 3, *(3 * [math.nan]))
    # 020006, and since 2.0.9 with two digits more, 02000902
    version = values.by_name.get("CONFIGURATION_H_VERSION", [])
    newer = any(d.value.ljust(8, "0") >= FIRST_WITH_ROD_TRIMS for d in version)
    contained = newer and BED_PROBES & values.by_name.keys() and not math.isnan(probe[2])
    height_offset = float(probe[2]) if contained else 0.0
    steps = None
    if "DEFAULT_AXIS_STEPS_PER_UNIT" in values.by_name:
        name = "DEFAULT_AXIS_STEPS_PER_UNIT"
        steps = values.numbers(name, 3)
        if steps.min() <= 0:
            raise impossible(values.place(name), name, float(steps.min()), "above 0")
    radii = [name for name in PRINT_RADII if name in values.by_name]
    home = next((name for name in HOME_HEIGHTS if name in values.by_name), HOME_HEIGHTS[0])
    own_steps = [math.nan] if steps is None else steps.tolist()
    rod_trims = values.numbers("DELTA_DIAGONAL_ROD_TRIM_TOWER", 3, *zeros)
    angle_trims = values.numbers("DELTA_TOWER_ANGLE_TRIM", 3, *zeros)
    return Settings(
        rod=positive("DELTA_DIAGONAL_ROD") + rod_trims,
        radius=positive("DELTA_RADIUS"),
        angle=np.array(TOWER_ANGLES) + angle_trims,
        offset=offset,
        height=positive(home) - height_offset,
        height_offset=height_offset,
        probe=(float(probe[0]), float(probe[1]), float(probe[2])),
        reach=positive(radii[0]) if radii else None,
        steps=steps,
        remarks=(
            *_small_offsets(offset, own_steps),
            *misspelt_remarks(values.places, DEFINES),
        ),
    )


# Writing


def _commands_text(values: Settings, offset: float | None, steps: Array | None) -> list[str]:
    """Commands; without H and M500 where `offset`, mm, is not known."""
    rod = float(np.round(values.rod.mean(), 4))
    trims = values.angle - np.array(TOWER_ANGLES)
    height = "" if offset is None else f" H{firmware_length(values.height + offset)}"
    return [
        f"M665 L{firmware_length(rod)} R{firmware_length(values.radius)}{height}"
        f" {lettered('XYZ', trims, firmware_angle)}"
        " ; L rods, R radius, H height, XYZ towers' angles",
        f"M665 {lettered('ABC', values.rod - rod, firmware_length)}"
        " ; rods' trims; leave this line out before Marlin 2.0.6, where B is another value",
        f"M666 {lettered('XYZ', values.offset, firmware_length)} ; end switches' offsets, mm",
        *([] if steps is None else [f"M92 {lettered('XYZ', steps, firmware_length)}"]),
        *([] if offset is None else ["M500"]),
    ]


def _defines_text(
    values: Settings, offset: float | None, steps: Array | None, reach: str | None
) -> list[str]:
    """Definitions for Configuration.h."""
    rod = float(np.round(values.rod.mean(), 4))
    trims = values.angle - np.array(TOWER_ANGLES)
    height = None if offset is None else firmware_length(values.height + offset)
    scalars = {
        "DELTA_DIAGONAL_ROD": firmware_length(rod),
        "DELTA_RADIUS": firmware_length(values.radius),
        "DELTA_HEIGHT": height,
        "DELTA_PRINTABLE_RADIUS": reach,
        "DELTA_ENDSTOP_ADJ": _braces(values.offset, firmware_length),
        "DELTA_TOWER_ANGLE_TRIM": _braces(trims, firmware_angle),
        "DELTA_DIAGONAL_ROD_TRIM_TOWER": _braces(values.rod - rod, firmware_length),
        "DELTA_RADIUS_TRIM_TOWER": _braces(np.zeros(3), firmware_length),
    }
    lines = [f"#define {name} {text}" for name, text in scalars.items() if text is not None]
    if steps is not None:
        xyz = ", ".join(firmware_length(v) for v in steps)
        lines.append(f"#define DEFAULT_AXIS_STEPS_PER_UNIT {{ {xyz}, the extruder's own }}")
    return lines


def _braces(values: Array, write: Callable[[float], str]) -> str:
    """Values in braces, as in C."""
    return "{ " + ", ".join(write(float(v)) for v in values) + " }"
