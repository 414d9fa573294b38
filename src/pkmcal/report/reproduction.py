"""The page of a paper's reproduction: its figures beside ours, as frozen views.

Terminal, page and JSON show the same views; a study fills them in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pkmcal.outcome import Check, Figure, Part
from pkmcal.report import page as templating
from pkmcal.report import scene as figure


@dataclass(frozen=True)
class Reproduction:
    """A paper computed again. numbers : everything for programs, m and rad."""

    letter: str
    title: str
    cited: str
    headline: str
    cards: tuple[Figure, ...]
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
