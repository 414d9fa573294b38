"""What was left out and why: counts by reason, then every case."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pkmcal.measurements import Rejection
from pkmcal.report.residuals import SIDES
from pkmcal.session.load import Session

MOST_CASES = 400
"""Cases listed for one reason; calibration.json has all of them."""


@dataclass(frozen=True)
class Reason:
    """One reason. cases : (photograph, what) for the first of ``count`` findings."""

    text: str
    count: int
    photographs: int
    cases: tuple[tuple[str, str], ...]

    @property
    def unlisted(self) -> int:
        """Findings that the list leaves out."""
        return self.count - len(self.cases)


def reasons(session: Session, rejected: tuple[Rejection, ...]) -> tuple[Reason, ...]:
    """Grouped by reason, the most frequent first; numbers in a reason do not part groups."""
    groups: dict[str, list[Rejection]] = {}
    for item in rejected:
        groups.setdefault(_kind(item.reason), []).append(item)
    ordered = sorted(groups.items(), key=lambda pair: -len(pair[1]))
    return tuple(_reason(session, text, items) for text, items in ordered)


def _kind(reason: str) -> str:
    """The reason without its measured numbers, which differ from case to case."""
    return re.sub(r"[-+−]?\d+(\.\d+)?([eE][-+]?\d+)?", "…", reason)


def _reason(session: Session, text: str, items: list[Rejection]) -> Reason:
    same = len({item.reason for item in items}) == 1
    return Reason(
        text=items[0].reason if same else text,
        count=len(items),
        photographs=len({(i.station, i.configuration) for i in items}),
        cases=tuple(
            (_photograph(session, i), _what(i) if same else f"{_what(i)}: {i.reason}")
            for i in items[:MOST_CASES]
        ),
    )


def _photograph(session: Session, item: Rejection) -> str:
    return f"{session.station_names[item.station]} / {session.configurations[item.configuration]}"


def _what(item: Rejection) -> str:
    """The rejected thing in words; -1 stands for all of them."""
    if item.leg < 0:
        return "board" if item.reason.startswith("the board") else "whole photograph"
    words = [f"leg {item.leg + 1}"]
    if item.tube >= 0:
        words.append(f"tube {item.tube + 1}")
    if item.side >= 0:
        words.append(SIDES[item.side])
    return " ".join(words)
