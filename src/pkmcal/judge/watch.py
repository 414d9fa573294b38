"""Test of whether a machine has changed since its calibration: ``pkmcal watch``.

New images, boards or poses with their readings are measured as for a calibration. Then the
calibrated machine is fixed, the poses of platform and stations are estimated, and the residuals are
tested for a change of each leg. The machine is not calibrated anew.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.calibration.calibrate import Calibration
from pkmcal.calibration.holdout import select
from pkmcal.calibration.machine_identity import read_same_machine
from pkmcal.calibration.saved_calibration import CalibrationPrior, SavedCalibration
from pkmcal.errors import InputError
from pkmcal.files import json_value
from pkmcal.identify.assembly import observed_configurations
from pkmcal.judge.causes import magnified
from pkmcal.judge.changes import CHANGE_ALPHA, ChangeTests, StationTest, detect_changes
from pkmcal.judge.fixed_machine import Held, Trust, change_evidence, hold
from pkmcal.judge.new_data import (
    calibrated_rows,
    check_new,
    measured_new_data,
    temperature_notes,
)
from pkmcal.judge.sentences import ComparedSession, Names, watch_verdict
from pkmcal.judge.watch_runs import Run, continued, run_of
from pkmcal.measurements.rows import RowGroups
from pkmcal.outcome import Verdict
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.ranges import check_number
from pkmcal.session.load import Session
from pkmcal.wording import listed

WATCH_FORMAT = 1
NOTHING_NEW = (
    "there is nothing new in this session: the calibration was made from it",
    "images, or poses, that were taken after the calibration",
    "Take five or more new images from one place, with their readings",
)


@dataclass(frozen=True)
class Watch:
    """Results of the tests of a calibrated machine.

    calibration : as loaded.
    judged : tests for a change.
    residuals : (K,) root mean squares of each configuration's residuals with the fixed machine, in
        standard deviations.
    calibrated : (K,) configurations used by the calibration, which are excluded.
    observed : (K,) configurations that are tested.
    noise_scale, pose_scale : factors on the stated noise.
    same_place : stations that are assumed to have the poses of the calibration.
    stations_moved : stations among these that have moved.
    run : this test as an entry of the run chart.
    earlier : earlier entries.
    """

    calibration: SavedCalibration
    session: Session
    verdict: Verdict
    judged: ChangeTests
    residuals: Array
    calibrated: Booleans
    observed: Booleans
    noise_scale: float
    pose_scale: float
    run: Run
    same_place: tuple[str, ...] = ()
    stations_moved: tuple[StationTest, ...] = ()
    timings: dict[str, float] = field(default_factory=dict)
    earlier: tuple[Run, ...] = ()

    __repr__ = short_repr

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON: m and rad."""
        names = self.session.configurations
        return json_value(
            {
                "pkmcal_watch": WATCH_FORMAT,
                "verdict": self.verdict.document(),
                **self.judged.document(self.calibration.machine),
                "configurations": [*compress(names, self.observed)],
                "known_configurations": [*compress(names, self.calibrated)],
                "noise_scale": self.noise_scale,
                "pose_scale": self.pose_scale,
                "same_place": self.same_place,
                "moved_stations": [
                    {
                        "name": self.session.station_names[s.station],
                        **asdict(s.test),
                        "turn": s.change.value[:3],
                        "shift": s.change.value[3:],
                        "sigma": s.change.sigma,
                    }
                    for s in self.stations_moved
                ],
                "runs": [one.model_dump() for one in continued(self.earlier, self.run)],
                "timings": self.timings,
            }
        )


def watch_machine(
    calibration: SavedCalibration | Path | str,
    session: Session | Path | str,
    *,
    alpha: float = CHANGE_ALPHA,
    seed: int = 0,
    same_place: Sequence[str] = (),
    progress: Progress = no_progress,
) -> Watch:
    """Test a calibrated machine on new data, without writing files.

    calibration : its folder, or as loaded.
    session : a loaded session, or its folder; a few configurations are enough.
    alpha : false-alarm rate.
    seed : of the localization.
    same_place : names of stations whose camera was not touched since the calibration; a station
        that has evidently moved is localized anew and reported.

    Raises InputError if the two do not belong together.
    """
    from threadpoolctl import threadpool_limits

    check_number("watch", "alpha", alpha)
    check_number("watch", "seed", seed)
    with threadpool_limits(1, "blas"):  # as in calibrate
        began = time.perf_counter()
        saved, session = read_same_machine(calibration, session)
        _check_usable(saved)
        session = _with_fixed_poses(saved, session, same_place)
        # New configurations, measured and estimated with the machine free.
        calibrated = calibrated_rows(saved, session)
        check_new(calibrated, np.ones_like(calibrated), *NOTHING_NEW)
        remeasured = measured_new_data(saved, session, seed, part(progress, 0, 0.9))
        session = replace(remeasured.session, machine=session.machine)
        observed = observed_configurations(remeasured.measurements)
        check_new(calibrated, observed, *NOTHING_NEW)

        progress("Testing for changes", 0.9)
        # Weights and noise of the new data, with the machine free; then the fit with it fixed.
        old = saved.document.get("statistics") or {}
        factors = ("noise_scale", "pose_scale", "link_scale")
        before = RowGroups(*(float(old.get(name, 1.0)) for name in factors))
        # the noise of readings as the calibration scaled it, if the session states the same
        joints = (saved.document.get("session") or {}).get("joints") or {}
        same = joints.get("noise") == session.joint_noise
        reading_scale = float(old.get("reading_scale", 1.0)) if same else 1.0
        data_weights = Trust.of(remeasured.estimate, before, reading_scale)
        noise = remeasured.estimate.statistics.noise_scale * data_weights.scale.edges
        held = _hold_new(saved, session, remeasured, data_weights, ~calibrated)
        prior = saved.prior(same_place, session.station_names)
        judged, prior, stations_moved = tests_with_fixed_stations(held, prior, alpha)
        compared = ComparedSession(
            session.configurations,
            calibrated,
            observed,
            noise / before.edges,
            names_of(session),
            stations_moved,
        )
        verdict = watch_verdict(judged, compared)
        notes = (*verdict.findings, *temperature_notes(saved, session))
        verdict = replace(verdict, findings=notes)
        tested = observed & ~calibrated
        return Watch(
            calibration=saved,
            session=session,
            verdict=verdict,
            judged=judged,
            residuals=held.residuals(),
            calibrated=calibrated,
            observed=tested,
            noise_scale=noise,
            pose_scale=data_weights.scale.poses,
            run=run_of(saved, session, judged, verdict, int(tested.sum())),
            same_place=tuple(session.station_names[k] for k in prior.stations),
            stations_moved=stations_moved,
            timings={**remeasured.timings, "all": time.perf_counter() - began},
        )


def names_of(session: Session) -> Names:
    """Names of a session's cameras and stations, in the order of their indices."""
    cameras = dict.fromkeys(station.camera_file for station in session.stations)
    return Names(tuple(cameras), session.station_names)


def _with_fixed_poses(
    saved: SavedCalibration, session: Session, same_place: Sequence[str]
) -> Session:
    """Session with the calibration's poses of the kept stations.

    Raises `InputError` for a station that the session, or the calibration, does not have.
    """
    for name in same_place:
        if name not in session.station_names:
            raise InputError(
                "the session has no station of this name",
                where="--same-place",
                found=name,
                expected=listed(session.station_names, 8),
                next_step="A camera that was left in place has the same name in both sessions",
            )
    prior = saved.prior(same_place, session.station_names)
    places = dict(zip(prior.stations, prior.T_camera_base, strict=True))
    stations = tuple(
        replace(station, T_camera_base=places.get(k, station.T_camera_base))
        for k, station in enumerate(session.stations)
    )
    return replace(session, stations=stations)


def tests_with_fixed_stations(
    held: Held, prior: CalibrationPrior, alpha: float
) -> tuple[ChangeTests, CalibrationPrior, tuple[StationTest, ...]]:
    """All tests, the prior with the stations that remain fixed, and the stations that have moved.

    If moved cameras explain the data better than any change of the machine, they are freed and the
    tests repeated; so the false-alarm rate remains alpha.
    """
    moved: list[StationTest] = []
    while True:
        judged = detect_changes(change_evidence(held, prior), held.machine, alpha)
        if not judged.moved:
            return judged, prior, tuple(moved)
        moved += [s for s in judged.stations if s.station in judged.moved]
        prior = prior.only([s for s in prior.stations if s not in judged.moved])


def _hold_new(
    saved: SavedCalibration,
    session: Session,
    remeasured: Calibration,
    data_weights: Trust,
    keep: Booleans,
) -> Held:
    """Fit of the new configurations, mask (K,) ``keep``, with the calibrated machine fixed."""
    data = remeasured.estimate.stated_edge_noise(remeasured.measurements)
    cameras = [station.camera for station in session.stations]
    magnified_data = magnified(data, remeasured.observation, cameras) if cameras else None
    weights = RowGroups(
        data_weights.robust.edges[keep[data.edges.configuration]],
        data_weights.robust.poses[
            keep[data.poses.configuration] | ~data.on_platform[data.poses.mount]
        ],
        data_weights.robust.links[data.links_among(keep)],
    )
    return hold(
        saved.machine,
        select(data, keep),
        remeasured.estimate.state,
        replace(data_weights, robust=weights),
        select(magnified_data, keep) if magnified_data else None,
    )


def _check_usable(saved: SavedCalibration) -> None:
    """Raise `InputError` for a calibration with the verdict not to use it."""
    if saved.verdict.usable:
        return
    raise InputError(
        "this calibration should not be used, so no data can be tested against it",
        where=str(saved.path),
        found=saved.verdict.reasons[0] if saved.verdict.reasons else saved.verdict.headline,
        expected="a calibration that was not refused",
        next_step="Calibrate the machine first",
        code="calibration.refused",
    )
