"""What a command found: one kind of thing for all of them.

A command's work ends in an :class:`Outcome`. One finisher writes it, tells it and sets the exit
code; one page shows it; programs read its ``document``. Terminal, page and JSON show the same
tables and figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal

from pkmcal.errors import PkmcalError

Source = Literal["paper", "prototype", "ours"]


@dataclass(frozen=True)
class Verdict:
    """What a person should know first.

    usable : whether the result may be loaded into a controller.
    headline : one sentence. reasons : why not usable. warnings : what to look at. advice : what
    would make it better.
    """

    usable: bool
    headline: str
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()


class Level(StrEnum):
    """How bad a finding is."""

    WRONG = "wrong"
    DOUBTFUL = "doubtful"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """One thing found, as a sentence; station : where it is one's."""

    level: Level
    text: str
    station: str | None = None


def wrong(error: PkmcalError, station: str | None = None) -> Finding:
    """An error as a finding."""
    return Finding(Level.WRONG, str(error), station)


@dataclass(frozen=True)
class Figure:
    """A card: one number that answers a question; ``values`` are (number, unit) pairs."""

    question: str
    values: tuple[tuple[str, str], ...]
    note: str


@dataclass(frozen=True)
class Row:
    """One line of a table: its name, its cells in text, and whose figures they are."""

    name: str
    cells: tuple[str, ...]
    source: Source = "ours"


@dataclass(frozen=True)
class Table:
    """``columns`` has one name more than a row has cells: the first is of the rows' names.

    brief : short enough for a terminal. folded : shown on the page when asked for.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    brief: bool = True
    folded: bool = False


@dataclass(frozen=True)
class Plot:
    """A Plotly figure (data, layout, config) with colours named as in :mod:`report.figure`.

    width : px below which it is scrolled sideways. alt : what it shows, for who cannot see it.
    """

    name: str
    title: str
    caption: str
    alt: str
    figure: dict[str, Any]
    height: int = 460
    width: int = 0


@dataclass(frozen=True)
class Part:
    """A section: paragraphs, then plots, then tables."""

    name: str
    title: str
    text: tuple[str, ...] = ()
    plots: tuple[Plot, ...] = ()
    tables: tuple[Table, ...] = ()


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
class Outcome:
    """What a command found, for people and for programs.

    command : its name. verdict : may the result be used. figures : cards at the page's top.
    parts : sections of the page; the terminal shows their brief tables. notes : what to look at
    besides the verdict's warnings. document : everything as plain data, m and rad.
    """

    command: str
    title: str
    verdict: Verdict
    figures: tuple[Figure, ...] = ()
    parts: tuple[Part, ...] = ()
    notes: tuple[str, ...] = ()
    document: dict[str, Any] = field(default_factory=dict[str, Any])

    @property
    def exit_code(self) -> int:
        """0 done; 1 it ran, but the result should not be used."""
        return 0 if self.verdict.usable else 1
