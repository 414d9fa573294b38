"""Reproduction of a paper's figures as an outcome: what all papers have in common.

The text of a paper's report is in ``paper_x.yaml``, with figures in braces as in ``str.format``;
its tables, checks and plots are code. Terminal, page and JSON show the same content. Figures are
compared with those that the paper reports, or with those of an independent prototype.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from math import degrees, isfinite
from pathlib import Path
from typing import Any, NamedTuple

from pkmcal.files import read_yaml
from pkmcal.outcome import Check, Figure, Level, Outcome, Part, Plot, Row, Table, Verdict
from pkmcal.outcome.finding import finding, note, wrong
from pkmcal.studies.engine import StudyProgress, StudyResult
from pkmcal.studies.statistics import Summary
from pkmcal.studies.tasks import Key, StudySetting
from pkmcal.wording import brief, count, number

PrintedFigures = Mapping[Key, Mapping[str, str]]
"""Figures of a prototype as printed, by key and quantity."""
MONTE_CARLO_NOTE = ", its Monte-Carlo error aside"


@dataclass(frozen=True)
class Options:
    """Options of a reproduction.

    runs : number of the Monte-Carlo simulation. long : include parts that take minutes. images
    : include measurements on rendered images. progress : callback with a text and the share done.
    """

    runs: int = 100
    seed: int = 0
    long: bool = False
    images: bool = False
    progress: StudyProgress = lambda _text, _share: None

    def within(self, first: float, last: float) -> StudyProgress:
        """Progress callback for a part of the work, from ``first`` to ``last`` of its share."""
        return lambda text, share: self.progress(text, first + (last - first) * share)


def reproduce_paper(paper: str, options: Options) -> Outcome:
    """Reproduce the figures of a paper. paper : its letter in lower case.

    With fewer than the default number of runs, a missed expectation comes with a note on that
    number.
    """
    outcome: Outcome = import_module(f"pkmcal.studies.paper_{paper}_report").reproduce(options)
    if outcome.verdict.usable or options.runs >= Options.runs:
        return outcome
    few = note("study.few_runs", runs=options.runs, usual=Options.runs)
    verdict = replace(outcome.verdict, findings=(*outcome.verdict.findings, few))
    return replace(outcome, verdict=verdict)


class DisplayNumber(float):
    """Number with format specifications ``{:3}`` for three decimals and ``{:~}`` for two digits."""

    def __format__(self, spec: str) -> str:
        """Format for display; other specifications are those of float."""
        if spec == "~":
            return brief(self)
        return number(self, int(spec)) if spec.isdigit() else super().__format__(spec)


@dataclass(frozen=True)
class Words:
    """Text of a paper's report. document : content of its file. values : by the names in the
    text.
    """

    letter: str
    document: Mapping[str, Any]
    values: Mapping[str, Any]

    @classmethod
    def of(cls, letter: str, study: StudyResult[Any], **values: Any) -> Words:
        """Text with the values of a study.

        ``found`` and ``error`` hold each method's figures and standard errors in their units.
        values : further values that the text names.
        """
        units = study.setting.quantities
        figures = {
            ", ".join(key): {
                name: summary.times(units[name].factor) for name, summary in accuracy.items()
            }
            for key, accuracy in study.accuracy.items()
        }
        numbers: dict[str, Any] = {
            "found": {
                m: {q: DisplayNumber(s.value) for q, s in a.items()} for m, a in figures.items()
            },
            "error": {
                m: {q: DisplayNumber(s.error) for q, s in a.items()} for m, a in figures.items()
            },
            "setting": study.setting,
            "runs": study.runs,
            "seed": study.seed,
            "workers": study.workers,
        }
        times = {"wall": study.wall, "solving": study.solving, "cpu": study.cpu}
        for name, value in {**times, **values}.items():
            numbers[name] = DisplayNumber(value) if isinstance(value, float) else value
        document = read_yaml(Path(__file__).with_name(f"paper_{letter}.yaml")).data
        return cls(letter, document, numbers)

    def say(self, text: str) -> str:
        """Text with its values filled in."""
        return text.format_map(self.values)

    def part(
        self,
        name: str,
        *tables: Table,
        plots: Mapping[str, Mapping[str, Any]] | None = None,
        more: Iterable[str] = (),
    ) -> Part:
        """Section of the report. plots : by name, the ``figure`` and sizes of each. more : names of
        optional paragraphs.
        """
        own = self.document["parts"][name]
        texts = [*own["text"], *(own[key] for key in more)]
        figures = tuple(
            Plot(key, **own["plots"][key], **plot) for key, plot in (plots or {}).items()
        )
        title, text = own["title"], tuple(self.say(t) for t in texts)
        return Part(name, title, text, plots=figures, tables=tables)

    def reproduction(
        self,
        parts: Sequence[Part],
        checks: Sequence[Check],
        remarks: Iterable[str],
        numbers: Mapping[str, Any],
    ) -> Outcome:
        """Outcome of the reproduction. remarks : names of those that apply. numbers : figures for
        programs.
        """
        passed = all(check.passed for check in checks)
        failed = tuple(
            wrong("study.missed", check.what, found=check.found, expected=check.expected)
            for check in checks
            if not check.passed
        )
        headline, cited = self.say(self.document["headline"]), self.document["cited"]
        if failed:  # the headline of the text may praise what is missed here
            headline = (
                f"Not reproduced: this run misses {len(failed)} of the"
                f" {count(len(checks), 'expectation')} that it is held against."
            )
        words = {name: self.say(self.document["remarks"][name]) for name in remarks}
        open_ = [words[name] for name in self.document["not_reproduced"] if name in words]
        return Outcome(
            command="reproduce",
            title=self.document["title"],
            kicker=f"reproduction of paper {self.letter.upper()}",
            subject=cited,
            verdict=Verdict(passed, headline, failed),
            stamp=("Reproduced in part" if open_ else "Reproduced") if passed else "Not reproduced",
            partial=bool(open_),
            figures=tuple(
                Figure(
                    card["question"],
                    tuple((self.say(value), unit) for value, unit in card["values"]),
                    self.say(card["note"]),
                )
                for card in self.document["cards"]
            ),
            parts=(*parts, Part("checks", "Expectations", checks=tuple(checks))),
            findings=tuple(
                finding(
                    "study.remark",
                    Level.DOUBTFUL if text in open_ else Level.NOTE,
                    name,
                    text=text,
                )
                for name, text in words.items()
            ),
            document={
                "paper": self.letter,
                "title": cited,
                "passed": passed,
                "headline": headline,
                "checks": [vars(check) for check in checks],
                "remarks": list(words.values()),
                "not_reproduced": open_,
                **numbers,
            },
        )


class Column(NamedTuple):
    """Column of a table of accuracies: quantity, decimals of its value and of its error."""

    quantity: str
    places: int
    error_places: int


def accuracy_rows(
    study: StudyResult[Any],
    key: Key,
    name: str,
    columns: Sequence[Column],
    printed: Mapping[str, str] | None = None,
    *,
    errors: bool = True,
) -> list[Row]:
    """Rows of one method: figures in the quantities' units, Monte-Carlo errors if ``errors``, and
    the figures ``printed`` by an independent prototype.
    """
    setting: StudySetting = study.setting
    figures = [
        (column, study.accuracy[key][column.quantity].times(quantity.factor))
        for column in columns
        for quantity in [setting.quantities[column.quantity]]
    ]
    cells = (number(s.value, c.places) if isfinite(s.value) else "" for c, s in figures)
    rows = [Row(name, tuple(cells))]
    if errors:
        cells = (number(s.error, c.error_places) for c, s in figures)
        rows.append(Row("  ± Monte-Carlo error", tuple(cells), "prototype"))
    prototype = tuple((printed or {}).get(c.quantity, "") for c in columns)
    if any(prototype):
        rows.append(Row("  independent prototype", prototype, "prototype"))
    return rows


class Compared(NamedTuple):
    """Figure in its printed ``unit`` with its Monte-Carlo error, beside the prototype's.

    rounding : half of the last digit of the prototype's figure. tolerance : relative difference
    that settings can cause, so not a fault of the method. held : whether the settings are
    comparable. name : description in words.
    """

    key: Key
    quantity: str
    measured: Summary
    expected: float
    rounding: float
    tolerance: float
    held: bool = True
    name: str = ""
    unit: str = ""

    @property
    def differs(self) -> bool:
        """Whether the figures differ by more than two standard errors of the difference of two such
        simulations, and the rounding.
        """
        return (
            abs(self.measured.value - self.expected)
            > 2 * 2**0.5 * self.measured.error + self.rounding
        )

    @property
    def tolerable(self) -> bool:
        """Whether the difference is within the tolerance and two Monte-Carlo errors."""
        allowed = self.tolerance * self.expected + 2 * self.measured.error
        return abs(self.measured.value - self.expected) <= allowed


def compared(
    study: StudyResult[Any],
    prototype: PrintedFigures,
    tolerance: Callable[[Key, str], float],
    held: Callable[[Key], bool] = lambda _: True,
    named: Callable[[Key, str], str] = lambda key, quantity: ", ".join((*key, quantity)),
) -> list[Compared]:
    """All figures of the prototype beside those of the study. named : description of a figure, by
    key and quantity.
    """
    out: list[Compared] = []
    for key, figures in prototype.items():
        for quantity, printed in figures.items():
            definition = study.setting.quantities[quantity]
            measured = study.of(*key)[quantity].times(definition.factor)
            rounding = 0.5 * 10.0 ** -len(printed.partition(".")[2])
            allowed = tolerance(key, quantity)
            name = named(key, quantity)
            out.append(
                Compared(
                    key, quantity, measured, float(printed), rounding, allowed, held(key),
                    name, definition.unit,
                )
            )  # fmt: skip
    return out


def prototype_check(figures: list[Compared], within: str) -> Check:
    """Check that all comparable figures agree with the prototype's.

    The others, which depend on what the paper leaves open, are only counted. within : the tolerance
    in words.
    """
    held = [f for f in figures if f.held]
    bad = [
        f"{f.name}: {f.measured.value:.3g} against {f.expected:g} {f.unit}"
        for f in held
        if not f.tolerable
    ]
    others = [f for f in figures if not f.held]
    text = "; ".join(bad) or f"{len(held)} of {len(held)} that are held"
    if others:
        differ = sum(not f.tolerable for f in others)
        text += f"; of {len(others)} that depend on what is left open {differ} differ"
    return Check("figures of the independent prototype", text, within, not bad)


def at_most(what: str, unit: str, summary: Summary, most: float, places: int) -> Check:
    """Check of an upper limit, within two Monte-Carlo errors. most : in the summary's unit."""
    space = "" if unit == "°" else " "
    return Check(
        what,
        f"{number(summary.value, places)} ± {number(summary.error, places)}{space}{unit}",
        f"≤ {most:g}{space}{unit}{MONTE_CARLO_NOTE}",
        summary.value - 2 * summary.error <= most,
    )


def mm(value: float, places: int = 3) -> str:
    """Number in mm or mrad, from m or rad, without its unit."""
    return number(1e3 * value, places)


def deg(value: float, places: int) -> str:
    """Number in degrees, from rad, without its unit."""
    return number(degrees(value), places)
