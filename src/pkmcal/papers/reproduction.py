"""Reproduction of a paper's figures: one table for the terminal, Markdown and JSON.

A row is a claim of the paper with the value that the paper prints and the value found here. Where
something is expected of the value, the row is also a check. Expectations come from the paper, or
from an independent prototype that shares no code with this program.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from math import degrees
from typing import Any, NamedTuple

from pkmcal.outcome import Level, Mark, Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.finding import doubtful, note, wrong
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.studies.engine import StudyResult
from pkmcal.studies.statistics import Summary
from pkmcal.studies.tasks import Key
from pkmcal.wording import count, number, with_unit

PrintedFigures = Mapping[Key, Mapping[str, str]]
"""Figures of a prototype as printed, by key and quantity."""
TWO_SIGMA = " + 2σ"
"""What is allowed beyond a limit: two Monte-Carlo standard errors."""
MARKS: Mapping[bool | None, Mark | None] = {True: "good", False: Level.WRONG, None: None}
"""Mark of a row by whether it is as expected."""
NOT_PRINTED = "–"
"""The paper's value where the paper prints none."""


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
    progress: Progress = no_progress

    def within(self, first: float, last: float) -> Progress:
        """Progress callback for a part of the work, from ``first`` to ``last`` of its share."""
        return part(self.progress, first, last)


@dataclass(frozen=True)
class Claim:
    """Row of a reproduction's table.

    place : equation, table, figure or section of the paper. what : the claim. here : value found.
    paper : value in the paper. expected : of the value found. passed : whether it is as expected;
    None if nothing is expected.
    """

    place: str
    what: str
    here: str
    paper: str = NOT_PRINTED
    expected: str = ""
    passed: bool | None = None

    @property
    def text(self) -> str:
        """The claim with its place in the paper and what is expected."""
        return f"{self.place}: {self.what}" + (f"; {self.expected}" if self.expected else "")


@dataclass(frozen=True)
class Reproduction:
    """A paper's table.

    paper : its letter in lower case. cited : authors, title, place and section. headline : one
    sentence, if every check passes. not_reproduced : sentences on what of the paper does not hold
    here. numbers : figures for programs.
    """

    paper: str
    cited: str
    claims: Sequence[Claim]
    headline: str
    not_reproduced: Sequence[str]
    numbers: Mapping[str, Any]

    def outcome(self) -> Outcome:
        """Outcome with the table; its files are the table in Markdown and the document."""
        checks = [claim for claim in self.claims if claim.passed is not None]
        failed = [check for check in checks if not check.passed]
        open_ = [f"Not reproduced: {text}" for text in self.not_reproduced]
        headline = self.headline
        if failed:  # the headline may praise what is missed here
            headline = f"Not reproduced: {len(failed)} of {count(len(checks), 'check')} failed."
        table = Table(
            "",
            ("", "paper", "here"),
            tuple(
                Row(claim.text, (claim.paper, claim.here), mark=MARKS[claim.passed])
                for claim in self.claims
            ),
            words=(1, 2),
        )
        missed = (wrong("study.missed", c.what, found=c.here, expected=c.expected) for c in failed)
        return Outcome(
            command="reproduce",
            title=f"Reproduction of paper {self.paper.upper()}",
            subject=self.cited,
            verdict=Verdict(not failed, headline, tuple(missed)),
            partial=bool(open_),
            parts=(Part("table", "", tables=(table,)),),
            findings=tuple(doubtful("study.remark", text=text) for text in open_),
            texts={f"paper-{self.paper}.md": self._markdown(headline, open_)},
            document={
                "paper": self.paper,
                "title": self.cited,
                "passed": not failed,
                "headline": headline,
                "table": [
                    {"claim": c.text, "paper": c.paper, "here": c.here, "passed": c.passed}
                    for c in self.claims
                ],
                "checks": [
                    {"what": c.what, "found": c.here, "expected": c.expected, "passed": c.passed}
                    for c in checks
                ],
                "not_reproduced": open_,
                **self.numbers,
            },
        )

    def _markdown(self, headline: str, open_: Sequence[str]) -> str:
        """The table in Markdown, with the list of what is not reproduced."""
        signs = {True: "✓", False: "✕", None: ""}
        rows = [(c.text, c.paper, c.here, signs[c.passed]) for c in self.claims]
        cells = [("claim", "paper", "here", "✓"), ("---",) * 4, *rows]
        lines = [f"| {' | '.join(row)} |" for row in cells]
        lines += ["", *(f"- {text}" for text in open_)]
        title = f"# Reproduction of paper {self.paper.upper()}"
        return "\n".join([title, "", self.cited, "", headline, "", *lines]) + "\n"


def reproduce_paper(paper: str, options: Options) -> Outcome:
    """Reproduce the figures of a paper. paper : its letter in lower case."""
    module = import_module(f"pkmcal.papers.paper_{paper}")
    return with_few_runs(module.reproduce(options).outcome(), options.runs)


def with_few_runs(outcome: Outcome, runs: int) -> Outcome:
    """Outcome with a note if an expectation is missed with fewer runs than by default."""
    if outcome.verdict.usable or runs >= Options.runs:
        return outcome
    few = note("study.few_runs", runs=runs, usual=Options.runs)
    verdict = replace(outcome.verdict, findings=(*outcome.verdict.findings, few))
    return replace(outcome, verdict=verdict)


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


def prototype_claim(figures: list[Compared], within: str) -> Claim:
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
    what = "figures of the independent prototype"
    return Claim("errata", what, text, expected=within, passed=not bad)


def at_most(
    place: str, what: str, unit: str, summary: Summary, most: float, places: int,
    paper: str = NOT_PRINTED,
) -> Claim:  # fmt: skip
    """Check of an upper limit, within two Monte-Carlo errors. most : in the summary's unit."""
    limit = with_unit(f"{most:g}", unit)
    passed = summary.value - 2 * summary.error <= most
    here = with_error(summary, unit, places)
    return Claim(place, what, here, paper, f"≤ {limit}{TWO_SIGMA}", passed)


def with_error(summary: Summary, unit: str, places: int) -> str:
    """Value with its Monte-Carlo error, ``0.0732 ± 0.0075 mm``."""
    error = number(summary.error, places)
    return with_unit(f"{number(summary.value, places)} ± {error}", unit)


def mm(*values: float, places: int = 3) -> str:
    """Values in mm, from m: ``0.05, 0.10 mm``."""
    return ", ".join(number(1e3 * value, places) for value in values) + " mm"


def deg(value: float, places: int) -> str:
    """Value in degrees, from rad, ``0.12°``."""
    return f"{number(degrees(value), places)}°"
