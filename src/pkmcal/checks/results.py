"""Results of a check: stations, boards and joints of a session, and the findings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from pkmcal.checks.forecast import Forecast
from pkmcal.checks.inspection import Inspection
from pkmcal.files import json_value
from pkmcal.outcome.finding import Finding, Level, first_error


@dataclass(frozen=True)
class BoardCheck:
    """Board in the images of one station.

    found : number of images in which the board was detected.
    corners, corners_of : mean number of corners in these images, and number of corners of the
        board.
    rms : root mean square distance of the corners from their predicted positions, px.
    scatter : motion in px of a board on the base between images; NaN if it need not be at rest, or
        was detected once.
    distance : m.
    unseen : outer row or column that is in no image while all others are visible, in words.
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
    """Readings of one joint.

    unit : m or rad.
    used : share of its range.
    ends : numbers of readings near either end of it. NaN and 0 if the mechanism file gives no
        range.
    """

    name: str
    unit: str
    low: float
    high: float
    used: float
    ends: tuple[int, int]


@dataclass(frozen=True)
class StationCheck:
    """Check of one station.

    mismatch : 0 for a perfect match, 1 for none; NaN without a search.
    by_chance : probability that wrong readings (by hand: another place) match as well; NaN without
        a search.
    moved, turned : distance (m) and rotation (rad) from the rough to the localized pose.
    legs : mean number of legs measured in an image.
    saturated, black : mean shares of the legs' pixels.
    blur : median, px.
    board : None if the station observes none, or it was not detected.
    handheld : whether it is an image by hand, with a pose of its own.
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
    handheld: bool = False
    by_chance: float = math.nan


@dataclass(frozen=True)
class SessionCheck:
    """Results of a check.

    singularity : smallest over the configurations, 1 good, 0 singular.
    assemblies : number of assembly modes at the first configuration's readings.
    forecast : accuracy of a full capture, if the first images allow it.
    advice : improvements.
    look : localization of the machine for pictures; None if it could not be searched for.
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
        """2 if a calibration would be refused, 1 if its result would be doubtful, else 0."""
        return exit_code_of(self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Document for ``--json``, with the first error as in every command."""
        case = self.forecast and replace(self.forecast, edges=())
        out = json_value(asdict(replace(self, look=None, forecast=case, findings=(), advice=())))
        out.pop("look")
        out["findings"] = [finding.document() for finding in (*self.findings, *self.advice)]
        out["advice"] = [finding.text for finding in self.advice]
        if self.forecast:
            out["forecast"].pop("edges")
            out["forecast"]["handheld"] = self.forecast.handheld
        return first_error(self.findings) | out


def exit_code_of(findings: Sequence[Finding]) -> int:
    """2 if a finding is wrong, 1 if one is doubtful, else 0."""
    levels = {finding.level for finding in findings}
    return 2 if Level.WRONG in levels else 1 if Level.DOUBTFUL in levels else 0
