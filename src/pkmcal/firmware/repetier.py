"""Repetier-Firmware: values of a linear delta in its EEPROM, read from what M205 prints and written
as M206 by ``export --to repetier``.

Semantics: Repetier-Firmware's Printer.cpp (homeZAxis, updateDerivedParameter) and Eeprom.cpp. Lines
are ``EPR:type position value name``, and ``<epr pos="position" type="type" value="value">`` in
Repetier-Host's files .epr. The towers stand at the angles Alpha A, B and C on one circle, plus a
correction of the radius for each, which is written as 0; rods have a correction of the length each.
With the nozzle in the middle at Z max length, after homing, a carriage is lower than its switch by
its endstop offset, in motor steps: the switch triggers at ``Z max length + sqrt(rod^2 - radius^2) +
offset / steps per mm``.

``Z-probe:10.66 X:0.00 Y:0.00`` of G29, G30 and G33 (Printer.cpp, runZProbe) is how far the probe
moved down, with corrections, from a height that is not printed and depends on the version: such
lines have no heights.

All motors have one number of steps per mm, and the firmware rounds towers and rods to whole steps.

Configuration.h has the values with which an empty EEPROM begins; later ones are in the EEPROM
alone.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import ExportedValue, commented
from pkmcal.exporters.delta import Fit
from pkmcal.exporters.delta_texts import about, firmware_angle, firmware_length
from pkmcal.files import quoted
from pkmcal.firmware.contract import (
    TOWER_ANGLES,
    Firmware,
    Printer,
    Touches,
    WrittenValues,
    printer_number,
    travel_without_start,
)
from pkmcal.firmware.definitions import Definitions
from pkmcal.firmware.towers import (
    SettingNames,
    Settings,
    Words,
    fitted_settings,
    impossible,
    named_settings,
    switch_lines,
    written_values,
)

DELTA = "3"
"""DRIVE_SYSTEM of a delta, which Repetier.h defines."""
INTEGER, FLOAT = 1, 3
"""Types of the EEPROM's values."""
ROD, RADIUS, HEIGHT, REACH, STEPS = 881, 885, 153, 925, 11
SWITCHES, ANGLES = (893, 895, 897), (901, 905, 909)
RADIUS_CORRECTIONS, ROD_CORRECTIONS = (913, 917, 921), (933, 937, 941)
ZERO_POSITIONS = (133, 137, 141)
"""Positions of X, Y and Z min pos, which move the end switches as well."""
NEEDED = (ROD, RADIUS, HEIGHT, STEPS, *SWITCHES, *ANGLES)
"""Positions that every delta has."""
HEADER = {
    "DELTA_DIAGONAL_ROD": ROD,
    "ROD_RADIUS": RADIUS,
    "Z_MAX_LENGTH": HEIGHT,
    "ZAXIS_STEPS_PER_MM": STEPS,
    "DELTA_MAX_RADIUS": REACH,
    **{
        name.format(letter): position
        for name, letters, positions in (
            ("DELTA_ALPHA_{}", "ABC", ANGLES),
            ("DELTA_{}_ENDSTOP_OFFSET_STEPS", "XYZ", SWITCHES),
            ("DELTA_RADIUS_CORRECTION_{}", "ABC", RADIUS_CORRECTIONS),
            ("DELTA_DIAGONAL_CORRECTION_{}", "ABC", ROD_CORRECTIONS),
            ("{}_MIN_POS", "XYZ", ZERO_POSITIONS),
        )
        for letter, position in zip(letters, positions, strict=True)
    },
}
"""Positions in the EEPROM by names of Configuration.h."""
OLD_RADIUS = ("PRINTER_RADIUS", "END_EFFECTOR_HORIZONTAL_OFFSET", "CARRIAGE_HORIZONTAL_OFFSET")
"""Names whose difference is ROD_RADIUS where that is not defined."""
_HEADER = re.compile(r"^[^\S\n]*#[^\S\n]*define[^\S\n]+(DELTA_ALPHA_A|ROD_RADIUS)\b", re.MULTILINE)
_EEPROM = re.compile(r"\bEPR:(\d+) (\d+) (\S+)(?: (.{0,60}))?")
_TRAVEL = re.compile(r"\bZ-probe: ?-?\d{1,4}\.\d{1,6} X:[^\n]{0,60}")
_HOST = re.compile(r'<epr pos="(\d+)" type="(\d+)" value="([^"<]*)">')
_WRITTEN = re.compile(r"M206 T(\d) P(\d+) [SX](\S+)(?: ; (.*))?")


@final
class Repetier(Firmware):
    """Repetier-Firmware's EEPROM."""

    name: ClassVar = "repetier"
    title: ClassVar = "Repetier-Firmware: commands to send"
    program: ClassVar = "Repetier-Firmware"
    configuration: ClassVar = "the lines EPR: of M205, .epr, or Configuration.h (Repetier-Firmware)"
    file: ClassVar = "pkmcal_repetier.gcode"
    carriage_source: ClassVar = "what M114\nprints, turned into motors by its values"

    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """The rod's length in the EEPROM, or definitions of a header."""
        del label
        if define := _HEADER.search(text):
            return (f"line {text.count(chr(10), 0, define.start()) + 1} defines {define[1]}",)
        for n, line in enumerate(text.splitlines(), 1):
            typed = [match.group(1, 2) for p in (_EEPROM, _WRITTEN) for match in p.finditer(line)]
            typed += [match.group(2, 1) for match in _HOST.finditer(line)]
            if (str(FLOAT), str(ROD)) in typed:
                return (f"line {n} has the EEPROM's rod length, {ROD}",)
        return ()

    def printer(self, text: str, path: Path) -> Printer:
        """Printer of the EEPROM's values, of which the last counts, or of Configuration.h.

        Raises InputError for missing, malformed or impossible values.
        """
        if not _HEADER.search(text):
            return _settings(_eeprom(text, path.name), path.name).printer(self, path.name)
        settings = _settings(_header(text, path.name), path.name)
        remark = (
            "Configuration.h has the values of an empty EEPROM: if the printer was calibrated,"
            " name the output of M205, which prints those in force."
        )
        return replace(settings, remarks=(*settings.remarks, remark)).printer(self, path.name)

    def touched(self, text: str, path: Path, printer: Printer) -> Touches | None:
        """None without lines of probing. Raises InputError for these, which have no heights."""
        del printer
        if (line := _TRAVEL.search(text)) is None:
            return None
        raise travel_without_start(
            path.name,
            line[0],
            "the nozzle's positions at contact, in a table configuration,x [mm],y [mm],z [mm]",
            "At seven places or more, lower the nozzle until it holds a sheet of paper, and write"
            " X, Y and Z by M114 into such a table",
        )

    def text(self, fit: Fit, source: MachineSource) -> str:
        """Commands under a header. Raises InputError for a machine without motor steps."""
        values = fitted_settings(fit)
        steps = self.steps(fit)
        rod = float(np.round(values.rod.mean(), 4))
        radius = self.print_radius(fit)
        offsets = np.round(-values.offset * steps)
        rule = (
            "The offsets in the EEPROM are each height less that height, in motor steps, and Z max"
            " length is that height."
        )
        entries = [
            (ROD, rod, "Diagonal rod length [mm]"),
            (RADIUS, values.radius, "Horizontal rod radius at 0,0 [mm]"),
            (HEIGHT, values.height, "Z max length [mm]"),
            *zip(ANGLES, values.angle, ("Alpha A", "Alpha B", "Alpha C"), strict=True),
            *((position, 0.0, "Delta Radius") for position in RADIUS_CORRECTIONS),
            *zip(ROD_CORRECTIONS, values.rod - rod, 3 * ["Corr. diagonal [mm]"], strict=True),
            *((position, 0.0, "min pos [mm]") for position in ZERO_POSITIONS),
        ]
        code = [
            f"M206 T{FLOAT} P{position}"
            f" X{(firmware_angle if position in ANGLES else firmware_length)(value)} ; {name}"
            for position, value, name in entries
        ]
        code += [
            f"M206 T{INTEGER} P{position} S{int(offset)} ; Tower {name} endstop offset [steps]"
            for position, offset, name in zip(SWITCHES, offsets, "XYZ", strict=True)
        ]
        own = firmware_length(float(steps[0]))
        code.append(f"M206 T{FLOAT} P{STEPS} X{own} ; Steps per mm, as it was")
        if radius is not None:
            code.append(f"M206 T{FLOAT} P{REACH} X{radius} ; Max printable radius [mm]")
        correcting = (
            "All motors have one number of steps per mm in the EEPROM, 11: divide it by their mean,"
            " if they agree."
        )
        lines = about(source, fit, "XYZ", correcting) + switch_lines(fit, values.height, rule)
        return commented(lines, ";") + "\n".join(code) + "\n"

    def steps(self, fit: Fit) -> Array:
        """Motor steps per mm (3,) of the mechanism file, one number for all motors.

        Raises InputError where the mechanism file has none.
        """
        steps = fit.delta.machine.document.steps_per_mm
        if steps is None or np.ptp(steps) > 0:
            raise InputError(
                "Repetier-Firmware counts end switches in motor steps",
                found="no steps_per_mm" if steps is None else f"steps_per_mm {[*steps]}",
                expected="steps_per_mm in the mechanism file, equal for all legs, such as"
                " [80, 80, 80]",
                code="export.no_steps",
            )
        return np.array(steps)

    def named_values(self, fit: Fit, at: Fit) -> tuple[ExportedValue, ...]:
        """Values of the EEPROM by position; end switches in motor steps."""
        position = SettingNames(
            rod=f"EPR {ROD}",
            radius=f"EPR {RADIUS}",
            height=f"EPR {HEIGHT}",
            angles=("EPR 901", "EPR 905", "EPR 909"),
            trims=("EPR 933", "EPR 937", "EPR 941"),
            switches=("EPR 893", "EPR 895", "EPR 897"),
        )
        values, steps = named_settings(position, fit, at), self.steps(fit)
        alpha = dict(zip(position.angles, TOWER_ANGLES, strict=True))
        switch = dict(zip(position.switches, -steps, strict=True))
        return tuple(
            one._replace(value=one.value * switch[one.name], unit="steps")
            if one.name in switch
            else one._replace(value=one.value + alpha.get(one.name, 0.0))
            for one in values
        )

    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values as Repetier-Firmware reads them, but for its rounding of towers and rods to motor
        steps.
        """
        settings = _settings(_eeprom(text, self.file), self.file)
        # offsets are whole steps
        return written_values(text, settings, end_rounding=0.5 / float(self.steps(fit)[0]))


def _eeprom(text: str, label: str) -> Words:
    """Value and place by position. Raises InputError for values that are no numbers in bounds."""
    out: Words = {}
    for n, line in enumerate(text.splitlines(), 1):
        match = _EEPROM.search(line) or _WRITTEN.match(line.strip())
        where, what = f"{label}, line {n}", "a value of this line"
        expected = "a number in mm, degrees or steps"
        for one in _HOST.finditer(line):
            value = printer_number(one[3], what, where, line=one[0], expected=expected)
            out[one[1]] = value, where
        if match is None:
            if "EPR:" in line:
                raise InputError(
                    "this line of the EEPROM is damaged",
                    where=where,
                    found=quoted(line.strip()),
                    expected="EPR:, the type, the position and a number, as M205 prints them",
                )
            continue
        value = printer_number(match[3], what, where, line=match[0], expected=expected)
        out[match[2]] = value, where
    return out


def _header(text: str, label: str) -> Words:
    """Value and place by position in the EEPROM, of Configuration.h.

    Raises InputError for missing values, and for those that are no numbers in bounds.
    """
    values = Definitions(text, label, HEADER, {"DELTA": DELTA})
    drives = values.by_name.get("DRIVE_SYSTEM", [])
    if drives and drives[-1].value not in (DELTA, "DELTA"):
        raise InputError(
            "this configuration is not of a delta",
            where=values.place("DRIVE_SYSTEM"),
            found=quoted(f"DRIVE_SYSTEM {drives[-1].value}"),
            expected=f"DRIVE_SYSTEM DELTA, or {DELTA}",
        )
    needed = {str(position) for position in NEEDED}
    if "ROD_RADIUS" not in values.by_name and OLD_RADIUS[0] in values.by_name:
        outer, *inner = (float(values.numbers(name, 1)[0]) for name in OLD_RADIUS)
        radius = {str(RADIUS): (outer - sum(inner), values.place(OLD_RADIUS[0]))}
        needed -= radius.keys()
    else:
        radius = Words()
    return radius | {
        str(position): (float(values.numbers(name, 1)[0]), values.place(name))
        for name, position in HEADER.items()
        if name in values.by_name or str(position) in needed
    }


def _settings(eeprom: Words, label: str) -> Settings:
    """Settings of the EEPROM. Raises InputError for missing or impossible values."""
    # M205 prints all of them, so a missing one is no 0
    for position in NEEDED:
        if str(position) not in eeprom:
            raise InputError(
                f"the EEPROM's value {position} is missing",
                where=label,
                expected=f"a line EPR: with {position} and a number, as M205 prints it",
            )

    def values(positions: tuple[int, ...]) -> Array:
        return np.array([eeprom.get(str(k), (0.0, ""))[0] for k in positions])

    for position in (ROD, RADIUS, HEIGHT, STEPS, REACH):
        value, place = eeprom.get(str(position), (1.0, ""))
        if value <= 0:
            raise impossible(place, f"the EEPROM's value {position}", value, "above 0")
    for position in ZERO_POSITIONS:
        value, place = eeprom.get(str(position), (0.0, ""))
        if value:
            raise impossible(
                place, f"the EEPROM's value {position}", value, "0",
                "Set it to 0, home, and probe again",
            )  # fmt: skip
    steps = eeprom[str(STEPS)][0]
    reach = eeprom.get(str(REACH))
    return Settings(
        rod=eeprom[str(ROD)][0] + values(ROD_CORRECTIONS),
        radius=eeprom[str(RADIUS)][0],
        radius_trims=values(RADIUS_CORRECTIONS),
        angle=values(ANGLES),
        offset=-values(SWITCHES) / steps,
        height=eeprom[str(HEIGHT)][0],
        probe=(0.0, 0.0, 0.0),
        reach=None if reach is None else reach[0],
        steps=np.full(3, steps),
        remarks=(
            "ENDSTOP_Z_BACK_ON_HOME of the firmware is taken for 0; export --to repetier is right"
            " with any.",
        ),
    )
