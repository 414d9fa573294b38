"""Validation of a calibration on independent data: ``pkmcal validate``.

The session's images are measured as for a calibration. Then the calibrated machine is fixed, the
platform's poses are estimated without their readings, and the readings are predicted.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Booleans, short_repr
from pkmcal.calibration.calibrate import Calibration
from pkmcal.calibration.holdout import check_predictable
from pkmcal.calibration.machine_identity import read_same_machine
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.errors import PkmcalError
from pkmcal.files import json_value
from pkmcal.judge.comparison import NominalComparison, compare_with_nominal
from pkmcal.judge.holdouts import HoldOut, by_regions
from pkmcal.judge.new_data import (
    calibrated_rows,
    check_new,
    measured_new_data,
    repeated_rows,
    temperature_notes,
)
from pkmcal.judge.paths import LinePath, line_path, paths_of
from pkmcal.judge.prediction import predict
from pkmcal.judge.sentences import validation_verdict
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, note
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.ranges import check_number
from pkmcal.session.load import Session

VALIDATION_FORMAT = 1
NOT_INDEPENDENT = (
    "the session is not independent: the calibration was made from these images",
    "images that the calibration did not see",
    "Take new images, calibrate with --holdout N, or hold out regions of this session with"
    " --regions N",
)


@dataclass(frozen=True)
class Validation:
    """Results of a validation.

    calibration : as loaded.
    judged : comparison on configurations that the calibration did not use; None if only regions
        were held out.
    remeasured : measurements of the new data, with an estimate of their own.
    calibrated : (K,) configurations that the calibration used.
    repeated : (K,) new measurements at poses that the calibration used.
    regions : holdouts within the session.
    paths : straight paths.
    """

    calibration: SavedCalibration
    session: Session
    verdict: Verdict
    judged: NominalComparison | None
    remeasured: Calibration
    calibrated: Booleans
    repeated: Booleans
    regions: tuple[HoldOut, ...]
    paths: tuple[LinePath, ...]
    timings: dict[str, float] = field(default_factory=dict)

    __repr__ = short_repr

    def as_dict(self) -> dict[str, Any]:
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
    progress: Progress = no_progress,
) -> Validation:
    """Errors of a calibration on a session that it did not use, without writing files.

    calibration : its folder, or as loaded.
    session : a loaded session, or its folder.
    regions : number of regions of the session's workspace that are held out in addition, one after
        the other, from a calibration on the rest; the session may then be that of the calibration.
    seed : of the localization.

    Raises InputError if the two do not belong together.
    """
    from threadpoolctl import threadpool_limits

    check_number("validate", "regions", regions)
    check_number("validate", "seed", seed)
    with threadpool_limits(1, "blas"):  # as in calibrate
        began = time.perf_counter()
        saved, session = read_same_machine(calibration, session)
        check_predictable(session)
        # New configurations, measured and estimated with the machine free.
        lines, calibrated = paths_of(session), calibrated_rows(saved, session)
        if not regions:
            # configurations with an image; all of a tracker's, or of readings alone
            every = bool(session.trackers or not session.stations)
            observed = np.full(len(session.configurations), every)
            for station in session.stations:
                observed[[photo.configuration for photo in station.images]] = True
            check_new(calibrated, observed, *NOT_INDEPENDENT)
        remeasured = measured_new_data(saved, session, seed, part(progress, 0, 0.8))
        session = replace(remeasured.session, machine=session.machine)
        estimate = remeasured.estimate
        data = estimate.stated_edge_noise(remeasured.measurements)

        progress("Predicting the readings", 0.8)
        nominal = nominal_of(saved)
        prediction = predict(saved.machine, data, estimate.state)
        if not regions:
            check_new(calibrated, prediction.observed, *NOT_INDEPENDENT)
        # Calibrated and nominal machine compared on the new configurations.
        judged, failed = None, tuple[Finding, ...]()
        repeated = ~calibrated & repeated_rows(saved, session)
        new = np.flatnonzero(prediction.observed & ~calibrated)
        if new.size:
            try:
                by_nominal = predict(nominal, data, estimate.state)
            except PkmcalError as error:
                # the nominal machine is too far off for its poses to be found
                by_nominal = None
                why = str(error).rstrip(".")
                failed = (note("validation.nominal_fails", why=why),)
            judged = compare_with_nominal(
                nominal, saved.covariance, data, prediction, by_nominal, new
            )

        progress("Holding out regions", 0.85)
        held_out = by_regions(nominal, data, estimate, regions) if regions else ()
        verdict = validation_verdict(judged, held_out, saved.machine, data, repeated)
        return Validation(
            calibration=saved,
            session=session,
            verdict=replace(
                verdict,
                findings=(*verdict.findings, *failed, *temperature_notes(saved, session)),
            ),
            judged=judged,
            remeasured=remeasured,
            calibrated=calibrated,
            repeated=repeated,
            regions=held_out,
            paths=tuple(line_path(*line, nominal, session, prediction) for line in lines.items()),
            timings={**remeasured.timings, "all": time.perf_counter() - began},
        )


def nominal_of(saved: SavedCalibration) -> Machine:
    """Nominal machine of a calibration.

    The machine of a loaded calibration has the calibrated values as its nominal ones; holdouts of
    regions must not use them as priors, because they depend on the held-out data.
    """
    table = replace(saved.machine.parameters, nominal=saved.nominal.copy())
    return replace(saved.machine, parameters=table, values=saved.nominal.copy())
