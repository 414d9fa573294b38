"""``hangprinter``: cable robots as RepRapFirmware's Hangprinter, M669 K6 and M666.

Semantics: the firmware's HangprinterKinematics without flex (no mover's weight W). The tool is a
point with all lines; line j goes to an anchor, and its position is its length less that in the
origin. With the mechanical advantage U, the line's share of the spool O, the build-up Q and the
spool's radius R in the origin, the spool turns by ``2 U / k2 (sqrt(R^2 + k2 position) - R)`` with
``k2 = -U O Q``; L and H are the teeth of motor and spool.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError, legible
from pkmcal.exporters.contract import Difference, Exporter, commented, largest
from pkmcal.exporters.samples import samples
from pkmcal.files import quoted
from pkmcal.firmware.cables import ANCHOR_SIGMA, anchors_from_origin
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import scales
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.starter.nominal import NominalLeg, NominalModel, millimetres
from pkmcal.starter.sources import StarterSource

HANGPRINTER_FILE = "hangprinter.g"
ANCHOR_LETTERS = "ABCDIJ"
"""Letters of the anchors in M669, in the firmware's order; the next is K, the kinematics itself."""
FEWEST_ANCHORS = 3
MOST_TEETH = 999
"""Largest number of teeth that stands for a gear's ratio."""
LINE_ROUNDING = 2e-7
"""Tolerance of a line's position, m: numbers are written to nine digits."""
SPOOL_LETTERS = "RUOLH"
"""Letters of M666 with a value for each axis."""
_K6 = re.compile(r"^[ \t]*M669[^;\n]*?[ \t]K6(?![0-9])", re.MULTILINE)
_COMMAND = re.compile(r"^[ \t]*(M669|M666)([^;\n]*)", re.MULTILINE)
_WORD = re.compile(r"([A-Z])([-+.,0-9:eE]+)")


@final
class Hangprinter(Exporter):
    """Anchors and spools of a cable robot for RepRapFirmware."""

    name: ClassVar = "hangprinter"
    title: ClassVar = "RepRapFirmware, Hangprinter: M669 K6 and M666"

    def files(self, source: MachineSource) -> dict[str, str]:
        """One file of commands. Raises InputError for a machine that is no point on lines."""
        machine = source.machine
        anchors, order = _anchors(machine), np.argsort(machine.layout.actuated)
        letters = ANCHOR_LETTERS[: machine.n_legs]
        lines = [
            f"Hangprinter by pkmcal: {legible(source.identity)}.",
            legible(source.headline),
            "Anchors in mm, base frame; the tool is the platform frame's origin.",
            "Home it at 0, 0, 0.",
            *(
                f"{letter} is leg {leg + 1}."
                for letter, leg in zip(letters, order.tolist(), strict=True)
            ),
        ]
        places = " ".join(
            f"{letter}{':'.join(_number(1e3 * x) for x in anchor)}"
            for letter, anchor in zip(letters, anchors[order], strict=True)
        )
        commands = [f"M669 K6 N{machine.n_legs} {places}"]
        if spools := _spools(machine):
            commands.append(
                "M666 "
                + " ".join(
                    f"{name}{':'.join(_number(values[j]) for j in order)}"
                    if name != "Q"
                    else f"Q{_number(values[0])}"
                    for name, values in spools.items()
                )
            )
        else:
            factor = scales(machine.layout, machine.values)
            if np.ptp(np.append(factor, 1.0)) > 0:
                lines.append(
                    "True lines over the readings, by which the spools' radii in M666 R are to be"
                    f" multiplied: {' '.join(f'{x:.6f}' for x in factor[order])}"
                )
        return {HANGPRINTER_FILE: commented(lines, ";") + "\n".join(commands) + "\n"}

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Motors' turns, or lines' positions, at poses all over the workspace."""
        machine = source.machine
        words = hangprinter_words(files[HANGPRINTER_FILE], HANGPRINTER_FILE)
        order = np.argsort(machine.layout.actuated)
        poses = samples(machine)[0]
        origin = np.eye(4)
        origin[:3, :3] = poses[0, :3, :3]
        readings = machine.inverse(poses) - machine.inverse(origin[None])
        # positions (n, L), m, of the lines
        anchors = 1e-3 * words["anchors"]
        apart = poses[:, None, :3, 3] - anchors
        line = np.sqrt(dot(apart, apart)) - np.linalg.norm(anchors, axis=1)
        if "R" not in words:
            true = readings * scales(machine.layout, machine.values)[order]
            return [Difference("lines' positions", largest(line, true), LINE_ROUNDING)]
        sign = np.sign([machine.document.legs[j].base.gear for j in order])
        # the motors' turns, as lengths of line on a spool without build-up
        turns = _motor_turns(words, line) - readings * sign
        off = turns * 1e-3 * words["R"] * words["L"] / (words["U"] * words["H"])
        return [Difference("motors' turns, as lengths of line", largest(off), LINE_ROUNDING)]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Values that the firmware has and the machine has not."""
        return (doubtful("export.hangprinter_flex", source.origin),)


def _number(value: float) -> str:
    """Number to nine digits, of mm to no less than a nanometre."""
    return f"{round(float(value), 6 if abs(value) > 1 else 12) + 0.0:.9g}"


def _refused(machine: Machine, what: str, expected: str) -> InputError:
    """Error for a machine that is no Hangprinter."""
    return InputError(
        f"mechanism {machine.name!r} is no Hangprinter: a point on lines from fixed anchors",
        found=what,
        expected=expected,
    )


def _anchors(machine: Machine) -> Array:
    """Anchors (L, 3), m, for a tool in the platform's origin. Raises InputError."""
    document, layout = machine.document, machine.layout
    if document.motion != "translation":
        raise _refused(machine, f"motion: {document.motion}", "motion: translation")
    for j, leg in enumerate(document.legs, 1):
        joint = leg.base.joint
        thin = joint in ("spherical", "universal") and layout.rod_reads[j - 1]
        if not (thin or (joint == "spool" and leg.base.radius is None)):
            drive = f"leg {j} on a {joint}" + (" with a pulley" if joint == "spool" else "")
            raise _refused(machine, drive, "lines through small eyes, read as lengths or at spools")
        if leg.platform.joint not in ("spherical", "universal"):
            raise _refused(machine, f"leg {j} on a {leg.platform.joint}", "joint: spherical")
    if len({leg.base.joint == "spool" for leg in document.legs}) > 1 or layout.shares_motors:
        raise _refused(machine, "different drives", "a motor of its own and one kind for each line")
    if not FEWEST_ANCHORS <= machine.n_legs <= len(ANCHOR_LETTERS):
        expected = f"{FEWEST_ANCHORS} to {len(ANCHOR_LETTERS)}"
        raise _refused(machine, f"{machine.n_legs} lines", expected)
    out = np.zeros((machine.n_legs, 3))
    for group in layout.base:
        out[group.legs] = group.of(machine.values)[..., :3]
    for group in layout.platform:
        out[group.legs] -= group.of(machine.values)[..., :3]
    return out


def _spools(machine: Machine) -> dict[str, Array]:
    """Values (L,) of the letters of M666 by leg, mm; empty for lines read as lengths.

    Raises InputError for what the firmware cannot express.
    """
    nodes = [leg.base for leg in machine.document.legs]
    if nodes[0].joint != "spool":
        return {}
    (group,) = machine.layout.base
    values = np.empty((machine.n_legs, 4))
    values[group.legs] = group.of(machine.values)[:, 7:11]
    spool, gear, lines, buildup = values.T
    # the radius holds at the origin, where the firmware's positions are zero
    origin = np.broadcast_to(machine.home(), (1, 4, 4)).copy()
    origin[:, :3, 3] = 0.0
    phi = machine.inverse(origin)[0][machine.layout.actuated] / gear
    radius = spool - buildup * phi / 2
    teeth = [Fraction(abs(x)).limit_denominator(MOST_TEETH) for x in gear.tolist()]
    if any(abs(t - abs(x)) > 1e-9 * abs(x) for t, x in zip(teeth, gear.tolist(), strict=True)):
        raise _refused(machine, f"a gear of {gear[0]:g}", "a ratio of two numbers of teeth")
    least = buildup.min()
    if least <= 0:
        raise _refused(
            machine, "a spool without build-up", "build-ups above 0, by which the firmware divides"
        )
    share = buildup / least
    if np.abs(share - np.rint(share)).max() > 1e-9 or np.abs(lines - np.rint(lines)).max() > 1e-9:
        raise _refused(
            machine, "parts of a line", "whole numbers of lines, and build-ups that are multiples"
        )
    return {
        "Q": np.full(len(spool), 1e3 * least),
        "R": 1e3 * radius,
        "U": lines,
        "O": share,
        "L": np.array([t.denominator for t in teeth], dtype=float),
        "H": np.array([t.numerator for t in teeth], dtype=float),
    }


# Reading


@final
class HangprinterConfiguration(StarterSource):
    """RepRapFirmware's configuration of a Hangprinter."""

    title: ClassVar = "a Hangprinter's configuration"
    recognised: ClassVar = "RepRapFirmware's line 'M669 K6' of a Hangprinter"

    def claims(self, text: str, path: Path) -> bool:
        """Whether a configuration makes RepRapFirmware a Hangprinter."""
        del path
        return _K6.search(text) is not None

    def read(
        self, text: str, path: Path, unit: str | None, given: Mapping[str, float]
    ) -> NominalModel:
        """Nominal model. Raises InputError for a configuration without the anchors."""
        del unit, given
        return _model(text, path.name)


def hangprinter_words(text: str, label: str) -> dict[str, Array]:
    """Anchors (n, 3) mm under ``anchors``, and M666's values (n,) by letter.

    Raises InputError for a configuration without anchors or with values that are no numbers.
    """
    given = _stated(text, label)

    def numbers(name: str, *sizes: int) -> Array:
        values, where = given[name]
        try:
            out = np.array([float(x) for x in values.split(":")])
        except ValueError:
            out = np.zeros(0)
        if len(out) not in sizes or not np.isfinite(out).all():
            raise InputError(
                f"{name[:4]} has no value {name[4:]} that could be used",
                where=where,
                found=quoted(values),
                expected=f"{' or '.join(map(str, sizes))} numbers",
            )
        return out

    letters = [c for c in ANCHOR_LETTERS if f"M669{c}" in given]
    if "".join(letters) != ANCHOR_LETTERS[: len(letters)] or len(letters) < FEWEST_ANCHORS:
        raise InputError(
            "M669 K6 does not give the anchors",
            where=label,
            found=", ".join(letters) or "none",
            expected="A, B, C and so on with x:y:z each, as in config-override.g after M500",
        )
    # older firmwares write the height of D alone, which is above the origin
    anchors = [numbers(f"M669{c}", 3, 1) if c == "D" else numbers(f"M669{c}", 3) for c in letters]
    n = len(letters)
    if "M669N" in given and not np.array_equal(numbers("M669N", 1), [n]):
        raise InputError(
            "M669 states another number of anchors than it gives",
            where=given["M669N"][1],
            found=f"N{given['M669N'][0]} with {', '.join(letters)}",
            expected=f"N{n}, or the other anchors",
        )
    out = {"anchors": np.array([a if len(a) == 3 else [0.0, 0.0, a[0]] for a in anchors])}
    if "M666R" not in given:
        return out
    if missing := [c for c in (*SPOOL_LETTERS, "Q") if f"M666{c}" not in given]:
        raise InputError(
            "M666 does not describe the spools",
            where=label,
            found=f"no {', '.join(missing)}",
            expected=f"Q, and {', '.join(SPOOL_LETTERS)} with a value for each axis",
        )
    for letter in (*SPOOL_LETTERS, "Q"):
        name = f"M666{letter}"
        out[letter] = numbers(name, 1 if letter == "Q" else n)
        # lines may be so thin that they build up nothing
        least = 0.0 if letter == "Q" else np.finfo(float).tiny
        if out[letter].min() < least:
            raise InputError(
                f"M666 {letter} is no number of a spool",
                where=given[name][1],
                found=quoted(given[name][0]),
                expected="0 or more" if letter == "Q" else "above 0",
            )
    return out


def _stated(text: str, label: str) -> dict[str, tuple[str, str]]:
    """Values of M669 and M666 as text, and their places, by command and letter; the last counts.

    Raises InputError for words that are no letter with numbers.
    """
    given: dict[str, tuple[str, str]] = {}
    for match in _COMMAND.finditer(text):
        where = f"{label}, line {text.count(chr(10), 0, match.start(1)) + 1}"
        if rest := _WORD.sub("", match.group(2)).split():
            raise InputError(
                f"a word of {match.group(1)} is no letter with numbers",
                where=where,
                found=quoted(rest[0]),
                expected="numbers, with colons between those of several axes",
            )
        for letter, values in _WORD.findall(match.group(2)):
            given[match.group(1) + letter] = values, where
    return given


def _model(text: str, label: str) -> NominalModel:
    """Nominal model of a Hangprinter by its configuration: readings are the motors' turns if M666
    gives the spools, and otherwise the lines' positions. Raises InputError.
    """
    words = hangprinter_words(text, label)
    anchors = anchors_from_origin(
        words["anchors"], [f"{label}, M669 {c}" for c in ANCHOR_LETTERS[: len(words["anchors"])]]
    )
    lengths = np.linalg.norm(anchors, axis=1)
    reads = "the lines' positions: their lengths less those in the origin"
    if spools := "R" in words:
        reads = "the motors' turns from the origin, positive where the line becomes longer"
    legs: list[NominalLeg] = []
    for j, (anchor, length) in enumerate(zip(anchors, lengths.tolist(), strict=True)):
        center = ", ".join(millimetres(x) for x in anchor)
        base = f"{{joint: spherical, center: [{center}]}}"
        rod = f"{{actuated: true, offset: {millimetres(length)}}}"
        if spools:
            buildup = 1e-3 * float(words["Q"][0] * words["O"][j])
            base = (
                f"{{joint: spool, center: [{center}], spool: {millimetres(1e-3 * words['R'][j])},"
                f" gear: {float(words['H'][j] / words['L'][j]):.12g},"
                f" lines: {float(words['U'][j]):g}, buildup: {buildup:.9g}}}"
            )
            rod = f"{{actuated: false, constant: {millimetres(length)}}}"
        legs.append(NominalLeg(base, rod, anchor, np.zeros(3)))
    # above the origin, in which some anchors may lie in one plane with the tool
    home = np.array([0.0, 0.0, 0.25 * max(float(anchors[:, 2].max()), float(lengths.min()))])
    return NominalModel(
        "hangprinter",
        (
            f"A Hangprinter by the values in {legible(label)}: a point on lines from anchors."
            f" Readings are {reads}.",
        ),
        (),
        "translation",
        tuple(legs),
        home,
        sigma=ANCHOR_SIGMA,
    )


# The firmware's formulas


def _motor_turns(words: dict[str, Array], positions: Array) -> Array:
    """Turns (n, L) of the motors, rad, at positions (n, L), m."""
    radius, lines = 1e-3 * words["R"], words["U"]
    growth = 1e-3 * words["Q"][0] * words["O"] * lines
    with np.errstate(divide="ignore", invalid="ignore"):
        turns = 2 * lines / growth * (radius - np.sqrt(radius**2 - growth * positions))
    turns = np.where(growth > 0, turns, lines * positions / radius)
    return turns * words["H"] / words["L"]
