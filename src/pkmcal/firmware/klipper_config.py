"""Klipper's configuration files: sections, included files, the block of SAVE_CONFIG, and numbers.

Semantics: Klipper's klippy/configfile.py and klippy/stepper.py. ``[include SPEC]`` stands for the
files that SPEC names, beside the file that has the line, in alphabetical order where SPEC has
wildcards; a wildcard may match none. Of repeated values the last one counts.

SAVE_CONFIG writes lines that begin with ``#*#``. A value that also occurs above SAVE_CONFIG's block
or in an included file is taken from there. If a line below SAVE_CONFIG's header lacks the mark, or
a marked line precedes the header, Klipper ignores the whole saved block (_find_autosave_data).

At its start Klipper writes its whole configuration into klippy.log, included files and saved values
in their places. What stands below was printed with these values.

Until 2021 ``step_distance``, the carriage's travel for one step, stood in place of
``rotation_distance``, the travel for one revolution of the motor.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from glob import glob, has_magic
from math import prod
from pathlib import Path, PurePath
from string import ascii_lowercase

import numpy as np

from pkmcal.arrays import short_repr
from pkmcal.errors import InputError, legible
from pkmcal.files import LARGEST_WRITTEN_FILE, quoted, read_text
from pkmcal.firmware.contract import (
    LARGEST_PRINTER_VALUE,
    missing_value,
    misspelt_remarks,
    printer_number,
)

KEYS = (
    "kinematics", "delta_radius", "print_radius", "shoulder_radius", "shoulder_height",
    "minimum_z_position", "arm_length", "upper_arm_length", "lower_arm_length", "angle",
    "position_endstop", "rotation_distance", "microsteps", "full_steps_per_rotation", "gear_ratio",
    "step_distance", "anchor_x", "anchor_y", "anchor_z",
)  # fmt: skip
"""Names of values that are read of [printer] and of the steppers."""
SECTIONS = ("[printer]", *(f"[stepper_{letter}]" for letter in ascii_lowercase))
SAVED_LINE_MARK = "#*#"
FULL_STEPS = 200.0
"""Default full steps per motor revolution, as in Klipper."""
MOST_INCLUDED_FILES = 64
MOST_WILDCARD_PARTS = 3
"""Bound on the folders and files of an include that have wildcards, as links may make a circle."""
LOG_HEADING, LOG_END = "===== Config file =====", "======================="
"""Lines before and after a configuration in klippy.log."""
_HEADER = re.compile(r"#\*# <-+ SAVE_CONFIG -+>")
_SECTION = re.compile(r"\[([^\]]+)\]")
_ENTRY = re.compile(r"([A-Za-z_]\w*)\s*[:=](.*)")

Sections = dict[str, dict[str, tuple[str, str]]]
"""Entries by section and name: the text of each, and its place in the file."""
Line = tuple[str, str]
"""A line's place, for messages, and its text."""


@dataclass(frozen=True)
class KlipperConfig:
    """Entries of a configuration and of the files that it includes.

    label : the file's name, for messages. missing : included files that are not there, with the
    places of their lines.
    """

    label: str
    entries: Sections
    missing: tuple[tuple[str, str], ...] = ()

    __repr__ = short_repr

    def number(self, section: str, name: str, default: float | None = None) -> float:
        """Number in a section.

        Raises InputError if it is not a number within bounds, or missing without a default.
        """
        if name not in self.entries.get(section, {}):
            if default is not None:
                return default
            whole = section in self.entries
            raise missing_value(
                name if whole else f"[{section}]",
                f"{self.label}, [{section}]" if whole else self.label,
                f"{name}: a number" if whole else f"[{section}] with {name}",
                self._places(section)
                if whole
                else {f"[{one}]": self.label for one in self.entries},
                KEYS if whole else SECTIONS,
                next_step=None
                if not self.missing
                else f"Put {self.missing[0][0]}, which {self.missing[0][1]} includes, beside"
                f" {self.label}, if that has it",
            )
        text, where = self.entries[section][name]
        return printer_number(text, name, where)

    def _places(self, section: str) -> dict[str, str]:
        """Places of a section's entries by name."""
        return {name: place for name, (_, place) in self.entries.get(section, {}).items()}

    def positive(self, section: str, name: str, default: float | None = None) -> float:
        """Number in a section that must be positive. Raises InputError otherwise."""
        value = self.number(section, name, default)
        if value <= 0:
            text, where = self.entries[section][name]
            raise InputError(
                f"{name} is no number that a printer can have",
                where=where,
                found=quoted(text),
                expected="a number above zero",
            )
        return value

    def by_stepper(self, steppers: Sequence[str], name: str, *, positive: bool) -> list[float]:
        """A number of each stepper's section; the first one's is the default of the others."""
        value = self.positive if positive else self.number
        first, *others = (f"stepper_{one}" for one in steppers)
        default = value(first, name)
        return [default, *(value(section, name, default) for section in others)]

    @property
    def has_steps(self) -> bool:
        """Whether the first stepper's travel for a step is stated."""
        names = self.entries.get("stepper_a", {}).keys()
        return "step_distance" in names or {"rotation_distance", "microsteps"} <= names

    def step(self, section: str) -> float:
        """Travel of a stepper for one step, mm."""
        # the other steppers default to the first
        first, own = self.entries.get("stepper_a", {}), self.entries.get(section, {})
        stated = own if own.keys() & {"rotation_distance", "step_distance"} else first
        both = KlipperConfig(self.label, {section: {**first, **own}}, self.missing)
        if "step_distance" in stated and "rotation_distance" not in stated:
            return both.positive(section, "step_distance")
        turn = both.positive(section, "rotation_distance")
        micro = both.positive(section, "microsteps")
        full = both.positive(section, "full_steps_per_rotation", FULL_STEPS)
        text, where = both.entries[section].get("gear_ratio", ("1:1", ""))
        try:
            pairs = [
                [float(x) for x in part.split(":")] for part in text.split(",") if part.strip()
            ]
        except ValueError:
            pairs = [[np.nan]]
        if any(len(p) != 2 or not all(0 < x <= LARGEST_PRINTER_VALUE for x in p) for p in pairs):
            raise InputError(
                "the gears cannot be read",
                where=where,
                found=quoted(text),
                expected="such as 80:20",
            )
        return turn / (full * micro * prod(a / b for a, b in pairs))

    def remarks(self) -> tuple[str, ...]:
        """Sentences on included files that are missing, misspelt names, and step_distance."""
        out = [
            f"{place} includes {spec}, which is not there; values in it are not read."
            for spec, place in self.missing
        ]
        for section in self.entries:
            if section == "printer" or section.startswith("stepper_"):
                out += misspelt_remarks(self._places(section), KEYS)
        old = self.entries.get("stepper_a", {})
        if "step_distance" in old and "rotation_distance" not in old:
            distance = self.positive("stepper_a", "step_distance")
            out.append(
                f"step_distance {distance:g} mm: Klipper has rotation_distance in its place since"
                " 2020, step_distance times microsteps times full_steps_per_rotation"
                + self._rotation_distance(distance)
            )
        return tuple(out)

    def _rotation_distance(self, step_distance: float) -> str:
        """End of the sentence on rotation_distance, with its value where it is unambiguous."""
        if "microsteps" not in self.entries["stepper_a"]:
            return "."
        revolution = step_distance * self.positive("stepper_a", "microsteps")
        name = "full_steps_per_rotation"
        if name in self.entries["stepper_a"]:
            return f": {revolution * self.positive('stepper_a', name):g}."
        turns = [revolution * full for full in (FULL_STEPS, 2 * FULL_STEPS)]
        return f": {turns[0]:g} for a motor of 200 full steps, {turns[1]:g} for one of 400."


def read_config(text: str, path: Path) -> KlipperConfig:
    """Read a configuration and the files that it includes.

    path : of the text, which can be a klippy.log; the last configuration in it counts. Raises
    InputError for a saved block that Klipper would ignore, and for includes that cannot be
    followed: in a circle, of too many files, by wildcards beyond the folder, of no text.
    """
    numbered = [(f"{path.name}, line {n}", line) for n, line in enumerate(text.splitlines(), 1)]
    start, end = _logged(text)
    lines = numbered[start:end]
    if not start:
        _check_saved(text, path.name)
    own = [line for line in lines if not line[1].startswith(SAVED_LINE_MARK)]
    saved = [
        (place, line.removeprefix(SAVED_LINE_MARK).removeprefix(" "))
        for place, line in lines
        if line.startswith(SAVED_LINE_MARK)
    ]
    includes = _Includes()
    entries: Sections = {}
    # SAVE_CONFIG's lines first, so that the others override them
    for chunk in (saved, *includes.chunks(own, path, ())):
        _parse(chunk, entries)
    return KlipperConfig(path.name, entries, tuple(includes.missing))


def console_of(text: str) -> str:
    """What Klipper printed below its last configuration in a klippy.log; other texts are whole."""
    start, end = _logged(text)
    return "\n".join(text.splitlines()[end:]) if start else text


def _logged(text: str) -> tuple[int, int]:
    """First line of the last configuration in a klippy.log and the line after it, from 0; all lines
    of another text.
    """
    lines = text.splitlines()
    start = max((n for n, line in enumerate(lines, 1) if line == LOG_HEADING), default=0)
    if not start:
        return 0, len(lines)
    end = next((n for n, line in enumerate(lines[start:], start) if line == LOG_END), len(lines))
    return start, end


def _parse(lines: Iterable[Line], entries: Sections) -> None:
    """Add the entries of lines; a line that is indented more than an entry continues its value."""
    section, where, indent = "", "", 0
    value: list[str] = []
    name = ""

    def end_entry() -> None:
        if name:
            entries[section][name] = "\n".join(value).strip(), where

    for place, line in lines:
        plain = re.split(r"(?:^|\s);", line.partition("#")[0])[0].rstrip()
        stripped = plain.lstrip()
        if name and len(plain) - len(stripped) > indent:
            value.append(stripped)
        elif head := _SECTION.match(stripped):
            end_entry()
            section, name = head[1].strip(), ""
            entries.setdefault(section, {})
        elif plain:
            end_entry()
            entry = _ENTRY.fullmatch(stripped) if section else None
            name, value = (entry[1].lower(), [entry[2].strip()]) if entry else ("", [])
            where, indent = f"{place}, [{section}]", len(plain) - len(stripped)
    end_entry()


@dataclass
class _Includes:
    """Files that are included; missing : those that are not there, with their lines' places."""

    missing: list[tuple[str, str]] = field(default_factory=list)
    number: int = 0

    def chunks(
        self, lines: Iterable[Line], path: Path, within: tuple[Path, ...]
    ) -> Iterator[list[Line]]:
        """Lines between includes, and those of included files in their places.

        path : the lines' file. within : the files that include it.
        """
        chunk: list[Line] = []
        for place, line in lines:
            head = _SECTION.match(line.partition("#")[0])
            if head is None or not head[1].startswith("include "):
                chunk.append((place, line))
                continue
            yield chunk
            chunk = []
            spec = head[1].removeprefix("include ").strip()
            for one in self._files(spec, path, place):
                if one.resolve() in (path.resolve(), *(outer.resolve() for outer in within)):
                    raise InputError(
                        "this file includes itself",
                        where=place,
                        found=quoted(line.strip()),
                        expected="files that do not include one another in a circle",
                        code="printer.include_circle",
                    )
                yield from self._included(one, place, (*within, path))
        yield chunk

    def _included(self, path: Path, place: str, within: tuple[Path, ...]) -> Iterator[list[Line]]:
        """Lines of an included file. Raises InputError for too many of them."""
        self.number += 1
        if self.number > MOST_INCLUDED_FILES:
            raise InputError(
                "too many files are included",
                where=place,
                expected=f"{MOST_INCLUDED_FILES} at most",
                next_step="Make a copy without macros, and include the printer's own files",
                code="printer.too_many_includes",
            )
        text = read_text(path, largest=LARGEST_WRITTEN_FILE)
        lines = ((f"{path.name}, line {n}", one) for n, one in enumerate(text.splitlines(), 1))
        yield from self.chunks(lines, path, within)

    def _files(self, spec: str, path: Path, place: str) -> list[Path]:
        """Files of an include; none is missing where it has wildcards."""
        folder, parts = path.parent, PurePath(spec).parts
        if not has_magic(spec):
            file = folder / spec
            try:
                there = file.exists()
            except (OSError, ValueError):  # a name that no file can have
                there = False
            if not there:
                self.missing.append((legible(spec), place))
            return [file] if there else []
        wild = sum(has_magic(part) for part in parts)
        if PurePath(spec).is_absolute() or ".." in parts or wild > MOST_WILDCARD_PARTS:
            raise InputError(
                "these wildcards are not followed",
                where=place,
                found=quoted(spec),
                expected="files in the configuration's own folder, with wildcards in at most"
                f" {MOST_WILDCARD_PARTS} parts",
                next_step="Name the file that has the printer's values without wildcards",
                code="printer.include_wildcards",
            )
        return [folder / one for one in sorted(glob(spec, root_dir=folder))]


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
            code="printer.saved_lines_dropped",
        )
