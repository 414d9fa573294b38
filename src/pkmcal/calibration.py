"""From a session to a calibrated machine: load, observe, identify in turns, judge.

What is known so far predicts where to look. The drawing and the rough poses find the machine in
the photographs; legs found to a pixel give a first estimate; that predicts edges to a pixel, whose
sub-pixel positions give the next.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.boards import Boards
from pkmcal.errors import ResultError
from pkmcal.identify.bundle import bundle, start_state, what_data_tell
from pkmcal.identify.conditions import conditions
from pkmcal.identify.paper_methods import Method as PaperMethod
from pkmcal.identify.paper_methods import by_paper
from pkmcal.identify.problem import Estimate, Measurements, Mount
from pkmcal.identify.start import better_start
from pkmcal.identify.verdict import Verdict, judge
from pkmcal.identify.words import Findings, explain, joined_by_boards, seen_legs
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.edges import EdgeSet, Observation, Rejection, concatenate
from pkmcal.observe.repeats import combined
from pkmcal.recognition import (
    WORKERS,
    boards_of,
    check_observable,
    found_stations,
    read_photographs,
)
from pkmcal.refinement import CameraRefinement, refinement_of
from pkmcal.session import Session, load_session

ROUNDS = 3
"""Most looks at the edges, each from the estimate before."""
SETTLED = 0.15
"""Median distance (px) of edges from their prediction below which another look changes nothing:
the first look corrects a pixel, the second what shading leaves, and profiles reach ten times as
far."""
FEWEST_EDGES = 24
"""Edges without which there is nothing to identify: one photograph of a hexapod shows as many."""

Method = Literal["bundle"] | PaperMethod

Progress = Callable[[str, float], None]
"""Called with a sentence about the present step and the share that is done, 0 to 1."""


@dataclass(frozen=True)
class Calibration:
    """Everything that a calibration found.

    boards : the calibration board, where stations observe one. findings : what the data tell of
    the machine and what they leave open. timings : seconds by step.
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
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the machine of a session; nothing is written.

    session : a loaded session, or its folder.
    method : ``bundle`` (joint maximum likelihood), ``four-step`` ([A]) or ``linear`` ([B]).
    seed : of the random search for the stations' poses.
    refine_camera : estimate the cameras' intrinsics with the machine, from their calibration's
        covariance on.
    progress : called with the step in words and the share done.
    Raises InputError where the session is at fault, ResultError where nothing can be said.
    """
    from threadpoolctl import threadpool_limits

    # Matrices here are small: threads inside the linear algebra only wait for one another, and
    # beside our own threads they slow it twentyfold.
    with threadpool_limits(1, "blas"):
        told = progress or (lambda _text, _share: None)
        return _calibrate(session, method, seed, refine_camera, told)


def _calibrate(
    session: Session | Path | str, method: Method, seed: int, refine_camera: bool, told: Progress
) -> Calibration:
    """:func:`calibrate`, step by step."""
    clock = _Clock()
    if not isinstance(session, Session):
        session = load_session(session)
    check_observable(session)
    cameras = refinement_of(session, refine_camera)
    clock.lap("load")
    told("Reading photographs", 0.0)
    photographs = read_photographs(session)
    clock.lap("decode")
    told("Recognising the machine", 0.2)
    boards = boards_of(session, photographs)
    poses = found_stations(session, photographs, np.random.default_rng(seed), boards)
    clock.lap("observe")
    turns = _take_turns(session, photographs, boards, poses, cameras, told, clock)
    estimate = turns.estimate
    if method != "bundle":
        told("Repeating the paper's method", 0.9)
        estimate = by_paper(method, session.machine, turns.measurements, estimate, seed)
    told("Judging", 0.95)
    findings = _findings(turns.measurements, estimate)
    verdict = judge(turns.observation, estimate, method, findings=findings)
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
    )


def _findings(measurements: Measurements, estimate: Estimate) -> Findings:
    """What the data tell of the machine, in words, and the paper's conditions."""
    seen = seen_legs(
        measurements.edges,
        estimate.edge_weights,
        measurements.n_stations,
        estimate.machine.n_legs,
    )
    told = what_data_tell(measurements, estimate)
    counted = conditions(estimate.machine, seen)
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


class _Turns(NamedTuple):
    """What the last turn left."""

    observation: Observation
    measurements: Measurements
    estimate: Estimate
    cameras: CameraRefinement


def _take_turns(
    session: Session,
    photographs: list[legs.Photographs],
    boards: Boards,
    T_camera_base: Array,
    cameras: CameraRefinement,
    told: Progress,
    clock: _Clock,
) -> _Turns:
    """Observation and identification in turns, the search narrowing."""
    told("Finding the legs", 0.35)
    machine, poses = session.machine, session.machine.forward(session.joints)
    looks = _each(
        photographs,
        lambda p: legs.search(p, machine, T_camera_base[p.station], poses[p.configuration]),
    )
    measurements = _measurements(session, _edges(looks), boards, None)
    clock.lap("observe")
    estimate = bundle(machine, measurements, start_state(machine, measurements, T_camera_base))
    clock.lap("identify")
    blur: list[float | None] = [None] * len(photographs)
    for turn in range(ROUNDS):
        told("Measuring edges and identifying", 0.45 + 0.5 * turn / ROUNDS)
        cameras = cameras.moved(estimate)
        photographs = [
            replace(p, camera=cameras.camera(session.stations[p.station].camera_file))
            for p in photographs
        ]
        look = partial(_measure, estimate=estimate, blur=blur, refine=cameras.active)
        looks = _each(photographs, look)
        blur = [look.blur for look in looks]
        measurements = _measurements(session, _edges(looks), boards, cameras)
        clock.lap("observe")
        known = replace(estimate.state, intrinsics=np.zeros_like(cameras.at))
        start = better_start(machine, measurements, known) if turn == 0 else known
        estimate = bundle(machine, measurements, start)
        clock.lap("identify")
        if max(look.moved for look in looks) < SETTLED and not cameras.active:
            break
    return _Turns(_observation(looks, boards, estimate), measurements, estimate, cameras)


def _measure(
    photographs: legs.Photographs, estimate: Estimate, blur: list[float | None], refine: bool
) -> legs.StationEdges:
    state = estimate.state
    return legs.measure(
        photographs,
        estimate.machine,
        state.T_camera_base[photographs.station],
        state.T_base_platform[photographs.configuration],
        blur[photographs.station],
        refine_camera=refine,
    )


def _each(
    photographs: list[legs.Photographs],
    look: Callable[[legs.Photographs], legs.StationEdges],
) -> list[legs.StationEdges]:
    with ThreadPoolExecutor(WORKERS) as pool:
        return [combined(seen) for seen in pool.map(look, photographs)]


def _edges(looks: list[legs.StationEdges]) -> EdgeSet:
    edges = concatenate([look.edges for look in looks])
    if len(edges) < FEWEST_EDGES:
        raise ResultError(
            f"only {len(edges)} edges of legs were found in all photographs",
            expected=f"at least {FEWEST_EDGES}",
            next_step="Look whether the photographs show the legs sharply and brightly enough",
        )
    return edges


def _measurements(
    session: Session, edges: EdgeSet, boards: Boards, cameras: CameraRefinement | None
) -> Measurements:
    """What is measured; no cameras at the first look, which is too coarse to refine any."""
    files = [station.camera_file for station in session.stations]
    numbers = {name: k for k, name in enumerate(dict.fromkeys(files))}
    measurements = Measurements(
        edges=edges,
        joints=session.joints,
        joint_noise=session.joint_noise,
        n_stations=len(files),
        camera_of_station=np.array([numbers[name] for name in files]),
        poses=boards.poses,
        mounts=(Mount("board", boards.body),) if boards.stations else (),
    )
    if cameras is None:
        return measurements
    return replace(
        measurements, intrinsics_factor=cameras.factor, intrinsics_at=cameras.at, shaded=True
    )


def _observation(looks: list[legs.StationEdges], boards: Boards, estimate: Estimate) -> Observation:
    """The last looks joined, with the edges that the estimate gave up among the rejected."""
    edges = concatenate([look.edges for look in looks])
    first = np.cumsum([0] + [len(look.edges) for look in looks[:-1]])
    given_up = [
        Rejection(
            int(edges.station[k]),
            int(edges.configuration[k]),
            int(edges.leg[k]),
            int(edges.tube[k]),
            int(edges.side[k]),
            _OUTLIER,
        )
        for k in np.flatnonzero(estimate.edge_weights < 0.5)
    ]
    return Observation(
        edges=edges,
        rejected=tuple(r for look in looks for r in look.rejected)
        + boards.rejected
        + tuple(given_up),
        points=np.concatenate([look.points for look in looks]),
        point_edge=np.concatenate(
            [look.point_edge + k for look, k in zip(looks, first, strict=True)]
        ),
        T_camera_base=estimate.state.T_camera_base,
    )


_OUTLIER = "disagrees with all other edges: another thing's edge, or a highlight's"
