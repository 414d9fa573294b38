"""What a check found: the session's stations, boards and joints, and what is to be said of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pkmcal.check.forecast import Forecast
from pkmcal.check.inspection import Inspection
from pkmcal.files import json_value
from pkmcal.outcome.finding import Finding, Level, first_error


@dataclass(frozen=True)
class BoardCheck:
    """The board in one station's photographs.

    found : photographs that show it. corners : mean number in these, of ``corners_of``. rms : px
    off their predicted places. scatter : px by which a board on the base wanders from photograph
    to photograph; nan where it need not stand still, or is seen once. distance : m. unseen : an
    outer row or column that no photograph shows though it shows all others, in words.
    """

    found: int
    corners: float
    corners_of: int
    rms: float
    scatter: float
    distance: float
    unseen: str = ""


@dataclass(frozen=True)
class JointCheck:
    """One joint's readings, m or rad; used : share of its range, ends : readings near either end
    of it (NaN and 0 where the mechanism file gives no range).
    """

    name: str
    low: float
    high: float
    used: float
    ends: tuple[int, int]


@dataclass(frozen=True)
class StationCheck:
    """One station. mismatch : 0 perfect, 1 nothing fits; by_chance : probability that wrong
    readings fit as well; NaN where not looked for.

    moved, turned : from the pose by hand to the one found, m and rad. legs : mean number found in
    a photograph. saturated, black : mean shares of the legs' pixels. blur : median, px. board :
    where the station observes one and it was found.
    """

    name: str
    photographs: int
    recognised: bool
    mismatch: float = math.nan
    moved: float = math.nan
    turned: float = math.nan
    legs: float = math.nan
    saturated: float = math.nan
    black: float = math.nan
    blur: float = math.nan
    board: BoardCheck | None = None
    by_chance: float = math.nan


@dataclass(frozen=True)
class SessionCheck:
    """All that was found. singularity : least over the configurations, 1 good, 0 singular.

    assemblies : ways to assemble the machine at the first configuration's readings. forecast : what
    a full capture would give, where the first photographs tell. advice : what would make it better.
    look : where the machine was looked for, for pictures; None where it could not be.
    """

    folder: str
    findings: tuple[Finding, ...]
    machine: str = ""
    n_legs: int = 0
    configurations: int = 0
    stations: tuple[StationCheck, ...] = ()
    joints: tuple[JointCheck, ...] = ()
    singularity: float = math.nan
    assemblies: int = 0
    forecast: Forecast | None = None
    advice: tuple[Finding, ...] = ()
    look: Inspection | None = None

    @property
    def exit_code(self) -> int:
        """2 where calibrating would be refused, 1 where its result would be doubtful, else 0."""
        return exit_code_of(self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Everything under its name, for ``--json``, and the first error as every command's."""
        case = self.forecast and replace(self.forecast, edges=())
        out = json_value(asdict(replace(self, look=None, forecast=case, findings=(), advice=())))
        out.pop("look")
        out["findings"] = [finding.document() for finding in (*self.findings, *self.advice)]
        out["advice"] = [finding.text for finding in self.advice]
        if self.forecast:
            out["forecast"].pop("edges")
        return first_error(self.findings) | out


def exit_code_of(findings: Sequence[Finding]) -> int:
    """2 where one of them is wrong, 1 where one is doubtful, else 0."""
    levels = {finding.level for finding in findings}
    return 2 if Level.WRONG in levels else 1 if Level.DOUBTFUL in levels else 0
