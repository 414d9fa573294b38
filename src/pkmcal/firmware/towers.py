"""Linear deltas as Marlin and Smoothieware have them: model, values of a fit, and texts.

Towers are at 210, 330 and 90 degrees and their corrections, counted anticlockwise, on one circle;
every rod has a length of its own. With the nozzle in the middle at its height at home, a carriage
is at ``height + sqrt(rod^2 - radius^2)``, and its switch triggers higher by the amount of an offset
that is not positive (M666): ``height + sqrt(rod^2 - radius^2) - offset``. RepRapFirmware adds the
adjustment of its M666 instead.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.errors import InputError
from pkmcal.exporters.contract import Difference, ExportedValue, largest
from pkmcal.exporters.delta import DEGREES_A_RADIAN, Fit
from pkmcal.exporters.delta_texts import (
    SWITCH_ROUNDING,
    end_switches,
    firmware_length,
    proportional_switches,
)
from pkmcal.firmware.contract import (
    CARRIAGE_STEP,
    TOWER_ANGLES,
    Firmware,
    Printer,
    WrittenValues,
    printer_number,
)

HEIGHT_AT_HOME = "Height of the nozzle at home: "
_ECHO = r"[^A-Za-z;]*(?:(?:recv|read)\b[^A-Za-z;]*)?echo:\s*"
_SENT = r"(?:[^A-Za-z;]*(?:recv|read|send|sent)\b[\s:>]*)?(?:N\d+\s*)?"
_COMMAND = re.compile(rf"(?:(?P<echo>{_ECHO})|{_SENT})([GM]\d+)\b(.*)", re.IGNORECASE)
"""Command of G-code, of a console's output, or of a host's log of it."""

Words = dict[str, tuple[float, str]]
"""Value and place in the file by command and letter, as ``665L``; the last one counts."""


@dataclass(frozen=True)
class Settings:
    """Values of a printer, mm and degrees.

    rod, angle, offset : (3,) lengths of the rods, directions of the towers, offsets of the end
        switches.
    radius_trims : (3,) what is added to the radius for each tower.
    height : of the nozzle at home.
    height_offset : what the firmware's own height at home contains beyond `height`, if it is kept.
    probe : (x, y, z) from the nozzle; NaN where unknown.
    reach : print radius, None if unknown.
    steps : (3,) motor steps per mm, None if unknown.
    remarks : sentences on what the file leaves open.
    """

    rod: Array
    radius: float
    angle: Array
    offset: Array
    height: float
    radius_trims: Array = field(default_factory=lambda: np.zeros(3))
    height_offset: float | None = None
    probe: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    reach: float | None = None
    steps: Array | None = None
    remarks: tuple[str, ...] = ()

    __repr__ = short_repr

    def printer(self, firmware: Firmware, label: str) -> Printer:
        """The printer of these values; label : name of its file.

        Towers on circles of their own stand on one circle about another middle. Raises InputError
        for towers on a line.
        """
        with np.errstate(invalid="ignore"):
            homed = switch_heights(self)
        radius, angle = self.radius, self.angle
        if self.radius_trims.any():
            towers = tower_places(self)
            chords = towers[1:] - towers[0]
            if np.linalg.matrix_rank(chords) < 2:
                raise InputError(
                    "the towers stand on one line",
                    where=label,
                    found=", ".join(f"{a:g}" for a in self.angle) + " degrees",
                    expected="three directions about 120 degrees apart",
                )
            middle = np.linalg.solve(2 * chords, np.sum(chords**2, axis=1))
            radius = float(np.linalg.norm(middle))
            x, y = (towers - towers[0] - middle).T
            # as far round as the firmware's own directions
            near = np.arctan2(y, x) * DEGREES_A_RADIAN
            angle = near + 360 * np.round((self.angle - near) / 360)
        return Printer(
            firmware=firmware,
            label=label,
            radius=radius,
            angle=angle,
            rod=self.rod,
            homed=homed,
            reach=self.reach,
            carriages=partial(tower_carriage_heights, self),
            offset=self.probe,
            step=CARRIAGE_STEP if self.steps is None else float(1 / self.steps.min()),
            steps=self.steps,
            height_offset=self.height_offset,
            remarks=self.remarks,
        )


def switch_heights(settings: Settings) -> Array:
    """Carriage heights (3,) mm at which the end switches trigger."""
    rise = np.sqrt(settings.rod**2 - (settings.radius + settings.radius_trims) ** 2)
    return settings.height + rise - settings.offset


def tower_places(settings: Settings) -> Array:
    """Places (3, 2) mm of the towers."""
    angle = settings.angle / DEGREES_A_RADIAN
    radius = settings.radius + settings.radius_trims
    return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def tower_carriage_heights(settings: Settings, points: Array) -> Array:
    """Carriage heights (n, 3) mm at points (n, 3) mm."""
    off = points[:, None, :2] - tower_places(settings)
    return points[:, 2:] + np.sqrt(settings.rod**2 - np.sum(off**2, axis=-1))


# Reading


@dataclass(frozen=True)
class Command:
    """Command with its line's number and words. echoed : whether ``echo:`` stands before it."""

    line: int
    code: str
    rest: str
    echoed: bool


def commands(text: str, codes: tuple[str, ...]) -> Iterator[Command]:
    """Commands with some of the codes, such as M665."""
    for n, line in enumerate(text.splitlines(), 1):
        match = _COMMAND.match(line.strip())
        if match and match[2].upper() in codes:
            rest = match[3].partition(";")[0].partition("*")[0]
            yield Command(n, match[2].upper(), rest.strip(), bool(match["echo"]))


def read_commands(text: str, label: str, codes: tuple[str, ...]) -> Words:
    """Words of commands. Raises InputError for words that are no numbers within bounds."""
    out: Words = {}
    for command in commands(text, codes):
        place = f"{label}, line {command.line}"
        for word in command.rest.split():
            if word.lower() == "sensorless":  # values of another kind follow
                break
            value = printer_number(
                word[1:],
                "a value of this line",
                place,
                line=f"{command.code} {command.rest}",
                expected="a letter and a number in mm, or degrees, in each word",
            )
            out[command.code[1:] + word[0].upper()] = value, place
    return out


def xyz_values(words: Words, code: str) -> Array | None:
    """Values (3,) of a command's letters X, Y and Z; None unless all are there."""
    names = [code + c for c in "XYZ"]
    return np.array([words[name][0] for name in names]) if words.keys() >= {*names} else None


def impossible(
    place: str, what: str, value: float, expected: str, next_step: str | None = None
) -> InputError:
    """Error for a value that the printer cannot have, or that cannot be used."""
    return InputError(
        f"{what} is no number that this printer can have",
        where=place,
        found=f"{value:g}",
        expected=expected,
        next_step=next_step,
    )


# Writing


def nozzle_heights(fit: Fit) -> Array:
    """Heights (3,) mm of the nozzle at which the carriages are at their switches."""
    return fit.end_motors - np.sqrt(fit.rod**2 - fit.radius**2)


def fitted_settings(fit: Fit, least_offset: float = 0.0) -> Settings:
    """Settings of a fit, with the largest height at home at which no offset is positive.

    least_offset : mm; if an offset is smaller but not 0, the height is lowered by as much.
    """
    heights = np.round(nozzle_heights(fit), 4)
    beyond = heights - heights.min()
    small = bool(((beyond > 0) & (beyond < least_offset)).any())
    height = float(heights.min()) - (least_offset if small else 0.0)
    return Settings(fit.rod, fit.radius, fit.angle, height - heights, height)


@dataclass(frozen=True)
class SettingNames:
    """A firmware's names of its settings; of each tower angle, rod's trim and switch.

    trims : none for a firmware with one length for all rods.
    """

    rod: str
    radius: str
    height: str
    angles: tuple[str, str, str]
    trims: tuple[str, ...]
    switches: tuple[str, str, str]


def named_settings(
    names: SettingNames, fit: Fit, at: Fit, least_offset: float = 0.0, height_offset: float = 0.0
) -> tuple[ExportedValue, ...]:
    """Settings of a fit before rounding: angles and rods as trims, switches as offsets, mm.

    at, least_offset : of the exported settings (:func:`fitted_settings`), in which the height at
        home is that of one switch, or lower by the least offset. height_offset : what the
        firmware's height contains beyond.
    """
    exported, heights = fitted_settings(at, least_offset), nozzle_heights(fit)
    least = int(np.argmin(nozzle_heights(at)))
    height = heights[least] + float(np.round(exported.offset[least], 4))
    rod = float(fit.rod.mean())
    numbers = (
        (names.rod, rod, "mm"),
        (names.radius, fit.radius, "mm"),
        (names.height, height + height_offset, "mm"),
        *zip(names.angles, fit.angle - np.array(TOWER_ANGLES), 3 * ["degrees"], strict=True),
        *((name, trim, "mm") for name, trim in zip(names.trims, fit.rod - rod, strict=False)),
        *zip(names.switches, height - heights, 3 * ["mm"], strict=True),
    )
    return tuple(ExportedValue(name, float(value), unit) for name, value, unit in numbers)


def switch_lines(fit: Fit, height: float, rule: str) -> list[str]:
    """Header lines on end switches elsewhere, and the height at home.

    rule : how the firmware's values follow from the heights.
    """
    names = [f"Z of {c}'s switch" for c in "XYZ"]
    return [
        end_switches(fit),
        *proportional_switches(fit, names, nozzle_heights(fit)),
        "These are heights of the nozzle. Its height at home is at most the least of them. " + rule,
        f"{HEIGHT_AT_HOME}{firmware_length(height)} mm.",
    ]


def stated_height(text: str) -> float:
    """Height of the nozzle at home by a text's header, mm."""
    return float(text.partition(HEIGHT_AT_HOME)[2].partition(" ")[0])


def written_values(
    text: str,
    settings: Settings,
    *,
    end_rounding: float = 0.0,
    others: tuple[Difference, ...] = (),
) -> WrittenValues:
    """Values of a written text, whose end switches elsewhere are heights of the nozzle.

    settings : of the text, as the firmware reads them. end_rounding, others : see `WrittenValues`.
    """
    rise = np.sqrt(settings.rod**2 - settings.radius**2)
    raised = settings.offset[settings.offset > 0]
    height = abs(settings.height - stated_height(text))
    return WrittenValues(
        inverse=partial(tower_carriage_heights, settings),
        homed=switch_heights(settings),
        homed_by=lambda heights: heights + rise,
        print_radius=settings.reach,
        steps=() if settings.steps is None else settings.steps.tolist(),
        end_rounding=end_rounding,
        others=(
            Difference("height at home", height, SWITCH_ROUNDING, "mm"),
            Difference("offsets above 0", largest(raised), 0.0, "mm"),
            *others,
        ),
    )


def lettered(letters: str, values: Array, write: Callable[[float], str]) -> str:
    """Values behind letters."""
    return " ".join(f"{c}{write(float(v))}" for c, v in zip(letters, values, strict=True))
