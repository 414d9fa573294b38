"""What measured poses tell before any calibration, as `pkmcal check` reports it."""

from __future__ import annotations

from pkmcal.boards.views import Boards
from pkmcal.calibration.doubts import check_poses, richer_models, turning
from pkmcal.calibration.gather import known_stations, measurements_of, refinement_of, with_poses
from pkmcal.calibration.turns import identify_poses
from pkmcal.errors import InputError, PkmcalError
from pkmcal.identify.verdict import POOR
from pkmcal.outcome import Finding, Level, wrong
from pkmcal.session.load import Session


def pose_findings(session: Session, boards: Boards) -> list[Finding]:
    """How the platform turns, and, where no legs are needed for it, whether the poses fit."""
    if not session.trackers and (not boards.stations or boards.body == "base"):
        return []
    try:
        measurements = measurements_of(session, boards)
        turns = turning(session, measurements.poses, measurements.on_platform)
        findings = [Finding(Level.DOUBTFUL if bad else Level.NOTE, text) for bad, text in turns]
        if any("legs" in station.observe for station in session.stations):
            return findings
        return findings + _fit(session, boards)
    except InputError as error:
        return [wrong(error)]
    except PkmcalError as error:
        return [Finding(Level.DOUBTFUL, str(error))]


def _fit(session: Session, boards: Boards) -> list[Finding]:
    """Whether the mechanism, its parameters adjusted, explains the poses."""
    known = with_poses(session, boards, known_stations(session, boards))
    cameras = refinement_of(session, refine=False)
    turns = identify_poses(session, boards, known, cameras, lambda _text, _share: None)
    richer = richer_models(session, turns.measurements, turns.estimate)
    check_poses(session, turns.measurements, turns.estimate, richer)
    scale = turns.estimate.statistics.pose_scale
    if scale <= POOR:
        return []
    better = min(richer, key=lambda model: model.scale, default=None)
    told = f" With --model {better.name} it is {better.scale:.2f} times." if better else ""
    text = f"The machine explains the measured poses only to {scale:.1f} times their noise.{told}"
    return [Finding(Level.DOUBTFUL, text)]
