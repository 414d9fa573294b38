"""The page of a paper's reproduction: its figures beside ours, as frozen views.

Terminal, page and JSON show the same views; a study fills them in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pkmcal.outcome import Check, Figure, Finding, Level, Outcome, Part, Verdict
from pkmcal.report.page import page_html


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


def outcome_of(found: Reproduction) -> Outcome:
    """As every command's: verdict, cards, parts and expectations."""
    reasons = tuple(check.sentence for check in found.checks if not check.passed)
    return Outcome(
        command="reproduce",
        title=found.title,
        verdict=Verdict(found.passed, found.headline, reasons),
        kicker=f"reproduction of paper {found.letter.upper()}",
        subject=found.cited,
        stamp="Reproduced" if found.passed else "Not reproduced",
        figures=found.cards,
        parts=(*found.parts, Part("checks", "Expectations", checks=found.checks)),
        findings=tuple(Finding(Level.NOTE, text) for text in found.remarks),
        document=found.document(),
    )


def reproduction_html(found: Reproduction) -> str:
    """One HTML page that needs nothing else: no network, no other file."""
    return page_html(outcome_of(found))
