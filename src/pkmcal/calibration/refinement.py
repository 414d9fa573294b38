"""Observation and identification in turns: what is known so far predicts where to look.

The nominal model and the rough poses find the machine in the images; legs found to a pixel
give a first estimate; that predicts edges to a pixel, whose sub-pixel positions give the next.
Boards and tables of poses need no prediction: they are measured once.
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
from pkmcal.calibration.camera_refinement import CameraRefinement, measurements_of
from pkmcal.calibration.camera_responses import ResponseEstimate, overruled, responses_by_edges
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.calibration.localization import CalibrationProgress
from pkmcal.errors import InputError, PkmcalError, ResultError
from pkmcal.identify.assembly import state_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.confirmation import rejected_units
from pkmcal.identify.covariance import covariance_by_noise, machine_covariance
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.start import edge_misfit, start_state
from pkmcal.identify.state import State
from pkmcal.identify.verdict import POLISHED_SHADING
from pkmcal.levels import FEW, NEARLY_ALL
from pkmcal.measurements import (
    EdgeSet,
    Measurements,
    Observation,
    Rejection,
    concatenate,
    of_stations,
)
from pkmcal.measurements.effects import FOCAL_EXCESS, INTRINSICS
from pkmcal.mechanisms import Machine
from pkmcal.observe import legs
from pkmcal.observe.image_batches import StationImages, placed_at
from pkmcal.observe.image_localization import finest_view
from pkmcal.observe.images import CACHED_IMAGE_BYTES
from pkmcal.observe.profiles import PROFILE_OPTIONS, BlurByStation
from pkmcal.observe.quality import quality
from pkmcal.observe.repeats import combine_repeats
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.outcome.finding import Finding, note, wrong
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.solver.ranks import nonzero
from pkmcal.wording import listed

MOST_MEASUREMENT_PASSES = 3
"""Measurement passes, each from the estimate before, after which only the machine has to have
converged; refined cameras do not converge in fewer."""
MOST_BAD_PASSES = 9
"""Largest number of measurement passes of a machine that does not converge."""
SETTLED_MACHINE_CHANGE = 2.0
"""Change of a converged machine by a measurement pass, in standard deviations, root mean square
over the determined directions. The second pass changes it by a half to one, and passes that measure
other edges of polished legs by one again and again. While a camera that is centimetres off
approaches its pose, edges lie where they are predicted, and each pass changes the machine by four
or more."""
SETTLED_AT_ONCE = SETTLED_MACHINE_CHANGE / 2
"""The same for a pass that is the last one before MOST_MEASUREMENT_PASSES: after a larger change, a
further pass reduces the remaining dependence on the starting point to a quarter."""
SETTLED_EDGE_DISTANCE = PROFILE_OPTIONS.shift_reach / 10
"""Median distance (px) of edges from their prediction below which a further pass changes nothing:
the first pass corrects a pixel, the second what shading leaves; profiles reach ten times as far."""
ASTRAY_EDGE_DISTANCE = PROFILE_OPTIONS.shift_reach / 3
"""The same (px) for a first pass that may have measured other edges: chance matches are uniform
over the profiles' reach, so the median of hundreds of them is half of it."""
IMPUTATION_PASSES = 6
"""Measurement passes from machines drawn from the posterior: with some thirty determined numbers in
each, the standard deviations that contain their scatter are known to a twentieth."""
MOST_BINNING = 4
"""Largest ratio of the binning to the first one: images then have 256 pixels, in which a machine is
still localized."""
IMAGES_FOR_WIDTH = 4
"""Images of a station from which the width of its edges is measured: a lens blurs all equally."""
FEWEST_EDGES_TO_IDENTIFY = 24
"""Fewest edges for an estimate: as many as one image of a hexapod shows."""
_OUTLIER = "disagrees with all other edges: another thing's edge, or a highlight's"
_OFF = (
    "the board lies {:.0f} standard deviations from where all other poses put it: it, or the"
    " machine, moved, or the readings are another configuration's"
)
_IMAGE_OFF = "most of its edges disagree with all other images: its name, or its place, is wrong"
_POINT_OFF = "the measurement lies {:.0f} standard deviations from where all others put it"


class RefinementResult(NamedTuple):
    """What the last turn left.

    images : as they were looked at. blur : px, of their edges, by station. scatter : of coarse
    edges, see :class:`PriorScene`. start : from where the estimate was sought. change : by how
    many of its deviations the last look has moved the machine, as SETTLED_MACHINE_CHANGE has it.
    failures : why passes from machines as likely gave no estimate.
    """

    observation: Observation
    measurements: Measurements
    estimate: Estimate
    cameras: CameraRefinement
    responses: tuple[ResponseEstimate, ...] = ()
    images: Sequence[StationImages] = ()
    blur: BlurByStation = MappingProxyType({})
    scatter: float = 1.0
    start: State | None = None
    change: float = 0.0
    failures: tuple[str, ...] = ()

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """A reason where the machine did not settle, and a note where passes failed."""
        if self.failures:
            why = self.failures[0].rstrip(".")
            failed = note(
                "edges.passes_failed", number=len(self.failures), of=IMPUTATION_PASSES, why=why
            )
            return (*self._replace(failures=()).reasons, failed)
        if self.change < SETTLED_MACHINE_CHANGE:
            return ()
        return (wrong("estimate.unsettled", passes=MOST_BAD_PASSES, change=self.change),)


def refine_alternating(
    case: Case,
    cameras: CameraRefinement,
    progress: CalibrationProgress,
    lap: Callable[[str], None],
) -> RefinementResult:
    """Observation and identification in turns, the search narrowing.

    lap : called with the name of a step that is done.
    """
    session, images, boards, _ = case
    total, machine = sum(len(p.images) for p in images), session.machine
    estimate = _first_estimate(case, total, progress, lap)
    blur: BlurByStation = {}
    passes: list[legs.StationEdges] = []
    measurements = measurements_of(session, boards)
    responses: tuple[ResponseEstimate, ...] = ()
    scatter, start = case.scene.scatter, estimate.state
    change = 0.0
    for turn in range(MOST_BAD_PASSES):
        share = 0.45 + 0.35 * min(turn / MOST_MEASUREMENT_PASSES, 0.9)
        done = _counted(progress, "Measuring edges", total, share)
        cameras = cameras.updated(estimate)
        images = [replace(p, camera=cameras.at_station(p.station)) for p in images]
        passes, images, blur = _checked_pass(
            session, images, estimate, blur, scatter, cameras.active, done
        )
        measurements = measurements_of(session, boards, _edges(passes), cameras)
        lap("observe")
        progress("Identifying", share + 0.05)
        before = estimate
        start, shifted = (
            _without_camera_changes(estimate.state),
            max(station_edges.shift for station_edges in passes),
        )
        if turn == 0 and shifted > ASTRAY_EDGE_DISTANCE:
            start = initial_guess(machine, measurements, start)
        estimate = bundle(machine, measurements, start)
        scatter *= _scatter_of(measurements.edges.coarse, estimate)
        lap("identify")
        if turn == 0:
            progress("Asking how the images code light", share + 0.1)

            def measured(
                some: list[StationImages],
                blur: BlurByStation,
                before: Estimate = before,
                refine: bool = cameras.active,
            ) -> EdgeSet:
                lap("identify")
                station_edges = partial(_measure, estimate=before, blur=blur, refine=refine)
                edges = concatenate([one.edges for one in _search_pass(some, station_edges)])
                lap("observe")
                return edges

            responses = responses_by_edges(
                session,
                images,
                measurements,
                estimate,
                partial(measured, blur=blur),  # nearly the same by the other response
                partial(measured, blur={}),
                lambda edges, cameras=cameras: measurements_of(session, boards, edges, cameras),
            )
            lap("identify")
            if results := overruled(responses):
                images = [
                    replace(p, response=results.get(session.stations[p.station].entry, p.response))
                    for p in images
                ]
                blur = {}
                continue
        usual = shifted < SETTLED_EDGE_DISTANCE and not cameras.active
        last = turn + 1 >= MOST_MEASUREMENT_PASSES
        if usual or last:
            away = (estimate.state.theta - before.state.theta)[None]
            change = float(np.sqrt(_variance(away, estimate)))
            if change < (SETTLED_MACHINE_CHANGE if last else SETTLED_AT_ONCE):
                finer = _binned(session, images, blur, more=False)
                if not finer or turn + 1 == MOST_BAD_PASSES:
                    break
                images = finer
                blur = {}
    observation = observation_of(session, passes, boards, measurements, estimate, images)
    return RefinementResult(
        observation, measurements, estimate, cameras, responses, images, blur, scatter, start,
        change,
    )  # fmt: skip


def imputation_variance(
    case: Case, turns: RefinementResult, rng: np.random.Generator, progress: CalibrationProgress
) -> RefinementResult:
    """The same, with what depends on where edges were looked for among the deviations.

    Which border is a leg's, where two lie side by side, is found by where the leg should be, and no
    residual shows it: all edges of a look are where that look's machine has them. So they are
    looked for from machines as likely as the one that was found, and the variance between the
    estimates is added to that of one (Rubin, Multiple imputation for nonresponse in surveys, 1987,
    3.1). One look is kept, not their mean: its residuals and weights are those that are told. What
    looks scatter by hardly follows the machine that is drawn, so it counts as independent, in pairs
    too. Of painted legs on a tripod the edges are the same from anywhere, and nothing is asked.
    """
    session, estimate = case.session, turns.estimate
    by_hand = any(session.stations[p.station].handheld for p in turns.images)
    if turns.start is None or not (by_hand or estimate.edge_noise.shading.max() > POLISHED_SHADING):
        return turns
    offsets: list[Array] = []
    failures: list[str] = []
    for number, drawn in enumerate(_as_likely(session, estimate, rng)):
        progress(f"Looking by a machine as likely: {number + 1} of {IMPUTATION_PASSES}", 0.87)
        cameras = turns.cameras.updated(drawn)
        images = [replace(p, camera=cameras.at_station(p.station)) for p in turns.images]
        try:
            passes = _measurement_pass(
                session, images, drawn, turns.blur, turns.scatter, cameras.active
            )
            measurements = measurements_of(session, case.boards, _edges(passes), cameras)
            ended = bundle(session.machine, measurements, _without_camera_changes(drawn.state))
        except (PkmcalError, np.linalg.LinAlgError) as error:
            failures.append(str(error))
            continue
        offsets.append(ended.state.theta)
    variance = 1.0  # as much again as noise, where hardly a look ends
    if len(offsets) > 1:
        apart = np.stack(offsets) - np.mean(offsets, axis=0)
        variance = _variance(apart, estimate) * len(offsets) / (len(offsets) - 1)
    measurements = replace(turns.measurements, imputation_covariance=variance)
    again = bundle(session.machine, measurements, turns.start)
    return turns._replace(measurements=measurements, estimate=again, failures=tuple(failures))


def _as_likely(
    session: Session, estimate: Estimate, rng: np.random.Generator
) -> Iterator[Estimate]:
    """Estimates as likely as one, in pairs to both sides of it: machine, stations, cameras, and
    platforms as the readings then have them.
    """
    assembled, info = estimate.linearized
    problem, half = info.problem, info.root[0]
    still = np.zeros((1, assembled.observed.sum(), problem.layout.own_motion.shape[1]))
    for step in rng.normal(size=(IMPUTATION_PASSES // 2, half.shape[1])) @ half.T:
        for away in (step, -step):
            shifted = problem.retract(info.state, away[None], still)
            there = state_of(assembled, shifted, estimate.state)
            values = estimate.machine.parameters.unit_axes(there.theta)
            other = estimate.machine.with_values(values)
            closed = other.forward_result(session.joints, there.T_base_platform)
            reached = closed.converged[:, None]
            poses = np.where(reached[..., None], closed.T_base_platform, there.T_base_platform)
            internal = np.where(reached, closed.internal, there.internal)
            there = replace(there, theta=values, T_base_platform=poses, internal=internal)
            yield replace(estimate, machine=other, state=there)


def _variance(changes: Array, estimate: Estimate) -> float:
    """Mean square of changes (N, P) of the machine's parameters, in the variance that the noise
    gives them.
    """
    machine, n = estimate.machine, len(estimate.machine.values)
    info = estimate.linearized.info
    shared = covariance_by_noise(info)[0]
    gauge = default_gauge(machine)
    noise = machine_covariance(info.problem, machine, estimate.state, shared, gauge)[:n, :n]
    covariance = estimate.joint_covariance[:n, :n]
    size = np.sqrt(np.diag(covariance))
    size[size == 0] = np.inf  # of what is exactly known
    value, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    above_rounding = nonzero(value)
    white = vectors[:, above_rounding] / np.sqrt(value[above_rounding]) / size[:, None]
    trace = max(float(np.trace(white.T @ noise @ white)), 1.0)
    return float(np.mean(np.sum((changes @ white) ** 2, axis=1))) / trace


def _measurement_pass(
    session: Session,
    images: Sequence[StationImages],
    estimate: Estimate,
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.ImageBatchesInUse | None = None,
) -> list[legs.StationEdges]:
    """The edges of all images, where an estimate has them."""
    whole = partial(_with_silhouettes, session, estimate, scatter, refine)

    def station_edges(some: Sequence[StationImages]) -> list[legs.StationEdges]:
        passes = _measure(some, estimate, blur, refine, done)
        return [whole(p, one) for p, one in zip(some, passes, strict=True)]

    return _search_pass(images, station_edges)


def _checked_pass(
    session: Session,
    images: Sequence[StationImages],
    estimate: Estimate,
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.ImageBatchesInUse,
) -> tuple[list[legs.StationEdges], Sequence[StationImages], BlurByStation]:
    """A look, the images as they were looked at, and their blur: binned more where edges are
    too blurred to be measured, which must not lead an estimate astray.
    """
    measure = partial(_measurement_pass, session, estimate=estimate, scatter=scatter, refine=refine)
    passes = measure(images, blur=blur, done=done)
    blur_by_station = _blur_of(passes, images)
    # few of the localized edges can be measured: they may be too blurred
    if sum(len(one.edges) for one in passes) < FEW * len(estimate.edge_weights):
        blur_by_station |= _width_of_edges(images, estimate)
    while coarser := _binned(session, images, blur_by_station, more=True):
        images = coarser
        passes = measure(images, blur={})
        blur_by_station = _blur_of(passes, images)
    return passes, images, blur_by_station


def _blur_of(
    passes: Sequence[legs.StationEdges], images: Sequence[StationImages]
) -> dict[int, float]:
    """Px, by station."""
    return {p.station: edges.blur for p, edges in zip(images, passes, strict=True)}


def _width_of_edges(images: Sequence[StationImages], estimate: Estimate) -> dict[int, float]:
    """Px, by station, by how far the steps of some images reach: profiles tell no blur that is
    wider than they are. Nothing of stations whose edges do not tell it.
    """
    out: dict[int, float] = {}
    for p in images:
        few = p.select(p.spread(IMAGES_FOR_WIDTH))
        T = estimate.state.T_camera_base[p.station]
        poses = estimate.state.T_base_platform[few.configuration]
        blur = quality(few, estimate.machine, T, poses).blur
        if np.isfinite(blur).any():
            out[p.station] = float(np.nanmedian(blur))
    return out


def _binned(
    session: Session,
    images: Sequence[StationImages],
    blur: BlurByStation,
    *,
    more: bool,
) -> list[StationImages]:
    """The images as they should be looked at, where their edges, so blurred (px) by station,
    ask for ``more`` pixels as one, or for fewer; nothing where none does. All of one camera alike,
    for its lens is the same.
    """
    of_camera: dict[str, list[float]] = {}
    files = [session.stations[p.station].camera_file for p in images]
    for file, p in zip(files, images, strict=True):
        of_camera.setdefault(file, []).append(blur[p.station])
    out: list[StationImages] = []
    for file, p in zip(files, images, strict=True):
        binning = legs.sharp_binning(p.binning, float(np.median(of_camera[file])))
        most = MOST_BINNING * legs.first_binning(p.camera.image_size)
        wanted = max(binning, p.binning) if more else min(binning, p.binning)
        out.append(replace(p, binning=min(wanted, most)))
    changed = any(one.binning != p.binning for one, p in zip(out, images, strict=True))
    return out if changed else []


def _counted(
    progress: CalibrationProgress, text: str, total: int, share: float
) -> legs.ImageBatchesInUse:
    """A callback of images looked at, told with how many there are of them."""
    lock, done_count = Lock(), [0]
    progress(text, share)

    def done(more: int) -> None:
        with lock:  # stations are looked at beside one another
            done_count[0] += more
            progress(f"{text}: {done_count[0]} of {total} images", share)

    return done


def _without_camera_changes(state: State) -> State:
    """A state whose cameras are where their edges were measured."""
    other = {c: x for c, x in state.columns.items() if c not in (INTRINSICS, FOCAL_EXCESS)}
    return replace(state, columns=other)


def initial_guess(machine: Machine, measurements: Measurements, prior_state: State) -> State:
    """``prior_state``, or [A]'s four steps on the edges where these explain the edges better.

    The four steps need no first guess, so they find the way back when the nominal model or an
    earlier estimate has gone astray. Judged by the median misfit, which wrong edges do not move.
    Any machine: the steps refuse in words where the data do not allow them, and ``prior_state``
    remains.
    """
    from pkmcal.papers.four_step import four_step

    try:
        steps = four_step(machine, measurements, T_camera_base_guess=prior_state.T_camera_base)
    except (PkmcalError, np.linalg.LinAlgError):  # too few legs, directions or configurations
        return prior_state
    return min(prior_state, steps, key=lambda state: edge_misfit(machine, measurements, state))


def identify_poses(
    session: Session,
    boards: Boards,
    T_camera_base: Array,
    cameras: CameraRefinement,
    progress: CalibrationProgress,
) -> RefinementResult:
    """The same without legs: what poses say does not depend on the estimate, but for the cameras
    that are refined with it.
    """
    progress("Identifying", 0.6)
    machine = session.machine
    measurements = measurements_of(session, boards, None, cameras)
    start = start_state(machine, measurements, T_camera_base, session.forward)
    start = _feasible_start(session, measurements, start)
    estimate = bundle(machine, measurements, start)
    for turn in range(1, MOST_MEASUREMENT_PASSES if cameras.active else 1):
        progress("Identifying with the cameras", 0.6 + 0.3 * turn / MOST_MEASUREMENT_PASSES)
        cameras = cameras.updated(estimate)
        measurements = measurements_of(session, boards, None, cameras)
        estimate = bundle(machine, measurements, _without_camera_changes(estimate.state))
    observation = observation_of(session, [], boards, measurements, estimate)
    return RefinementResult(observation, measurements, estimate, cameras)


def _feasible_start(session: Session, measurements: Measurements, start: State) -> State:
    """The start where the nominal model cannot take all readings: from a first estimate by the
    rest.

    Raises `InputError` for readings that the machine so found cannot take either.
    """
    drawn = session.forward.converged
    if drawn.all():
        return start
    poses = measurements.poses
    first = measurements.with_links(measurements.links_among(drawn))
    first = replace(first, poses=poses.select(drawn[poses.configuration]))
    estimate = bundle(session.machine, first, start)
    fk = estimate.machine.forward_result(session.joints)
    bad = [session.configurations[k] for k in np.flatnonzero(~fk.converged)]
    if bad:
        raise InputError(
            "the machine cannot take these readings, neither as drawn nor as the other"
            " configurations show it: its legs do not meet the platform",
            where=f"{session.document['joints']['file']}, configuration {listed(bad)}",
            found=f"a gap of {float(fk.error.max()) * 1e3:.3g} mm",
            expected="readings at which all legs reach the platform",
            next_step="Check these readings, or leave these configurations out",
        )
    return replace(estimate.state, T_base_platform=fk.T_base_platform, internal=fk.internal)


def _first_estimate(
    case: Case, total: int, progress: CalibrationProgress, lap: Callable[[str], None]
) -> Estimate:
    """Of images by hand, from what was measured when they were placed; else from legs that are
    looked for as wholes, where they should be, and, unless nearly all were there, again where the
    first look has put them.
    """
    session, images, boards, reference_values = case
    begin = partial(
        start_state,
        reference_values.machine,
        T_camera_base_guess=reference_values.T_camera_base,
        forward=session.forward if reference_values.machine is session.machine else None,
    )
    if all(p.station in reference_values.edges for p in images):
        placed = of_stations({p.station: reference_values.edges[p.station] for p in images})
        measurements = measurements_of(session, boards, placed)
        return bundle(session.machine, measurements, begin(measurements))
    start: State | None = None
    for text, reach, share in (
        ("Finding the legs", legs.LEG_SEARCH_OPTIONS.reach, 0.35),
        ("Finding the legs again", legs.LEG_SEARCH_OPTIONS.repeated_reach, 0.4),
    ):
        done = _counted(progress, text, total, share)
        search = partial(_whole_legs, scene=reference_values, reach=reach, done=done)
        passes = _search_pass(images, search)
        measurements = measurements_of(session, boards, _edges(passes))
        lap("observe")
        start = start or begin(measurements)
        estimate = bundle(session.machine, measurements, start)
        lap("identify")
        # a further pass for the remaining legs would hardly move the estimate
        if _share_agreeing(passes, measurements.edges, estimate) > NEARLY_ALL:
            break
        start = estimate.state
        reference_values = PriorScene(estimate.machine, start.T_camera_base, start.T_base_platform)
    return estimate


def _share_agreeing(passes: list[legs.StationEdges], edges: EdgeSet, estimate: Estimate) -> float:
    """Share of the legs that were looked for, hidden ones too, that were found where all others put
    them.
    """
    missed = sum(len(station_edges.rejected) for station_edges in passes)
    leg = np.stack([edges.station, edges.configuration, edges.leg], axis=-1)
    count = len(np.unique(leg, axis=0))
    elsewhere = len(np.unique(leg[estimate.edge_weights < INLIER_WEIGHT], axis=0))
    return (count - elsewhere) / (count + missed)


def _whole_legs(
    images: Sequence[StationImages],
    scene: PriorScene,
    reach: float,
    done: legs.ImageBatchesInUse,
) -> list[legs.StationEdges]:
    placed = placed_at(images, scene.T_camera_base, scene.T_base_platform)
    return legs.search_stations(placed, scene.machine, reach, done)


def _measure(
    images: Sequence[StationImages],
    estimate: Estimate,
    blur: BlurByStation,
    refine: bool,
    done: legs.ImageBatchesInUse | None = None,
) -> list[legs.StationEdges]:
    state = estimate.state
    placed = placed_at(images, state.T_camera_base, state.T_base_platform)
    return legs.measure_stations(placed, estimate.machine, blur, refine, done)


def _with_silhouettes(
    session: Session,
    estimate: Estimate,
    scatter: float,
    refine: bool,
    images: StationImages,
    edges: legs.StationEdges,
) -> legs.StationEdges:
    """A look at an image by hand, and where an edge could not be measured in it, where its
    silhouettes lie, coarse: what has a place of its own in each image is told by few edges.

    scatter : by how much more or less these scatter than each says.
    """
    if not session.stations[images.station].handheld:
        return edges
    state = estimate.state
    view = finest_view(estimate.machine, images, session.joints, state.T_base_platform)
    T_camera_base = state.T_camera_base[images.station]
    coarse = silhouette_edges(view, T_camera_base, images.station, refine)

    more = np.ones(len(coarse.edges), dtype=bool)
    more[coarse.edges.same_as(edges.edges)[0]] = False
    at, number = more[coarse.point_edge], np.cumsum(more) - 1
    added = replace(
        coarse,
        edges=coarse.edges.select(more).scaled(scatter),
        points=coarse.points[at],
        point_edge=number[coarse.point_edge[at]],
    )
    columns = added.edges.leg, added.edges.tube, added.edges.side
    measured_keys = set(zip(*(column.tolist() for column in columns), strict=True))
    rejected = [r for r in edges.rejected if (r.leg, r.tube, r.side) not in measured_keys]
    both = legs.joined_passes([edges, added], edges.blur, edges.shift)
    return replace(both, rejected=tuple(rejected))


def _scatter_of(coarse: Booleans, estimate: Estimate) -> float:
    """Root mean square of the coarse edges' residuals, in what they state; 1 where they are too few
    to tell.
    """
    squares = estimate.edge_residuals[coarse & (estimate.edge_weights >= INLIER_WEIGHT)] ** 2
    return float(np.sqrt(squares.mean())) if squares.size > LEAST_NOISE_FREEDOM else 1.0


def _search_pass(
    images: Sequence[StationImages],
    measure: Callable[[Sequence[StationImages]], list[legs.StationEdges]],
) -> list[legs.StationEdges]:
    """A look at all stations, repeats as one: together, or two at a time where images have to
    be decoded for it, which runs beside Python.
    """
    pixels = sum(np.prod(p.camera.image_size) * len(p.images) for p in images)
    if pixels <= CACHED_IMAGE_BYTES:
        return [combine_repeats(one) for one in measure(images)]
    with ThreadPoolExecutor(THREADS) as pool:
        return [combine_repeats(one) for (one,) in pool.map(measure, ([p] for p in images))]


def _edges(passes: list[legs.StationEdges]) -> EdgeSet:
    edges = concatenate([station_edges.edges for station_edges in passes])
    if len(edges) < FEWEST_EDGES_TO_IDENTIFY:
        raise ResultError(
            f"only {len(edges)} edges of legs were found in all images",
            expected=f"at least {FEWEST_EDGES_TO_IDENTIFY}",
            next_step="Look whether the images show the legs sharply and brightly enough",
        )
    return edges


def observation_of(
    session: Session,
    passes: list[legs.StationEdges],
    boards: Boards,
    measurements: Measurements,
    estimate: Estimate,
    images: Sequence[StationImages] = (),
) -> Observation:
    """The last looks joined, with what the estimate gave up among the rejected. images : as
    they were looked at.
    """
    # a station that observes a board alone has that of its camera, whose edge shift is in it
    of_camera = {session.stations[p.station].camera_file: p.binning for p in images}
    binning = np.ones(len(estimate.state.T_camera_base), dtype=int)
    for k, station in enumerate(session.stations):
        binning[k] = of_camera.get(station.camera_file, 1)
    in_view = legs.joined_passes(passes, float("nan"), float("nan"))
    given_up = np.flatnonzero(estimate.edge_weights < INLIER_WEIGHT).tolist()
    return Observation(
        edges=in_view.edges,
        rejected=in_view.rejected
        + boards.rejected
        + tuple(in_view.edges.rejection(k, _OUTLIER) for k in given_up)
        + _images_given_up(measurements, estimate)
        + _poses_given_up(session, measurements, estimate),
        points=in_view.points,
        point_edge=in_view.point_edge,
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
    lost = np.flatnonzero(estimate.pose_weights < INLIER_WEIGHT)
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
