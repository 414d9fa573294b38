"""Contract of firmwares of delta printers, whose configurations pkmcal reads and writes.

A firmware is one file in this folder with a subclass of :class:`Firmware`: an export format that
also reads a printer's own configuration and the points of the bed that it probed. Reading and
writing share the firmware's names, units, signs and formulas.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import ClassVar

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError
from pkmcal.exporters.contract import (
    Difference,
    ExportedValue,
    Exporter,
    commented,
    exporters,
    largest,
)
from pkmcal.exporters.delta import Fit, Freedoms, fit_of, value_sigmas
from pkmcal.exporters.delta_texts import (
    STEPS_ROUNDING,
    SWITCH_ROUNDING,
    Inverse,
    corrected_steps,
    firmware_tool_difference,
    readings_elsewhere,
    switch_values,
    workspace_radius,
)
from pkmcal.files import closest, quoted, read_log
from pkmcal.firmware.cables import check_millimetres
from pkmcal.outcome.finding import Finding, doubtful, note
from pkmcal.wording import listed

CARRIAGE_STEP = 1 / 80
"""Default carriage travel per step, mm.

200 full steps of 16 microsteps, belts of 2 mm pitch on 20 teeth, as on most printers.
"""
LARGEST_PRINTER_VALUE = 1e6
"""Bound on lengths (mm) and angles (degrees); larger values would overflow when squared."""
TOWER_ANGLES = (210.0, 330.0, 90.0)
"""Usual directions of the towers X, Y and Z, degrees, counted anticlockwise."""
LEAST_LIKENESS = 0.8
"""Likeness, by difflib, of a misspelt key: twice the equal letters over all letters of both keys,
with one wrong letter of five. A similar key is named in a message and never read."""
LEAST_PRIOR_SIGMA = 1e-4
"""Prior sigma, mm, degrees or steps, below which a value is fixed: that of the written digits."""
NUMBER = r"(-?\d+(?:\.\d+)?)"
"""Pattern of a number that a console prints."""


@dataclass(frozen=True)
class Touches:
    """Probed points of the bed.

    carriages : (n, 3) mm, positions of the carriages at contact.
    heights : (n,) mm, height of the tool's tip above the bed at these positions.
    origin : the file they were read from, for messages.
    sigma : standard deviation of the probe, mm, by the same file; None where unknown.
    """

    carriages: Array
    heights: Array
    origin: str
    sigma: float | None = None

    __repr__ = short_repr


@dataclass(frozen=True)
class PrintedPart:
    """Marks that the tool left on a printed part, and N distances between them, mm.

    label : the file that they were read from.
    names : of the marks, n.
    carriages : (n, 3) heights of the carriages when the marks were printed.
    between : (N, 2) indices of marks.
    distance : (N,) when the part was warm, its shrinkage undone.
    noise : standard deviation of a distance; None for the default.
    shrinkage : share by which the part shrank as it cooled.
    """

    label: str
    names: tuple[str, ...]
    carriages: Array
    between: Integers
    distance: Array
    noise: float | None = None
    shrinkage: float = 0.0

    __repr__ = short_repr

    @classmethod
    def of_pairs(cls, first: Array, second: Array, distance: Array, label: str) -> PrintedPart:
        """Part whose N distances have two marks of their own each.

        first, second : (N, 3) heights of the carriages at these, mm.
        """
        n = len(distance)
        return cls(
            label=label,
            names=tuple(f"m{k:02d}{end}" for k in range(1, n + 1) for end in "ab"),
            carriages=np.stack([first, second], axis=1).reshape(-1, 3),
            between=np.arange(2 * n).reshape(n, 2),
            distance=distance,
        )


@dataclass(frozen=True)
class Printer:
    """Geometry of a linear delta in its firmware's own numbers, mm and degrees.

    label : name of the file, for messages.
    radius : radius of the towers' circle less that of the effector.
    angle : (3,) directions of the towers.
    rod : (3,) lengths of the rods.
    homed : (3,) heights of the carriages at their end switches.
    reach : print radius, None if unknown.
    carriages : map from tool points (n, 3) to carriage heights (n, 3), by the firmware's formulas.
    offset : (x, y, z) of the probe from the nozzle.
    touches : probed points in the same file that do not depend on its values, None for none.
    part : printed part with its distances, likewise.
    step : carriage travel per motor step.
    steps : (3,) motor steps per mm of carriage travel, None if unknown.
    height_offset : what the firmware's height at home contains beyond the nozzle's, None for a
        firmware whose values contain nothing else.
    remarks : sentences on what the file leaves open.
    """

    firmware: Firmware
    label: str
    radius: float
    angle: Array
    rod: Array
    homed: Array
    reach: float | None
    carriages: Callable[[Array], Array]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    touches: Touches | None = None
    part: PrintedPart | None = None
    step: float = CARRIAGE_STEP
    steps: Array | None = None
    height_offset: float | None = None
    remarks: tuple[str, ...] = ()

    __repr__ = short_repr


@dataclass(frozen=True)
class WrittenValues:
    """Values of a written file as the firmware reads them; motor positions in mm or degrees.

    inverse : motor positions (n, 3) at points (n, 3) mm, by the firmware's formulas.
    homed : (3,) motor positions at the end switches.
    homed_by : the same for other values (3,) of the end switches.
    print_radius : mm, None without one.
    steps : motor steps per mm, three or none.
    switches : readings of end switches elsewhere and the values that the text gives for them, (3,)
        each and NaN for a motor without; None for a text with values proportional to readings.
    end_rounding : rounding of `homed` beyond that of lengths, mm or degrees.
    others : differences of values that this firmware alone has.
    """

    inverse: Inverse
    homed: Array
    homed_by: Callable[[Array], Array]
    print_radius: float | None
    steps: Sequence[float] = ()
    switches: list[tuple[Array, Array]] | None = None
    end_rounding: float = 0.0
    others: tuple[Difference, ...] = ()


class Firmware(Exporter, ABC):
    """Firmware of delta printers. Firmwares are stateless, as all exporters.

    program : its name.
    configuration : the files that are read, in words.
    file : name of the exported file.
    comment : mark of a comment in the exported file.
    motors : names of the motors.
    carriage_source : where a user reads the heights of the carriages, in two lines.
    linear, rotary : free parameters of its kinematics; `rotary` is None without a rotary one.
    """

    program: ClassVar[str]
    configuration: ClassVar[str]
    file: ClassVar[str]
    comment: ClassVar[str] = ";"
    motors: ClassVar[tuple[str, str, str]] = ("X", "Y", "Z")
    carriage_source: ClassVar[str]
    linear: ClassVar[Freedoms] = Freedoms(TOWER_ANGLES)
    rotary: ClassVar[Freedoms | None] = None

    @abstractmethod
    def evidence(self, text: str, label: str) -> tuple[str, ...]:
        """Features of a text, in words, that only configurations of this firmware have.

        Commands that other firmwares have as well do not count: the meaning of M665 and M666
        depends on the firmware. label : name of the file.
        """

    @abstractmethod
    def printer(self, text: str, path: Path) -> Printer:
        """Printer of a configuration; path : its file, beside which included files are.

        Raises InputError for missing, malformed or impossible values.
        """

    def touched(self, text: str, path: Path, printer: Printer) -> Touches | None:
        """Probed points of the bed in a console's output or a file of the firmware.

        None for a text without any, and for a firmware whose points are not read. Raises InputError
        for points that cannot be read.
        """
        del text, path, printer
        return None

    def distances(self, text: str, label: str, printer: Printer) -> PrintedPart | None:
        """Distances on a printed part in a console's output; None for a text without any."""
        del text, label, printer
        return None

    @abstractmethod
    def text(self, fit: Fit, source: MachineSource) -> str:
        """Text of the exported file. Raises InputError for values that the firmware refuses."""

    @abstractmethod
    def named_values(self, fit: Fit, at: Fit) -> tuple[ExportedValue, ...]:
        """Values of the exported text that a calibration determines, under the firmware's names,
        before rounding.

        at : the exported fit, whose choices (such as the lowest switch) hold for fits beside it.
        """

    @abstractmethod
    def written(self, text: str, fit: Fit) -> WrittenValues:
        """Values of an exported text."""

    def has_print_radius(self, fit: Fit) -> bool:
        """Whether the firmware limits a delta of this kind to a print radius."""
        del fit
        return True

    def print_radius(self, fit: Fit) -> str | None:
        """Print radius of the exported file, mm, as written; None without one."""
        return workspace_radius(fit.delta.machine) if self.has_print_radius(fit) else None

    def steps(self, fit: Fit) -> Array | None:
        """Motor steps per mm (3,) of the exported file; None without any."""
        return corrected_steps(fit)

    def fit(self, source: MachineSource) -> Fit:
        """The firmware's parameters of a source's machine."""
        return fit_of(source, self.program, self.linear, self.rotary)

    def files(self, source: MachineSource) -> dict[str, str]:
        """The exported file; pins, speeds and the like remain the printer's own."""
        values = self.values(source)
        undetermined = [finding.text for finding in undetermined_values(values)]
        lines = [
            f"{one.name} = {one.value:.4f} {one.unit},"
            + (f" sigma {one.sigma:.2g}" if one.sigma else " exact")
            + (", mostly by the nominal model" if one.by_nominal else "")
            for one in values
            if one.sigma is not None
        ]
        head = ["Values and their standard deviations, before rounding:"] if lines else []
        text = self.text(self.fit(source), source)
        return {
            self.file: commented(undetermined, self.comment)
            + text
            + commented([*head, *lines], self.comment)
        }

    def values(self, source: MachineSource) -> tuple[ExportedValue, ...]:
        """The firmware's values, with the standard deviations that the calibration gives them."""
        fit = self.fit(source)
        freedoms = self.linear if fit.kind == "linear" or self.rotary is None else self.rotary

        def numbers(beside: Fit) -> Array:
            return np.array([one.value for one in self.named_values(beside, fit)])

        values, sigmas = self.named_values(fit, fit), value_sigmas(fit, freedoms, source, numbers)
        if sigmas is None:
            return values
        return tuple(
            one._replace(
                sigma=sigma,
                data_share=max(0.0, 1 - (sigma / prior) ** 2)
                if prior > LEAST_PRIOR_SIGMA
                else None,
            )
            for one, sigma, prior in zip(values, *map(np.ndarray.tolist, sigmas), strict=True)
        )

    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences by the firmware's formulas, with values read as the firmware reads them."""
        fit, text = self.fit(source), files[self.file]
        values = self.written(text, fit)
        zero = values.homed - fit.rate * fit.delta.ends[fit.order]
        # homing with the values that the text gives for switches at other readings
        switches = values.switches
        if switches is None:
            switches = [(q, switch_values(text, q)) for q in readings_elsewhere(fit)]
        off = [
            np.where(np.isnan(q), 0.0, values.homed_by(value) - (fit.rate * q + fit.zero))
            for q, value in switches
        ]
        radius, steps = self.print_radius(fit), self.steps(fit)
        same = values.print_radius == (None if radius is None else float(radius))
        expected = np.zeros(0) if steps is None else steps
        same_number = len(values.steps) == len(expected)
        motor_steps = Difference(
            "motor steps",
            largest(values.steps, expected) if same_number else np.inf,
            STEPS_ROUNDING,
            "steps per mm",
        )
        return [
            firmware_tool_difference(text, fit, values.inverse, zero, values.end_rounding),
            Difference(
                f"motors at end switches elsewhere, {len(off)} readings",
                largest(off) if off else np.inf,
                SWITCH_ROUNDING,
                "mm or degrees",
            ),
            Difference("print radius", 0.0 if same else np.inf, 0.0, "mm"),
            *([motor_steps] if len(values.steps) or len(expected) else []),
            *values.others,
        ]

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Values that the data left to the nominal model, agreement of settings and machine, and
        the steps after installing the values of a calibration.
        """
        fit = self.fit(source)
        notes = (*undetermined_values(self.values(source)), fit.following)
        if not source.calibrated:
            return notes
        radius = self.print_radius(fit)
        limit = "print radius" if radius is None and self.has_print_radius(fit) else None
        bed = "unknown" if source.bed is None else "probed"
        return (*notes, note("export.redo", radius=radius, limit=limit, bed=bed))


def undetermined_values(values: Sequence[ExportedValue]) -> tuple[Finding, ...]:
    """Warning with the names of values that the nominal model decides more than the data do; none
    without such values.
    """
    names = [one.name for one in values if one.by_nominal]
    if not names:
        return ()
    share = max(one.data_share or 0.0 for one in values if one.by_nominal)
    return (doubtful("export.by_nominal", names=names, data_share=share),)


def firmwares() -> list[Firmware]:
    """All firmwares, in alphabetical order."""
    return [one for one in exporters().values() if isinstance(one, Firmware)]


def buildable_delta(printer: Printer) -> Printer:
    """The printer, unchanged. Raises InputError if no delta with these values can be built."""
    check_millimetres(float(printer.rod.max()), printer.label)
    if not 0 < printer.radius < printer.rod.min():
        raise InputError(
            "a rod has to be longer than the delta radius",
            where=printer.label,
            found=f"rods of {printer.rod.min():g} mm, a radius of {printer.radius:g} mm",
            expected="both in mm, as the firmware has them",
        )
    # towers closer than half of their regular spacing: a delta is singular where two coincide, and
    # works with all three on one side of the bed. Not checked with other spacings
    apart = np.sort(np.mod(printer.angle, 360))
    gaps = np.diff(np.append(apart, apart[0] + 360))
    if gaps.min() < 60:
        raise InputError(
            "two towers are less than 60 degrees apart",
            where=printer.label,
            found=", ".join(f"{a:g}" for a in printer.angle) + " degrees",
            expected="three directions about 120 degrees apart",
        )
    return printer


def read_printer(path: Path, firmware: str | None = None) -> Printer:
    """Read a printer from a configuration of one of the firmwares.

    firmware : name of the firmware, for a file that does not show which one it is of.

    Raises InputError for a file without evidence of a firmware or with that of several, and for a
    printer that is not a linear delta.
    """
    label = path.name
    text = read_log(path)
    return buildable_delta(firmware_of(text, label, firmware).printer(text, path))


def firmware_of(text: str, label: str, name: str | None = None) -> Firmware:
    """The firmware that a configuration is of.

    name : of the firmware by the user; it decides unless the text has evidence of others alone.

    Raises InputError if the text does not decide, and for an unknown name.
    """
    by_name = {one.name: one for one in firmwares()}
    if name is not None and name not in by_name:
        guess = closest(name, by_name)
        raise InputError(
            "there is no such firmware",
            where="--firmware",
            found=quoted(name),
            expected=(f"{guess}, or another of " if guess else "") + listed(list(by_name)),
        )
    claims = {one.name: one.evidence(text, label) for one in by_name.values()}
    claims = {one: reasons for one, reasons in claims.items() if reasons}
    if name is not None and (name in claims or not claims):
        return by_name[name]
    if name is None and len(claims) == 1:
        return by_name[next(iter(claims))]
    words = [f"{by_name[one].program} ({reasons[0]})" for one, reasons in claims.items()]
    if claims:
        raise InputError(
            "this file shows another firmware than the one named"
            if name is not None
            else "this file shows two firmwares"
            if len(claims) == 2
            else "this file shows several firmwares",
            where=label,
            found=" and ".join(words),
            expected="the values of one firmware: signs and meanings differ between them",
            next_step="Leave out --firmware"
            if name is not None
            else f"Keep one firmware's lines, or name it: --firmware {' or '.join(claims)}",
        )
    first = next((line.strip() for line in text.splitlines() if line.strip()), "an empty file")
    raise InputError(
        "nothing in this file shows which firmware of a delta it is of",
        where=label,
        found=quoted(first),
        expected=", or ".join(one.configuration for one in by_name.values()),
        next_step="Name the file that holds these values, or its firmware with --firmware"
        f" ({listed(list(by_name))}): the meaning of M665 and M666 depends on it",
    )


def touches_at(
    points: Array, height: float, printer: Printer, label: str, sigma: float | None = None
) -> Touches:
    """Touches of the tool at points (n, 3) mm, at one height above the bed.

    label : the file that they are from. sigma : of the probe, mm. Raises InputError for points that
    the printer does not reach.
    """
    carriages = reachable_carriages(points, printer, label)
    return Touches(carriages, np.full(len(points), height), label, sigma)


def travel_without_start(label: str, found: str, expected: str, next_step: str) -> InputError:
    """Error for heights that are only how far the probe moved, from a height that is not stated."""
    return InputError(
        "these points of the bed have no heights, only how far the probe moved from a height that"
        " the firmware does not print",
        where=label,
        found=quoted(found),
        expected=expected,
        next_step=next_step,
        code="printer.probe_travel",
    )


def printer_number(
    text: str,
    name: str,
    where: str,
    *,
    line: str = "",
    expected: str = "a number in mm, or degrees",
) -> float:
    """Number in a firmware's configuration.

    name : of the value in messages. line : text for messages, where the number's own is not enough.
    Raises InputError for what is no number within LARGEST_PRINTER_VALUE.
    """
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) <= LARGEST_PRINTER_VALUE:
        raise InputError(
            f"{name} is no number that a printer can have",
            where=where,
            found=quoted(line or text),
            expected=expected,
        )
    return value


def reachable_carriages(points: Array, printer: Printer, label: str) -> Array:
    """Carriages (n, 3) mm with the tool at points (n, 3) mm.

    label : the file that they are from. Raises InputError for points that the printer does not
    reach.
    """
    with np.errstate(all="ignore"):
        carriages = printer.carriages(points)
    bad = np.flatnonzero(~(np.abs(carriages) <= LARGEST_PRINTER_VALUE).all(axis=1))
    if bad.size:
        x, y, z = points[bad[0]]
        raise InputError(
            "the printer does not reach this point",
            where=label,
            found=f"x {x:g}, y {y:g}, z {z:g} mm",
            expected="the tool's own places, in mm, of the printer described in " + printer.label,
        )
    return carriages


def misspelt_keys(names: Mapping[str, str], legal: Collection[str]) -> dict[str, str]:
    """Names in a file that most likely mean one of a firmware's keys, as ``'delta_raduis' in line
    7``, by that key; keys that the file has are not meant.

    names : place by name, of all in the file or in a section of it. legal : the keys that are read.
    """
    absent = {key.lower(): key for key in legal if key not in names}
    out: dict[str, str] = {}
    for name, place in names.items():
        if name not in legal:
            near = get_close_matches(name.lower(), absent, n=1, cutoff=LEAST_LIKENESS)
            out.update({absent[key]: f"{quoted(name)} in {place}" for key in near})
    return out


def misspelt_remarks(names: Mapping[str, str], legal: Collection[str]) -> tuple[str, ...]:
    """Sentence for each misspelt key; arguments as for :func:`misspelt_keys`."""
    return tuple(
        f"{found} is not read: did you mean {key}?"
        for key, found in misspelt_keys(names, legal).items()
    )


def missing_value(
    name: str,
    where: str,
    expected: str,
    names: Mapping[str, str],
    legal: Collection[str],
    next_step: str | None = None,
) -> InputError:
    """Error for a missing value of a printer, with the misspelt key that the file has instead.

    names, legal : as for :func:`misspelt_keys`.
    """  # fmt: skip
    instead = misspelt_keys(names, legal).get(name)
    return InputError(
        f"this value of the printer is missing: {name}",
        where=where,
        found=instead,
        expected=expected,
        next_step=next_step if instead is None else f"Did you mean {name}? Correct the name",
    )


def means_by_position(points: Array) -> Array:
    """Mean points (m, 3) of the points (n, 3) with equal x and y, in the order of first contact."""
    places = list(dict.fromkeys(map(tuple, points[:, :2].tolist())))
    return np.array([points[(points[:, :2] == place).all(axis=1)].mean(axis=0) for place in places])


def root_mean_square(texts: Sequence[str]) -> float | None:
    """Root mean square of standard deviations that a console printed; None without any above 0."""
    values = np.array(texts, dtype=float)
    return float(np.sqrt(np.mean(values**2))) or None if len(values) else None
