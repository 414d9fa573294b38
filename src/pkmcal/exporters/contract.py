"""Contract of export formats, and an export from start to end.

A format is one file in this folder, or in that of the firmwares, with a subclass of
:class:`Exporter`. It turns a
:class:`~pkmcal.calibration.machine_source.MachineSource` into texts and reads them again
independently, as the target program would: with that program's units, signs and formulas, from the
text alone. :func:`make_export` returns only texts that agree with the machine.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from inspect import isabstract
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError, ResultError, legible
from pkmcal.exporters.samples import samples
from pkmcal.files import check_own_folder, closest, write_folder
from pkmcal.levels import MAJORITY
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.disturbances import growth_by_readings, is_compliant, sag, tool_shift
from pkmcal.outcome.finding import Finding, Level, doubtful, note
from pkmcal.wording import listed

FORMAT_PACKAGES = ("pkmcal.exporters", "pkmcal.firmware")
"""Folders of plug-ins, each module of which may define a format."""

UNWARNED_ERROR = 5e-5
"""Largest error of the tool or of a reading without a warning, m: the repeatability of a good kit.
"""


@dataclass(frozen=True)
class Difference:
    """Difference of one quantity between a text, read again, and the machine.

    what : the quantity in words, as "readings at 64 poses".
    largest : largest difference, in ``unit``.
    limit : tolerance for rounding, or for a stated approximation of the format.
    """

    what: str
    largest: float
    limit: float
    unit: str = "m"

    @property
    def beyond(self) -> bool:
        """Whether the difference exceeds the limit; NaN counts as beyond."""
        return not self.largest <= self.limit


class ExportedValue(NamedTuple):
    """Value of a file under the target program's own name, and its standard deviation.

    unit : mm, degrees or steps.
    sigma : None for a machine without a covariance.
    data_share : share of the information that comes from the data, 1 - posterior variance / prior
        variance; None without a covariance, and for a value that the mechanism file fixes.
    """

    name: str
    value: float
    unit: str
    sigma: float | None = None
    data_share: float | None = None

    @property
    def by_nominal(self) -> bool:
        """Whether the nominal model decides the value more than the data do."""
        return self.data_share is not None and self.data_share < MAJORITY


class Exporter(ABC):
    """Format. Exporters are stateless; all data come from the source.

    name : word after ``--to``.
    title : description in words.
    trial : shell command that tries the files out in their folder.
    leaves : files that the trial leaves there; a later export removes them, so that an old result
        is not taken for the new one's.
    holds_screws : whether it has the screws that joints turn; other formats take readings to be
        lengths.
    holds_joint_offsets : whether it has universal joints whose axes do not meet; other formats have
        one centre for both axes.
    holds_effects : whether it has the sag under a load and the thermal growth; it is the mechanism
        file.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    trial: ClassVar[str] = ""
    leaves: ClassVar[tuple[str, ...]] = ()
    holds_screws: ClassVar[bool] = False
    holds_joint_offsets: ClassVar[bool] = False
    holds_effects: ClassVar[bool] = False

    @abstractmethod
    def files(self, source: MachineSource) -> dict[str, str]:
        """Texts by file name; nothing is written.

        Raises InputError if the format cannot express the machine.
        """

    @abstractmethod
    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """Differences between the texts, read as the target program reads them, and the machine."""

    def values(self, source: MachineSource) -> tuple[ExportedValue, ...]:
        """Values that the target program has names for; none where it takes the machine's own
        parameters.
        """
        del source
        return ()

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """Findings on the use of the files."""
        del source
        return ()


@cache
def exporters() -> dict[str, Exporter]:
    """All formats by name, in alphabetical order."""
    # import every module of the folders, so that its subclasses exist
    for package in FORMAT_PACKAGES:
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
            importlib.import_module(f"{package}.{module.name}")
    kinds: list[type[Exporter]] = [Exporter]
    for kind in kinds:  # grows on the way: subclasses of subclasses too
        kinds += kind.__subclasses__()
    formats: list[Callable[[], Exporter]] = [kind for kind in kinds if not isabstract(kind)]
    return {one.name: one for one in sorted((make() for make in formats), key=lambda one: one.name)}


def exporter_of(name: str) -> Exporter:
    """Format by name. Raises InputError for an unknown name."""
    formats = exporters()
    if name in formats:
        return formats[name]
    guess = closest(name, formats)
    raise InputError(
        "there is no such format to export to",
        found=name,
        expected=(f"{guess}, or another of " if guess else "") + listed(list(formats), 20),
    )


@dataclass(frozen=True)
class Export:
    """Texts by file name, their differences from the machine, findings on their use, and values."""

    exporter: Exporter
    files: dict[str, str]
    differences: tuple[Difference, ...]
    notes: tuple[Finding, ...]
    values: tuple[ExportedValue, ...]


def make_export(source: MachineSource, name: str, *, force: bool = False) -> Export:
    """Texts of a format, verified against the machine; nothing is written.

    Raises InputError for a machine that the format cannot express, and ResultError for a refused
    calibration (unless forced) and for a text that disagrees with the machine.
    """
    exporter = exporter_of(name)
    if not (source.usable or force):
        raise ResultError(
            "this calibration was refused, and is not exported: "
            + " ".join((source.headline, *source.reasons)),
            where=source.origin,
            next_step="Calibrate again; or export it with --force; its files then"
            " state that it was refused",
            code="calibration.refused",
        )
    more: list[Finding] = []
    machine = source.machine
    if len(machine.layout.screws) and not (exporter.holds_screws or exporter.holds_effects):
        poses, joints = samples(machine)
        source = replace(source, machine=machine.with_screws_held())
        change = largest(source.machine.inverse(poses), joints)
        more.append(_by_error(note("export.without_screws", program=name, largest=change)))
    if len(machine.layout.offsets) and not exporter.holds_joint_offsets:
        poses, joints = samples(source.machine)
        source = replace(source, machine=source.machine.with_meeting_axes(poses))
        change = largest(source.machine.inverse(poses), joints)
        more.append(_by_error(note("export.without_joint_offsets", program=name, largest=change)))
    if not exporter.holds_effects:
        more += _without_effects(machine, name)
    files = exporter.files(source)
    differences = tuple(exporter.check(files, source))
    for difference in differences:
        if difference.beyond:
            raise ResultError(
                f"the {name} files, read again, are not the machine ({difference.what});"
                " nothing was written",
                found=f"{difference.largest:.3g} {difference.unit}",
                expected=f"at most {difference.limit:.3g} {difference.unit}",
                next_step="This is a defect of pkmcal: report it, with the mechanism file",
                code="export.reads_otherwise",
            )
    notes, values = (*more, *exporter.notes(source)), exporter.values(source)
    return Export(exporter, files, differences, notes, values)


def _without_effects(machine: Machine, name: str) -> Iterator[Finding]:
    """Notes on sag and thermal growth, with what they do to the tool, at the compared poses."""
    compliant, growth = is_compliant(machine), machine.document.growth
    if not compliant and growth is None:
        return
    poses, joints = samples(machine)
    if compliant and machine.document.load is None:
        yield doubtful("export.without_stretch", program=name)
    elif compliant:
        sunk = np.linalg.norm(tool_shift(machine, poses, sag(machine, poses)), axis=-1)
        least = float(sunk.min())
        yield _by_error(
            note("export.without_sag", program=name, largest=largest(sunk), least=least)
        )
    if growth is not None:
        by = growth_by_readings(machine, joints, poses) @ np.array([growth.drives, growth.frame])
        moved = np.linalg.norm(tool_shift(machine, poses, by), axis=-1)
        yield note(
            "export.without_growth",
            program=name,
            temperature=growth.temperature,
            per_kelvin=largest(moved),
        )


def _by_error(finding: Finding) -> Finding:
    """Finding on an effect that a format has not, a warning if its largest error is above
    UNWARNED_ERROR.
    """
    small = finding.facts["largest"] <= UNWARNED_ERROR
    return finding if small else replace(finding, level=Level.DOUBTFUL)


def write_export(made: Export, folder: Path) -> None:
    """Write the files, all or none, and remove what a trial of earlier ones left."""
    leaves = made.exporter.leaves
    check_own_folder(folder, {*made.files, *leaves}, "this export", "an earlier export")
    write_folder(folder, made.files, over=leaves)


def exact(value: float) -> str:
    """Shortest decimal that parses to the same double; integers without a point."""
    return repr(float(value) + 0.0).removesuffix(".0")


def commented(lines: Iterable[str], mark: str) -> str:
    """Lines, each after a comment mark such as ``#`` or ``;``."""
    return "".join(f"{mark} {legible(line)}".rstrip() + "\n" for line in lines)


def largest(values: Any, expected: Any = 0.0) -> float:
    """Largest absolute difference of two arrays; 0 for empty ones."""
    off = np.asarray(values, dtype=float) - np.asarray(expected, dtype=float)
    return float(np.abs(off).max(initial=0.0))
