"""Smoothieware: M665, M666 and M92 of linear deltas, read from what M503 prints, config-override or
the file config, and written by ``export --to smoothie``.

Semantics: Smoothieware's LinearDeltaSolution.cpp, Endstops.cpp and Robot.cpp. All rods have the
length L, the towers stand at 210 + D, 330 + E and 90 + H (until 2015 F) degrees on one circle of
radius R, plus A, B and C, which are 0 here. Z of M665 and of M206 together are the nozzle's height
at home. A carriage is at ``height + sqrt(L^2 - R^2) - trim`` where its switch triggers; its trim is
that of M666, negative downwards.

Trims of single rods, I, J and K, are in builds of pull request 1511 alone, which never was merged:
they are read where a printer has them, and written as 0, since every other build ignores them
without a message.

``G29.1`` of DeltaCalibrationStrategy.cpp prints seven places and, as Z, the height of the third
tower's carriage above the middle of the bed less the probe's travel (``start_z - z``, of an
actuator): the nozzle's height at contact and that carriage's height above a nozzle in the middle.

The file config has the same as arm_length, arm1_trim, arm_radius, delta_tower1_offset,
delta_tower1_angle, gamma_max or endstop.NAME.homing_position, alpha_trim_mm (until 2016
alpha_trim), beta_trim_mm, gamma_trim_mm and alpha_steps_per_mm.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import ExportedValue, commented
from pkmcal.exporters.delta import Fit, Freedoms
from pkmcal.exporters.delta_texts import (
    about,
    firmware_angle,
    firmware_length,
    steps_correction,
)
from pkmcal.firmware.contract import (
    TOWER_ANGLES,
    Firmware,
    Printer,
    Touches,
    WrittenValues,
    means_by_position,
    missing_value,
    misspelt_remarks,
    printer_number,
    touches_at,
    travel_without_start,
)
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
    switch_lines,
    written_values,
    xyz_values,
)

SMOOTHIE_COMMANDS = ("M665", "M666", "M92", "M206")
RADIUS_LETTERS, ANGLE_LETTERS, ROD_LETTERS = "ABC", "DEH", "IJK"
CONFIG_WORDS = {
    "arm_length": "665L",
    "arm_radius": "665R",
    "gamma_max": "665Z",
    **{f"delta_tower{k}_offset": "665" + c for k, c in enumerate(RADIUS_LETTERS, 1)},
    **{f"delta_tower{k}_angle": "665" + c for k, c in enumerate(ANGLE_LETTERS, 1)},
    **{f"arm{k}_trim": "665" + c for k, c in enumerate(ROD_LETTERS, 1)},
    **{
        f"{name}_{key}": code + c
        for key, code in (("trim_mm", "666"), ("trim", "666"), ("steps_per_mm", "92"))
        for name, c in zip(("alpha", "beta", "gamma"), "XYZ", strict=True)
    },
}
"""Words of commands by keys of the file config."""
OWN_KEYS = ("arm_length", "arm_radius")
EMPTY: Mapping[str, str] = MappingProxyType(dict[str, str]())
_HEADING = re.compile(r";\s*(Optional arm solution specific settings|Max Z\s*$)", re.MULTILINE)
PROBING = "initial Bed ht is"
"""Beginning of the output of G29 and G29.1 of the delta's calibration."""
_PROBED = re.compile(r"\bX(-?\d{1,5}\.\d{4}) Y(-?\d{1,5}\.\d{4}) Z(-?\d{1,5}\.\d{4})(?!\S)")
_CONFIG_LINE = re.compile(r"([a-z][a-z0-9_.]*)\s+([^\s=:]\S*)")
"""Key and value; with = or : between, the line is of another program, such as Klipper."""


@final
class Smoothie(Firmware):
    """Smoothieware's commands, and its file config."""

    name: ClassVar = "smoothie"
    title: ClassVar = "Smoothieware: commands to send"
    program: ClassVar = "Smoothieware"
    configuration: ClassVar = "the output of M503, config-override or config (Smoothieware)"
    file: ClassVar = "pkmcal_smoothie.gcode"
    carriage_source: ClassVar = "what M114.3\nprints"
    linear: ClassVar = Freedoms(TOWER_ANGLES, rods=False)

    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """Headings of M503, letters of its M665, and keys of config."""
        del label
        key = next((line for line in _config(text) if line[1] in OWN_KEYS), None)
        reasons = [] if key is None else [f"line {key[0]} has {key[1]}"]
        geometry = [command for command in commands(text, ("M665",)) if ":" not in command.rest]
        if geometry and (match := _HEADING.search(text)):
            reasons.append(
                f"line {text.count(chr(10), 0, match.start()) + 1} has {match[1].strip()}"
            )
        for command in geometry:
            if {word[0].upper() for word in command.rest.split()} & set("DEIJK"):
                reasons.append(f"line {command.line} gives M665 towers' angles or rods' trims")
                break
        return tuple(reasons)

    def printer(self, text: str, path: Path) -> Printer:
        """Printer of commands, or of config; commands count more, as after config-override.

        Raises InputError for missing, malformed or impossible values.
        """
        label = path.name
        words = {**_config_words(text, label), **read_commands(text, label, SMOOTHIE_COMMANDS)}
        names = {key: f"line {n}" for n, key, _ in _config(text)}
        settings = _settings(words, label, names)
        # commands have no names that could be misspelt
        remarks = misspelt_remarks(names, CONFIG_WORDS) if names.keys() & CONFIG_WORDS else ()
        return replace(settings, remarks=remarks).printer(self, label)

    def touched(self, text: str, path: Path, printer: Printer) -> Touches | None:
        """Points of G29.1. Repeats at a place are averaged.

        Raises InputError for the points of G29, whose heights begin at an unknown one.
        """
        if PROBING not in text:
            return None
        points = np.array(_PROBED.findall(text), dtype=float)
        if len(points):
            tower = float(printer.carriages(np.zeros((1, 3)))[0, 2])
            tool = means_by_position(points) - [0.0, 0.0, tower]
            return touches_at(tool, 0.0, printer, path.name)
        raise travel_without_start(
            path.name,
            PROBING,
            "lines such as 'X-86.6000 Y-50.0000 Z248.1234'",
            "Probe with G29.1, which prints them",
        )

    def text(self, fit: Fit, source: MachineSource) -> str:
        """Commands under a header of comments."""
        steps = self.steps(fit)
        values = fitted_settings(fit)
        rule = "M666 is that height less each, and M665 Z that height."
        angles = values.angle - np.array(TOWER_ANGLES)
        lines = about(source, fit, "XYZ", steps_correction(steps))
        lines += switch_lines(fit, values.height, rule)
        code = [
            f"M665 L{firmware_length(values.rod[0])} R{firmware_length(values.radius)}"
            f" Z{firmware_length(values.height)} ; L rods, R radius, Z height at home",
            f"M665 {lettered(RADIUS_LETTERS, np.zeros(3), firmware_length)}"
            f" {lettered(ANGLE_LETTERS, angles, firmware_angle)}"
            f" {lettered(ROD_LETTERS, np.zeros(3), firmware_length)}"
            " ; one radius, DEH towers' angles, one length of rods",
            f"M666 {lettered('XYZ', values.offset, firmware_length)} ; end switches' trims, mm",
            "M206 X0 Y0 Z0 ; Z of M665 is the whole height",
            *([] if steps is None else [f"M92 {lettered('XYZ', steps, firmware_length)}"]),
            "M500",
        ]
        return commented(lines, ";") + "\n".join(code) + "\n"

    def has_print_radius(self, fit: Fit) -> bool:
        """False: Smoothieware has none."""
        del fit
        return False

    def named_values(self, fit: Fit, at: Fit) -> tuple[ExportedValue, ...]:
        """Letters of M665 and M666."""
        letters = SettingNames(
            rod="M665 L",
            radius="M665 R",
            height="M665 Z",
            angles=("M665 D", "M665 E", "M665 H"),
            trims=(),
            switches=("M666 X", "M666 Y", "M666 Z"),
        )
        return named_settings(letters, fit, at)

    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values as Smoothieware reads them."""
        del fit
        words = read_commands(text, self.file, SMOOTHIE_COMMANDS)
        return written_values(text, _settings(words, self.file))


def _settings(words: Words, label: str, names: Mapping[str, str] = EMPTY) -> Settings:
    """Settings of commands. Raises InputError for missing or impossible values.

    names : places of the keys of a file config.
    """
    missing = [name for name in ("665L", "665R", "665Z") if name not in words]
    if missing and names.keys() & CONFIG_WORDS:
        key = next(key for key, word in CONFIG_WORDS.items() if word == missing[0])
        raise missing_value(key, label, f"{key} with a number in mm", names, CONFIG_WORDS)
    if missing:
        raise InputError(
            f"M{missing[0][:-1]} has no value {missing[0][-1]}",
            where=label,
            expected="the lines M665 that M503 prints, with L, R and Z, or arm_length, arm_radius"
            " and gamma_max",
        )
    words = {"665H": words.get("665F", (0.0, "")), **words}

    def values(code: str, letters: str) -> Array:
        return np.array([words.get(code + c, (0.0, ""))[0] for c in letters])

    for name in ("665L", "665R", "665Z", "92X", "92Y", "92Z"):
        if name in words and words[name][0] <= 0:
            raise impossible(words[name][1], f"M{name[:-1]} {name[-1]}", words[name][0], "above 0")
    for name in ("206X", "206Y"):
        if words.get(name, (0.0, ""))[0]:
            raise impossible(
                words[name][1], f"M{name[:-1]} {name[-1]}", words[name][0], "0",
                "Set it to 0, home, and probe again",
            )  # fmt: skip
    return Settings(
        rod=words["665L"][0] + values("665", ROD_LETTERS),
        radius=words["665R"][0],
        radius_trims=values("665", RADIUS_LETTERS),
        angle=np.array(TOWER_ANGLES) + values("665", ANGLE_LETTERS),
        offset=values("666", "XYZ"),
        height=words["665Z"][0] + words.get("206Z", (0.0, ""))[0],
        probe=(0.0, 0.0, 0.0),
        steps=xyz_values(words, "92"),
    )


def _config(text: str) -> Iterator[tuple[int, str, str]]:
    """Number, key and value of each line of a file config."""
    for n, line in enumerate(text.splitlines(), 1):
        match = _CONFIG_LINE.match(line.partition("#")[0].strip())
        if match:
            yield n, match[1], match[2]


def _config_words(text: str, label: str) -> Words:
    """Words of a file config; of repeated keys the last counts.

    Raises InputError for values that are no numbers within bounds.
    """
    # the switch at the upper end of Z, endstop.maxz in Smoothieware's examples, has any name
    lines = list(_config(text))
    entries = {key: value for _, key, value in lines}
    heights = {
        f"{switch}.homing_position"
        for switch, _, name in (key.rpartition(".") for key in entries)
        if name == "axis"
        and entries[f"{switch}.axis"].upper().startswith("Z")
        and entries.get(f"{switch}.homing_direction") == "home_to_max"
    }
    keys = {**dict.fromkeys(heights, CONFIG_WORDS["gamma_max"]), **CONFIG_WORDS}
    out: Words = {}
    for n, key, value in lines:
        if key in keys:
            where = f"{label}, line {n}"
            out[keys[key]] = printer_number(value, key, where), where
    return out
