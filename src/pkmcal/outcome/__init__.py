"""What a command found: one kind of thing for all of them.

A command's work ends in an :class:`Outcome`. One finisher writes it, tells it and sets the exit
code; one page shows it; programs read its ``document``. Terminal, page and JSON show the same
tables and figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from pkmcal.outcome.finding import Finding, Level

FigureSource = Literal["paper", "prototype", "ours"]


@dataclass(frozen=True)
class Verdict:
    """What a person should know first.

    usable : whether the result may be loaded into a controller. headline : one sentence.
    findings : reasons against the result, warnings, and advice, by their level.
    """

    usable: bool
    headline: str
    findings: tuple[Finding, ...] = ()

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why not usable, in sentences."""
        return self._texts(Level.WRONG)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to look at, in sentences."""
        return self._texts(Level.DOUBTFUL)

    @property
    def advice(self) -> tuple[str, ...]:
        """What would make it better, in sentences."""
        return self._texts(Level.NOTE)

    @property
    def codes(self) -> tuple[str, ...]:
        """Of the findings."""
        return tuple(one.code for one in self.findings)

    def of(self, code: str) -> tuple[Finding, ...]:
        """The findings of a code, or of an area as ``readings``."""
        return tuple(
            one for one in self.findings if one.code == code or one.code.startswith(f"{code}.")
        )

    def document(self) -> dict[str, Any]:
        """For programs: sentences, and the findings with their codes and facts."""
        return {
            "usable": self.usable,
            "headline": self.headline,
            "reasons": self.reasons,
            "warnings": self.warnings,
            "advice": self.advice,
            "findings": [one.document() for one in self.findings],
        }

    def _texts(self, level: Level) -> tuple[str, ...]:
        return tuple(one.text for one in self.findings if one.level is level)


Mark = Literal["good"] | Level
"""What to think of something: that all is well, or how bad it is."""


@dataclass(frozen=True)
class Figure:
    """A card: one number that answers a question; ``values`` are (number, unit) pairs."""

    question: str
    values: tuple[tuple[str, str], ...]
    note: str


@dataclass(frozen=True)
class Row:
    """One line of a table: its name, its cells in text, and whose figures they are.

    mark : what to think of it, as a sign before its name.
    """

    name: str
    cells: tuple[str, ...]
    source: FigureSource = "ours"
    mark: Mark | None = None


@dataclass(frozen=True)
class Table:
    """``columns`` has one name more than a row has cells: the first is of the rows' names.

    note : under it on the page. brief : short enough for a terminal. folded : shown on the page
    when asked for. first : columns that a terminal shows, the rows' names among them; None for
    all. words : places of columns that hold words, which stand to the left. legend : lines under
    it on a terminal.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    brief: bool = True
    folded: bool = False
    first: int | None = None
    words: tuple[int, ...] = ()
    legend: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plot:
    """A Plotly figure (data, layout, config): plain data, drawn by the page's script.

    Its colours are names of the page's CSS variables; the script puts in the values of the light
    or the dark theme.

    width : px below which it is scrolled sideways. alt : what it shows, for who cannot see it.
    frames : of an animation.
    """

    name: str
    title: str
    caption: str
    alt: str
    figure: dict[str, Any]
    height: int = 460
    width: int = 0
    frames: tuple[dict[str, Any], ...] = ()


@dataclass(frozen=True)
class Check:
    """One expectation that a reproduction has of itself."""

    what: str
    found: str
    expected: str
    passed: bool

    @property
    def sentence(self) -> str:
        """As one line."""
        return f"{self.what}: {self.found}, expected {self.expected}"


@dataclass(frozen=True)
class Part:
    """A section of the page, in this order: what follows ``title``, one after the other.

    text : paragraphs. terminal_text : sentences that the terminal tells, too. html : made by a
    template of :mod:`report`, which escapes what it shows: photographs, charts. notes : small
    print. menu : its name in the page's navigation, where that is shorter.
    """

    name: str
    title: str
    text: tuple[str, ...] = ()
    terminal_text: tuple[str, ...] = ()
    plots: tuple[Plot, ...] = ()
    html: str = ""
    tables: tuple[Table, ...] = ()
    checks: tuple[Check, ...] = ()
    notes: tuple[str, ...] = ()
    menu: str = ""


@dataclass(frozen=True)
class Outcome:
    """What a command found, for people and for programs.

    command : its name. title : of the page. kicker : above the title, such as a session's name.
    subject : what was looked at, in a sentence. origin : what tells the data from others, such as
    a session's digest; on the page. notes : the user's own words. verdict : may the result be used.
    stamp : the verdict in a word or three. level : how bad it is if the result may not be used.
    partial : it may be used, but not all of it holds.
    figures : cards at the page's top; a terminal shows them where no part has a brief table.
    parts : sections of the page. findings : what to look at besides the verdict's warnings.
    closing : a terminal's last words before the files. document : everything as plain data, m
    and rad. summary : what ``--json`` prints instead, where that is less. texts : further files
    by their names.
    """

    command: str
    title: str
    verdict: Verdict
    kicker: str = ""
    subject: str = ""
    origin: tuple[str, ...] = ()
    notes: str = ""
    stamp: str = ""
    level: Level = Level.WRONG
    partial: bool = False
    figures: tuple[Figure, ...] = ()
    parts: tuple[Part, ...] = ()
    findings: tuple[Finding, ...] = ()
    closing: str = ""
    document: dict[str, Any] = field(default_factory=dict[str, Any])
    summary: dict[str, Any] | None = None
    texts: dict[str, str | bytes] = field(default_factory=dict[str, str | bytes])

    @property
    def mark(self) -> Mark:
        """The sign of the verdict."""
        if self.verdict.usable:
            return Level.DOUBTFUL if self.partial else "good"
        return self.level

    @property
    def exit_code(self) -> int:
        """0 done; 1 it ran, but the result should not be used; 2 the input is wrong."""
        if any(finding.level is Level.WRONG for finding in self.findings):
            return 2
        return 0 if self.verdict.usable else 1
