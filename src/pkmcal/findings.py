"""What a look through a session comes back with: sentences, and how bad they are."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from pkmcal.errors import PkmcalError


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
