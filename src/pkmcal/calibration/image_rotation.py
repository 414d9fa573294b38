"""Hypothesis that images are upside down relative to their camera's file, by a score test.

The machine in images rotated by half a turn is localized as well as before, with a rotated station.
But the principal point is then on the other side of the image's middle, which no pose of the camera
compensates. So the change from a camera to the same one rotated by half a turn is a column of one
number (:mod:`pkmcal.identify.score`), whose estimate is 0 if the file is right and 1 if the images
are upside down. At log-odds of ``act`` the images are measured with the rotated camera (a repair);
at ``report`` the verdict has a warning. Cameras that are estimated with the machine are not tested.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import exp

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.model_violations import CameraChange
from pkmcal.calibration.refinement import RefinementResult
from pkmcal.cameras import Camera
from pkmcal.cameras.contract import CENTER
from pkmcal.cameras.files import written_camera
from pkmcal.identify.score import ScoreTests
from pkmcal.measurements import Column
from pkmcal.outcome.finding import Finding, doubtful, note
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS, Hypothesis, Ranked, decide
from pkmcal.session.load import Session

USUAL_CENTRE_ERROR = 1.5
"""Prior sigma (px) of a calibrated camera's principal point along the change, if its file states
none."""
LEAST_CENTRE_ERROR = 1e-6
"""Prior sigma (px) of a principal point that a file states to be exact."""


@dataclass(frozen=True)
class UpsideDown(Hypothesis[Session]):
    """Images that are upside down relative to their camera's file, the subject.

    camera : rotated by half a turn, as the images are. Facts: ``stations``, names in session.yaml.
    """

    camera: Camera = field(kw_only=True)


def upside_down_images(file: str, entries: Sequence[str], camera: Camera) -> UpsideDown:
    """Images of some stations that are upside down. camera : of the file, turned by half."""
    return UpsideDown(
        "image.upside_down",
        file,
        partial(turned_round, cameras={file: camera}),
        action="repair",
        facts={"stations": tuple(entries)},
        camera=camera,
    )


def rotation_finding(one: Ranked[UpsideDown]) -> Finding:
    """A note where the images are measured by the turned camera, else a warning."""
    file, camera = one.hypothesis.subject, one.hypothesis.camera
    facts = {"file": file, **one.hypothesis.facts, "log_odds": one.log_odds}
    if decide([one]) is None:
        return doubtful("image.perhaps_upside_down", file, **facts, odds=exp(one.log_odds))
    x, y = camera.document()["center"]
    return note(
        "image.upside_down",
        file,
        **facts,
        odds=round(exp(HYPOTHESIS_THRESHOLDS.act)),
        centre_x=x,
        centre_y=y,
        written=written_camera(file),
    )


def upside_down(session: Session, turns: RefinementResult) -> tuple[Ranked[UpsideDown], ...]:
    """Cameras whose images are upside down relative to their files with log-odds of ``report`` or
    more.

    Cameras with a station whose images are upright with the same log-odds are excluded.
    """
    changed = CameraChange.of(session, turns.observation, turns.measurements)
    refined = turns.measurements.intrinsics_factor.shape[-1] > 0
    if changed is None or refined or not len(turns.measurements.edges):
        return ()
    entries = np.array([station.entry for station in session.stations])
    cameras = {station.entry: (station.camera_file, station.camera) for station in session.stations}
    ways = {entry: _half_turn_change(camera) for entry, (_, camera) in cameras.items()}
    effects = [
        changed.of_stations(Column("image.turn"), entries == entry, attempt[:, None])
        for entry, attempt in ways.items()
    ]
    fits = ScoreTests(*turns.estimate.linearized, effects).fitted(range(len(effects)))
    out = list[Ranked[UpsideDown]]()
    for file, camera in dict(cameras.values()).items():
        own = [k for k, (mine, _) in enumerate(cameras.values()) if mine == file]
        value = np.concatenate([fits[k].value for k in own])
        sigma = np.concatenate([fits[k].sigma for k in own])
        file_sigma = _file_sigma(camera)
        alone = [_log_odds(value[[k]], sigma[[k]], file_sigma) for k in range(len(own))]
        odds = _log_odds(value, sigma, file_sigma)
        if odds > HYPOTHESIS_THRESHOLDS.report and min(alone) > -HYPOTHESIS_THRESHOLDS.report:
            names = [list(cameras)[k] for k in own]
            hypothesis = upside_down_images(file, names, camera.turned_by_half())
            out.append(Ranked(hypothesis, odds, "score"))
    return tuple(out)


def _half_turn_change(camera: Camera) -> Array:
    """Change (n,) of a camera's parameters to those of the same camera turned by half."""
    return camera.turned_by_half().parameters - camera.parameters


def _file_sigma(camera: Camera) -> float:
    """Prior sigma of the number of the column, by the file's covariance of the principal point;
    infinite if the principal point is in the image's middle.
    """
    centre = _half_turn_change(camera)[CENTER]
    length = float(np.linalg.norm(centre))
    if not length:
        return np.inf
    if camera.covariance is None:
        return USUAL_CENTRE_ERROR / length
    covariance = camera.covariance[CENTER, CENTER] + LEAST_CENTRE_ERROR**2 * np.eye(2)
    return float(centre @ np.linalg.solve(covariance, centre)) ** -0.5


def _log_odds(value: Array, sigma: Array, file_sigma: float) -> float:
    """Log-odds of 1 against 0 by the estimates (n,) of some stations with standard deviations (n,).

    0 if the estimates determine nothing, or if neither camera fits.
    """
    weight = sigma**-2.0
    if not weight.any():
        return 0.0
    mean = float(weight @ value / weight.sum())
    variance = float(1 / weight.sum()) + file_sigma**2
    # further beyond 1 than the middle between 0 and 1 is before it: neither camera
    return (2 * mean - 1) / (2 * variance) if mean - 1 < 1 / 2 else 0.0


def turned_round(session: Session, cameras: Mapping[str, Camera]) -> Session:
    """Session with other cameras in place of those of some files."""
    stations = tuple(
        replace(station, camera=cameras.get(station.camera_file, station.camera))
        for station in session.stations
    )
    return replace(session, stations=stations)
