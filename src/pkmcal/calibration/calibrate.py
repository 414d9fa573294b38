"""From a session to a calibrated machine: load, observe, identify in turns, judge."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from pkmcal.boards.views import Boards
from pkmcal.calibration.aside import LeftOut, chosen, set_aside
from pkmcal.calibration.doubts import check_poses, richer_models, scale_doubt
from pkmcal.calibration.gather import CameraRefinement, known_stations, refinement_of, with_poses
from pkmcal.calibration.recognise import (
    boards_of,
    check_observable,
    found_stations,
    legs_stations,
    platform_poses,
    read_photographs,
)
from pkmcal.calibration.turns import Progress, identify_poses, take_turns
from pkmcal.identify.bundle import what_data_tell
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.unidentified import Findings, explain, joined_by_boards, seen_legs
from pkmcal.identify.verdict import judge
from pkmcal.measurements import Measurements, Observation
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.papers.conditions import conditions
from pkmcal.papers.methods import Method as PaperMethod
from pkmcal.papers.methods import by_paper
from pkmcal.session.load import Session, load_session

Method = Literal["bundle"] | PaperMethod


@dataclass(frozen=True)
class Calibration:
    """Everything that a calibration found.

    boards : the calibration board, where stations observe one. findings : what the data tell of
    the machine and what they leave open. timings : seconds by step. holdout : configurations that
    the estimate did not see, where that was asked for; :func:`pkmcal.judge.holdouts.holdout_of`
    tells what it predicts of them.
    """

    session: Session
    observation: Observation
    measurements: Measurements
    estimate: Estimate
    verdict: Verdict
    cameras: CameraRefinement
    method: str
    seed: int
    timings: dict[str, float] = field(default_factory=dict)
    boards: Boards = field(default_factory=Boards)
    findings: Findings | None = None
    holdout: LeftOut | None = None

    @property
    def machine(self) -> Machine:
        """The calibrated machine."""
        return self.estimate.machine


def calibrate(
    session: Session | Path | str,
    *,
    method: Method = "bundle",
    seed: int = 0,
    refine_camera: bool = False,
    holdout: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the machine of a session; nothing is written.

    session : a loaded session, or its folder.
    method : ``bundle`` (joint maximum likelihood), ``four-step`` ([A]), ``linear`` ([B]) or
        ``inverse-kinematic`` ([C]).
    seed : of the random search for the stations' poses.
    refine_camera : estimate the cameras' intrinsics with the machine, from their calibration's
        covariance on.
    holdout : configurations, spread over the workspace, to leave out, to judge the result by them.
    progress : called with the step in words and the share done.
    Raises InputError where the session is at fault, ResultError where nothing can be said.
    """
    from threadpoolctl import threadpool_limits

    # Matrices here are small: threads inside the linear algebra only wait for one another, and
    # beside our own threads they slow it twentyfold.
    with threadpool_limits(1, "blas"):
        told = progress or (lambda _text, _share: None)
        return _calibrate(session, method, seed, refine_camera, holdout, told)


def _calibrate(
    session: Session | Path | str,
    method: Method,
    seed: int,
    refine_camera: bool,
    holdout: int,
    told: Progress,
) -> Calibration:
    """:func:`calibrate`, step by step."""
    clock = _Clock()
    if not isinstance(session, Session):
        session = load_session(session)
    check_observable(session)
    # a pose that the machine cannot take is told before any work
    platform_poses(session, most=not legs_stations(session))
    cameras = refinement_of(session, refine_camera)
    clock.lap("load")
    told("Reading photographs", 0.0)
    photographs = read_photographs(session)
    clock.lap("decode")
    told("Recognising the machine", 0.2)
    boards = boards_of(session, photographs)
    known = known_stations(session, boards)
    known = found_stations(session, photographs, np.random.default_rng(seed), boards, known)
    known = with_poses(session, boards, known)
    clock.lap("observe")
    if photographs:
        turns = take_turns(session, photographs, boards, known, cameras, told, clock.lap)
    else:
        turns = identify_poses(session, boards, known, cameras, told)
    clock.lap("identify")
    richer = richer_models(session, turns.measurements, turns.estimate)
    check_poses(session, turns.measurements, turns.estimate, richer)
    whole = turns.measurements
    out = chosen(session.machine, turns.estimate, holdout) if holdout else None
    turns = set_aside(session.machine, turns, out) if out else turns
    estimate = turns.estimate
    if method != "bundle":
        told("Repeating the paper's method", 0.9)
        estimate = by_paper(method, session.machine, turns.measurements, estimate, seed)
    told("Judging", 0.95)
    findings = _findings(turns.measurements, estimate)
    unseen = len(out.rows) if out else 0
    verdict = judge(
        turns.observation,
        estimate,
        method,
        findings=findings,
        richer=richer,
        held_out=unseen,
        doubts=scale_doubt(session, estimate),
    )
    clock.lap("identify")
    return Calibration(
        session=session,
        observation=turns.observation,
        measurements=turns.measurements,
        estimate=estimate,
        verdict=verdict,
        cameras=turns.cameras,
        method=method,
        seed=seed,
        timings=clock.laps,
        boards=boards,
        findings=findings,
        holdout=LeftOut(out, whole) if out else None,
    )


def _findings(measurements: Measurements, estimate: Estimate) -> Findings:
    """What the data tell of the machine, in words, and the paper's conditions."""
    seen = seen_legs(
        measurements.edges,
        estimate.edge_weights,
        measurements.n_stations,
        estimate.machine.n_legs,
    )
    if not len(measurements.edges):  # boards alone: of no leg can be said that it was not seen
        seen = np.ones_like(seen)
    told = what_data_tell(measurements, estimate)
    counted = conditions(estimate.machine, seen) if len(measurements.edges) else ()
    return explain(told, estimate, joined_by_boards(seen, measurements), counted)


class _Clock:
    """Seconds by step; a step may be lapped several times."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Count the time since the last lap to a step."""
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now
