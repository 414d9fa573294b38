"""What a format of other programs offers, and an export from start to end.

A format is one file in this folder: a subclass of :class:`Exporter`, which turns a
:class:`~pkmcal.calibration.machine_source.MachineSource` into texts and reads them again by itself,
as the other program would: with that program's units, signs and formulas, and with nothing of ours
but the text. :func:`make_export` gives out only what agrees with the machine.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from pkmcal.calibration.machine_source import MachineSource
from pkmcal.errors import InputError, ResultError, legible
from pkmcal.files import check_own_folder, closest, write_folder
from pkmcal.outcome.finding import Finding
from pkmcal.wording import listed


@dataclass(frozen=True)
class Difference:
    """How far a text read again is from the machine it was made of, in one quantity.

    what : the quantity in words, "readings at 64 poses". largest : the largest difference, in unit.
    limit : what rounding, or a format that says less and said so, accounts for.
    """

    what: str
    largest: float
    limit: float
    unit: str = "m"

    @property
    def beyond(self) -> bool:
        """Whether it is more than the limit; a difference that is no number is."""
        return not self.largest <= self.limit


class Exporter(ABC):
    """One format. Exporters have no state; all is in the source.

    name : the word after ``--to``. title : what it is, for people. trial : a command, for the
    files' folder, that tries them out. leaves : what it leaves there, which a later export removes:
    an old result must not be taken for the new one's.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    trial: ClassVar[str] = ""
    leaves: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def files(self, source: MachineSource) -> dict[str, str]:
        """Texts by file name; nothing is written.

        Raises InputError with a sentence where the format cannot express the machine.
        """

    @abstractmethod
    def check(self, files: dict[str, str], source: MachineSource) -> list[Difference]:
        """The texts read again, as the other program reads them, beside the machine."""

    def notes(self, source: MachineSource) -> tuple[Finding, ...]:
        """What a person should know of the files beside what stands in them."""
        del source
        return ()


@cache
def exporters() -> dict[str, Exporter]:
    """Every format of this folder by its name, in alphabetical order."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
    made: list[Callable[[], Exporter]] = [*Exporter.__subclasses__()]
    return {one.name: one for one in sorted((make() for make in made), key=lambda one: one.name)}


def exporter_of(name: str) -> Exporter:
    """A format by its word after ``--to``; InputError lists them."""
    reference_values = exporters()
    if name in reference_values:
        return reference_values[name]
    guess = closest(name, reference_values)
    raise InputError(
        "there is no such format to export to",
        found=name,
        expected=(f"{guess}, or another of " if guess else "") + listed(list(reference_values), 20),
    )


@dataclass(frozen=True)
class Export:
    """What was made: texts by file name, how far they are from the machine, and what to know."""

    exporter: Exporter
    files: dict[str, str]
    differences: tuple[Difference, ...]
    notes: tuple[Finding, ...]


def make_export(source: MachineSource, name: str, *, force: bool = False) -> Export:
    """Make a format's texts, read them again, and compare; nothing is written.

    Raises InputError for a machine that the format cannot express, ResultError for a calibration
    that was refused, unless forced, and where a text read again is not the machine.
    """
    exporter = exporter_of(name)
    if not (source.usable or force):
        raise ResultError(
            "this calibration was refused, and is not exported: "
            + " ".join((source.headline, *source.reasons)),
            where=source.origin,
            next_step="Calibrate again; or export it all the same with --force, and its files"
            " say so",
        )
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
            )
    return Export(exporter, files, differences, tuple(exporter.notes(source)))


def write_export(made: Export, folder: Path) -> None:
    """Write the files, whole or not at all; what a trial of earlier ones left goes."""
    leaves = made.exporter.leaves
    check_own_folder(folder, {*made.files, *leaves}, "this export", "an earlier export")
    write_folder(folder, made.files, over=leaves)


def exact(value: float) -> str:
    """The fewest digits that a double comes back from as it was; whole numbers without a point."""
    return repr(float(value) + 0.0).removesuffix(".0")


def commented(lines: Iterable[str], mark: str) -> str:
    """Lines behind a mark each, such as ``#`` or ``;``."""
    return "".join(f"{mark} {legible(line)}".rstrip() + "\n" for line in lines)


def largest(values: Any, expected: Any = 0.0) -> float:
    """The largest absolute difference of two arrays, or sets of numbers; 0 for none."""
    off = np.asarray(values, dtype=float) - np.asarray(expected, dtype=float)
    return float(np.abs(off).max(initial=0.0))
