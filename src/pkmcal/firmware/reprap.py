"""RepRapFirmware: M665, M666 and M669 of deltas, read from config.g or config-override.g (which
M500 writes) and written by ``export --to reprap``, and bed points of G29 and G30.

M665 and M666 belong to linear deltas, M669 K10 and M666 to rotary ones; only printers of the first
are read. Semantics: Duet3D's G-code reference, and the firmware's LinearDeltaKinematics and
RotaryDeltaKinematics. Towers X, Y, Z are at -150, -30 and 90 degrees, with corrections counted
anticlockwise. A homed carriage is at ``H + sqrt(L^2 - R^2)`` plus its endstop adjustment, a homed
arm at the larger angle of A plus its adjustment. B is the print radius, beyond which the firmware
accepts no position; if omitted it remains as it was, 80 mm by default.

``G29`` writes heightmap.csv, and a sequence of ``G30 Pn X Y Z-99999`` that ends with S-1 prints
``G32 bed probe heights: ...``: places under the probe, with the tool's height when its tip would
touch the bed there. The tool is beside them by X and Y of ``G31`` (GCodes4.cpp, gridProbing;
Move.cpp, GetProbeCoordinates).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import ExportedValue, commented
from pkmcal.exporters.delta import DEGREES_A_RADIAN, MM_A_METRE, Fit, Freedoms
from pkmcal.exporters.delta_texts import (
    about,
    end_switches,
    firmware_angle,
    firmware_length,
    proportional_switches,
    steps_correction,
)
from pkmcal.files import quoted, read_text
from pkmcal.firmware.contract import (
    CARRIAGE_STEP,
    LARGEST_PRINTER_VALUE,
    NUMBER,
    Firmware,
    Printer,
    Touches,
    WrittenValues,
    printer_number,
    touches_at,
)
from pkmcal.wording import listed

REPRAP_TOWER_ANGLES = (-150.0, -30.0, 90.0)
STEEPEST_ARM_ANGLE = 90.0
NO_REPRAP_PRINT_RADIUS = (
    "There is no print radius, B: it stays the printer's own; where none was set it is 80 mm."
)
_WORD = re.compile(r"([A-Z])(-?[0-9.]+(?::-?[0-9.]+)*)")
OVERRIDE = "config-override.g"
"""File that M500 writes, and that M501 loads."""
FILE_NAMES = ("config.g", OVERRIDE)
OWN_WORDS = ("RepRapFirmware", OVERRIDE)
_OWN_COMMAND = re.compile(
    r"\s*(?:M665\b.*?[LR][\d.]+:|M666\b.*?[AB]-?[\d.]|M669 K|M584 |M569 P|M350 .*?I\d|M671 |M558 |"
    r"M307 )"
)
"""Commands, or their words, that Marlin has not: M666 A and B are the bed's tilt."""
_M665 = re.compile(r"^[^\S\n]*M665\b", re.MULTILINE)
_KINEMATICS = re.compile(r"^[^\S\n]*M669\b[^;\n]*?\sK(\d+)", re.MULTILINE)
LINEAR_DELTA, HANGPRINTER = "3", "6"
"""Numbers of kinematics behind M669 K; without M669, M665 makes the printer a linear delta."""
_PRINT_RADIUS = re.compile(r"^[^\S\n]*M665\b[^;\n]*\sB", re.MULTILINE)
_OURS = re.compile(r"\s*M(?:66[56]|501)\b")
HEIGHT_MAP_TITLE = "RepRapFirmware height map file"
_G30 = re.compile(r"^[^\S\n]*G30\b([^;\n]*)", re.MULTILINE | re.IGNORECASE)
_G30_WORD = re.compile(rf"([PXY])\s*{NUMBER}", re.IGNORECASE)
_G31 = re.compile(r"^[^\S\n]*G31\b([^;\n]*)", re.MULTILINE | re.IGNORECASE)
_G31_WORD = re.compile(r"([XY])\s*(-?[0-9.]+|\{)", re.IGNORECASE)
_HEIGHTS = re.compile(rf"bed probe heights:((?:\s+{NUMBER})+)", re.IGNORECASE)


@final
class RepRap(Firmware):
    """RepRapFirmware's commands."""

    name: ClassVar = "reprap"
    title: ClassVar = "RepRapFirmware: lines for config.g"
    program: ClassVar = "RepRapFirmware"
    configuration: ClassVar = "config.g or config-override.g with M665 (RepRapFirmware)"
    file: ClassVar = "pkmcal_delta.g"
    carriage_source: ClassVar = "what M114\nprints behind Count, divided by M92"
    linear: ClassVar = Freedoms(REPRAP_TOWER_ANGLES)
    rotary: ClassVar = linear

    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """The file's name, or words of this firmware alone, beside M665 or M669."""
        if not _M665.search(text) and not _KINEMATICS.search(text):
            return ()
        reasons = [f"it is called {label}"] if label.lower() in FILE_NAMES else []
        for n, line in enumerate(text.splitlines(), 1):
            names = [name for name in OWN_WORDS if name in line]
            if command := _OWN_COMMAND.match(line.partition(";")[0]):
                names.append(command[0].strip())
            if names:
                reasons.append(f"line {n} has {names[0]}")
                break
        return tuple(reasons)

    def printer(self, text: str, path: Path) -> Printer:
        """Printer of a file with M665 and M666; of repeated values the last counts.

        M501 loads config-override.g, with the values of the last M500, from the same folder.
        Raises InputError for missing, malformed or impossible values.
        """
        label = path.name
        for kind in list(_KINEMATICS.finditer(text))[-1:]:
            if kind[1] != LINEAR_DELTA:
                raise InputError(
                    "heights of a bed are read of linear deltas",
                    where=f"{label}, line {text.count(chr(10), 0, kind.start(1)) + 1}",
                    found=quoted(f"M669 K{kind[1]}"),
                    expected=f"M665, or M669 K{LINEAR_DELTA}",
                    next_step="Make a session of a Hangprinter: pkmcal new DIR --from FILE"
                    if kind[1] == HANGPRINTER
                    else None,
                )
        words, places, remarks = _checked_words(text, label, path.with_name(OVERRIDE))
        rod, radius, height = (
            _words(words, label, "665" + letter, size)
            for letter, size in (("L", 3), ("R", 1), ("H", 1))
        )
        # without B the print radius is what was set before
        reach = _words(words, label, "665B", 1) if _PRINT_RADIUS.search(text) else None
        for name, values in (("665L", rod), ("665R", radius), ("665H", height), ("665B", reach)):
            if values is not None and values.min() <= 0:
                raise InputError(
                    f"M665 {name[-1]} is no number that a printer can have",
                    where=places[name],
                    found=f"{values.min():g}",
                    expected="a number above zero",
                )
        # complete command: corrections and adjustments default to 0
        command = dict(words)
        command["665L"] = rod
        for name in ("665X", "665Y", "665Z", "666X", "666Y", "666Z", "666A", "666B"):
            command.setdefault(name, np.zeros(1))
        command["665R"], command["665H"] = radius[:1], height[:1]
        with np.errstate(invalid="ignore"):
            ends = homed_carriages(command)
        corrections = np.array([command[f"665{letter}"][0] for letter in "XYZ"])
        steps = _steps_per_mm(text, label)
        return Printer(
            firmware=self,
            label=label,
            radius=float(radius[0]),
            angle=np.array(REPRAP_TOWER_ANGLES) + corrections,
            rod=rod,
            homed=ends,
            reach=None if reach is None else float(reach[0]),
            carriages=partial(reprap_carriage_heights, command),
            offset=_probe_offset(text, path.with_name(OVERRIDE)),
            step=CARRIAGE_STEP if steps is None else float(1 / steps.min()),
            steps=steps,
            remarks=remarks,
        )

    def touched(self, text: str, path: Path, printer: Printer) -> Touches | None:
        """Points of a height map, or of lines G30 with the heights that they printed."""
        label = path.name
        values = _HEIGHTS.findall(text)
        if text.startswith(HEIGHT_MAP_TITLE):
            points = _height_map_points(text, label)
        elif values:
            points = _sequence_points(text, label, values[-1][0])
        else:
            return None
        if not np.isfinite(printer.offset[:2]).all():
            raise InputError(
                "where the probe is beside the nozzle is not known",
                where=printer.label,
                found="G31 with an expression in braces",
                expected="G31 with X and Y in mm",
                next_step="Write these numbers into a copy of that line; G31 without values prints"
                " them",
            )
        return touches_at(points - [*printer.offset[:2], 0.0], 0.0, printer, label)

    def text(self, fit: Fit, source: MachineSource) -> str:
        """Commands under a header of comments."""
        unit = "mm" if fit.kind == "linear" else "degree"
        steps = self.steps(fit)
        lines = about(source, fit, "XYZ", steps_correction(steps, unit))
        names = [f"M666 {letter}" for letter in "XYZ"]
        lines += [end_switches(fit), *proportional_switches(fit, names, _adjustments(fit))]
        radius = self.print_radius(fit)
        if radius is None:
            lines.append(NO_REPRAP_PRINT_RADIUS)
        commands = (_linear if fit.kind == "linear" else _rotary)(fit, radius)
        if steps is not None:
            commands.append(f"M92 {_letters(steps, firmware_length)} ; behind M350, steps per mm")
        return commented(lines, ";") + "\n".join(commands) + "\n"

    def named_values(self, fit: Fit, at: Fit) -> tuple[ExportedValue, ...]:
        """Letters of M665 and M666, or of M669 and M666 for arms."""
        del at
        corrections = fit.angle - np.array(REPRAP_TOWER_ANGLES)
        linear = fit.kind == "linear"
        if linear:
            homed = float((fit.end_motors - np.sqrt(fit.rod**2 - fit.radius**2)).mean())
            common = (("M665 R", fit.radius, "mm"), ("M665 H", homed, "mm"))
            lists = (("M665 L", fit.rod),)
        else:
            common = (("M669 R", fit.radius, "mm"),)
            lists = (("M669 U", fit.arm), ("M669 L", fit.rod), ("M669 H", fit.height))
        command, unit = ("M665", "mm") if linear else ("M669", "degrees")
        numbers = (
            *common,
            *((f"{name}, {c}", value, "mm") for name, values in lists
              for c, value in zip("XYZ", values, strict=True)),
            *((f"{command} {c}", value, "degrees")
              for c, value in zip("XYZ", corrections, strict=True)),
            *((f"M666 {c}", value, unit)
              for c, value in zip("XYZ", _adjustments(fit), strict=True)),
        )  # fmt: skip
        return tuple(ExportedValue(name, float(value), unit) for name, value, unit in numbers)

    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values as RepRapFirmware reads them."""
        words = read_words(text)
        linear = fit.kind == "linear"
        homed = homed_carriages if linear else homed_arms
        move = reprap_carriage_heights if linear else reprap_arm_angles

        def homed_by(values: Array) -> Array:
            adjusted = {f"666{c}": np.array([v]) for c, v in zip("XYZ", values, strict=True)}
            return homed({**words, **adjusted})

        radius = words.get("665B", words.get("669B"))
        return WrittenValues(
            partial(move, words),
            homed(words),
            homed_by,
            None if radius is None else radius[0],
            [words[f"92{c}"][0] for c in "XYZ" if f"92{c}" in words],
        )


# The firmware's words and formulas


def read_words(text: str) -> dict[str, Array]:
    """Values by command and letter, as ``665L``; text after a semicolon is a comment."""
    out: dict[str, Array] = {}
    for line in text.splitlines():
        command, _, rest = line.partition(";")[0].strip().partition(" ")
        for letter, values in _WORD.findall(rest):
            out[command[1:] + letter] = np.array([float(v) for v in values.split(":")])
    return out


def _xyz(words: dict[str, Array], command: str) -> Array:
    """Values (3,) of the letters X, Y and Z."""
    return np.array([words[command + letter][0] for letter in "XYZ"])


def homed_arms(words: dict[str, Array]) -> Array:
    """Arm angles (3,) degrees at the end switches."""
    return words["669A"][1] + _xyz(words, "666")


def homed_carriages(words: dict[str, Array]) -> Array:
    """Carriage heights (3,) mm at the end switches."""
    rise = np.sqrt(words["665L"] ** 2 - words["665R"] ** 2)
    return words["665H"] + rise + _xyz(words, "666")


def reprap_carriage_heights(words: dict[str, Array], points: Array) -> Array:
    """Carriage heights (n, 3) mm at points (n, 3) mm, by the firmware's linear Transform."""
    x, y, z, tower = *_xyz(words, "665"), words["665R"][0]
    towers = tower * np.array(
        [
            [-np.cos((30 + x) / DEGREES_A_RADIAN), -np.sin((30 + x) / DEGREES_A_RADIAN)],
            [np.cos((30 - y) / DEGREES_A_RADIAN), -np.sin((30 - y) / DEGREES_A_RADIAN)],
            [-np.sin(z / DEGREES_A_RADIAN), np.cos(z / DEGREES_A_RADIAN)],
        ]
    )
    d = points[:, None, :2] - towers
    tilt = points[:, 0] * words["666A"][0] / 100 + points[:, 1] * words["666B"][0] / 100
    rise = np.sqrt(words["665L"] ** 2 - d[..., 0] ** 2 - d[..., 1] ** 2)
    return rise + points[:, 2:] + tilt[:, None]


def reprap_arm_angles(words: dict[str, Array], points: Array) -> Array:
    """Arm angles (n, 3) degrees at points (n, 3) mm, by the firmware's rotary Transform.

    The arcsine limits angles to 90 degrees from the horizontal.
    """
    angle = (np.array(REPRAP_TOWER_ANGLES) + _xyz(words, "669")) / DEGREES_A_RADIAN
    along = points[:, :1] * np.cos(angle) + points[:, 1:2] * np.sin(angle)
    across = points[:, 1:2] * np.cos(angle) - points[:, :1] * np.sin(angle)
    r, h = words["669R"] - along, words["669H"] - points[:, 2:]
    a, b = 2 * words["669U"] * r, 2 * words["669U"] * h
    c = words["669L"] ** 2 - words["669U"] ** 2 - (h**2 + r**2 + across**2)
    square = a**2 + b**2
    return np.arcsin((b * c - a * np.sqrt(square - c**2)) / square) * DEGREES_A_RADIAN


# Reading


def _check_numbers(line: str, where: str) -> None:
    """Raise InputError for a line with an expression, which the firmware evaluates as it runs."""
    code = line.partition(";")[0].strip()
    if "{" in code:
        command = code.split()[0]
        raise InputError(
            f"{command} has an expression in braces, whose value only the printer knows",
            where=where,
            found=quoted(code),
            expected="numbers",
            next_step=f"Send {command} without values to the printer, which answers with those in"
            " force, and write these numbers into a copy of this line; or name config-override.g,"
            " which M500 writes",
        )


def _line_words(line: str, where: str) -> dict[str, Array]:
    """Values of one line. Raises InputError for a word that is no letter with numbers within
    bounds.
    """
    _, _, rest = line.partition(";")[0].strip().partition(" ")
    try:
        values = read_words(line)
    except ValueError:
        values = {"": np.array([np.inf])}
    # what remains of a line without its words, as of a decimal comma, is none; NaN fails as well
    if _WORD.sub("", rest).strip() or any(
        not np.abs(v).max() <= LARGEST_PRINTER_VALUE for v in values.values()
    ):
        raise InputError(
            "a value of this line is no number that a printer can have",
            where=where,
            found=quoted(line.strip()),
            expected="letters with numbers in mm, degrees or steps",
        )
    return values


def _checked_words(
    text: str, label: str, override: Path
) -> tuple[dict[str, Array], dict[str, str], tuple[str, ...]]:
    """Values by command and letter, of M665 and M666 only, the line of each, and remarks.

    override : the file that M501 loads; its values count where it exists. Raises InputError for a
    line that holds no numbers within bounds.
    """
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if _OURS.match(line)]
    remarks: tuple[str, ...] = ()
    words: dict[str, Array] = {}
    places: dict[str, str] = {}
    for n, line in lines:
        if line.split()[0] == "M501":
            if label == OVERRIDE:
                continue
            if override.is_file():
                saved = _checked_words(read_text(override), OVERRIDE, override)
                words |= saved[0]
                places |= saved[1]
                remarks = (f"{OVERRIDE} counts, which {label} loads with M501.",)
            else:
                remarks = (
                    f"{label} loads {OVERRIDE} with M501, which is not beside it: copy it there,"
                    " for its values count.",
                )
            continue
        _check_numbers(line, f"{label}, line {n}")
        value = _line_words(line, f"{label}, line {n}")
        words.update({name.upper(): values for name, values in value.items()})
        places.update({name.upper(): f"{label}, line {n}" for name in value})
    return words, places, remarks


def _probe_offset(text: str, override: Path) -> tuple[float, float, float]:
    """Offset (x, y, 0) of the probe from the nozzle, mm, by the last G31 with each; zeros without.

    NaN where an expression gives it. override : file that M501 loads, whose values count.
    """
    if any(line.split()[:1] == ["M501"] for line in text.splitlines()) and override.is_file():
        text += "\n" + read_text(override)
    out = {"X": 0.0, "Y": 0.0}
    for words in _G31.findall(text):
        for letter, number in _G31_WORD.findall(words):
            try:
                out[letter.upper()] = float(number)
            except ValueError:
                out[letter.upper()] = np.nan
    return out["X"], out["Y"], 0.0


def _steps_per_mm(text: str, label: str) -> Array | None:
    """Motor steps per mm (3,) of the last M92 with X, Y and Z; None without one.

    Raises InputError for impossible ones.
    """
    lines = [(n, line.partition(";")[0].strip()) for n, line in enumerate(text.splitlines(), 1)]
    steps: Array | None = None
    for n, line in lines:
        if line.startswith("M350 "):  # changes the steps that were set before
            steps = None
        if not line.startswith("M92 "):
            continue
        _check_numbers(line, f"{label}, line {n}")
        words = _line_words(line, f"{label}, line {n}")
        if {"92X", "92Y", "92Z"} <= words.keys():
            steps = np.array([words[f"92{c}"][0] for c in "XYZ"])
            if steps.min() <= 0:
                raise InputError(
                    "a value of this line is no number that a printer can have",
                    where=f"{label}, line {n}",
                    found=quoted(line),
                    expected="steps per mm above zero",
                )
    return steps


def _words(words: dict[str, Array], label: str, name: str, size: int) -> Array:
    """Values (size,) of a word; a single one stands for all.

    Raises InputError for any other number of values.
    """
    values = words.get(name, np.zeros(0))
    if len(values) not in (1, size):
        raise InputError(
            f"M{name[:-1]} has no value {name[-1]} that could be used",
            where=label,
            found=f"{len(values)} numbers",
            expected="one, or one for each tower" if size > 1 else "one",
            next_step="Name the file in which M665 has L, R and H: after M500 that is"
            " config-override.g",
        )
    return np.broadcast_to(values, (size,)).copy()


def _height_map_points(text: str, label: str) -> Array:
    """Points (n, 3) of heightmap.csv, mm. Raises InputError for a map without a valid grid."""
    lines = [line for line in text.splitlines()[1:] if line.strip()]
    names = [word.strip() for word in (lines[0] if lines else "").split(",")]
    values = [word.strip() for word in (lines[1] if len(lines) > 1 else "").split(",")]
    numbers = dict(zip(names, values, strict=False))

    def number_under(*called: str, above: float = -LARGEST_PRINTER_VALUE) -> float:
        """Number of the map's grid, under the first of several names that the map has."""
        text = next((numbers[name] for name in called if name in numbers), "")
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not above < value <= LARGEST_PRINTER_VALUE:
            raise InputError(
                "the height map does not define its grid",
                where=f"{label}, line 3",
                found=", ".join(values) or "nothing",
                expected=f"a number{'' if above else ' above zero'} under {called[0]}",
            )
        return value

    axes = [numbers.get(name, letter) for name, letter in (("axis0", "X"), ("axis1", "Y"))]
    if axes != ["X", "Y"]:
        raise InputError(
            "the height map is not of the axes X and Y",
            where=f"{label}, line 3",
            found=", ".join(axes),
            expected="X,Y",
        )
    # names since 3.3, since 1.19 and before, of RepRapFirmware
    x0, y0 = number_under("xmin", "min0"), number_under("ymin", "min1")
    dx = number_under("xspacing", "spacing0", "spacing", above=0.0)
    dy = number_under("yspacing", "spacing1", "spacing", above=0.0)
    rows = [line.split(",") for line in lines[2:]]
    size = tuple(
        next((numbers[name] for name in names if name in numbers), "")
        for names in (("xnum", "num0"), ("ynum", "num1"))
    )
    wrong = next((k for k, row in enumerate(rows, 1) if size[0] not in ("", str(len(row)))), None)
    if wrong is not None or size[1] not in ("", str(len(rows))):
        raise InputError(
            "the height map is not complete",
            where=label if wrong is None else f"{label}, row {wrong} of heights",
            found=f"{len(rows)} rows" if wrong is None else f"{len(rows[wrong - 1])} heights",
            expected=f"{size[1]} rows of {size[0]} heights, as line 3 has them",
            next_step="Copy the whole file from the printer, or probe with G29 again",
        )
    # RepRapFirmware writes a plain 0 for a point that was not probed
    out: list[tuple[float, float, float]] = []
    for k, row in enumerate(rows):
        for column, word in enumerate(row):
            if word.strip() in ("0", ""):
                continue
            place = f"{label}, row {k + 1} of heights"
            z = printer_number(word.strip(), "a height", place, expected="millimetres")
            out.append((x0 + column * dx, y0 + k * dy, z))
    return np.array(out).reshape(-1, 3)


def _sequence_points(text: str, label: str, heights: str) -> Array:
    """Points (n, 3), mm, from the lines ``G30 Pn`` and the heights of the last reply.

    Raises InputError if the numbers of the points do not match the heights.
    """
    z = [float(word) for word in heights.split()]
    places: dict[int, tuple[float, float]] = {}
    for words in _G30.findall(text):
        word_values = {letter.upper(): float(number) for letter, number in _G30_WORD.findall(words)}
        if word_values.keys() >= {"P", "X", "Y"}:
            places[int(word_values["P"])] = word_values["X"], word_values["Y"]
    if sorted(places) != list(range(len(z))):
        raise InputError(
            "heights and points do not belong together",
            where=label,
            found=f"{len(z)} heights, and lines G30 of the points"
            f" {listed([str(p) for p in sorted(places)]) or 'none'}",
            expected=f"lines G30 P0 to P{len(z) - 1} with X and Y, as in bed.g",
        )
    return np.array([(*places[k], height) for k, height in enumerate(z)])


# Writing


def _adjustments(fit: Fit) -> Array:
    """Endstop adjustments (3,), mm or degrees, relative to H or to the larger angle of A."""
    homed = fit.end_motors
    if fit.kind == "linear":
        homed = homed - np.sqrt(fit.rod**2 - fit.radius**2)
    return homed - homed.mean()


def _linear(fit: Fit, radius: str | None) -> list[str]:
    """Commands of a linear delta."""
    heights = fit.end_motors - np.sqrt(fit.rod**2 - fit.radius**2)
    homed = float(heights.mean())
    corrections = fit.angle - np.array(REPRAP_TOWER_ANGLES)
    return [
        "M669 K3 ; linear delta",
        f"M665 L{_by_tower(fit.rod)} R{firmware_length(fit.radius)} H{firmware_length(homed)}"
        + ("" if radius is None else f" B{radius}")
        + f" {_letters(corrections, firmware_angle)}"
        " ; L rods, R radius, H homed height"
        + ("" if radius is None else ", B the printer's own print radius"),
        f"M666 {_letters(_adjustments(fit), firmware_length)} A0 B0"
        " ; endstop adjustments, mm; no tilt",
    ]


def _rotary(fit: Fit, radius: str | None) -> list[str]:
    """Commands of a rotary delta. Raises InputError for arms beyond 90 degrees."""
    delta = fit.delta
    homed = float(fit.end_motors.mean())
    ranges = delta.machine.joint_ranges[delta.joint][fit.order]
    lowest = float((fit.rate[:, None] * ranges + fit.zero[:, None]).min())
    if lowest < -STEEPEST_ARM_ANGLE or homed > STEEPEST_ARM_ANGLE:
        raise InputError(
            "RepRapFirmware's rotary delta takes arms up to 90 degrees from the horizontal",
            found=f"arms from {lowest:.1f} to {homed:.1f} degrees",
            next_step="Give the cranks a smaller range in the mechanism file",
        )
    corrections = fit.angle - np.array(REPRAP_TOWER_ANGLES)
    low = float(MM_A_METRE * delta.positions[:, 2].min() + MM_A_METRE * fit.T_firmware_base[2, 3])
    high = float(MM_A_METRE * delta.positions[:, 2].max() + MM_A_METRE * fit.T_firmware_base[2, 3])
    return [
        f"M669 K10 U{_by_tower(fit.arm)} L{_by_tower(fit.rod)} H{_by_tower(fit.height)}"
        f" R{firmware_length(fit.radius)} A{firmware_angle(lowest)}:{firmware_angle(homed)}"
        + ("" if radius is None else f" B{radius}")
        + f" {_letters(corrections, firmware_angle)}"
        " ; U arms, L rods, H bearings' heights, R radius",
        f"M666 {_letters(_adjustments(fit), firmware_angle)}"
        " ; homed angles beyond A's larger one, degrees",
        f"; M208 Z{firmware_length(max(low, 0.0))}:{firmware_length(high)}"
        " ; Z of the workspace at most; set your own",
        "; M92: microsteps per degree of the arm, on X, Y and Z",
    ]


def _by_tower(values: Array) -> str:
    """Three lengths, separated by colons."""
    return ":".join(firmware_length(v) for v in values)


def _letters(values: Array, write: Callable[[float], str]) -> str:
    """Values after the letters X, Y and Z."""
    return " ".join(f"{letter}{write(float(v))}" for letter, v in zip("XYZ", values, strict=True))
