"""A calibration on data that it did not see: ``pkmcal validate``.

The session's photographs are measured as for a calibration. Then the calibrated machine is held,
the platform's poses are seen without their readings, and the readings become predictions.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Booleans, Integers
from pkmcal.calibration.calibrate import Calibration, Progress, calibrate
from pkmcal.calibration.results import SavedCalibration, load
from pkmcal.errors import InputError, ResultError
from pkmcal.files import plain
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.session.load import Session, load_session
from pkmcal.validate.figures import holdout_document, judged_document, reading_units
from pkmcal.validate.held import Prediction, predict
from pkmcal.validate.holdouts import HoldOut, Judged, by_regions, judge
from pkmcal.validate.independence import check_independent, check_machine, known_rows
from pkmcal.validate.paths import Straightness, straightness
from pkmcal.validate.words import verdict_of

__all__ = ["LinePath", "Validation", "validate"]

FORMAT = 1
SHORTEST = 3
"""Points without which nothing is straight or bent."""


@dataclass(frozen=True)
class LinePath:
    """A straight path that the session names: how straight its tool points are ([C] Table 4).

    seen : by the photographs; None where they show fewer than three. drawing, calibrated : by
    forward kinematics of the readings; None where a machine cannot be closed. n : points.
    """

    name: str
    n: int
    seen: Straightness | None
    drawing: Straightness | None
    calibrated: Straightness | None


@dataclass(frozen=True)
class Validation:
    """Everything that a validation found.

    calibration : as read back. judged : on configurations that it did not see; None where there are
    none, and only regions were held out. known : (K,) configurations that it had seen.
    regions : hold-outs within the session. paths : the straight ones.
    """

    calibration: SavedCalibration
    session: Session
    verdict: Verdict
    judged: Judged | None
    known: Booleans
    regions: tuple[HoldOut, ...]
    paths: tuple[LinePath, ...]
    timings: dict[str, float] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """Plain data for JSON: m and rad."""
        names = self.session.configurations
        found = {
            "pkmcal_validation": FORMAT,
            "verdict": asdict(self.verdict),
            "new_data": judged_document(self.judged, names) if self.judged else None,
            "known_configurations": [n for n, flag in zip(names, self.known, strict=True) if flag],
            "regions": [holdout_document(item, names) for item in self.regions],
            "paths": [asdict(path) for path in self.paths],
            "joints": {
                "names": self.session.document["joints"]["columns"],
                "units": reading_units(self.calibration.machine),
            },
            "timings": self.timings,
        }
        return plain(found)


def validate(
    calibration: SavedCalibration | Path | str,
    session: Session | Path | str,
    *,
    regions: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
) -> Validation:
    """Errors of a calibration on a session that it did not see; nothing is written.

    calibration : its folder, or as read back. session : a loaded session, or its folder.
    regions : besides, hold out so many regions of the session's workspace, one after the other, and
    calibrate on the rest; the session may then be the calibration's own. seed : of the search.
    Raises InputError where the two do not belong together.
    """
    from threadpoolctl import threadpool_limits

    told = progress or (lambda _text, _share: None)
    with threadpool_limits(1, "blas"):  # as in calibrate
        return _validate(calibration, session, regions, seed, told)


def _validate(
    calibration: SavedCalibration | Path | str,
    session: Session | Path | str,
    regions: int,
    seed: int,
    told: Progress,
) -> Validation:
    """:func:`validate`, step by step."""
    began = time.perf_counter()
    saved = calibration if isinstance(calibration, SavedCalibration) else load(calibration)
    if not isinstance(session, Session):
        session = load_session(session)
    check_machine(saved, session)
    lines = _lines(session)
    known = known_rows(saved, session)
    if not regions:
        check_independent(known, _photographed(session))
    # The calibrated machine is the best guess of where to look.
    looked = calibrate(
        replace(session, machine=saved.machine),
        seed=seed,
        progress=lambda text, share: told(text, 0.8 * share),
    )
    told("Predicting the readings", 0.8)
    drawing = drawing_of(saved)
    found = predict(saved.machine, looked.measurements, looked.estimate.state)
    new = np.flatnonzero(found.seen & ~known)
    judged = _judged(saved, drawing, looked, found, new) if new.size else None
    if not regions:
        check_independent(known, found.seen)
    told("Holding out regions", 0.9)
    held = by_regions(drawing, looked.measurements, looked.estimate, regions) if regions else ()
    return Validation(
        calibration=saved,
        session=session,
        verdict=verdict_of(judged, held, saved.machine),
        judged=judged,
        known=known,
        regions=held,
        paths=tuple(_path(*line, drawing, session, found) for line in lines),
        timings={**looked.timings, "all": time.perf_counter() - began},
    )


def drawing_of(saved: SavedCalibration) -> Machine:
    """The machine as drawn: its values, and where the drawing holds an estimate.

    A calibration read back has its own values for a drawing; regions would be held out of an
    estimate that is held to what they told.
    """
    table = replace(saved.machine.parameters, drawing=saved.drawing.copy())
    return replace(saved.machine, parameters=table, values=saved.drawing.copy())


def _judged(
    saved: SavedCalibration,
    drawing: Machine,
    looked: Calibration,
    found: Prediction,
    rows: Integers,
) -> Judged:
    """The calibrated machine beside the drawing, which may see with its own geometry as well."""
    by_drawing = _by_drawing(drawing, looked.measurements, looked)
    return judge(drawing, saved.covariance, looked.measurements, found, by_drawing, rows)


def _by_drawing(
    drawing: Machine, measurements: Measurements, looked: Calibration
) -> Prediction | None:
    try:
        return predict(drawing, measurements, looked.estimate.state)
    except ResultError:  # so far off that its poses are not found
        return None


def _photographed(session: Session) -> Booleans:
    """(K,) configurations with a photograph; all where a tracker may have seen them."""
    out = np.full(len(session.configurations), bool(session.trackers))
    for station in session.stations:
        out[[photo.configuration for photo in station.photographs]] = True
    return out


def _lines(session: Session) -> list[tuple[str, list[int]]]:
    """The session's straight paths: name and rows of their configurations."""
    paths: dict[str, Any] = session.document.get("paths") or {}
    out: list[tuple[str, list[int]]] = []
    for name, members in paths.items():
        for k, member in enumerate(members):
            if member not in session.configurations:
                raise InputError(
                    "there is no such configuration",
                    where=f"session.yaml, paths.{name}[{k + 1}]",
                    found=member,
                    expected=f"a name from {session.document['joints']['file']}",
                )
        if len(set(members)) < SHORTEST:
            raise InputError(
                "too few configurations for a straight path",
                where=f"session.yaml, paths.{name}",
                found=str(len(set(members))),
                expected=f"{SHORTEST} at least",
            )
        out.append((name, [session.configurations.index(member) for member in members]))
    return out


def _path(
    name: str, rows: list[int], drawing: Machine, session: Session, found: Prediction
) -> LinePath:
    seen = found.T_base_platform[rows][found.seen[rows]]
    joints = session.joints[rows]
    by = []
    for machine in (drawing, found.machine):
        result = machine.forward_result(joints)
        closes = bool(result.converged.all())
        by.append(straightness(result.T_base_platform[:, :3, 3]) if closes else None)
    return LinePath(
        name=name,
        n=len(rows),
        seen=straightness(seen[:, :3, 3]) if len(seen) >= SHORTEST else None,
        drawing=by[0],
        calibrated=by[1],
    )
