"""Observation and identification in turns: what is known so far predicts where to look.

The drawing and the rough poses find the machine in the photographs; legs found to a pixel give a
first estimate; that predicts edges to a pixel, whose sub-pixel positions give the next. Boards and
tables of poses need no prediction: they are measured once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from threading import Lock
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans
from pkmcal.boards.views import Boards
from pkmcal.calibration.gather import CameraRefinement, measurements_of
from pkmcal.calibration.known import KnownScene, SeenSession
from pkmcal.calibration.recognise import CalibrationProgress
from pkmcal.calibration.responses import ResponseTold, overruled, told_by_edges
from pkmcal.errors import InputError, PkmcalError, ResultError
from pkmcal.identify.assembly import state_of
from pkmcal.identify.bundle import as_ended, bundle
from pkmcal.identify.confirmation import rejected_units
from pkmcal.identify.covariance import covariance_by_noise, machine_covariance
from pkmcal.identify.estimate import Estimate, State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.start import edge_misfit, start_state
from pkmcal.identify.verdict import POLISHED_SHADING
from pkmcal.measurements import (
    EdgeSet,
    Measurements,
    Observation,
    Rejection,
    concatenate,
    of_stations,
)
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.alone import finest_view
from pkmcal.observe.images import KEPT_PHOTOGRAPH_BYTES
from pkmcal.observe.photographs import Photographs, placed_at
from pkmcal.observe.profiles import EDGE_SHIFTS, BlurByStation
from pkmcal.observe.quality import quality
from pkmcal.observe.repeats import combined
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.outcome.finding import Finding, note, wrong
from pkmcal.session.load import Session
from pkmcal.solver.ranks import RANK_TOLERANCE
from pkmcal.wording import listed

MOST_EDGE_LOOKS = 3
"""Looks at the edges, each from the estimate before, after which nothing but the machine itself is
asked to have settled, and before which refined cameras are not."""
MOST_LOOKS_ASTRAY = 9
"""Most looks of one that does not."""
SETTLED_MACHINE_CHANGE = 2.0
"""Standard deviations, root mean square over what the data tell, by which a look may move a machine
that has settled: the second look moves it
by one half or one, and looks that find other edges, of polished legs, by one again and again. Where
a camera stands centimetres off and slides towards its place, edges lie where they are predicted,
and each look moves the machine by four or more."""
SETTLED_AT_ONCE = 1.0
"""The same of a second look that nothing follows: after one that moves the machine by more, another
leaves a quarter of what the way there still makes of it."""
SETTLED_EDGE_DISTANCE = 0.15
"""Median distance (px) of edges from their prediction below which another look changes nothing:
the first look corrects a pixel, the second what shading leaves, and profiles reach ten times as
far."""
ASTRAY_EDGE_DISTANCE = float(EDGE_SHIFTS[-1]) / 3
"""The same (px) of a first look that may have been elsewhere: what is found by chance lies evenly
over the profiles' reach, so that the median of hundreds of places is half of it."""
LOOKS_AGAIN = 6
"""Looks from machines as likely as the one that was found: with some thirty numbers told in each,
the deviations that they make larger are known to a twentieth."""
MOST_BINNING = 4
"""Times that photographs are binned as at first, at most: to pictures of 256 pixels, in which a
machine is still recognised."""
FEW_MEASURED = 1 / 3
"""Share of the edges by which the machine was found below which too few of them can be measured one
by one, so that it is asked whether they are too blurred."""
PHOTOGRAPHS_FOR_WIDTH = 4
"""Photographs of a station that are asked about that: a lens blurs all alike."""
NEARLY_ALL = 0.9
"""Share of the legs, found where all others put them, above which a second look for the rest would
hardly move the estimate, from which edges are looked for next."""
FEWEST_EDGES_TO_IDENTIFY = 24
"""Edges without which there is nothing to identify: one photograph of a hexapod shows as many."""
_OUTLIER = "disagrees with all other edges: another thing's edge, or a highlight's"
_OFF = (
    "the board lies {:.0f} standard deviations from where all other poses put it: it, or the"
    " machine, moved, or the readings are another configuration's"
)
_IMAGE_OFF = "most of its edges disagree with all other images: its name, or its place, is wrong"
_POINT_OFF = "the measurement lies {:.0f} standard deviations from where all others put it"


class Turns(NamedTuple):
    """What the last turn left.

    photographs : as they were looked at. blur : px, of their edges, by station. scatter : of coarse
    edges, see :class:`KnownScene`. start : from where the estimate was sought. change : by how
    many of its deviations the last look has moved the machine, as SETTLED_MACHINE_CHANGE has it.
    failures : why passes from machines as likely gave no estimate.
    """

    observation: Observation
    measurements: Measurements
    estimate: Estimate
    cameras: CameraRefinement
    responses: tuple[ResponseTold, ...] = ()
    photographs: Sequence[Photographs] = ()
    blur: BlurByStation = MappingProxyType({})
    scatter: float = 1.0
    start: State | None = None
    change: float = 0.0
    failures: tuple[str, ...] = ()

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """A reason where the machine did not settle, and a note where passes failed."""
        if self.failures:
            why = self.failures[0].rstrip(".")
            failed = note("edges.passes_failed", number=len(self.failures), of=LOOKS_AGAIN, why=why)
            return (*self._replace(failures=()).doubts, failed)
        if self.change < SETTLED_MACHINE_CHANGE:
            return ()
        return (wrong("estimate.unsettled", passes=MOST_LOOKS_ASTRAY, change=self.change),)


def take_turns(
    seen: SeenSession,
    cameras: CameraRefinement,
    told: CalibrationProgress,
    lap: Callable[[str], None],
) -> Turns:
    """Observation and identification in turns, the search narrowing.

    lap : called with the name of a step that is done.
    """
    session, photographs, boards, _ = seen
    total, machine = sum(len(p.images) for p in photographs), session.machine
    estimate = _first_estimate(seen, total, told, lap)
    blur: BlurByStation = {}
    looks: list[legs.StationEdges] = []
    measurements = measurements_of(session, boards)
    responses: tuple[ResponseTold, ...] = ()
    scatter, start = seen.known.scatter, estimate.state
    change = 0.0
    for turn in range(MOST_LOOKS_ASTRAY):
        share = 0.45 + 0.35 * min(turn / MOST_EDGE_LOOKS, 0.9)
        done = _counted(told, "Measuring edges", total, share)
        cameras = cameras.moved(estimate)
        photographs = [replace(p, camera=cameras.at_station(p.station)) for p in photographs]
        looks, photographs, blur = _looked_through(
            session, photographs, estimate, blur, scatter, cameras.active, done
        )
        measurements = measurements_of(session, boards, _edges(looks), cameras)
        lap("observe")
        told("Identifying", share + 0.05)
        before = estimate
        start, moved = _at_cameras(estimate.state, cameras), max(look.moved for look in looks)
        if turn == 0 and moved > ASTRAY_EDGE_DISTANCE:
            start = better_start(machine, measurements, start)
        estimate = bundle(machine, measurements, start)
        scatter *= _scatter_of(measurements.edges.coarse, estimate)
        lap("identify")
        if turn == 0:
            told("Asking how the photographs code light", share + 0.1)

            def measured(
                some: list[Photographs],
                blur: BlurByStation,
                before: Estimate = before,
                refine: bool = cameras.active,
            ) -> EdgeSet:
                lap("identify")
                look = partial(_measure, estimate=before, blur=blur, refine=refine)
                edges = concatenate([one.edges for one in _looked_at(some, look)])
                lap("observe")
                return edges

            responses = told_by_edges(
                session,
                photographs,
                measurements,
                estimate,
                partial(measured, blur=blur),  # nearly the same by the other response
                partial(measured, blur={}),
                lambda edges, cameras=cameras: measurements_of(session, boards, edges, cameras),
            )
            lap("identify")
            if found := overruled(responses):
                photographs = [
                    replace(p, response=found.get(session.stations[p.station].entry, p.response))
                    for p in photographs
                ]
                blur = {}
                continue
        usual = moved < SETTLED_EDGE_DISTANCE and not cameras.active
        last = turn + 1 >= MOST_EDGE_LOOKS
        if usual or last:
            away = (estimate.state.theta - before.state.theta)[None]
            change = float(np.sqrt(_variance(away, measurements, estimate)))
            if change < (SETTLED_MACHINE_CHANGE if last else SETTLED_AT_ONCE):
                finer = _binned(session, photographs, blur, more=False)
                if not finer or turn + 1 == MOST_LOOKS_ASTRAY:
                    break
                photographs = finer
                blur = {}
    observation = observation_of(session, looks, boards, measurements, estimate, photographs)
    return Turns(
        observation, measurements, estimate, cameras, responses, photographs, blur, scatter, start,
        change,
    )  # fmt: skip


def looked_again(
    seen: SeenSession, turns: Turns, rng: np.random.Generator, told: CalibrationProgress
) -> Turns:
    """The same, with what depends on where edges were looked for among the deviations.

    Which border is a leg's, where two lie side by side, is found by where the leg should be, and no
    residual shows it: all edges of a look are where that look's machine has them. So they are
    looked for from machines as likely as the one that was found, and the variance between the
    estimates is added to that of one (Rubin, Multiple imputation for nonresponse in surveys, 1987,
    3.1). One look is kept, not their mean: its residuals and weights are those that are told. What
    looks scatter by hardly follows the machine that is drawn, so it counts as independent, in pairs
    too. Of painted legs on a tripod the edges are the same from anywhere, and nothing is asked.
    """
    session, estimate = seen.session, turns.estimate
    by_hand = any(session.stations[p.station].handheld for p in turns.photographs)
    if turns.start is None or not (by_hand or estimate.edge_noise.shading.max() > POLISHED_SHADING):
        return turns
    found: list[Array] = []
    failures: list[str] = []
    for number, drawn in enumerate(_as_likely(session, turns.measurements, estimate, rng)):
        told(f"Looking by a machine as likely: {number + 1} of {LOOKS_AGAIN}", 0.87)
        cameras = turns.cameras.moved(drawn)
        photographs = [replace(p, camera=cameras.at_station(p.station)) for p in turns.photographs]
        try:
            looks = _looked(session, photographs, drawn, turns.blur, turns.scatter, cameras.active)
            measurements = measurements_of(session, seen.boards, _edges(looks), cameras)
            ended = bundle(session.machine, measurements, _at_cameras(drawn.state, cameras))
        except (PkmcalError, np.linalg.LinAlgError) as error:
            failures.append(str(error))
            continue
        found.append(ended.state.theta)
    variance = 1.0  # as much again as noise, where hardly a look ends
    if len(found) > 1:
        apart = np.stack(found) - np.mean(found, axis=0)
        variance = _variance(apart, turns.measurements, estimate) * len(found) / (len(found) - 1)
    measurements = replace(turns.measurements, look_variance=variance)
    again = bundle(session.machine, measurements, turns.start)
    return turns._replace(measurements=measurements, estimate=again, failures=tuple(failures))


def _as_likely(
    session: Session, measurements: Measurements, estimate: Estimate, rng: np.random.Generator
) -> Iterator[Estimate]:
    """Estimates as likely as one, in pairs to both sides of it: machine, stations, cameras, and
    platforms as the readings then have them.
    """
    assembled, info = as_ended(measurements, estimate)
    problem, half = info.problem, info.root[0]
    still = np.zeros((1, assembled.seen.sum(), problem.layout.own_motion.shape[1]))
    for step in rng.normal(size=(LOOKS_AGAIN // 2, half.shape[1])) @ half.T:
        for away in (step, -step):
            moved = problem.moved(info.state, away[None], still)
            there = state_of(assembled, moved, estimate.state)
            values = estimate.machine.parameters.unit_axes(there.theta)
            other = estimate.machine.with_values(values)
            closed = other.forward_result(session.joints, there.T_base_platform)
            reached = closed.converged[:, None]
            poses = np.where(reached[..., None], closed.T_base_platform, there.T_base_platform)
            internal = np.where(reached, closed.internal, there.internal)
            there = replace(there, theta=values, T_base_platform=poses, internal=internal)
            yield replace(estimate, machine=other, state=there)


def _variance(changes: Array, measurements: Measurements, estimate: Estimate) -> float:
    """Mean square of changes (N, P) of the machine's parameters, in the variance that the noise
    gives them.
    """
    machine, n = estimate.machine, len(estimate.machine.values)
    info = as_ended(measurements, estimate)[1]
    shared = covariance_by_noise(info)[0]
    gauge = default_gauge(machine)
    noise = machine_covariance(info.problem, machine, estimate.state, shared, gauge)[:n, :n]
    covariance = estimate.joint_covariance[:n, :n]
    size = np.sqrt(np.diag(covariance))
    size[size == 0] = np.inf  # of what is exactly known
    value, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    known = value > RANK_TOLERANCE * value[-1]
    white = vectors[:, known] / np.sqrt(value[known]) / size[:, None]
    told = max(float(np.trace(white.T @ noise @ white)), 1.0)
    return float(np.mean(np.sum((changes @ white) ** 2, axis=1))) / told


def _looked(
    session: Session,
    photographs: Sequence[Photographs],
    estimate: Estimate,
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.PhotographsLookedAt | None = None,
) -> list[legs.StationEdges]:
    """The edges of all photographs, where an estimate has them."""
    whole = partial(_with_silhouettes, session, estimate, scatter, refine)

    def look(some: Sequence[Photographs]) -> list[legs.StationEdges]:
        looks = _measure(some, estimate, blur, refine, done)
        return [whole(p, one) for p, one in zip(some, looks, strict=True)]

    return _looked_at(photographs, look)


def _looked_through(
    session: Session,
    photographs: Sequence[Photographs],
    estimate: Estimate,
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.PhotographsLookedAt,
) -> tuple[list[legs.StationEdges], Sequence[Photographs], BlurByStation]:
    """A look, the photographs as they were looked at, and their blur: binned more where edges are
    too blurred to be measured, which must not lead an estimate astray.
    """
    look = partial(_looked, session, estimate=estimate, scatter=scatter, refine=refine)
    looks = look(photographs, blur=blur, done=done)
    found = _blur_of(looks, photographs)
    if sum(len(one.edges) for one in looks) < FEW_MEASURED * len(estimate.edge_weights):
        found |= _width_of_edges(photographs, estimate)
    while coarser := _binned(session, photographs, found, more=True):
        photographs = coarser
        looks = look(photographs, blur={})
        found = _blur_of(looks, photographs)
    return looks, photographs, found


def _blur_of(
    looks: Sequence[legs.StationEdges], photographs: Sequence[Photographs]
) -> dict[int, float]:
    """Px, by station."""
    return {p.station: look.blur for p, look in zip(photographs, looks, strict=True)}


def _width_of_edges(photographs: Sequence[Photographs], estimate: Estimate) -> dict[int, float]:
    """Px, by station, by how far the steps of some photographs reach: profiles tell no blur that is
    wider than they are. Nothing of stations whose edges do not tell it.
    """
    out: dict[int, float] = {}
    for p in photographs:
        few = p.select(p.spread(PHOTOGRAPHS_FOR_WIDTH))
        T = estimate.state.T_camera_base[p.station]
        poses = estimate.state.T_base_platform[few.configuration]
        blur = quality(few, estimate.machine, T, poses).blur
        if np.isfinite(blur).any():
            out[p.station] = float(np.nanmedian(blur))
    return out


def _binned(
    session: Session,
    photographs: Sequence[Photographs],
    blur: BlurByStation,
    *,
    more: bool,
) -> list[Photographs]:
    """The photographs as they should be looked at, where their edges, so blurred (px) by station,
    ask for ``more`` pixels as one, or for fewer; nothing where none does. All of one camera alike,
    for its lens is the same.
    """
    of_camera: dict[str, list[float]] = {}
    files = [session.stations[p.station].camera_file for p in photographs]
    for file, p in zip(files, photographs, strict=True):
        of_camera.setdefault(file, []).append(blur[p.station])
    out: list[Photographs] = []
    for file, p in zip(files, photographs, strict=True):
        binning = legs.sharp_binning(p.binning, float(np.median(of_camera[file])))
        most = MOST_BINNING * legs.first_binning(p.camera.image_size)
        wanted = max(binning, p.binning) if more else min(binning, p.binning)
        out.append(replace(p, binning=min(wanted, most)))
    changed = any(one.binning != p.binning for one, p in zip(out, photographs, strict=True))
    return out if changed else []


def _counted(
    told: CalibrationProgress, text: str, total: int, share: float
) -> legs.PhotographsLookedAt:
    """A callback of photographs looked at, told with how many there are of them."""
    lock, seen = Lock(), [0]
    told(text, share)

    def done(more: int) -> None:
        with lock:  # stations are looked at beside one another
            seen[0] += more
            told(f"{text}: {seen[0]} of {total} photographs", share)

    return done


def _at_cameras(state: State, cameras: CameraRefinement) -> State:
    """A state whose cameras are where the refinement is now."""
    return replace(state, intrinsics=np.zeros_like(cameras.at), breathing=np.zeros(0))


def better_start(machine: Machine, measurements: Measurements, known: State) -> State:
    """``known``, or [A]'s four steps on the edges where these explain the edges better.

    The four steps need no first guess, so they find the way back when the drawing or an earlier
    estimate has gone astray. Judged by the median misfit, which wrong edges do not move. Any
    machine: the steps refuse in words where the data do not allow them, and ``known`` remains.
    """
    from pkmcal.papers.four_step import four_step

    try:
        steps = four_step(machine, measurements, T_camera_base_guess=known.T_camera_base)
    except (PkmcalError, np.linalg.LinAlgError):  # too few legs, directions or configurations
        return known
    return min(known, steps, key=lambda state: edge_misfit(machine, measurements, state))


def identify_poses(
    session: Session,
    boards: Boards,
    T_camera_base: Array,
    cameras: CameraRefinement,
    told: CalibrationProgress,
) -> Turns:
    """The same without legs: what poses say does not depend on the estimate, but for the cameras
    that are refined with it.
    """
    told("Identifying", 0.6)
    machine = session.machine
    measurements = measurements_of(session, boards, None, cameras)
    start = _reached(session, measurements, start_state(machine, measurements, T_camera_base))
    estimate = bundle(machine, measurements, start)
    for turn in range(1, MOST_EDGE_LOOKS if cameras.active else 1):
        told("Identifying with the cameras", 0.6 + 0.3 * turn / MOST_EDGE_LOOKS)
        cameras = cameras.moved(estimate)
        measurements = measurements_of(session, boards, None, cameras)
        estimate = bundle(machine, measurements, _at_cameras(estimate.state, cameras))
    observation = observation_of(session, [], boards, measurements, estimate)
    return Turns(observation, measurements, estimate, cameras)


def _reached(session: Session, measurements: Measurements, start: State) -> State:
    """The start where the drawing cannot take all readings: from a first estimate by the rest.

    Raises `InputError` for readings that the machine so found cannot take either.
    """
    drawn = session.machine.forward_result(session.joints).converged
    if drawn.all():
        return start
    poses = measurements.poses
    first = measurements.with_links(measurements.links_among(drawn))
    first = replace(first, poses=poses.select(drawn[poses.configuration]))
    estimate = bundle(session.machine, first, start)
    found = estimate.machine.forward_result(session.joints)
    bad = [session.configurations[k] for k in np.flatnonzero(~found.converged)]
    if bad:
        raise InputError(
            "the machine cannot take these readings, neither as drawn nor as the other"
            " configurations show it: its legs do not meet the platform",
            where=f"{session.document['joints']['file']}, configuration {listed(bad)}",
            found=f"a gap of {float(found.error.max()) * 1e3:.3g} mm",
            expected="readings at which all legs reach the platform",
            next_step="Check these readings, or leave these configurations out",
        )
    return replace(estimate.state, T_base_platform=found.T_base_platform, internal=found.internal)


def _first_estimate(
    seen: SeenSession, total: int, told: CalibrationProgress, lap: Callable[[str], None]
) -> Estimate:
    """Of photographs by hand, from what was measured when they were placed; else from legs that are
    looked for as wholes, where they should be, and, unless nearly all were there, again where the
    first look has put them.
    """
    session, photographs, boards, known = seen
    if all(p.station in known.edges for p in photographs):
        placed = of_stations({p.station: known.edges[p.station] for p in photographs})
        measurements = measurements_of(session, boards, placed)
        start = start_state(known.machine, measurements, known.T_camera_base)
        return bundle(session.machine, measurements, start)
    start: State | None = None
    for text, reach, share in (
        ("Finding the legs", legs.LEG_SEARCH_REACH, 0.35),
        ("Finding the legs again", legs.REPEATED_SEARCH_REACH, 0.4),
    ):
        done = _counted(told, text, total, share)
        search = partial(_whole_legs, known=known, reach=reach, done=done)
        looks = _looked_at(photographs, search)
        measurements = measurements_of(session, boards, _edges(looks))
        lap("observe")
        start = start or start_state(known.machine, measurements, known.T_camera_base)
        estimate = bundle(session.machine, measurements, start)
        lap("identify")
        if _share_agreeing(looks, measurements.edges, estimate) > NEARLY_ALL:
            break
        start = estimate.state
        known = KnownScene(estimate.machine, start.T_camera_base, start.T_base_platform)
    return estimate


def _share_agreeing(looks: list[legs.StationEdges], edges: EdgeSet, estimate: Estimate) -> float:
    """Share of the legs that were looked for, hidden ones too, that were found where all others put
    them.
    """
    missed = sum(len(look.rejected) for look in looks)
    leg = np.stack([edges.station, edges.configuration, edges.leg], axis=-1)
    found = len(np.unique(leg, axis=0))
    elsewhere = len(np.unique(leg[estimate.edge_weights < 0.5], axis=0))
    return (found - elsewhere) / (found + missed)


def _whole_legs(
    photographs: Sequence[Photographs],
    known: KnownScene,
    reach: float,
    done: legs.PhotographsLookedAt,
) -> list[legs.StationEdges]:
    placed = placed_at(photographs, known.T_camera_base, known.T_base_platform)
    return legs.search_stations(placed, known.machine, reach, done)


def _measure(
    photographs: Sequence[Photographs],
    estimate: Estimate,
    blur: BlurByStation,
    refine: bool,
    done: legs.PhotographsLookedAt | None = None,
) -> list[legs.StationEdges]:
    state = estimate.state
    placed = placed_at(photographs, state.T_camera_base, state.T_base_platform)
    return legs.measure_stations(placed, estimate.machine, blur, refine, done)


def _with_silhouettes(
    session: Session,
    estimate: Estimate,
    scatter: float,
    refine: bool,
    photographs: Photographs,
    look: legs.StationEdges,
) -> legs.StationEdges:
    """A look at a photograph by hand, and where an edge could not be measured in it, where its
    silhouettes lie, coarse: what has a place of its own in each photograph is told by few edges.

    scatter : by how much more or less these scatter than each says.
    """
    if not session.stations[photographs.station].handheld:
        return look
    state = estimate.state
    view = finest_view(estimate.machine, photographs, session.joints, state.T_base_platform)
    T_camera_base = state.T_camera_base[photographs.station]
    coarse = silhouette_edges(view, T_camera_base, photographs.station, refine)

    more = np.ones(len(coarse.edges), dtype=bool)
    more[coarse.edges.same_as(look.edges)[0]] = False
    at, number = more[coarse.point_edge], np.cumsum(more) - 1
    added = replace(
        coarse,
        edges=coarse.edges.select(more).scaled(scatter),
        points=coarse.points[at],
        point_edge=number[coarse.point_edge[at]],
    )
    columns = added.edges.leg, added.edges.tube, added.edges.side
    told = set(zip(*(column.tolist() for column in columns), strict=True))
    rejected = [r for r in look.rejected if (r.leg, r.tube, r.side) not in told]
    both = legs.joined_looks([look, added], look.blur, look.moved)
    return replace(both, rejected=tuple(rejected))


def _scatter_of(coarse: Booleans, estimate: Estimate) -> float:
    """Root mean square of the coarse edges' residuals, in what they state; 1 where they are too few
    to tell.
    """
    squares = estimate.edge_residuals[coarse & (estimate.edge_weights >= 0.5)] ** 2
    return float(np.sqrt(squares.mean())) if squares.size > LEAST_NOISE_FREEDOM else 1.0


def _looked_at(
    photographs: Sequence[Photographs],
    look: Callable[[Sequence[Photographs]], list[legs.StationEdges]],
) -> list[legs.StationEdges]:
    """A look at all stations, repeats as one: together, or two at a time where photographs have to
    be decoded for it, which runs beside Python.
    """
    pixels = sum(np.prod(p.camera.image_size) * len(p.images) for p in photographs)
    if pixels <= KEPT_PHOTOGRAPH_BYTES:
        return [combined(one) for one in look(photographs)]
    with ThreadPoolExecutor(THREADS) as pool:
        return [combined(one) for (one,) in pool.map(look, ([p] for p in photographs))]


def _edges(looks: list[legs.StationEdges]) -> EdgeSet:
    edges = concatenate([look.edges for look in looks])
    if len(edges) < FEWEST_EDGES_TO_IDENTIFY:
        raise ResultError(
            f"only {len(edges)} edges of legs were found in all photographs",
            expected=f"at least {FEWEST_EDGES_TO_IDENTIFY}",
            next_step="Look whether the photographs show the legs sharply and brightly enough",
        )
    return edges


def observation_of(
    session: Session,
    looks: list[legs.StationEdges],
    boards: Boards,
    measurements: Measurements,
    estimate: Estimate,
    photographs: Sequence[Photographs] = (),
) -> Observation:
    """The last looks joined, with what the estimate gave up among the rejected. photographs : as
    they were looked at.
    """
    # a station that observes a board alone has that of its camera, whose edge shift is in it
    of_camera = {session.stations[p.station].camera_file: p.binning for p in photographs}
    binning = np.ones(len(estimate.state.T_camera_base), dtype=int)
    for k, station in enumerate(session.stations):
        binning[k] = of_camera.get(station.camera_file, 1)
    seen = legs.joined_looks(looks, float("nan"), float("nan"))
    given_up = np.flatnonzero(estimate.edge_weights < 0.5).tolist()
    return Observation(
        edges=seen.edges,
        rejected=seen.rejected
        + boards.rejected
        + tuple(seen.edges.rejection(k, _OUTLIER) for k in given_up)
        + _images_given_up(measurements, estimate)
        + _poses_given_up(session, measurements, estimate),
        points=seen.points,
        point_edge=seen.point_edge,
        T_camera_base=estimate.state.T_camera_base,
        poses=measurements.poses,
        binning=binning,
    )


def _images_given_up(measurements: Measurements, estimate: Estimate) -> tuple[Rejection, ...]:
    """Images of which most edges were rejected, as wholes."""
    return tuple(
        Rejection(unit.station, unit.configuration, -1, -1, -1, _IMAGE_OFF)
        for unit in rejected_units(measurements, estimate)
        if unit.is_image
    )


def _poses_given_up(
    session: Session, measurements: Measurements, estimate: Estimate
) -> tuple[Rejection, ...]:
    """Poses that do not fit the rest, with how far they lie off."""
    poses = measurements.poses
    lost = np.flatnonzero(estimate.pose_weights < 0.5)
    error = np.linalg.norm(estimate.pose_residuals, axis=1)
    return tuple(
        Rejection(
            int(poses.station[k]),
            int(poses.configuration[k]),
            -1,
            -1,
            -1,
            (_OFF if poses.station[k] < len(session.stations) else _POINT_OFF).format(error[k]),
        )
        for k in lost
    )
