"""A paper's figures computed again, as an outcome: what holds for every paper.

A paper's study gives its parts, cards and checks; terminal, page and JSON show the same of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from math import isfinite
from typing import Any, NamedTuple

from pkmcal.outcome import Check, Figure, Finding, Level, Outcome, Part, Row, Verdict
from pkmcal.studies.engine import Key, Setting, Study
from pkmcal.wording import number

PAPERS = ("a", "c")


def _silent(_text: str, _share: float) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Options:
    """What a person may choose. runs : of the Monte-Carlo simulation. long : also what takes
    minutes. photographs : also what is measured on rendered photographs. told : called with
    the step in words and the share done.
    """

    runs: int = 100
    seed: int = 0
    long: bool = False
    photographs: bool = False
    told: Callable[[str, float], None] = _silent

    def within(self, first: float, last: float) -> Callable[[str, float], None]:
        """The same telling, of a part of the work."""
        return lambda text, share: self.told(text, first + (last - first) * share)


def reproduce(paper: str, options: Options) -> Outcome:
    """One paper's figures beside ours. paper : its letter, small."""
    return import_module(f"pkmcal.studies.paper_{paper}_report").reproduce(options)


class Publication(NamedTuple):
    """What is reproduced. letter : its own, small. cited : where it was printed."""

    letter: str
    title: str
    cited: str


def reproduction(
    paper: Publication,
    headline: str,
    figures: Sequence[Figure],
    parts: Sequence[Part],
    checks: Sequence[Check],
    remarks: Sequence[str],
    numbers: Mapping[str, Any],
) -> Outcome:
    """The outcome. remarks : where figures differ from the paper's. numbers : all, for programs."""
    passed = all(check.passed for check in checks)
    failed = tuple(check.sentence for check in checks if not check.passed)
    expectations = Part("checks", "Expectations", checks=tuple(checks))
    return Outcome(
        command="reproduce",
        title=paper.title,
        kicker=f"reproduction of paper {paper.letter.upper()}",
        subject=paper.cited,
        verdict=Verdict(passed, headline, reasons=failed),
        stamp="Reproduced" if passed else "Not reproduced",
        figures=tuple(figures),
        parts=(*parts, expectations),
        findings=tuple(Finding(Level.NOTE, text) for text in remarks),
        document={
            "paper": paper.letter,
            "title": paper.cited,
            "passed": passed,
            "headline": headline,
            "checks": [vars(check) for check in checks],
            "remarks": list(remarks),
            **numbers,
        },
    )


class Column(NamedTuple):
    """A column of a table of accuracies: a quantity, its decimals, its error's."""

    quantity: str
    places: int
    error_places: int


def accuracy_rows(
    study: Study[Any],
    key: Key,
    name: str,
    columns: Sequence[Column],
    printed: Mapping[str, str] | None = None,
    *,
    errors: bool = True,
) -> list[Row]:
    """One method's figures in the quantities' units, their Monte-Carlo errors where asked for, and
    what an independent prototype ``printed``.
    """
    setting: Setting = study.setting
    found = [
        (column, study.accuracy[key][column.quantity].times(quantity.factor))
        for column in columns
        for quantity in [setting.quantities[column.quantity]]
    ]
    cells = (number(s.value, c.places) if isfinite(s.value) else "" for c, s in found)
    rows = [Row(name, tuple(cells))]
    if errors:
        cells = (number(s.error, c.error_places) for c, s in found)
        rows.append(Row("  ± Monte-Carlo error", tuple(cells), "prototype"))
    known = tuple((printed or {}).get(c.quantity, "") for c in columns)
    if any(known):
        rows.append(Row("  independent prototype", known, "prototype"))
    return rows


def mm(value: float, places: int = 3) -> str:
    """Metres as millimetres, radians as milliradians, without the unit."""
    return number(1e3 * value, places)
