"""Alternating observation and identification: each estimate predicts the edges to be measured.

The nominal model and the rough poses localize the machine in the images; legs found to a pixel
give a first estimate; that predicts edges to a pixel, whose sub-pixel positions give the next.
Boards and tables of poses need no prediction: they are measured once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import CameraRefinement, measurements_of
from pkmcal.calibration.camera_responses import ResponseComparison, responses_by_edges
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.errors import InputError, PkmcalError, ResultError
from pkmcal.identify.assembly import state_of
from pkmcal.identify.bundle import BundleSolution, bundle, fit_state
from pkmcal.identify.confirmation import rejected_units
from pkmcal.identify.covariance import covariance_by_noise, machine_covariance
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.hand_eye import start_from_poses
from pkmcal.identify.length_registration import determines_legs
from pkmcal.identify.noise import LEAST_NOISE_FREEDOM
from pkmcal.identify.start import edge_misfit, start_state
from pkmcal.identify.state import State
from pkmcal.identify.verdict import POLISHED_SHADING
from pkmcal.levels import FEW, FEWEST_EDGES, NEARLY_ALL, NOISE_EXCESS
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
from pkmcal.observe.distance_tables import DistanceTables
from pkmcal.observe.image_batches import StationImages, placed_at
from pkmcal.observe.image_localization import finest_tables, finest_view
from pkmcal.observe.images import CACHED_IMAGE_BYTES
from pkmcal.observe.profiles import PROFILE_OPTIONS, BlurByStation
from pkmcal.observe.quality import quality
from pkmcal.observe.repeats import combine_repeats
from pkmcal.observe.silhouettes import silhouette_edges
from pkmcal.outcome.finding import Finding, note, wrong
from pkmcal.outcome.progress import Progress, part
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.solver.ranks import nonzero
from pkmcal.wording import listed


@dataclass(frozen=True)
class RefinementOptions:
    """Constants of the alternation between measurement passes and estimates."""

    # measurement passes after which convergence is judged by the machine's parameters alone;
    # refined cameras need all of them
    passes: int = 3
    # upper bound of the measurement passes
    most_passes: int = 9
    # largest change of a converged machine by a measurement pass, root mean square over the
    # determined directions, in standard deviations. Two passes with independent errors, as over
    # polished legs, of which each measures other edges, differ by the root of two, which may be
    # NOISE_EXCESS times as large as any errors: 2.1. With a camera that starts centimetres off and
    # converges slowly, predicted and measured edges agree, but each pass changes the machine by
    # four or more
    settled_change: float = 2**0.5 * NOISE_EXCESS
    # the same for ending after the second pass. Each further pass reduces the dependence on the
    # starting point to a quarter (measured), so that a third of the last change remains; with one
    # third of a standard deviation the errors remain nearly all noise, by their squares
    early_settled_change: float = 3 * (1 / NEARLY_ALL - 1) ** 0.5
    # median distance (px) of edges from their prediction below which a further pass changes
    # nothing: the first pass corrects a pixel, the second the remaining effect of shading, and
    # profiles reach ten times as far
    settled_distance: float = PROFILE_OPTIONS.shift_reach / 10
    # median distance (px) in the first pass above which its edges may belong to other objects:
    # chance matches are uniform over the profiles' reach, with a median of half of it
    astray_distance: float = PROFILE_OPTIONS.shift_reach / 3
    # imputations, measurement passes from machines drawn from the estimate's distribution, an even
    # number: with some thirty parameters in each, the standard deviations that they enlarge are
    # known to a twentieth
    imputations: int = 6
    # largest binning, relative to the first: to images of 256 pixels, in which a machine can still
    # be localized
    most_binning: int = 4
    # images of a station from which a blur wider than the profiles is estimated: a lens blurs all
    # of them equally
    images_for_blur: int = 4
    # search of whole legs, before any estimate
    search: legs.LegSearchOptions = legs.LEG_SEARCH_OPTIONS
    # fewest edges of a calibration
    fewest_edges: int = FEWEST_EDGES


REFINEMENT = RefinementOptions()

Result = TypeVar("Result")

_OUTLIER = "disagrees with all other edges: another thing's edge, or a highlight's"
_OFF = (
    "the board lies {:.0f} standard deviations from where all other poses put it: it, or the"
    " machine, moved, or the readings are another configuration's"
)
_IMAGE_OFF = "most of its edges disagree with all other images: its name, or its place, is wrong"
_POINT_OFF = "the measurement lies {:.0f} standard deviations from where all others put it"


class RefinementResult(NamedTuple):
    """Estimate of the last measurement pass, with its inputs.

    images : as they were measured, with their binning.
    blur : blur of their edges, px, by station.
    scatter : scatter of coarse edges, see :class:`PriorScene`.
    solution : solution of the last estimate; None without images of legs.
    change : change of the machine by the last pass, in its standard deviations, as
        ``RefinementOptions.settled_change``.
    failures : reasons why imputations have no estimate.
    """

    observation: Observation
    measurements: Measurements
    estimate: Estimate
    cameras: CameraRefinement
    responses: ResponseComparison = ResponseComparison()
    images: Sequence[StationImages] = ()
    blur: BlurByStation = MappingProxyType({})
    scatter: float = 1.0
    solution: BundleSolution | None = None
    change: float = 0.0
    failures: tuple[str, ...] = ()
    options: RefinementOptions = REFINEMENT

    @property
    def reasons(self) -> tuple[Finding, ...]:
        """A reason if the machine did not converge, and a note if imputations failed."""
        if self.failures:
            why = self.failures[0].rstrip(".")
            of = self.options.imputations
            failed = note("edges.passes_failed", number=len(self.failures), of=of, why=why)
            return (*self._replace(failures=()).reasons, failed)
        if self.change < self.options.settled_change:
            return ()
        passes = self.options.most_passes
        return (wrong("estimate.unsettled", passes=passes, change=self.change),)


def refine_alternating(
    case: Case,
    cameras: CameraRefinement,
    progress: Progress,
    lap: Callable[[str], None],
    options: RefinementOptions = REFINEMENT,
) -> RefinementResult:
    """Alternate measurement passes and estimates until neither edges nor machine change.

    lap : called with the name of each completed step, for its time.
    """
    session, images, boards, _ = case
    total, machine = sum(len(p.images) for p in images), session.machine
    estimate = _first_estimate(case, total, part(progress, 0, 0.2), lap, options)
    blur: BlurByStation = {}
    passes: list[legs.StationEdges] = []
    measurements = measurements_of(session, boards)
    responses = ResponseComparison()
    scatter, solution = case.scene.scatter, None
    change, rest = 0.0, part(progress, 0.2, 1)
    for turn in range(options.most_passes):
        now, rest = part(rest, 0, 0.5), part(rest, 0.5, 1)
        done = _counted(part(now, 0, 0.3), "Measuring edges", total)
        cameras = cameras.updated(estimate)
        images = [replace(p, camera=cameras.at_station(p.station)) for p in images]
        passes, images, blur = _checked_pass(
            session, images, estimate, blur, scatter, cameras.active, done, options
        )
        edges = _edges(passes, options)
        measurements = measurements_of(session, boards, edges, cameras, estimate)
        lap("observe")
        now("Identifying", 0.3)
        before = estimate
        # next estimate, from a new start if the first pass may have measured other objects
        start, shifted = (
            _without_camera_changes(estimate.state),
            max(station_edges.shift for station_edges in passes),
        )
        if turn == 0 and shifted > options.astray_distance:
            start = initial_guess(machine, measurements, start)
        solution = BundleSolution.of(machine, measurements, start)
        estimate = solution.estimate(measurements)
        scatter *= _scatter_of(measurements.edges.coarse, estimate)
        lap("identify")
        if turn == 0:
            now("Comparing the responses of images", 0.7)
            # other responses are tested once; with them, edges are measured again
            responses = _responses(case, images, measurements, before, estimate, cameras, blur, lap)
            if results := responses.by_entry:
                images = [
                    replace(p, response=results.get(session.stations[p.station].entry, p.response))
                    for p in images
                ]
                blur = {}
                continue
        # convergence, at full resolution
        usual = shifted < options.settled_distance and not cameras.active
        last = turn + 1 >= options.passes
        if usual or last:
            away = (estimate.state.theta - before.state.theta)[None]
            change = float(np.sqrt(_variance(away, estimate)))
            if change < (options.settled_change if last else options.early_settled_change):
                finer = _binned(session, images, blur, options, more=False)
                if not finer or turn + 1 == options.most_passes:
                    break
                images = finer
                blur = {}
    observation = observation_of(session, passes, boards, measurements, estimate, images)
    return RefinementResult(
        observation, measurements, estimate, cameras, responses, images, blur, scatter, solution,
        change, options=options,
    )  # fmt: skip


def _responses(
    case: Case,
    images: Sequence[StationImages],
    measurements: Measurements,
    before: Estimate,
    estimate: Estimate,
    cameras: CameraRefinement,
    blur: BlurByStation,
    lap: Callable[[str], None],
) -> ResponseComparison:
    """Response of each camera's images to light, by the edges of the first pass.

    before : estimate that predicted the edges of ``measurements``.
    estimate : from these edges.
    """

    def measured(some: list[StationImages], blur: BlurByStation) -> EdgeSet:
        """Edges of some images by another response, measured where ``before`` predicts them."""
        lap("identify")
        measure = partial(_measure, estimate=before, blur=blur, refine=cameras.active)
        edges = concatenate([combine_repeats(one).edges for one in _search_pass(some, measure)])
        lap("observe")
        return edges

    responses = responses_by_edges(
        case.session,
        list(images),
        measurements,
        estimate,
        partial(measured, blur=blur),  # nearly the same by the other response
        partial(measured, blur={}),
        lambda edges: measurements_of(case.session, case.boards, edges, cameras),
    )
    lap("identify")
    return responses


def imputation_variance(
    case: Case, turns: RefinementResult, rng: np.random.Generator, progress: Progress
) -> RefinementResult:
    """Add the variance due to the choice of edges to the covariance, by multiple imputation.

    Where two borders lie side by side, the prediction determines which of them is measured as the
    leg's edge. No residual reveals a wrong choice, because all edges of a pass agree with the
    machine that predicted them. So edges are measured again from machines drawn from the estimate's
    distribution, and the variance between their estimates is added to the variance of one (Rubin,
    Multiple imputation for nonresponse in surveys, 1987, 3.1). The estimate itself is that of the
    first pass, not the mean, so that residuals and weights are those of the reported estimate. The
    estimates depend little on the drawn machines, so antithetic pairs count as independent too.
    Edges of painted legs from a tripod do not depend on the prediction, and nothing is repeated.
    """
    session, estimate, options = case.session, turns.estimate, turns.options
    by_hand = any(session.stations[p.station].handheld for p in turns.images)
    if turns.solution is None or not (
        by_hand or estimate.edge_noise.shading.max() > POLISHED_SHADING
    ):
        return turns
    # edges that drawn machines predict
    machines = list(_as_likely(session, estimate, options.imputations, rng))
    cameras = [turns.cameras.updated(drawn) for drawn in machines]
    predictions = [
        _Prediction(drawn, [replace(p, camera=own.at_station(p.station)) for p in turns.images])
        for drawn, own in zip(machines, cameras, strict=True)
    ]
    total = sum(len(p.images) for p in turns.images) * len(predictions)
    done = _counted(part(progress, 0, 0.5), "Measuring edges from drawn machines", total)
    active = turns.cameras.active
    offsets: list[Array] = []
    failures: list[str] = []
    try:
        passes = _measurement_passes(session, predictions, turns.blur, turns.scatter, active, done)
    except (PkmcalError, np.linalg.LinAlgError) as error:
        failures = [str(error)] * len(machines)
        machines, cameras, passes = machines[:0], cameras[:0], list[list[legs.StationEdges]]()
    # and the estimates from them
    for number, (drawn, own, one) in enumerate(zip(machines, cameras, passes, strict=True)):
        text = f"Identifying from a drawn machine's edges: {number + 1} of {len(predictions)}"
        progress(text, 0.5 + 0.5 * number / len(predictions))
        try:
            edges = _edges(one, options)
            measurements = measurements_of(session, case.boards, edges, own, estimate)
            there = _without_camera_changes(drawn.state)
            ended = fit_state(session.machine, measurements, there, scale_readings=True)
        except (PkmcalError, np.linalg.LinAlgError) as error:
            failures.append(str(error))
            continue
        offsets.append(ended.state.theta)
    # between-imputation variance, relative to that by noise, in the covariance of the first pass
    variance = 1.0  # as large as the noise's, if fewer than two imputations gave an estimate
    if len(offsets) > 1:
        apart = np.stack(offsets) - np.mean(offsets, axis=0)
        variance = _variance(apart, estimate) * len(offsets) / (len(offsets) - 1)
    measurements = replace(turns.measurements, imputation_covariance=variance)
    again = turns.solution.estimate(measurements)
    return turns._replace(measurements=measurements, estimate=again, failures=tuple(failures))


def _as_likely(
    session: Session, estimate: Estimate, count: int, rng: np.random.Generator
) -> Iterator[Estimate]:
    """``count`` draws from the estimate's distribution, in antithetic pairs.

    Machine, stations and cameras are drawn; the platform's poses are by forward kinematics of the
    readings.
    """
    assembled, info = estimate.linearized
    problem, half = info.problem, info.root[0]
    still = np.zeros((1, assembled.observed.sum(), problem.layout.own_motion.shape[1]))
    for step in rng.normal(size=(count // 2, half.shape[1])) @ half.T:
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
    """Mean square of changes (N, P) of the machine's parameters, relative to their variance due to
    noise.
    """
    machine, n = estimate.machine, len(estimate.machine.values)
    info = estimate.linearized.info
    shared = covariance_by_noise(info)[0]
    gauge = default_gauge(machine)
    noise = machine_covariance(info.problem, machine, estimate.state, shared, gauge)[:n, :n]
    covariance = estimate.joint_covariance[:n, :n]
    size = np.sqrt(np.diag(covariance))
    size[size == 0] = np.inf  # exactly known parameters
    value, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    above_rounding = nonzero(value)
    white = vectors[:, above_rounding] / np.sqrt(value[above_rounding]) / size[:, None]
    trace = max(float(np.trace(white.T @ noise @ white)), 1.0)
    return float(np.mean(np.sum((changes @ white) ** 2, axis=1))) / trace


class _Prediction(NamedTuple):
    """Estimate that predicts edges, and the images of all stations with its cameras."""

    estimate: Estimate
    images: Sequence[StationImages]


def _measurement_pass(
    session: Session,
    images: Sequence[StationImages],
    estimate: Estimate,
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.ImageBatchesInUse | None = None,
) -> list[legs.StationEdges]:
    """Edges of all images, measured where the estimate predicts them."""
    return _measurement_passes(
        session, [_Prediction(estimate, images)], blur, scatter, refine, done
    )[0]


def _measurement_passes(
    session: Session,
    predictions: Sequence[_Prediction],
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.ImageBatchesInUse | None = None,
) -> list[list[legs.StationEdges]]:
    """Edges of all images, by estimate, measured where each of the estimates predicts them."""
    numbers = {p.station: n for n, p in enumerate(predictions[0].images)}
    estimates = [prediction.estimate for prediction in predictions]

    def measure(some: Sequence[StationImages]) -> list[list[legs.StationEdges]]:
        own = [[prediction.images[numbers[p.station]] for p in some] for prediction in predictions]
        passes = [
            _measure(images, prediction.estimate, blur, refine, done)
            for prediction, images in zip(predictions, own, strict=True)
        ]
        whole = partial(_with_silhouettes, session, estimates, scatter, refine)
        with ThreadPoolExecutor(THREADS) as pool:  # distance tables take most of the time
            return list(pool.map(whole, zip(*own, strict=True), zip(*passes, strict=True)))

    stations = _search_pass(predictions[0].images, measure)
    return [[combine_repeats(one[n]) for one in stations] for n in range(len(predictions))]


def _checked_pass(
    session: Session,
    images: Sequence[StationImages],
    estimate: Estimate,
    blur: BlurByStation,
    scatter: float,
    refine: bool,
    done: legs.ImageBatchesInUse,
    options: RefinementOptions,
) -> tuple[list[legs.StationEdges], Sequence[StationImages], BlurByStation]:
    """Measurement pass, its images and their blur, by station.

    Images whose edges are too blurred to be measured are binned more and measured again, before
    they enter an estimate.
    """
    measure = partial(_measurement_pass, session, estimate=estimate, scatter=scatter, refine=refine)
    passes = measure(images, blur=blur, done=done)
    blur_by_station = _blur_of(passes, images)
    # few of the localized edges can be measured: they may be too blurred
    if sum(len(one.edges) for one in passes) < FEW * len(estimate.edge_weights):
        blur_by_station |= _width_of_edges(images, estimate, options.images_for_blur)
    while coarser := _binned(session, images, blur_by_station, options, more=True):
        images = coarser
        passes = measure(images, blur={})
        blur_by_station = _blur_of(passes, images)
    return passes, images, blur_by_station


def _blur_of(
    passes: Sequence[legs.StationEdges], images: Sequence[StationImages]
) -> dict[int, float]:
    """Blur (px) by station."""
    return {p.station: edges.blur for p, edges in zip(images, passes, strict=True)}


def _width_of_edges(
    images: Sequence[StationImages], estimate: Estimate, count: int
) -> dict[int, float]:
    """Blur (px) by station, from the width of the edges in ``count`` images.

    For blurs wider than the profiles, which these do not determine. Stations whose edges do not
    determine it are absent.
    """
    out: dict[int, float] = {}
    for p in images:
        few = p.select(p.spread(count))
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
    options: RefinementOptions,
    *,
    more: bool,
) -> list[StationImages]:
    """Images with the binning that the blur of their edges requires; an empty list if none changes.

    blur : px, by station. more : bin more pixels than now, otherwise fewer. Images of one camera
    are binned equally, because its lens is the same.
    """
    of_camera: dict[str, list[float]] = {}
    files = [session.stations[p.station].camera_file for p in images]
    for file, p in zip(files, images, strict=True):
        of_camera.setdefault(file, []).append(blur[p.station])
    out: list[StationImages] = []
    for file, p in zip(files, images, strict=True):
        binning = legs.sharp_binning(p.binning, float(np.median(of_camera[file])))
        most = options.most_binning * legs.first_binning(p.camera.image_size)
        wanted = max(binning, p.binning) if more else min(binning, p.binning)
        out.append(replace(p, binning=min(wanted, most)))
    changed = any(one.binning != p.binning for one, p in zip(out, images, strict=True))
    return out if changed else []


def _counted(progress: Progress, text: str, total: int) -> legs.ImageBatchesInUse:
    """Callback that reports the number of measured images out of the total."""
    lock, done_count = Lock(), [0]
    progress(text, 0.0)

    def done(more: int) -> None:
        with lock:  # stations are measured in parallel
            done_count[0] += more
            share = min(done_count[0] / max(total, 1), 1.0)  # larger images are measured twice
            progress(f"{text}: {done_count[0]} of {total} images", share)

    return done


def _without_camera_changes(state: State) -> State:
    """State without changes of the cameras: those are in the measurements."""
    other = {c: x for c, x in state.columns.items() if c not in (INTRINSICS, FOCAL_EXCESS)}
    return replace(state, columns=other)


def initial_guess(machine: Machine, measurements: Measurements, prior_state: State) -> State:
    """``prior_state``, or the state by [A]'s four steps if that explains the edges better.

    The four steps need no initial guess, so they recover from a nominal model or an earlier
    estimate that is far off. The median misfit, which is robust to wrong edges, decides. If the
    steps cannot be applied, ``prior_state`` is returned.
    """
    from pkmcal.identify.methods.four_step import four_step

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
    progress: Progress,
    options: RefinementOptions = REFINEMENT,
) -> RefinementResult:
    """Identification by boards, trackers and links alone.

    Their measurements do not depend on the estimate, except through refined cameras and effects on
    the readings.
    """
    progress("Identifying", 0.0)
    machine = session.machine
    measurements = measurements_of(session, boards, None, cameras)
    if machine.layout.underdetermined and determines_legs(measurements.poses):
        start = start_from_poses(machine, measurements)
    else:
        start = start_state(machine, measurements, T_camera_base, session.forward)
        start = _feasible_start(session, measurements, start)
    estimate = bundle(machine, measurements, start)
    turns = options.passes if cameras.active else 2 if measurements.effects else 1
    for turn in range(1, turns):
        progress("Identifying again", turn / turns)
        cameras = cameras.updated(estimate)
        measurements = measurements_of(session, boards, None, cameras, estimate)
        estimate = bundle(machine, measurements, _without_camera_changes(estimate.state))
    observation = observation_of(session, [], boards, measurements, estimate)
    return RefinementResult(observation, measurements, estimate, cameras, options=options)


def _feasible_start(session: Session, measurements: Measurements, start: State) -> State:
    """Initial state with all configurations closed.

    Where the nominal model does not close at all readings, by an estimate from the other readings.
    Raises `InputError` for readings at which that estimate does not close either.
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
            "the machine does not close at these readings, neither by the nominal model nor by an"
            " estimate from the other configurations",
            where=f"{session.document['joints']['file']}, configuration {listed(bad)}",
            found=f"a gap of {float(fk.error.max()) * 1e3:.3g} mm",
            expected="readings at which all legs reach the platform",
            next_step="Check these readings, or leave these configurations out",
            code="readings.unreachable",
        )
    return replace(estimate.state, T_base_platform=fk.T_base_platform, internal=fk.internal)


def _first_estimate(
    case: Case,
    total: int,
    progress: Progress,
    lap: Callable[[str], None],
    options: RefinementOptions,
) -> Estimate:
    """Estimate from whole legs, accurate to a pixel.

    Hand-held images have edges from their localization. In others, whole legs are searched around
    their prediction and, unless nearly all agree with the estimate, once more around the estimate's
    own prediction.
    """
    session, images, boards, scene = case
    # hand-held images have their edges already
    begin = partial(
        start_state,
        scene.machine,
        T_camera_base_guess=scene.T_camera_base,
        forward=session.forward if scene.machine is session.machine else None,
    )
    if all(p.station in scene.edges for p in images):
        placed = of_stations({p.station: scene.edges[p.station] for p in images})
        measurements = measurements_of(session, boards, placed)
        return bundle(session.machine, measurements, begin(measurements))
    start: State | None = None
    for text, reach, share in (
        ("Finding the legs", options.search.reach, 0.0),
        ("Finding the legs again", options.search.repeated_reach, 0.5),
    ):
        done = _counted(part(progress, share, share + 0.5), text, total)
        search = partial(_whole_legs, scene=scene, reach=reach, done=done, options=options.search)
        passes = [combine_repeats(one) for one in _search_pass(images, search)]
        measurements = measurements_of(session, boards, _edges(passes, options))
        lap("observe")
        start = start or begin(measurements)
        estimate = bundle(session.machine, measurements, start)
        lap("identify")
        # a further pass for the remaining legs would hardly move the estimate
        if _share_agreeing(passes, measurements.edges, estimate) > NEARLY_ALL:
            break
        start = estimate.state
        scene = PriorScene(estimate.machine, start.T_camera_base, start.T_base_platform)
    return estimate


def _share_agreeing(passes: list[legs.StationEdges], edges: EdgeSet, estimate: Estimate) -> float:
    """Share of the searched legs, hidden ones included, that agree with the estimate."""
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
    options: legs.LegSearchOptions,
) -> list[legs.StationEdges]:
    placed = placed_at(images, scene.T_camera_base, scene.T_base_platform)
    return legs.search_stations(placed, scene.machine, reach, done, options)


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
    estimates: Sequence[Estimate],
    scatter: float,
    refine: bool,
    images: Sequence[StationImages],
    edges: Sequence[legs.StationEdges],
) -> list[legs.StationEdges]:
    """Edges of one station, by estimate; of a hand-held image with coarse silhouettes.

    images : of the station, with the cameras of each estimate. The distance tables depend on none.
    """
    if not session.stations[images[0].station].handheld:
        return [*edges]
    tables = finest_tables(images[0])
    complete = partial(_completed, session, scatter, refine, tables)
    return [complete(*one) for one in zip(estimates, images, edges, strict=True)]


def _completed(
    session: Session,
    scatter: float,
    refine: bool,
    tables: DistanceTables,
    estimate: Estimate,
    images: StationImages,
    edges: legs.StationEdges,
) -> legs.StationEdges:
    """Edges of a hand-held image, with coarse silhouettes in place of edges that were not measured.

    The pose of such an image is determined by its own few edges, so none should be missing.

    scatter : ratio of the standard deviation of the coarse edges to the stated one.
    """
    state = estimate.state
    view = finest_view(estimate.machine, images, session.joints, state.T_base_platform, tables)
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
    """Root mean square residual of coarse edges in stated standard deviations; 1 for too few."""
    squares = estimate.edge_residuals[coarse & (estimate.edge_weights >= INLIER_WEIGHT)] ** 2
    return float(np.sqrt(squares.mean())) if squares.size > LEAST_NOISE_FREEDOM else 1.0


def _search_pass(
    images: Sequence[StationImages],
    measure: Callable[[Sequence[StationImages]], list[Result]],
    cached_bytes: float = CACHED_IMAGE_BYTES,
) -> list[Result]:
    """Results of ``measure`` for all stations.

    Stations are measured together, or in parallel where their images must be decoded, which
    releases the interpreter's lock: those that need more than ``cached_bytes`` bytes.
    """
    pixels = sum(np.prod(p.camera.image_size) * len(p.images) for p in images)
    if pixels <= cached_bytes:
        return measure(images)
    with ThreadPoolExecutor(THREADS) as pool:
        return [one for (one,) in pool.map(measure, ([p] for p in images))]


def _edges(passes: list[legs.StationEdges], options: RefinementOptions) -> EdgeSet:
    """Edges of a measurement pass; raises `ResultError` for too few to identify a machine."""
    edges = concatenate([station_edges.edges for station_edges in passes])
    if len(edges) < options.fewest_edges:
        raise ResultError(
            f"only {len(edges)} edges of legs were found in all images",
            expected=f"at least {options.fewest_edges}",
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
    """Concatenated edges of the last pass, with those that the estimate rejected as rejections.

    images : as they were measured.
    """
    # a station that observes only a board has the binning of its camera's other stations, because
    # they share the edge shift
    of_camera = {session.stations[p.station].camera_file: p.binning for p in images}
    binning = np.ones(len(estimate.state.T_camera_base), dtype=int)
    for k, station in enumerate(session.stations):
        binning[k] = of_camera.get(station.camera_file, 1)
    in_view = legs.joined_passes(passes, float("nan"), float("nan"))
    outliers = np.flatnonzero(estimate.edge_weights < INLIER_WEIGHT).tolist()
    # images of which most edges were rejected
    images_as_wholes = tuple(
        Rejection(unit.station, unit.configuration, -1, -1, -1, _IMAGE_OFF)
        for unit in rejected_units(measurements, estimate)
        if unit.is_image
    )
    return Observation(
        edges=in_view.edges,
        rejected=in_view.rejected
        + boards.rejected
        + tuple(in_view.edges.rejection(k, _OUTLIER) for k in outliers)
        + images_as_wholes
        + _rejected_poses(session, measurements, estimate),
        points=in_view.points,
        point_edge=in_view.point_edge,
        T_camera_base=estimate.state.T_camera_base,
        poses=measurements.poses,
        binning=binning,
    )


def _rejected_poses(
    session: Session, measurements: Measurements, estimate: Estimate
) -> tuple[Rejection, ...]:
    """Rejected poses, with their distances from the predictions."""
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
