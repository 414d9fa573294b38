"""RepRapFirmware's M665 and M666, in config.g or in config-override.g, which M500 writes.

Semantics: see :mod:`pkmcal.exporters.reprap`.
"""

from __future__ import annotations

import re
from functools import partial

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.exporters.reprap import (
    REPRAP_TOWER_ANGLES,
    homed_carriages,
    read_words,
    reprap_carriage_heights,
)
from pkmcal.files import quoted
from pkmcal.printers.printer import LARGEST_PRINTER_VALUE, Printer

_M665 = re.compile(r"^[^\S\n]*M665\b", re.MULTILINE)
_OURS = re.compile(r"\s*M66[56]\b")


def is_one(text: str) -> bool:
    """Whether a text is G-code of a delta."""
    return bool(_M665.search(text))


def printer(text: str, label: str) -> Printer:
    """Printer of a file with M665 and M666; of repeated values the last counts.

    Raises InputError for missing, malformed or impossible values.
    """
    words, places = _checked_words(text, label)
    rod, radius, height, reach = (
        _words(words, label, "665" + letter, size)
        for letter, size in (("L", 3), ("R", 1), ("H", 1), ("B", 1))
    )
    for name, values in (("665L", rod), ("665R", radius), ("665H", height), ("665B", reach)):
        if values.min() <= 0:
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
    return Printer(
        program="RepRapFirmware",
        label=label,
        motors=("X", "Y", "Z"),
        radius=float(radius[0]),
        angle=np.array(REPRAP_TOWER_ANGLES) + corrections,
        rod=rod,
        homed=ends,
        reach=float(reach[0]),
        carriages=partial(reprap_carriage_heights, command),
    )


def _checked_words(text: str, label: str) -> tuple[dict[str, Array], dict[str, str]]:
    """Values by command and letter, of M665 and M666 only, and the line of each.

    Raises InputError for a line that holds no numbers within bounds.
    """
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if _OURS.match(line)]
    words: dict[str, Array] = {}
    places: dict[str, str] = {}
    for n, line in lines:
        try:
            value = read_words(line)
        except ValueError:
            value = {"": np.array([np.inf])}
        # NaN and infinity fail this comparison as well
        if any(not np.abs(v).max() <= LARGEST_PRINTER_VALUE for v in value.values()):
            raise InputError(
                "a value of this line is no number that a printer can have",
                where=f"{label}, line {n}",
                found=quoted(line.strip()),
                expected="numbers in mm, or degrees",
            )
        words.update({name.upper(): values for name, values in value.items()})
        places.update({name.upper(): f"{label}, line {n}" for name in value})
    return words, places


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
            next_step="Name the file in which M665 has L, R, H and B: after M500 that is"
            " config-override.g",
        )
    return np.broadcast_to(values, (size,)).copy()
