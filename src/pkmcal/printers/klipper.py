"""Klipper's printer.cfg: geometry of the delta, and bed points of DELTA_CALIBRATE.

Semantics: Klipper's configuration reference, klippy/kinematics/delta.py and
klippy/extras/delta_calibrate.py. SAVE_CONFIG writes lines that begin with ``#*#``. A value that
also occurs above SAVE_CONFIG's block is taken from above. If a line below SAVE_CONFIG's header
lacks the mark, or a marked line precedes the header, Klipper ignores the whole saved block
(klippy/configfile.py, _find_autosave_data). ``heightN_pos`` are steps of the three motors from
their end switches, ``heightN`` is the height of the nozzle above the bed there.
"""

from __future__ import annotations

import math
import re
from configparser import ConfigParser
from functools import partial
from itertools import count, takewhile
from math import prod

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.klipper import (
    KLIPPER_LINEAR_FREEDOMS,
    KLIPPER_STEPPERS,
    homed,
    klipper_carriage_heights,
)
from pkmcal.files import quoted
from pkmcal.printers.printer import CARRIAGE_STEP, LARGEST_PRINTER_VALUE, Printer, Touches

SAVED_LINE_MARK = "#*#"
_HEADER = re.compile(r"#\*# <-+ SAVE_CONFIG -+>")
FULL_STEPS = 200.0
"""Default full steps per motor revolution, as in Klipper."""
MOST_CARRIAGE_STEPS = 1e9
"""Bound on steps from an end switch; more would be kilometres of carriage travel."""
_SECTION = re.compile(r"\[([^\]]+)\]")
_ENTRY = re.compile(r"([A-Za-z_]\w*)\s*[:=](.*)")

Sections = dict[str, dict[str, tuple[str, str]]]
"""Entries by section and name: the text of each, and its place in the file."""


def is_one(text: str) -> bool:
    """Whether a text is a Klipper configuration."""
    return "printer" in sections(text, "")


def printer(text: str, label: str) -> Printer:
    """Printer of a printer.cfg.

    Raises InputError for kinematics other than delta, for missing or impossible values, and for a
    saved block that Klipper would ignore.
    """
    _check_saved(text, label)
    entries = sections(text, label)
    kinematics = entries["printer"].get("kinematics", ("", f"{label}, [printer]"))
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
            value(entries, label, f"stepper_{s}", name, value(entries, label, "stepper_a", name))
            for s in KLIPPER_STEPPERS
        ]
        for name, value in (("arm_length", _positive), ("position_endstop", _number))
    }
    by_tower["angle"] = [
        _number(entries, label, f"stepper_{s}", "angle", default)
        for s, default in zip(KLIPPER_STEPPERS, KLIPPER_LINEAR_FREEDOMS.nominal, strict=True)
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
        program="Klipper",
        label=label,
        motors=("stepper_a", "stepper_b", "stepper_c"),
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
