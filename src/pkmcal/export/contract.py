"""What a format of other programs offers; a new one is one file in this folder.

An exporter turns a :class:`~pkmcal.export.source.Source` into texts, and reads them again by
itself, as the other program would: with that program's units, signs and formulas, and with nothing
of ours but the text. :func:`pkmcal.export.writing.export` writes only what agrees.
"""

from __future__ import annotations

import importlib
import pkgutil
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

from pkmcal.export.source import Source
from pkmcal.outcome import Finding


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

    name : the word after ``--to``. title : what it is, for people.
    """

    name: ClassVar[str]
    title: ClassVar[str]

    @abstractmethod
    def files(self, source: Source) -> dict[str, str]:
        """Texts by file name; nothing is written.

        Raises InputError with a sentence where the format cannot express the machine.
        """

    @abstractmethod
    def check(self, files: dict[str, str], source: Source) -> list[Difference]:
        """The texts read again, as the other program reads them, beside the machine."""

    def notes(self, files: dict[str, str], source: Source) -> tuple[Finding, ...]:
        """What a person should know of these files beside what stands in them."""
        del files, source
        return ()


@cache
def exporters() -> dict[str, Exporter]:
    """Every format of this folder by its name, in alphabetical order."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
    return {cls.name: cls() for cls in sorted(Exporter.__subclasses__(), key=lambda c: c.name)}
