"""The page of a paper's reproduction: its figures beside ours, as frozen views.

Terminal, page and JSON show the same views; a study fills them in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from pkmcal.report import figure, templating
from pkmcal.report.headline import Headline

Source = Literal["paper", "prototype", "ours"]


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
class Reproduction:
    """A paper computed again. numbers : everything for programs, m and rad."""

    letter: str
    title: str
    cited: str
    headline: str
    cards: tuple[Headline, ...]
    checks: tuple[Check, ...]
    remarks: tuple[str, ...]
    parts: tuple[Part, ...]
    numbers: dict[str, Any]

    @property
    def passed(self) -> bool:
        """Whether every expectation is met."""
        return all(check.passed for check in self.checks)

    def document(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "paper": self.letter,
            "title": self.cited,
            "passed": self.passed,
            "headline": self.headline,
            "checks": [vars(check) for check in self.checks],
            "remarks": list(self.remarks),
            **self.numbers,
        }


def reproduction_html(found: Reproduction) -> str:
    """One HTML page that needs nothing else: no network, no other file."""
    return templating.render(
        "reproduction.html.j2",
        r=found,
        plots=[plot for part in found.parts for plot in part.plots],
        plotly=figure.plotly_script(),
    )
