"""Calibration of a session: load, localize, measure and estimate in turns, compare hypotheses,
judge.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, get_args

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import CameraRefinement, refinement_of
from pkmcal.calibration.case import Case, PriorScene
from pkmcal.calibration.chance_matches import (
    chance_match_reason,
    explain_chance_matches,
    misplaced_stations,
)
from pkmcal.calibration.discrepancy_basis import ModelError, discrepancy_findings, explains_heights
from pkmcal.calibration.faults import (
    lens_notes,
    noise_fault,
    noise_notes,
    refit_fixed_noise,
    richer_model,
    scale_fault,
    scale_notes,
    size_notes,
)
from pkmcal.calibration.handheld import (
    inconsistent_poses,
    localization_share,
    localize_case,
    without_stations,
)
from pkmcal.calibration.heights import ProbedHeights, probed_heights
from pkmcal.calibration.image_rotation import UpsideDown, rotation_finding, upside_down
from pkmcal.calibration.leg_numbering import numbering_note
from pkmcal.calibration.localization import (
    boards_of,
    check_observable,
    legs_stations,
    platform_poses,
    read_images,
)
from pkmcal.calibration.model_violations import DetectedViolation, model_violations
from pkmcal.calibration.outlier_explanations import outlier_explanations
from pkmcal.calibration.pose_hypotheses import explain_closure, explain_poses
from pkmcal.calibration.reading_effects import effect_notes, with_estimated_effects
from pkmcal.calibration.refinement import (
    REFINEMENT,
    RefinementOptions,
    RefinementResult,
    identify_poses,
    imputation_variance,
    refine_alternating,
)
from pkmcal.calibration.rejections import rejection_findings, unused_configurations
from pkmcal.calibration.summary import CalibrationSummary, Overview
from pkmcal.calibration.tube_radii import explain_radii
from pkmcal.errors import InputError, PkmcalError, ResultError
from pkmcal.files import closest, quoted, resolved
from pkmcal.identify.bundle import bundle
from pkmcal.identify.conditions import conditions
from pkmcal.identify.covariance import identifiability
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM, Search
from pkmcal.identify.start import start_state
from pkmcal.identify.unidentified import (
    Identification,
    explain,
    observed_by_boards,
    observed_legs,
)
from pkmcal.identify.verdict import RicherModel, assess
from pkmcal.measurements import Column, Measurements, Observation
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Verdict
from pkmcal.outcome.finding import Finding, doubtful, note
from pkmcal.outcome.hypotheses import Ranked, decide, refuse
from pkmcal.outcome.progress import Progress, no_progress, part
from pkmcal.ranges import CalibrationMethod, check_number
from pkmcal.session.load import Session, load_session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import listed

if TYPE_CHECKING:
    from pkmcal.calibration.holdout import Holdout
    from pkmcal.identify.bed import Bed

CALIBRATION_METHODS: tuple[str, ...] = get_args(CalibrationMethod)


@dataclass(frozen=True, repr=False)
class Calibration(CalibrationSummary):
    """Result of a calibration.

    boards : calibration board, where stations observe one.
    identification : identifiability of the machine's parameters.
    timings : seconds by step.
    holdout : configurations that the estimate does not use, if requested;
        :func:`pkmcal.judge.holdouts.holdout_of` predicts them.
    violations : detected model violations.
    model_errors : smooth model errors without a name, which the covariance contains.
    upside_down : images that were measured with their camera rotated by half a turn.
    images : images of stations whose legs were observed, by the station's number; those that fitted
        into memory are decoded.
    """

    session: Session
    observation: Observation
    measurements: Measurements
    estimate: Estimate
    verdict: Verdict
    identification: Identification
    cameras: CameraRefinement
    method: str
    seed: int
    timings: dict[str, float] = field(default_factory=dict)
    boards: Boards = field(default_factory=Boards)
    holdout: Holdout | None = None
    violations: tuple[DetectedViolation, ...] = ()
    model_errors: tuple[ModelError, ...] = ()
    upside_down: tuple[UpsideDown, ...] = ()
    images: Mapping[int, Sequence[Integers]] = field(default_factory=dict[int, Sequence[Integers]])

    @property
    def machine(self) -> Machine:
        """The calibrated machine."""
        return self.estimate.machine

    @cached_property
    def heights(self) -> ProbedHeights:
        """Heights above a bed before and after; empty without any."""
        return probed_heights(self.session, self.measurements, self.estimate)

    def overview(self) -> Overview:
        """Contents of the summary."""
        session, e = self.session, self.estimate
        edges, poses = e.edge_residuals[e.edge_weights >= INLIER_WEIGHT], e.pose_residuals
        return Overview(
            source=resolved(session.folder).name,
            method=self.method,
            machine=e.machine,
            verdict=self.verdict,
            nominal=session.machine.values,
            covariance=e.covariance,
            data_share=e.data_share,
            poses=e.state.T_base_platform[e.configurations],
            stations=session.station_names,
            legs_observed=e.edge_weights.size > 0,
            residuals=np.concatenate(
                [edges.ravel(), poses[e.pose_weights >= INLIER_WEIGHT].ravel()]
            ),
            chi2=e.statistics.chi2_as_stated,
            warnings=session.warnings,
        )


def calibrate_session(
    session: Session | Path | str,
    *,
    method: CalibrationMethod = "bundle",
    seed: int = 0,
    refine_camera: bool = False,
    holdout: int = 0,
    progress: Progress = no_progress,
    options: RefinementOptions = REFINEMENT,
    case: Case | None = None,
    localized_by: Machine | None = None,
) -> Calibration:
    """Calibrate the machine of a session; nothing is written.

    session : a loaded session, or its folder.
    method : ``bundle`` (joint maximum likelihood), ``four-step`` ([A]), ``linear`` ([B]) or
        ``inverse-kinematic`` ([C]).
    seed : seed for the random search for the stations' poses.
    refine_camera : estimate the cameras' intrinsics with the machine, with their calibration's
        covariance as the prior.
    holdout : number of poses, spread over the workspace, that the estimate does not use and that
        test the result.
    progress : called with the step in words and the share done.
    options : of the measurement passes.
    case : session with its images localized; by default they are localized here.
    localized_by : machine by which the images are localized, by default the session's.

    Raises InputError where the session is at fault, ResultError where there is no estimate.
    """
    from threadpoolctl import threadpool_limits

    check_options(method, seed, holdout)
    # Matrices here are small: threads inside the linear algebra only wait for one another, and
    # beside our own threads they slow it twentyfold.
    with threadpool_limits(1, "blas"):
        clock = Clock(progress)
        session = _load(session, refine_camera, holdout, clock)
        share = localization_share(session)
        nominal = replace(session, machine=localized_by or session.machine)
        located = case or _observe(nominal, seed, clock.part(0, share))
        located = located._replace(session=replace(located.session, machine=session.machine))

        def calibrated(refine: bool, first: float, last: float) -> Calibration:
            own = clock.part(first, last)
            settled = settle(session, located, refine, seed, own.part(0, 0.5), options)
            return _finished(settled, method, seed, holdout, own.part(0.5, 1))

        if not refine_camera or refinement_of(session, False).refines_all:
            return calibrated(refine_camera, share, 1)
        middle = (share + 1) / 2
        return better_refined(
            partial(calibrated, True, share, middle), partial(calibrated, False, middle, 1)
        )


def better_refined(
    refined: Callable[[], Calibration], held: Callable[[], Calibration]
) -> Calibration:
    """Calibration with the cameras' intrinsics estimated, unless the one with those of the files is
    better.

    In the latter case the result has a warning. Estimated intrinsics can be wrong if there are few
    images, or images with an uncertain pose. Criteria, in this order: a usable result; more images
    in use; a significantly smaller chi2 per degree of freedom, to which additional unknowns
    contribute nothing by themselves. Raises the error of ``refined`` if neither has a result.
    """
    try:
        value = refined()
    except PkmcalError as error:
        try:
            other = held()
        except PkmcalError:
            raise error from None
        why = str(error).rstrip(".")
        return _with_warning(other, doubtful("camera.refinement_failed", why=why))
    try:
        other = held()
    except PkmcalError as error:
        why = str(error).rstrip(".")
        return _with_warning(value, note("camera.files_intrinsics_failed", why=why))
    worse = worse_refined(value, other)
    return _with_warning(other, worse) if worse else value


def worse_refined(refined: Calibration, held: Calibration) -> Finding | None:
    """Warning if a calibration with estimated intrinsics is worse than one with those of the
    files.
    """
    if refined.verdict.usable != held.verdict.usable:
        return None if refined.verdict.usable else doubtful("camera.refinement_refused")
    taken = refined.session.images_taken
    retained, more = (
        taken - sum(len(one.station.images) for one in candidate.session.rejected)
        for candidate in (refined, held)
    )
    if retained != more:
        if retained > more:
            return None
        return doubtful("camera.refinement_rejects", kept=retained, of=taken, by_files=more)
    by_refined, by_held = refined.estimate.statistics, held.estimate.statistics
    chance = SESSION_FALSE_ALARM.scale(Search.INTRINSICS, by_refined.dof) ** 2
    if by_refined.chi2_as_stated > chance * by_held.chi2_as_stated:
        return doubtful(
            "camera.refinement_fits_worse",
            chi2=by_refined.chi2_as_stated,
            by_files=by_held.chi2_as_stated,
        )
    return None


def _with_warning(calibration: Calibration, warning: Finding) -> Calibration:
    verdict = replace(calibration.verdict, findings=(warning, *calibration.verdict.findings))
    return replace(calibration, verdict=verdict)


def calibrate_measurements(
    session: Session,
    observation: Observation,
    measurements: Measurements,
    T_camera_base: Array,
    *,
    progress: Progress = no_progress,
) -> Calibration:
    """Calibrate the machine of a session from given edges, such as simulated ones; no image is
    read.

    observation : with the edges of ``measurements``, whose readings may differ from the session's.
    T_camera_base : (S, 4, 4) start of the estimate.

    Raises ResultError where there is no estimate.
    """
    clock = Clock(progress)
    start = start_state(session.machine, measurements, T_camera_base)
    estimate = bundle(session.machine, measurements, start)
    turns = RefinementResult(observation, measurements, estimate, refinement_of(session, False))
    scene = PriorScene(session.machine, T_camera_base, start.T_base_platform)
    case = Case(session, [], Boards(), scene)
    return _judge(case, _Identified(turns, estimate, None, None), (), (), "bundle", 0, clock)


def check_options(method: str, seed: int, holdout: int) -> None:
    """Raise InputError for options without a meaning."""
    if method not in CALIBRATION_METHODS:
        guess = closest(str(method), CALIBRATION_METHODS)
        raise InputError(
            "there is no method of this name",
            where="method",
            found=quoted(method),
            expected=guess or listed(CALIBRATION_METHODS),
        )
    check_number("calibrate", "seed", seed)
    check_number("calibrate", "holdout", holdout)


class Settled(NamedTuple):
    """Repaired session and its estimate, after no remaining hypothesis is decided for.

    stated : estimate with the readings' noise as stated.
    richer : another model of the mechanism file that explains the poses, if any.
    repairs : hypotheses by which the data were changed.
    findings : on repairs, on hypotheses that are likely but were not adopted, and on hypotheses
        that could not be tested.
    """

    case: Case
    turns: RefinementResult
    stated: Estimate
    richer: RicherModel | None
    repairs: tuple[UpsideDown, ...] = ()
    findings: tuple[Finding, ...] = ()


def settle(
    session: Session,
    case: Case,
    refine_camera: bool,
    seed: int,
    clock: Clock,
    options: RefinementOptions = REFINEMENT,
) -> Settled:
    """Localize, estimate and compare all hypotheses about a session, until no repair is decided
    for.

    `calibrate` continues from the result; `check` ends with it. Hypotheses are compared with the
    data as stated. A repair changes the data, so after each one the machine is localized and
    estimated, and all hypotheses are compared again. Each camera's file is repaired once at most,
    and stations are only removed, which bounds the number of repetitions.

    case : observations of the session.

    Raises `InputError` for the most likely error in the input, `ResultError` where there is no
    estimate.
    """
    repairs: list[Ranked[UpsideDown]] = []
    while True:
        now, clock = clock.part(0, 0.8), clock.part(0.8, 1)
        # errors in the readings first: with one of them, no estimate is valid
        refuse(partial(explain_closure, case.session, case.boards))
        try:
            turns = _identify(case, refine_camera, now.part(0, 0.9), options)
        except ResultError:
            refuse(
                partial(explain_chance_matches, case, None, seed),
                partial(explain_radii, case, None, refine_camera, seed),
            )
            raise
        # images that are upside down; all stations are localized again, because one that was
        # rejected before may have been upside down too
        files = {one.hypothesis.subject for one in repairs}
        rotations = [
            one for one in upside_down(case.session, turns) if one.hypothesis.subject not in files
        ]
        if sure := [one for one in rotations if decide([one])]:
            repairs += sure
            repaired = session
            for one in repairs:
                repaired = one.hypothesis.apply(repaired)
            case = _observe(repaired, seed, now.part(0.9, 1))
            continue
        # stations with a wrong localized pose
        wrong = misplaced_stations(case.session, turns) or inconsistent_poses(
            case.session, turns.measurements, turns.estimate, case.scene.T_camera_base
        )
        if not wrong:
            break
        case = without_stations(case, wrong, turns.measurements.edges, turns.estimate)
    # errors that only the user can correct
    now.progress("Testing hypotheses about the data", 0.9)
    stated = refit_fixed_noise(case.session.machine, turns.measurements, turns.estimate)
    richer, failed = richer_model(case.session, turns.measurements, stated)
    untested = refuse(
        partial(explain_poses, case.session, turns.measurements, stated, richer),
        partial(explain_chance_matches, case, turns, seed),
        partial(explain_radii, case, turns, refine_camera, seed),
    )
    found = (rotation_finding(one) for one in (*repairs, *rotations))
    findings = (*found, *case.scene.findings, *failed, *untested)
    made = tuple(one.hypothesis for one in repairs)
    return Settled(case, turns, stated, richer, made, findings)


def _finished(
    settled: Settled, method: CalibrationMethod, seed: int, holdout: int, clock: Clock
) -> Calibration:
    """Calibration of a session after all repairs."""
    case, turns, stated, richer, repairs, found = settled
    machine = case.session.machine
    turns = imputation_variance(case, turns, np.random.default_rng(0), clock.part(0, 0.85).progress)
    clock.lap("identify")
    if turns is not settled.turns:
        stated = refit_fixed_noise(machine, turns.measurements, turns.estimate)
    if richer is not None:
        turns = turns._replace(estimate=stated)
    value = _estimated(machine, turns, richer, method, seed, holdout, clock)
    return _judge(case, value, repairs, found, method, seed, clock)


class _Identified(NamedTuple):
    """Refinement, estimate by the requested method, richer model, and holdout."""

    turns: RefinementResult
    estimate: Estimate
    richer: RicherModel | None
    out: Holdout | None


def _load(
    session: Session | Path | str, refine_camera: bool, holdout: int, clock: Clock
) -> Session:
    """Loaded session, checked for conflicts with the options."""
    if not isinstance(session, Session):
        session = load_session(session)
    check_observable(session)
    if holdout:
        from pkmcal.calibration.holdout import check_holdout

        check_holdout(session, holdout)
    # a pose that the machine cannot reach is reported before any work
    platform_poses(session, most=not legs_stations(session))
    refinement_of(session, refine_camera)
    clock.lap("load")
    return session


def _observe(session: Session, seed: int, clock: Clock) -> Case:
    """Case of a session with its stations localized, without hand-held images that were not
    localized.

    seed : for the random search. Raises as :func:`calibrate_session`.
    """
    clock.progress("Reading images" if session.stations else "Reading the measurements", 0.0)
    images = read_images(session)
    clock.lap("decode")
    if any("board" in station.observe for station in session.stations):
        clock.progress("Detecting the board", 0.1)
    boards = boards_of(session, images)
    rng, localizing = np.random.default_rng(seed), clock.part(0.3, 1).progress
    case = localize_case(session, images, boards, rng, localizing)
    clock.lap("observe")
    return case


def _identify(
    case: Case, refine_camera: bool, clock: Clock, options: RefinementOptions
) -> RefinementResult:
    """Refine the machine in turns with measurement passes."""
    session, cameras = case.session, refinement_of(case.session, refine_camera)
    if case.images:
        turns = refine_alternating(case, cameras, clock.progress, clock.lap, options)
    else:
        turns = identify_poses(
            session, case.boards, case.scene.T_camera_base, cameras, clock.progress, options
        )
    clock.lap("identify")
    return turns


def _estimated(
    nominal: Machine,
    turns: RefinementResult,
    richer: RicherModel | None,
    method: CalibrationMethod,
    seed: int,
    holdout: int,
    clock: Clock,
) -> _Identified:
    """Estimate without the holdout, by a paper's method if requested.

    Configurations are held out only here, after the localization, which needs all images.
    """
    out = None
    if holdout:
        from pkmcal.calibration.holdout import Holdout, chosen, estimate_without

        region = chosen(nominal, turns.estimate, turns.measurements, holdout)
        out = Holdout(region, turns.measurements)
        turns = estimate_without(nominal, turns, region)
    estimate = turns.estimate
    if method != "bundle":
        from pkmcal.identify.methods.estimates import by_method

        clock.progress("Repeating the paper's method", 0.85)
        estimate = by_method(method, nominal, turns.measurements, estimate, seed)
    return _Identified(turns, estimate, richer, out)


def _judge(
    case: Case,
    value: _Identified,
    repairs: tuple[UpsideDown, ...],
    found: tuple[Finding, ...],
    method: CalibrationMethod,
    seed: int,
    clock: Clock,
) -> Calibration:
    """Verdict on an estimate: model violations, identifiability and all findings.

    repairs, found : see ``repairs`` and ``findings`` of :class:`Settled`.
    """
    clock.progress("Judging", 0.9)
    session, turns = _as_measured(case.session, value.turns), value.turns
    detections: tuple[DetectedViolation, ...] = ()
    errors: tuple[ModelError, ...] = ()
    discrepancy_columns: tuple[Column, ...] = ()
    # Identifiability follows from the information of the data, to which the discrepancy adds
    # nothing. It is computed from the estimate before the discrepancy, whose linearization is
    # cached; the accuracy over a bed takes the discrepancy's columns beside it.
    without_discrepancy = value.estimate
    # score tests need the minimum of the joint problem, where the papers' methods do not end
    if method == "bundle":
        detections, errors, estimate, discrepancy_columns = model_violations(
            session, turns.observation, turns.measurements, value.estimate
        )
        value = value._replace(estimate=with_estimated_effects(session, estimate))
    # identifiability, and findings other than those of the verdict
    identification = _identification(turns.measurements, without_discrepancy, discrepancy_columns)
    others = (
        *_findings_of_estimate(
            session, value, identification, detections, errors, method == "bundle"
        ),
        *numbering_note(session),
        *turns.responses.findings,
        *found,
    )
    verdict = assess(
        turns.observation,
        value.estimate,
        identification,
        method,
        labels=session.labels,
        richer=value.richer,
        explained=explains_heights(errors),
        others=others,
        joints=session.joints,
    )
    clock.lap("identify")
    return Calibration(
        session=session,
        observation=turns.observation,
        measurements=turns.measurements,
        estimate=value.estimate,
        verdict=verdict,
        identification=identification,
        cameras=turns.cameras,
        method=method,
        seed=seed,
        timings=clock.laps,
        boards=case.boards,
        holdout=value.out,
        violations=detections,
        model_errors=errors,
        upside_down=repairs,
        images={one.station: one.images for one in case.images},
    )


def _as_measured(session: Session, turns: RefinementResult) -> Session:
    """Session with the cameras and responses with which its images were finally measured."""
    stations = session.stations
    if turns.cameras.active:  # the edges are where these cameras see them
        stations = tuple(
            replace(station, camera=turns.cameras.at_station(k))
            for k, station in enumerate(stations)
        )
    if stations is not session.stations:
        session = replace(session, stations=stations)
    for repair in turns.responses.repairs:
        session = repair.apply(session)
    return session


def _findings_of_estimate(
    session: Session,
    value: _Identified,
    identification: Identification,
    detections: tuple[DetectedViolation, ...],
    errors: tuple[ModelError, ...],
    at_minimum: bool,
) -> Iterator[Finding]:
    """Findings about an estimate other than those of the verdict.

    detections, errors : model violations, and smooth model errors without a name.
    at_minimum : whether the estimate is the minimum of the joint problem.
    """
    turns, estimate, measurements = value.turns, value.estimate, value.turns.measurements
    uneven_bed = explains_heights(errors)
    named = bool(detections or any(one.sure for one in errors))
    out = value.out.region.rows if value.out else ()
    yield from scale_fault(session, estimate)
    if not uneven_bed:
        yield from noise_fault(session, estimate)
    yield from turns.reasons
    yield from chance_match_reason(turns)
    yield from unused_configurations(session, estimate, out)
    yield from rejection_findings(
        session, measurements, estimate, identification, at_minimum=at_minimum
    )
    yield from (one.finding for one in detections)
    yield from discrepancy_findings(errors)
    yield from outlier_explanations(session, measurements, estimate)
    yield from noise_notes(session, estimate, named, explained=uneven_bed)
    yield from lens_notes(turns.cameras)
    yield from size_notes(session, measurements, estimate)
    yield from effect_notes(session, estimate)
    yield from scale_notes(session, estimate, tuple(one.of for one in detections))


def _identification(
    measurements: Measurements, estimate: Estimate, discrepancy_columns: tuple[Column, ...]
) -> Identification:
    """Identifiability of the machine's parameters, in words, and the papers' conditions.

    estimate : without the discrepancy in its covariances.
    discrepancy_columns : of the model discrepancy, which for heights alone is an uneven bed.
    """
    observed = observed_legs(
        measurements.edges,
        estimate.edge_weights,
        measurements.n_stations,
        estimate.machine.n_legs,
    )
    if not len(measurements.edges):  # no leg can be reported as not visible
        observed = np.ones_like(observed)
    values = identifiability(estimate.linearized.info, estimate.machine)
    counted = conditions(estimate.machine, observed) if len(measurements.edges) else ()
    bed: Bed | None = None
    if estimate.purpose is Purpose.HEIGHT:
        from pkmcal.identify.bed import bed_of

        bed = bed_of(estimate, discrepancy_columns)
    return explain(values, estimate, observed_by_boards(observed, measurements), counted, bed)


@dataclass(frozen=True)
class Clock:
    """Progress of a task, and the seconds by step; a step may have several laps."""

    progress: Progress = no_progress
    laps: dict[str, float] = field(default_factory=dict)
    _last: list[float] = field(default_factory=lambda: [time.perf_counter()])

    def lap(self, name: str) -> None:
        """Count the time since the last lap to a step."""
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last[0]
        self._last[0] = now

    def part(self, first: float, last: float) -> Clock:
        """The clock of a part, from share to share; see :func:`pkmcal.outcome.progress.part`."""
        return replace(self, progress=part(self.progress, first, last))
