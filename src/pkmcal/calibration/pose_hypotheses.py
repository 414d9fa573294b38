"""Hypotheses about a session whose measured poses disagree with the machine.

The hypotheses are all mistakes in the readings (:mod:`pkmcal.mechanisms.reading_hypotheses`), a
board or a station that moved between two configurations, and a board of another size. Two levels of
evidence compare them:

- closure: platform poses by the nominal machine and the readings, registered to the measured poses
  by robot-world/hand-eye calibration in closed form. This takes milliseconds for each hypothesis;
  the residuals contain nominal errors.
- estimate: the joint estimate from the data without the mistake. This takes seconds for each
  hypothesis, so only those that closure retains are estimated.

An estimate from readings that contradict the poses takes minutes and is meaningless, so closure is
evaluated before any estimate. Its residuals, as stated and under each hypothesis, are compared in
units of those due to nominal errors of the prior's size; the true size of nominal errors is
unknown. If one mistake is not enough, two at once are tried. An estimate then only confirms what
closure prefers. Hypotheses are compared only if one could be reported at all: if the misfit as
stated exceeds :func:`~pkmcal.outcome.hypotheses.harmless_misfit`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from math import log
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.localization import frozen_in
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import inverse, pose, pose_difference
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.hand_eye import (
    Pair,
    PairProblem,
    closed_forms,
    size_of,
    start_from_poses,
)
from pkmcal.identify.length_registration import determines_legs, register_by_lengths
from pkmcal.identify.start import middle_pose, start_state
from pkmcal.identify.state import State
from pkmcal.identify.unidentified import identified
from pkmcal.identify.verdict import VERDICT, RicherModel
from pkmcal.levels import LARGEST_NOMINAL_ERROR, NEARLY_ALL
from pkmcal.measurements import BOARD_MOUNT_NAME, Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.reading_hypotheses import reading_error, reading_hypotheses
from pkmcal.outcome.finding import Finding, note
from pkmcal.outcome.hypotheses import (
    HYPOTHESIS_THRESHOLDS,
    NO_ESTIMATE,
    EvidenceLevel,
    Explanation,
    Hypothesis,
    Ranked,
    estimate_level,
    harmless_misfit,
    likely,
    log_likelihood,
    parameter_cost,
    posterior,
)
from pkmcal.session.load import Session
from pkmcal.session.station_movement import FEWEST_BESIDE_MOVEMENT, how_far
from pkmcal.solver.search import minimise

EXPLAINED_POSES_SHARE = NEARLY_ALL
"""Share of the poses that a hypothesis has to explain; the rest may be outliers."""
HOPELESS_POSE_SCALE = 50.0
"""Factor on the poses' noise above which an estimate under a hypothesis is abandoned after a first
search: far above ``VerdictOptions.too_noisy``."""

REGISTRATION_TOLERANCE = 0.1
"""Last step of a registration, as STEP_TOLERANCE, in stated standard deviations of the poses: a
tenth of their noise, where misfits are compared that exceed it."""


@dataclass(frozen=True)
class ClosureOptions:
    """Limits of the comparison by closure."""

    # largest ratio of a nominal model's errors to its prior sigmas, which a file may state too
    # small: above it neither a hypothesis nor the data as stated are tenable. A motor that does not
    # move while its readings change, or the reverse, causes 20 to 50 times as much
    most_nominal_error: float = LARGEST_NOMINAL_ERROR
    # number of machines drawn from the prior sigmas, for the closure residuals due to nominal
    # errors: four draws of some thirty parameters each determine their size to a tenth
    draws: int = 4
    # number of configurations, spread over all, in which poses and readings are tested for a
    # contradiction, and pairs of mistakes are compared: a thousand pairs in seconds
    configurations: int = 48


CLOSURE = ClosureOptions()


class PoseCase(NamedTuple):
    """Measurements, and the state from which their estimate starts; None for the nominal one."""

    measurements: Measurements
    start: State | None = None


PoseHypothesis = Hypothesis[PoseCase]


class Diagnosis(NamedTuple):
    """Decision between the hypotheses about measured poses.

    hypothesis : the mistake; None if no hypothesis explains the poses.
    log_odds : of the mistake, nats.
    misfit : root mean square residual of the poses without the mistake, in stated standard
        deviations.
    movement : (6,) left perturbation (omega, tau) of a board, or a station, that moved; NaN where
        the data do not determine it.
    untested : codes and errors of hypotheses without an estimate.
    rivals : other mistakes that are not excluded.
    """

    hypothesis: PoseHypothesis | None = None
    log_odds: float = -np.inf
    misfit: float = np.inf
    movement: Array = np.zeros(6)
    untested: tuple[tuple[str, str], ...] = ()
    rivals: tuple[PoseHypothesis, ...] = ()


class PoseEvidence:
    """Levels of evidence for the mistakes of one machine's measured poses.

    machine : nominal.
    null_misfit : misfit of the poses as stated, by an estimate.
    closure_unit : closure misfit due to nominal errors of the prior's size, in stated standard
        deviations.
    most : number of configurations that closure compares; None for all.
    estimates, misfits, ratios : results by estimate and by closure for the hypotheses so far, by
        identity.
    untested : see :class:`Diagnosis`.
    """

    def __init__(
        self,
        machine: Machine,
        measurements: Measurements,
        null_misfit: float,
        closure_unit: float = 1.0,
    ) -> None:
        self.machine, self.measurements = machine, measurements
        self.null_misfit, self.closure_unit = null_misfit, closure_unit
        self.n_effective = effective_sample_size(machine, measurements)
        self.most: int | None = None
        self.estimates: dict[int, Estimate] = {}
        self.misfits: dict[int, float] = {}
        self.ratios: dict[int, float] = {}
        self.untested: list[tuple[str, str]] = []

    def harmless(self, hypotheses: Sequence[PoseHypothesis], log_odds: float, n: int = 1) -> float:
        """Misfit up to which no hypothesis, or no n of them at once, can reach the log-odds."""
        prior = max(one.log_prior for one in hypotheses)
        return harmless_misfit(self.n_effective, n * prior, log_odds)

    def by_closure(self, hypotheses: Sequence[PoseHypothesis]) -> Array:
        """Log-likelihood ratios by closure.

        Minus infinity for mistakes in the readings that are less likely than none, and for all but
        the best variant of an explanation.
        """
        cases = [one.apply(PoseCase(self.measurements)).measurements for one in hypotheses]
        few = [spread_over(case, self.most) for case in (self.measurements, *cases)]
        misfits = closure_misfits(self.machine, few) / self.closure_unit
        self.misfits = {id(one): m for one, m in zip(hypotheses, misfits[1:].tolist(), strict=True)}
        null, *values = log_likelihood(misfits, self.n_effective).tolist()
        best: dict[tuple[str, str], int] = {}
        for k, (one, misfit) in enumerate(zip(hypotheses, misfits[1:], strict=True)):
            if misfit < misfits[1 + best.setdefault(one.meaning, k)]:
                best[one.meaning] = k
        # the best constant of a motor is enough, because an estimate corrects it by the offset
        retained = np.isin(np.arange(len(values)), list(best.values()))
        ratios = np.array(values) - null
        self.ratios = {id(one): r for one, r in zip(hypotheses, ratios.tolist(), strict=True)}
        # A mistake in the readings has a far larger effect than nominal errors, so closure detects
        # it; a movement or a size may have a smaller one, and is estimated in any case.
        prior = np.array([one.log_prior for one in hypotheses])
        readings = np.array([one.code.startswith("readings.") for one in hypotheses])
        return np.where(retained & (~readings | (ratios + prior > 0)), ratios, -np.inf)

    @property
    def by_estimate(self) -> EvidenceLevel[PoseHypothesis]:
        """Level of evidence by joint estimates."""

        def misfit(hypothesis: PoseHypothesis) -> float:
            value = self.estimates[id(hypothesis)] = self.estimate(hypothesis, HOPELESS_POSE_SCALE)
            return pose_misfit(value)

        def failed(hypothesis: PoseHypothesis, why: str) -> None:
            self.untested.append((hypothesis.code, why))

        return estimate_level(misfit, self.null_misfit, self.n_effective, VERDICT.too_noisy, failed)

    @property
    def by_confirmation(self) -> EvidenceLevel[PoseHypothesis]:
        """Levels of evidence from joint estimates where the data as stated have no estimate.

        Estimates compare hypotheses with each other; closure compares the best hypothesis with the
        null hypothesis.
        """

        def ratios(hypotheses: Sequence[PoseHypothesis]) -> Array:
            values = self.by_estimate.log_likelihood_ratios(hypotheses)
            best = int(np.argmax(values))
            if not np.isfinite(values[best]):
                return values
            return values - values[best] + self.ratios[id(hypotheses[best])]

        return EvidenceLevel("estimate", ratios)

    def estimate(self, hypothesis: PoseHypothesis, hopeless: float = np.inf) -> Estimate:
        """Estimate from the data without the mistake.

        hopeless : factor on the poses' noise above which it is abandoned after a first search.

        Raises one of NO_ESTIMATE where there is none.
        """
        case = hypothesis.apply(PoseCase(self.measurements))
        start = case.start or start_from_poses(self.machine, case.measurements)
        return bundle(
            self.machine, case.measurements, start, hopeless=hopeless, scale_readings=False
        )

    def beside(self, first: PoseHypothesis) -> Diagnosis:
        """Second mistake, of any kind, in addition to a first one in the readings."""
        try:
            value = self.estimate(first)
        except NO_ESTIMATE as error:
            return Diagnosis(untested=((first.code, str(error).rstrip(".")),))
        without = first.apply(PoseCase(self.measurements)).measurements
        second = diagnose(self.machine, without, value)
        if second.hypothesis is None:
            return second
        named = self._with_constants(first, value)
        parts = (*named.facts.get("parts", (named,)), second.hypothesis)
        return second._replace(hypothesis=replace(first, facts={"parts": parts}), rivals=())

    def diagnosis(self, ranked: Sequence[Ranked[PoseHypothesis]]) -> Diagnosis:
        """Decision between hypotheses that were estimated."""
        found, untested = likely(ranked), tuple(self.untested)
        if not found:
            return Diagnosis(untested=untested)
        best, *others = found
        value = self.estimates[id(best.hypothesis)]
        movement = _movement(self.machine, best.hypothesis, value)
        hypothesis = self._with_constants(best.hypothesis, value)
        # such as a movement of the camera, where the board may have moved
        rivals = tuple(one.hypothesis for one in others)
        return Diagnosis(hypothesis, best.log_odds, pose_misfit(value), movement, untested, rivals)

    def _with_constants(self, hypothesis: PoseHypothesis, estimate: Estimate) -> PoseHypothesis:
        """Hypothesis with the constants (m or rad) of its reversed motors as estimated.

        The values follow from the estimated platform poses by the nominal machine, whose offset
        applies to the corrected readings.
        """
        if parts := hypothesis.facts.get("parts"):
            if any("order" in one.facts or "step" in one.facts for one in parts):
                return hypothesis  # a motor's readings are then in another column or row
            parts = tuple(self._with_constants(one, estimate) for one in parts)
            return replace(hypothesis, facts={"parts": parts})
        if hypothesis.code != "readings.reversed":
            return hypothesis
        (motor,) = hypothesis.facts["motors"]
        joints = self.measurements.joints
        near = hypothesis.apply(PoseCase(self.measurements)).measurements.joints
        values = self.machine.inverse(estimate.state.T_base_platform, near)[:, motor]
        constant = values + joints[:, motor]
        if not np.isfinite(constant).any():
            return hypothesis
        return replace(
            hypothesis, facts={**hypothesis.facts, "constant": float(np.nanmedian(constant))}
        )


def diagnose(
    machine: Machine,
    measurements: Measurements,
    estimate: Estimate,
    richer_misfit: float = np.inf,
) -> Diagnosis:
    """Mistake that explains why poses disagree with the machine, by closure and estimates.

    machine : nominal.
    estimate : of these measurements.
    richer_misfit : misfit of the poses with another model of the mechanism file, in stated sigmas:
        a mistake has to explain more than that model.
    """
    if not np.any(measurements.on_platform[measurements.poses.mount]):
        return Diagnosis()  # poses of boards on the base alone
    evidence = PoseEvidence(machine, measurements, min(pose_misfit(estimate), richer_misfit))
    hypotheses = pose_hypotheses(machine, measurements, estimate)
    if evidence.null_misfit <= evidence.harmless(hypotheses, HYPOTHESIS_THRESHOLDS.report):
        return Diagnosis()
    levels = (
        # residuals contain nominal errors, so closure discards hypotheses but confirms none
        EvidenceLevel(
            "closure", evidence.by_closure, decides=False, most=HYPOTHESIS_THRESHOLDS.most
        ),
        evidence.by_estimate,
    )
    return evidence.diagnosis(posterior(hypotheses, levels))


def diagnose_by_closure(
    machine: Machine,
    measurements: Measurements,
    misfit: float,
    unit: float,
    options: ClosureOptions = CLOSURE,
) -> Diagnosis:
    """Mistake in the readings that explains why poses contradict them, by closure alone.

    With a second mistake of any kind if a single one does not explain the poses.

    misfit : closure misfit of the poses as stated, in stated standard deviations.
    unit : as returned by :func:`nominal_misfit`.
    """
    evidence = PoseEvidence(machine, measurements, misfit, unit)
    closure = EvidenceLevel(
        "closure", evidence.by_closure, decides=False, most=HYPOTHESIS_THRESHOLDS.most
    )
    single = reading_mistakes(machine, measurements)
    contradicted = misfit > options.most_nominal_error * unit
    for number in (1, 2):
        # a decision here replaces the estimate from the data as stated, so it needs log-odds of
        # ``act``
        if misfit <= evidence.harmless(single, HYPOTHESIS_THRESHOLDS.act, number) * unit:
            break
        hypotheses = single if number == 1 else [*_pairs(single, measurements)]
        closing = [
            one.hypothesis
            for one in posterior(hypotheses, [closure])
            if one.log_odds > HYPOTHESIS_THRESHOLDS.act
            and evidence.misfits[id(one.hypothesis)] < options.most_nominal_error
        ]
        diagnosis = evidence.diagnosis(posterior(closing, [evidence.by_confirmation]))
        if diagnosis.hypothesis is None and closing and contradicted:
            diagnosis = evidence.beside(closing[0])
        if diagnosis.hypothesis is not None:
            return diagnosis
        evidence.most = options.configurations
    return Diagnosis()


def effective_sample_size(machine: Machine, measurements: Measurements) -> float:
    """Effective sample size of measured poses.

    The six numbers of a pose have common errors and count once. Errors of an imperfect model vary
    smoothly over the workspace, so the number is at most that of the machine's free parameters.
    """
    return float(min(len(measurements.poses), machine.parameters.free_matrix().shape[1]))


def pose_misfit(estimate: Estimate) -> float:
    """Root mean square residual of the better EXPLAINED_POSES_SHARE of the poses, in stated
    standard deviations.

    Rejected poses are included; the worst poses are not, because they may be outliers with another
    cause.
    """
    errors = estimate.pose_residuals * estimate.statistics.pose_scale
    return float(_usual(np.mean(errors**2, axis=1)[None])[0])


def _usual(squares: Array) -> Array:
    """Root mean squares (N,) of the better EXPLAINED_POSES_SHARE of squares (N, n); 0 for n = 0."""
    count = int(np.ceil(EXPLAINED_POSES_SHARE * squares.shape[1]))
    few = np.sort(squares, axis=1)[:, :count]
    return np.sqrt(few.mean(axis=1)) if count else np.zeros(len(squares))


# ------------------------------------------------------------------ evidence: closure


def spread_over(measurements: Measurements, most: int | None) -> Measurements:
    """Readings and poses of at most ``most`` configurations, spread evenly; of all, if None."""
    if most is None or most >= len(measurements.joints):
        return measurements
    rows, poses = evenly(len(measurements.joints), most), measurements.poses
    poses = poses.select(np.isin(poses.configuration, rows))
    poses = replace(poses, configuration=np.searchsorted(rows, poses.configuration))
    return replace(measurements, joints=measurements.joints[rows], poses=poses)


def closure_misfits(machine: Machine, cases: Sequence[Measurements]) -> Array:
    """Misfits (N,), as :func:`pose_misfit`, of N cases with platform poses by the nominal machine
    and the readings.

    Each pair of a station and a mount on the platform is registered separately, by the best of the
    closed forms, or by the legs' lengths at whole poses where these do not hold the platform. Cases
    may differ in their readings and in their poses' stations, mounts and values.
    """
    joints = np.stack([case.joints for case in cases])
    fk = machine.forward_result(joints.reshape(-1, joints.shape[-1])).T_base_platform
    body = fk.reshape(*joints.shape[:2], 4, 4)
    # if loops do not close, the nearest pose is used: its error is as large as that of the readings
    body = np.where(np.isfinite(body).all(axis=(-1, -2), keepdims=True), body, np.eye(4))
    out = np.zeros(len(cases))
    shared: dict[tuple[bytes, bytes], list[int]] = {}  # cases that are registered together
    for k, case in enumerate(cases):
        key = case.poses.station.tobytes(), case.poses.mount.tobytes()
        shared.setdefault(key, []).append(k)
    for group in shared.values():
        poses, on_platform = cases[group[0]].poses, cases[group[0]].on_platform
        observed = np.stack([cases[k].poses.T_station_target for k in group])
        squares: list[Array] = []
        pairs = np.unique(np.stack([poses.station, poses.mount], axis=1), axis=0)
        for s, m in pairs[on_platform[pairs[:, 1]]]:
            own = np.flatnonzero((poses.station == s) & (poses.mount == m))
            at = poses.configuration[own]
            if machine.layout.underdetermined and determines_legs(poses.select(own)):
                each = register_by_lengths(
                    machine, joints[group][:, at], observed[:, own], poses.whiten[own],
                    cases[0].joint_noise,
                ).squares  # fmt: skip
            else:
                each = _registered_squares(
                    body[group][:, at], observed[:, own], poses.whiten[own], size_of(machine)
                )
            squares.append(each)
        if squares:
            out[group] = _usual(np.concatenate(squares, axis=1))
    return out


def _registered_squares(body: Array, observed: Array, whiten: Array, size: float) -> Array:
    """Mean squares (N, n) of the whitened residuals of N runs of n poses of one station and mount.

    The closed form with the smallest residuals is where least squares start: a nominal error of the
    rotations, which closed forms solve first, displaces their positions.

    body : T_base_platform (N, n, 4, 4).
    observed : T_station_target (N, n, 4, 4).
    whiten : (n, 6, 6).
    size : the limbs' length, m.
    """
    problem = PairProblem(body, observed, np.ones(body.shape[:2]), whiten, size)
    starts = closed_forms(body, observed)
    each = np.stack([np.mean(problem.differences(pair) ** 2, axis=-1) for pair in starts])
    best = _usual(each.reshape(-1, each.shape[-1])).reshape(each.shape[:2]).argmin(axis=0)
    every = Pair(
        *(np.stack(parts)[best, np.arange(len(body))] for parts in zip(*starts, strict=True))
    )
    pair = minimise(problem, every, tolerance=REGISTRATION_TOLERANCE).state
    return np.mean(problem.differences(pair) ** 2, axis=-1)


def nominal_misfit(
    machine: Machine,
    measurements: Measurements,
    rng: np.random.Generator,
    enough: float = np.inf,
    options: ClosureOptions = CLOSURE,
) -> float:
    """Closure misfit (:func:`closure_misfits`) of machines drawn from the prior sigmas, in stated
    standard deviations.

    At least 1, the misfit due to noise.

    enough : a lower bound is returned as soon as it is at least this value, usually after one draw.
    """
    squares, unit = 0.0, 1.0
    if unit >= enough:
        return unit
    poses, exact = measurements.poses, measurements.poses.T_station_target.copy()
    fk = machine.forward_result(measurements.joints).T_base_platform[poses.configuration]
    moving = measurements.on_platform[poses.mount]
    whole = moving & (poses.rows == 6)
    exact[~moving] = np.eye(4)
    exact[moving, :3, 3] = fk[moving, :3, 3]
    exact[whole, :3, :3] = fk[whole, :3, :3]
    nominal = replace(measurements, poses=replace(poses, T_station_target=exact))
    if machine.layout.underdetermined:
        nominal = _about_home(machine, nominal, moving)
    spread = machine.parameters.tolerance
    for _ in range(options.draws):
        values = machine.values + spread * rng.normal(size=len(spread))
        drawn = machine.with_values(machine.parameters.unit_axes(values))
        squares += float(closure_misfits(drawn, [nominal])[0]) ** 2 / options.draws
        unit = max(float(np.sqrt(squares)), 1.0)
        if unit >= enough:
            break
    return unit


def _about_home(machine: Machine, measurements: Measurements, moving: Booleans) -> Measurements:
    """Measurements without noise of the nominal machine, at poses that differ from home as the
    measured ones of the mounts on the platform do from their middle.
    """
    poses, joints = measurements.poses, measurements.joints.copy()
    middle = middle_pose(poses.T_station_target[moving])
    around = machine.home() @ inverse(middle) @ poses.T_station_target[moving]
    joints[poses.configuration[moving]] = machine.inverse(around)
    exact = poses.T_station_target.copy()
    exact[moving] = around
    return replace(measurements, joints=joints, poses=replace(poses, T_station_target=exact))


# ------------------------------------------------------------------ hypotheses


def reading_mistakes(machine: Machine, measurements: Measurements) -> list[PoseHypothesis]:
    """All mistakes in the readings."""
    n_effective = effective_sample_size(machine, measurements)
    return [
        PoseHypothesis(
            one.code,
            one.subject,
            lambda case, one=one: case._replace(
                measurements=replace(case.measurements, joints=one.apply(case.measurements.joints))
            ),
            # a reversed motor's constant is a free parameter
            one.log_prior + parameter_cost(int(one.code == "readings.reversed"), n_effective),
            facts=one.facts,
        )
        for one in reading_hypotheses(measurements.joints, machine.joint_ranges)
    ]


def _pairs(
    single: Sequence[PoseHypothesis], measurements: Measurements
) -> Iterator[PoseHypothesis]:
    """Two mistakes at once, each pair of readings once. Facts: ``parts``, the two."""
    compared: set[bytes] = set()
    for one, other in product(single, single):

        def apply(
            case: PoseCase, one: PoseHypothesis = one, other: PoseHypothesis = other
        ) -> PoseCase:
            return other.apply(one.apply(case))

        joints = np.round(apply(PoseCase(measurements)).measurements.joints, 12).tobytes()
        if one.meaning == other.meaning or joints in compared:
            continue
        compared.add(joints)
        subject = " and ".join(sorted(f"{part.code} of {part.subject}" for part in (one, other)))
        prior = one.log_prior + other.log_prior
        yield PoseHypothesis(one.code, subject, apply, prior, facts={"parts": (one, other)})


def pose_hypotheses(
    machine: Machine, measurements: Measurements, estimate: Estimate
) -> list[PoseHypothesis]:
    """Hypotheses about measured poses: readings, movements and sizes of boards."""
    n_effective = effective_sample_size(machine, measurements)
    # heights do not determine a tracker's pose: score tests detect whether it moved
    only_heights = estimate.purpose is Purpose.HEIGHT
    whole = () if only_heights else _movements(measurements, estimate)
    rest = [*whole, *_sizes(machine, measurements, estimate)]
    prior = -log(max(len({one.meaning for one in rest}), 1))
    return reading_mistakes(machine, measurements) + [
        replace(one, log_prior=prior + parameter_cost(one.facts["parameters"], n_effective))
        for one in rest
    ]


def _movements(measurements: Measurements, estimate: Estimate) -> Iterator[PoseHypothesis]:
    """Movements of a board, or a camera, between two configurations."""
    poses = measurements.poses
    for m in np.flatnonzero(measurements.on_platform):
        for s in np.unique(poses.station[poses.mount == m]):
            rows = np.flatnonzero((poses.mount == m) & (poses.station == s))
            rows = rows[np.argsort(poses.configuration[rows], kind="stable")]
            if len(rows) < 2 * FEWEST_BESIDE_MOVEMENT:
                continue
            at = _jump(measurements, estimate, rows)
            later = rows[at:]
            facts = {
                "station": int(s),
                "mount": int(m),
                "before": int(poses.configuration[rows[at - 1]]),
                "configuration": int(poses.configuration[later[0]]),
                "parameters": 6,
            }
            subject = f"station {s}, mount {m}"
            board = partial(_with_moved_board, estimate.state, int(s), int(m), later)
            yield PoseHypothesis("board.moved", subject, board, facts=facts)
            if not len(measurements.edges):  # its edges would have to move with the camera
                camera = partial(_with_moved_station, estimate.state, int(s), later)
                yield PoseHypothesis("station.moved", subject, camera, facts=facts)


def _with_moved_board(state: State, s: int, m: int, later: Integers, case: PoseCase) -> PoseCase:
    """A mount of its own for the later poses (n,) of mount m, measured from station s."""
    data, poses = case.measurements, case.measurements.poses
    body = state.T_camera_base[s] @ state.T_base_platform[poses.configuration[later]]
    mount = middle_pose(inverse(body) @ poses.T_station_target[later])
    moved = _changed(poses.mount, later, len(state.T_mount))
    start = replace(
        state,
        T_mount=np.concatenate([state.T_mount, mount[None]]),
        on_platform=np.append(data.on_platform, True),
    )
    mounts = (*data.mounts, data.mounts[m])
    return PoseCase(replace(data, poses=replace(poses, mount=moved), mounts=mounts), start)


def _with_moved_station(state: State, s: int, later: Integers, case: PoseCase) -> PoseCase:
    """A station of its own for the later poses (n,) that station s measured."""
    data, poses = case.measurements, case.measurements.poses
    there = state.T_base_platform[poses.configuration[later]] @ state.T_mount[poses.mount[later]]
    station = middle_pose(poses.T_station_target[later] @ inverse(there))
    start = replace(state, T_camera_base=np.concatenate([state.T_camera_base, station[None]]))
    other = replace(
        data,
        poses=replace(poses, station=_changed(poses.station, later, data.n_stations)),
        n_stations=data.n_stations + 1,
        camera_of_station=np.append(data.camera_of_station, data.camera_of_station[s]),
    )
    return PoseCase(other, start)


def _changed(index: Integers, rows: Integers, value: int) -> Integers:
    out = index.copy()
    out[rows] = value
    return out


def _jump(measurements: Measurements, estimate: Estimate, rows: Integers) -> int:
    """Number of poses before a jump of the board on the platform.

    The split with the smallest spread about the medians of the two parts, all six numbers in units
    of their own spread.

    rows : (n,) of one station and one mount, in the order of configurations.
    """
    poses, state = measurements.poses, estimate.state
    k = poses.configuration[rows]
    body = state.T_camera_base[poses.station[rows]] @ state.T_base_platform[k]
    mount = state.T_mount[poses.mount[rows]]
    off = pose_difference(inverse(body) @ poses.T_station_target[rows], mount)
    scale = np.median(np.abs(off - np.median(off, axis=0)), axis=0)
    off = off / np.maximum(scale, 1e-3 * max(scale.max(), 1e-12))
    rest = [
        sum(np.abs(part - np.median(part, axis=0)).sum() for part in (off[:at], off[at:]))
        for at in range(FEWEST_BESIDE_MOVEMENT, len(rows) - FEWEST_BESIDE_MOVEMENT + 1)
    ]
    return FEWEST_BESIDE_MOVEMENT + int(np.argmin(rest))


def _movement(machine: Machine, hypothesis: PoseHypothesis, estimate: Estimate) -> Array:
    """Movement (omega, tau), (6,), of the board or station, from the pose before to the pose after;
    NaN where the data do not determine it, zero for other hypotheses.
    """
    if hypothesis.code == "board.moved":
        pair = [hypothesis.facts["mount"], -1]
        T, covariance = estimate.state.T_mount[pair], estimate.mount_covariance[pair]
    elif hypothesis.code == "station.moved":
        pair = [hypothesis.facts["station"], -1]
        T = inverse(estimate.state.T_camera_base[pair])
        covariance = estimate.station_covariance[pair]
    else:
        return np.zeros(6)
    determined = identified(machine, covariance).all(axis=0)
    return np.where(determined, pose_difference(T[1], T[0]), np.nan)


def _sizes(
    machine: Machine, measurements: Measurements, estimate: Estimate
) -> Iterator[PoseHypothesis]:
    """Another size of the board's squares: all of its distances are wrong by one factor."""
    poses = measurements.poses
    boards = [m for m, mount in enumerate(measurements.mounts) if mount.name == BOARD_MOUNT_NAME]
    rows = np.flatnonzero(np.isin(poses.mount, boards) & measurements.on_platform[poses.mount])
    if not boards or len(rows) < 2 * FEWEST_BESIDE_MOVEMENT:
        return
    state = start_state(machine, measurements, estimate.state.T_camera_base)
    there = state.T_base_platform[poses.configuration[rows], :3, 3]
    in_view = poses.T_station_target[rows, :3, 3]
    size = float(np.sqrt(np.var(there, axis=0).sum() / np.var(in_view, axis=0).sum()))

    def apply(case: PoseCase) -> PoseCase:
        T = case.measurements.poses.T_station_target.copy()
        T[rows] = pose(T[rows, :3, :3], size * T[rows, :3, 3])
        other = replace(case.measurements.poses, T_station_target=T)
        return PoseCase(replace(case.measurements, poses=other))

    yield PoseHypothesis("board.size", "board", apply, facts={"size": size, "parameters": 1})


# ------------------------------------------------------------------ what follows


def explain_closure(
    session: Session, boards: Boards, options: ClosureOptions = CLOSURE
) -> Explanation:
    """Mistake in the readings that explains why measured poses contradict them, if any.

    Evaluated before any estimate: an estimate from such readings takes a thousand steps and does
    not converge.
    """
    measurements = measurements_of(session, boards)
    poses = measurements.poses
    positions = (poses.rows >= 3) & measurements.on_platform[poses.mount]
    if np.count_nonzero(positions) < 2 * FEWEST_BESIDE_MOVEMENT:
        return Explanation()  # a frame and mount of their own explain few
    machine, few = session.machine, spread_over(measurements, options.configurations)
    (misfit,) = closure_misfits(machine, [few]).tolist()
    least = PoseEvidence(machine, measurements, misfit).harmless(
        reading_mistakes(machine, measurements), HYPOTHESIS_THRESHOLDS.act
    )
    unit = nominal_misfit(machine, few, np.random.default_rng(0), misfit / least, options)
    if misfit <= least * unit:
        return Explanation()
    diagnosis = partial(diagnose_by_closure, machine, measurements, misfit, unit, options)
    tenable = misfit <= options.most_nominal_error * unit
    return _explanation(session, diagnosis, misfit, tenable)


def explain_poses(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    richer: RicherModel | None = None,
) -> Explanation:
    """Mistake that explains why poses disagree with the machine, if any.

    richer : model of the mechanism file that explains the poses. If they agree with that model, no
        hypothesis is compared.
    """
    # legs that do not hold the platform leave its pose to the measurement, so that residuals of the
    # poses alone, which are compared here, take up errors of the readings
    if not estimate.pose_weights.size or estimate.purpose is Purpose.LENGTHS:
        return Explanation()
    misfit = pose_misfit(estimate)
    richer_misfit = np.inf if richer is None else richer.scale
    if richer_misfit <= harmless_misfit(effective_sample_size(session.machine, measurements), 0.0):
        return Explanation()
    diagnosis = partial(diagnose, session.machine, measurements, estimate, richer_misfit)
    return _explanation(session, diagnosis, misfit, misfit < VERDICT.too_noisy)


def _explanation(
    session: Session, diagnose: Callable[[], Diagnosis], misfit: float, tenable: bool
) -> Explanation:
    """Error for the hypothesis that a diagnosis selects, with its rivals, and its log-odds.

    An encoder whose reading never changes precedes all other hypotheses, because its effect may
    equal that of any of them.

    misfit : of the poses as stated (RMS), in stated sigmas.
    tenable : whether the data as stated are not rejected at this misfit.
    """
    frozen = frozen_in(session)
    if frozen and not tenable:
        return Explanation(frozen, np.inf)
    diagnosis, untested = diagnose(), tuple[Finding, ...]()
    if frozen and diagnosis.hypothesis is not None:
        return Explanation(frozen, np.inf)
    if diagnosis.untested:
        codes, (why, *_) = zip(*diagnosis.untested, strict=True)
        untested = (note("poses.mistakes_untested", number=len(codes), mistakes=codes, why=why),)
    if diagnosis.hypothesis is None:
        return Explanation(untested=untested)
    error = _error(session, diagnosis.hypothesis, diagnosis, misfit)
    others = [_error(session, one, diagnosis, misfit).what for one in diagnosis.rivals]
    also = f"; the poses fit as well if {' or '.join(others)}" if others else ""
    error = error.with_fields(found=f"{error.found}{also}")
    return Explanation(error, diagnosis.log_odds, untested)


def _error(
    session: Session, hypothesis: PoseHypothesis, diagnosis: Diagnosis, misfit_before: float
) -> InputError:
    """Error that names one mistake, or two. misfit_before : of the poses as stated, in stated
    sigmas.
    """
    parts = [
        _error_of_part(session, one, diagnosis.movement, misfit_before)
        for one in hypothesis.facts.get("parts", (hypothesis,))
    ]
    found = list(dict.fromkeys(f"{one.found}" for one in parts))
    expected = [f"{one.expected}" for one in parts]
    residual = f"with that, the poses fit {diagnosis.misfit:.1f} times their noise"
    (found if parts[-1].code.endswith(".moved") else expected).append(residual)
    return parts[0].with_fields(
        what=", and ".join(one.what for one in parts),
        found="; ".join(found),
        expected="; ".join(expected),
        next_step=". ".join(f"{one.next_step}" for one in parts),
    )


def _error_of_part(
    session: Session, hypothesis: PoseHypothesis, movement: Array, misfit_before: float
) -> InputError:
    """Error that names one mistake, without the residual of the poses."""
    facts, joints = hypothesis.facts, session.document["joints"]
    if hypothesis.code in ("board.moved", "station.moved"):
        what = (
            "the board was moved on the platform"
            if hypothesis.code == "board.moved"
            else "the camera was moved"
        )
        before, after = (session.configurations[facts[k]] for k in ("before", "configuration"))
        return InputError(
            f"{what} between configuration {before} and {after}",
            where=f"session.yaml, stations.{session.station_names[facts['station']]}",
            found=how_far(movement).removeprefix(", "),
            expected="a board screwed to the platform, and a camera that stands still",
            next_step=f"Calibrate with the configurations before {after}, or with those from it on",
            code=hypothesis.code,
        )
    if hypothesis.code == "board.size":
        return InputError(
            "the board has another size than its file states",
            where=session.document["board"]["file"],
            found=f"a board {facts['size']:.4f} times as large, by how far the platform moved",
            expected="the size as measured with a ruler over many squares",
            next_step=f"Multiply square and marker by {facts['size']:.4f}, if a ruler agrees",
            code=hypothesis.code,
        )
    times = f"{misfit_before:.{int(misfit_before < 10)}f}"
    error = reading_error(
        hypothesis, joints["file"], joints["columns"], session.machine.joint_units
    )
    return error.with_fields(found=f"poses that the readings miss by {times} times their noise")
