"""A calibration on data that it did not see: ``pkmcal validate``.

The session's photographs are measured as for a calibration. Then the calibrated machine is held,
the platform's poses are seen without their readings, and the readings become predictions.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Booleans, short_repr
from pkmcal.calibration.calibrate import CalibrationProgress
from pkmcal.calibration.machine_identity import read_same_machine
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.errors import PkmcalError
from pkmcal.files import json_value
from pkmcal.judge.comparison import BesideDrawing, compare_with_drawing
from pkmcal.judge.holdouts import HoldOut, by_regions
from pkmcal.judge.new_data import calibrated_rows, check_new, measured_new_data, repeated_rows
from pkmcal.judge.paths import LinePath, line_path, paths_of
from pkmcal.judge.prediction import predict
from pkmcal.judge.sentences import validation_verdict
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, note
from pkmcal.ranges import check_number
from pkmcal.session.load import Session

VALIDATION_FORMAT = 1
NOT_INDEPENDENT = (
    "the session is not independent: the calibration was made from these photographs",
    "photographs that the calibration did not see",
    "Take new photographs, calibrate with --holdout N, or hold out regions of this session with"
    " --regions N",
)


@dataclass(frozen=True)
class Validation:
    """Everything that a validation found.

    calibration : as read back. judged : on configurations that it did not see; None where there are
    none, and only regions were held out. calibrated : (K,) configurations that it had seen.
    repeated : (K,) those that are new measurements of poses that it used. regions : hold-outs
    within the session. paths : the straight ones.
    """

    calibration: SavedCalibration
    session: Session
    verdict: Verdict
    judged: BesideDrawing | None
    calibrated: Booleans
    repeated: Booleans
    regions: tuple[HoldOut, ...]
    paths: tuple[LinePath, ...]
    timings: dict[str, float] = field(default_factory=dict)

    __repr__ = short_repr

    def document(self) -> dict[str, Any]:
        """Plain data for JSON: m and rad."""
        names = self.session.configurations
        results = {
            "pkmcal_validation": VALIDATION_FORMAT,
            "verdict": self.verdict.document(),
            "new_data": self.judged.document(names) if self.judged else None,
            "known_configurations": [*compress(names, self.calibrated)],
            "repeated_configurations": [*compress(names, self.repeated)],
            "regions": [item.document(names) for item in self.regions],
            "paths": [asdict(path) for path in self.paths],
            "joints": {
                "names": self.session.document["joints"]["columns"],
                "units": self.calibration.machine.joint_units,
            },
            "timings": self.timings,
        }
        return json_value(results)


def validate_calibration(
    calibration: SavedCalibration | Path | str,
    session: Session | Path | str,
    *,
    regions: int = 0,
    seed: int = 0,
    progress: CalibrationProgress | None = None,
) -> Validation:
    """Errors of a calibration on a session that it did not see; nothing is written.

    calibration : its folder, or as read back. session : a loaded session, or its folder.
    regions : besides, hold out so many regions of the session's workspace, one after the other, and
    calibrate on the rest; the session may then be the calibration's own. seed : of the search.
    Raises InputError where the two do not belong together.
    """
    from threadpoolctl import threadpool_limits

    check_number("validate", "regions", regions)
    check_number("validate", "seed", seed)
    values = progress or (lambda _text, _share: None)
    with threadpool_limits(1, "blas"):  # as in calibrate
        began = time.perf_counter()
        saved, session = read_same_machine(calibration, session)
        lines, reference_values = paths_of(session), calibrated_rows(saved, session)
        if not regions:
            check_new(reference_values, _photographed(session), *NOT_INDEPENDENT)
        remeasured = measured_new_data(saved, session, seed, values, 0.8)
        session = replace(remeasured.session, machine=session.machine)
        estimate = remeasured.estimate
        data = estimate.stated_edge_noise(remeasured.measurements)

        values("Predicting the readings", 0.8)
        drawing = drawing_of(saved)
        prediction = predict(saved.machine, data, estimate.state)
        if not regions:
            check_new(reference_values, prediction.observed, *NOT_INDEPENDENT)
        judged, failed = None, tuple[Finding, ...]()
        repeated = ~reference_values & repeated_rows(saved, session)
        new = np.flatnonzero(prediction.observed & ~reference_values)
        if new.size:
            try:
                by_drawing = predict(drawing, data, estimate.state)
            except PkmcalError as error:  # so far off that its poses are not found
                by_drawing = None
                why = str(error).rstrip(".")
                failed = (note("validation.nominal_fails", why=why),)
            judged = compare_with_drawing(
                drawing, saved.covariance, data, prediction, by_drawing, new
            )

        values("Holding out regions", 0.9)
        held_out = by_regions(drawing, data, estimate, regions) if regions else ()
        verdict = validation_verdict(judged, held_out, saved.machine, data, repeated)
        return Validation(
            calibration=saved,
            session=session,
            verdict=replace(verdict, findings=(*verdict.findings, *failed)),
            judged=judged,
            calibrated=reference_values,
            repeated=repeated,
            regions=held_out,
            paths=tuple(line_path(*line, drawing, session, prediction) for line in lines.items()),
            timings={**remeasured.timings, "all": time.perf_counter() - began},
        )


def drawing_of(saved: SavedCalibration) -> Machine:
    """The machine as drawn: its values, and where the drawing holds an estimate.

    A calibration read back has its own values for a drawing; regions would be held out of an
    estimate that is held to what they told.
    """
    table = replace(saved.machine.parameters, drawing=saved.drawing.copy())
    return replace(saved.machine, parameters=table, values=saved.drawing.copy())


def _photographed(session: Session) -> Booleans:
    """(K,) configurations with a photograph; all where a tracker may have seen them, or where
    readings alone were taken.
    """
    out = np.full(len(session.configurations), bool(session.trackers or not session.stations))
    for station in session.stations:
        out[[photo.configuration for photo in station.photographs]] = True
    return out
