"""Earlier results of ``pkmcal watch`` on the same calibrated machine: the data of a run chart.

A result's ``watch.json`` lists its run after those of the previous result in the same folder, so
that a folder that is used repeatedly contains the machine's history.
"""

from __future__ import annotations

import math
from datetime import datetime
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field

from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.files import Schema, json_text, read_json, validated_document
from pkmcal.identify.score import Score
from pkmcal.judge.changes import ChangeTests, LegTest
from pkmcal.session.load import Session, digests, session_digest

if TYPE_CHECKING:
    from pkmcal.outcome import Verdict

WATCH_DOCUMENT_FILE = "watch.json"
DIGEST_BYTES = 8

Result = Literal["as_calibrated", "changed", "undecided", "another_machine"]


def _iso_time(text: str) -> str:
    """A time as it is, local and ISO 8601. Raises ValueError for another text."""
    if datetime.fromisoformat(text).tzinfo is not None:
        raise ValueError("a local time has no zone")
    return text


class LegRun(Schema):
    """Zero of a leg's reading in a run.

    legs : from 1.
    unit : m or rad.
    value, sigma : change of the zero, if nothing else changed.
    limit : change above which its test fails.
    """

    legs: Annotated[tuple[int, ...], Field(min_length=1)]
    unit: Literal["m", "rad"]
    value: float
    sigma: float
    limit: float = Field(gt=0)


class Run(Schema):
    """One test of a calibrated machine.

    time : of the test, local, ISO 8601.
    session : name of the session.
    digest : digest of the session's data.
    calibration : digest of the calibrated machine.
    configurations : number of tested configurations.
    share : largest statistic of all tests, relative to its threshold.
    zeros : zeros of the legs that have one.
    """

    time: Annotated[str, AfterValidator(_iso_time)]
    session: str
    digest: str
    calibration: str
    configurations: int
    result: Result
    share: float
    zeros: tuple[LegRun, ...]

    @property
    def when(self) -> datetime:
        """Time of the test."""
        return datetime.fromisoformat(self.time)


class _EarlierWatch(Schema):
    """Part of watch.json that a later result continues."""

    model_config = ConfigDict(extra="ignore")

    runs: tuple[Run, ...] = ()


def run_of(
    calibration: SavedCalibration,
    session: Session,
    judged: ChangeTests,
    verdict: Verdict,
    configurations: int,
) -> Run:
    """Entry of a finished test.

    configurations : number of those tested.
    """
    machine = json_text(calibration.machine.to_document()).encode("utf-8")
    return Run(
        time=datetime.now().isoformat(timespec="seconds"),
        session=session.called,
        digest=session_digest(session, digests(session)),
        calibration=blake2b(machine, digest_size=DIGEST_BYTES).hexdigest(),
        configurations=configurations,
        result=_result(judged, verdict),
        share=max((share(test, judged.level) for test in judged.tests), default=0.0),
        zeros=tuple(filter(None, (_zero(leg, judged.level) for leg in judged.legs))),
    )


def _result(judged: ChangeTests, verdict: Verdict) -> Result:
    """Result of a test in one word."""
    if verdict.usable:
        return "as_calibrated"
    if judged.another_machine:
        return "another_machine"
    parts = {one.suspect.cause.part for one in judged.findings}
    return "changed" if judged.changed and parts != {"camera"} else "undecided"


def share(test: Score, level: float) -> float:
    """Statistic of a test relative to its threshold at a level."""
    from scipy.special import chdtri

    return test.chi2 / float(chdtri(test.dof, level))


def _zero(leg: LegTest, level: float) -> LegRun | None:
    """Zero of a leg's reading; None if these data do not determine it."""
    from scipy.special import chdtri

    if leg.change is None or leg.zero is None or not leg.zero.dof:
        return None
    value, sigma = float(leg.change.value[0]), float(leg.change.sigma[0])
    if not math.isfinite(sigma):
        return None
    return LegRun(
        legs=tuple(j + 1 for j in leg.legs),
        unit="rad" if leg.unit == "rad" else "m",
        value=value,
        sigma=sigma,
        limit=sigma * float(chdtri(1, level)) ** 0.5,
    )


def earlier_runs(folder: Path | str) -> tuple[Run, ...]:
    """Runs of an earlier result in a folder, the oldest first; none without one.

    Raises InputError for a result whose list of runs cannot be read.
    """
    path = Path(folder) / WATCH_DOCUMENT_FILE
    if not path.is_file():
        return ()
    return validated_document(read_json(path, str(path)), _EarlierWatch).runs


def continued(earlier: tuple[Run, ...], run: Run) -> tuple[Run, ...]:
    """Runs with a further one, in the order of their times.

    A test of the same data against the same calibration takes the place of the earlier one.
    """

    def key(one: Run) -> tuple[str, str]:
        return one.digest, one.calibration

    return (*(one for one in earlier if key(one) != key(run)), run)
