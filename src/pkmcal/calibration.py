"""From a session to a calibrated machine: load, observe, identify in turns, judge.

What is known so far predicts where to look. The drawing and the rough poses find the machine in
the photographs; legs found to a pixel give a first estimate; that predicts edges to a pixel, whose
sub-pixel positions give the next.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import GeometryError, InputError, ResultError
from pkmcal.files import listed
from pkmcal.identify.bundle import bundle, start_state
from pkmcal.identify.paper_methods import Method as PaperMethod
from pkmcal.identify.paper_methods import by_paper
from pkmcal.identify.problem import Estimate, Measurements
from pkmcal.identify.start import better_start
from pkmcal.identify.verdict import Verdict, judge
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.diagnose import unrecognised
from pkmcal.observe.edges import EdgeSet, Observation, Rejection, concatenate
from pkmcal.observe.images import decode_all
from pkmcal.observe.predict import tubes_of
from pkmcal.observe.stations import StationPose, View, find_station
from pkmcal.session import Session, Station, load_session

ROUNDS = 3
"""Looks at the edges, each from the estimate before: the first corrects a pixel, the second a
tenth, the third changes nothing that matters."""
WORKERS = 2
FEWEST_EDGES = 24
"""Edges without which there is nothing to identify: one photograph of a hexapod shows as many."""

Method = Literal["bundle"] | PaperMethod

Progress = Callable[[str, float], None]
"""Called with a sentence about the present step and the share that is done, 0 to 1."""


@dataclass(frozen=True)
class Calibration:
    """Everything that a calibration found.

    timings : seconds by step.
    """

    session: Session
    observation: Observation
    measurements: Measurements
    estimate: Estimate
    verdict: Verdict
    method: str
    seed: int
    timings: dict[str, float] = field(default_factory=dict)

    @property
    def machine(self) -> Machine:
        """The calibrated machine."""
        return self.estimate.machine


def calibrate(
    session: Session | Path | str,
    *,
    method: Method = "bundle",
    seed: int = 0,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the machine of a session; nothing is written.

    session : a loaded session, or its folder.
    method : ``bundle`` (joint maximum likelihood), ``four-step`` ([A]) or ``linear`` ([B]).
    seed : of the random search for the stations' poses.
    progress : called with the step in words and the share done.
    Raises InputError where the session is at fault, ResultError where nothing can be said.
    """
    from threadpoolctl import threadpool_limits

    # Matrices here are small: threads inside the linear algebra only wait for one another, and
    # beside our own threads they slow it twentyfold.
    with threadpool_limits(1, "blas"):
        return _calibrate(session, method, seed, progress or (lambda _text, _share: None))


def _calibrate(
    session: Session | Path | str, method: Method, seed: int, told: Progress
) -> Calibration:
    """:func:`calibrate`, step by step."""
    clock = _Clock()
    if not isinstance(session, Session):
        session = load_session(session)
    check_observable(session)
    clock.lap("load")
    told("Reading photographs", 0.0)
    photographs = read_photographs(session)
    clock.lap("decode")
    told("Recognising the machine", 0.2)
    poses = _stations(session, photographs, np.random.default_rng(seed))
    clock.lap("observe")
    observation, estimate, measurements = _take_turns(session, photographs, poses, told, clock)
    told("Judging", 0.95)
    if method != "bundle":
        told("Repeating the paper's method", 0.9)
        estimate = by_paper(method, session.machine, measurements, estimate, seed)
    verdict = judge(observation, estimate, method)
    clock.lap("identify")
    return Calibration(
        session, observation, measurements, estimate, verdict, method, seed, clock.laps
    )


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


def check_observable(session: Session) -> None:
    """What the session's form allows but this observation cannot use."""
    for station in session.stations:
        where = f"session.yaml, stations.{station.name}"
        if station.observe != "legs":
            raise InputError(
                "boards are not observed yet", where=where, found=f"observe: {station.observe}",
                expected="observe: legs",
            )  # fmt: skip
        if station.T_camera_base is None:
            raise InputError(
                "the station has no rough pose",
                where=where,
                expected="pose: {position: [x, y, z], look_at: [x, y, z], up: [0, 0, 1]}",
                next_step="Measure by hand where the camera stands; 10 cm and 10 degrees will do",
            )
    if not any(leg.tubes for leg in session.machine.document.legs):
        raise InputError(
            "no leg of the drawing has visible cylinders",
            where="mechanism.yaml, legs",
            expected="tubes: [{radius: 0.014, from: 0.05, to: 0.25}] on the legs",
            next_step="Measure the legs' radii with calipers",
        )


def read_photographs(session: Session) -> list[legs.Photographs]:
    """Every station's photographs, decoded and prepared for the search."""

    def read(number: int) -> legs.Photographs:
        station = session.stations[number]
        paths = [p.path for p in station.photographs]
        labels = [label_of(session.folder, path) for path in paths]
        images = decode_all(paths, station.camera.image_size, labels)
        rows = np.array([p.configuration for p in station.photographs])
        return legs.photographs_of(number, station.camera, rows, session.joints, images)

    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(read, range(len(session.stations))))


def label_of(folder: Path, path: Path) -> str:
    """A photograph's name in messages: its path inside the session."""
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def platform_poses(session: Session) -> Array:
    """T_base_platform (K, 4, 4) of all configurations by the drawing, or which one has none."""
    try:
        found = session.machine.forward_result(session.joints)
    except GeometryError as error:  # the drawing is the user's: it is at fault
        raise InputError(
            error.what,
            where=session.document["mechanism"],
            found=error.found,
            expected=error.expected,
            next_step=error.next_step,
        ) from None
    if found.converged.all():
        return found.T_base_platform
    bad = [session.configurations[k] for k in np.flatnonzero(~found.converged)]
    raise InputError(
        "the drawing's machine cannot take these readings: its legs do not meet the platform",
        where=f"{session.document['joints']['file']}, configuration {listed(bad)}",
        found=f"a gap of {float(found.error.max()) * 1e3:.3g} mm",
        expected="readings at which all legs reach the platform",
        next_step="Check these readings, the order of their columns, and the drawing's centres",
    )


@dataclass(frozen=True)
class Recognition:
    """Where the search for each station's pose ended; rough : the poses it began from."""

    views: tuple[View, ...]
    rough: tuple[Array, ...]
    found: tuple[StationPose, ...]

    @property
    def complete(self) -> bool:
        """Whether the machine was recognised in every station's photographs."""
        return all(pose.good for pose in self.found)


def recognise(
    session: Session,
    photographs: list[legs.Photographs],
    poses: Array,
    rngs: list[np.random.Generator],
) -> Recognition:
    """Look for the machine in every station's photographs, nothing raised.

    poses : T_base_platform (K, 4, 4) of the configurations. rngs : one a station.
    """
    machine, tubes = session.machine, tubes_of(session.machine)
    views = tuple(
        View(machine, p.camera, tubes, p.joints, poses[p.configuration], p.tables)
        for p in photographs
    )
    rough = tuple(_rough(station) for station in session.stations)
    with ThreadPoolExecutor(WORKERS) as pool:
        found = tuple(pool.map(find_station, views, rough, rngs))
    return Recognition(views, rough, found)


def why_unrecognised(
    session: Session,
    photographs: list[legs.Photographs],
    recognition: Recognition,
    rng: np.random.Generator,
) -> InputError:
    """The error about the stations that were not recognised; the usual mix-ups are tried."""
    return unrecognised(
        [station.name for station in session.stations],
        list(recognition.views),
        list(recognition.rough),
        list(recognition.found),
        session.joints,
        [p.configuration for p in photographs],
        rng,
    )


def _stations(
    session: Session, photographs: list[legs.Photographs], rng: np.random.Generator
) -> Array:
    """Poses T_camera_base (S, 4, 4) of all stations, or the reason why one is not recognised."""
    rngs = rng.spawn(len(photographs) + 1)
    found = recognise(session, photographs, platform_poses(session), rngs[1:])
    if not found.complete:
        raise why_unrecognised(session, photographs, found, rngs[0])
    return np.stack([pose.T_camera_base for pose in found.found])


def _rough(station: Station) -> Array:
    """The station's pose by hand; :func:`check_observable` has seen that there is one."""
    return np.eye(4) if station.T_camera_base is None else station.T_camera_base


def _take_turns(
    session: Session,
    photographs: list[legs.Photographs],
    T_camera_base: Array,
    told: Progress,
    clock: _Clock,
) -> tuple[Observation, Estimate, Measurements]:
    """Observation and identification in turns, the search narrowing."""
    told("Finding the legs", 0.35)
    poses = session.machine.forward(session.joints)
    looks = _each(
        photographs,
        lambda p: legs.search(p, session.machine, T_camera_base[p.station], poses[p.configuration]),
    )
    measurements = _measurements(session, _edges(looks))
    clock.lap("observe")
    state = start_state(session.machine, measurements, T_camera_base)
    estimate = bundle(session.machine, measurements, state)
    clock.lap("identify")
    blur: list[float | None] = [None] * len(photographs)
    for turn in range(ROUNDS):
        told("Measuring edges and identifying", 0.45 + 0.5 * turn / ROUNDS)
        looks = _each(photographs, partial(_measure, estimate=estimate, blur=blur))
        blur = [look.blur for look in looks]
        measurements = _measurements(session, _edges(looks))
        clock.lap("observe")
        known = estimate.state
        start = better_start(session.machine, measurements, known) if turn == 0 else known
        estimate = bundle(session.machine, measurements, start)
        clock.lap("identify")
    return _observation(looks, estimate), estimate, measurements


def _measure(
    photographs: legs.Photographs, estimate: Estimate, blur: list[float | None]
) -> legs.StationEdges:
    state = estimate.state
    return legs.measure(
        photographs,
        estimate.machine,
        state.T_camera_base[photographs.station],
        state.T_base_platform[photographs.configuration],
        blur[photographs.station],
    )


def _each(
    photographs: list[legs.Photographs],
    look: Callable[[legs.Photographs], legs.StationEdges],
) -> list[legs.StationEdges]:
    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(look, photographs))


def _edges(looks: list[legs.StationEdges]) -> EdgeSet:
    edges = concatenate([look.edges for look in looks])
    if len(edges) < FEWEST_EDGES:
        raise ResultError(
            f"only {len(edges)} edges of legs were found in all photographs",
            expected=f"at least {FEWEST_EDGES}",
            next_step="Look whether the photographs show the legs sharply and brightly enough",
        )
    return edges


def _measurements(session: Session, edges: EdgeSet) -> Measurements:
    files = [station.camera_file for station in session.stations]
    numbers = {name: k for k, name in enumerate(dict.fromkeys(files))}
    return Measurements(
        edges=edges,
        joints=session.joints,
        joint_noise=session.joint_noise,
        n_stations=len(files),
        camera_of_station=np.array([numbers[name] for name in files]),
    )


def _observation(looks: list[legs.StationEdges], estimate: Estimate) -> Observation:
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
        rejected=tuple(r for look in looks for r in look.rejected) + tuple(given_up),
        points=np.concatenate([look.points for look in looks]),
        point_edge=np.concatenate(
            [look.point_edge + k for look, k in zip(looks, first, strict=True)]
        ),
        T_camera_base=estimate.state.T_camera_base,
    )


_OUTLIER = "disagrees with all other edges: another thing's edge, or a highlight's"
