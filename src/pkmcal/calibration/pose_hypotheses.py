"""What may be wrong with a session whose measured poses disagree with the machine.

Hypotheses are all mistakes in the readings (:mod:`pkmcal.mechanisms.reading_hypotheses`), a board
or a station that moved between two configurations, and a board of another size. Two levels of
evidence compare them:

- closure: platform poses by the nominal machine and the readings, laid on the measured ones by
  robot-world/hand-eye in closed form. Milliseconds for each; nominal errors are in the residuals.
- estimate: the joint estimate from the data as they would be without the mistake. Seconds for each,
  so only hypotheses that closure leaves in the running are estimated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from math import log
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of
from pkmcal.calibration.localization import frozen_in
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import inverse, pose, pose_difference
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.start import middle_pose, start_state
from pkmcal.identify.state import State
from pkmcal.identify.unidentified import identified, only_heights
from pkmcal.identify.verdict import RicherModel
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.reading_hypotheses import reading_hypotheses
from pkmcal.outcome.finding import Finding, note
from pkmcal.outcome.hypotheses import (
    OPTIONS,
    EvidenceLevel,
    Hypothesis,
    decide,
    log_likelihood,
    parameter_cost,
    posterior,
    rivals_of,
)
from pkmcal.papers.hand_eye import closed_forms, start_from_poses
from pkmcal.session.load import Session
from pkmcal.session.station_movement import how_far
from pkmcal.wording import DISPLAY_UNITS, listed, number

SUSPECT_POSE_SCALE = 2.0
"""Factor on the poses' noise from which mistakes are looked for."""
SUSPECT_REJECTED_SHARE = 0.1
"""Share of rejected poses from which they are."""
FEWEST_POSES_A_SIDE = 3
"""Poses on either side of a movement: fewer are outliers."""
OTHER_SIZE = 2e-3
"""Relative difference of a board's size below which the print is as good as printers are."""
EXPLAINED_POSES_SHARE = 0.85
"""Share of the poses that a mistake put right has to explain; the rest may be outliers."""
TENABLE_MISFIT = 4.0
"""Root mean square of the poses' residuals, in stated standard deviations, beyond which a
hypothesis explains nothing: errors of the nominal model that no parameter takes up are below."""
HOPELESS_POSE_SCALE = 50.0
"""Factor on the poses' noise at which an estimate under a hypothesis is given up after a first
search: far beyond TENABLE_MISFIT."""
NOMINAL_ERROR_FACTOR = 10.0
"""Factor by which the errors of a nominal model may exceed its prior sigmas. A motor that stands
still while its readings move, or the reverse, is off by 20 to 50 times as much."""
NOMINAL_DRAWS = 4
"""Machines drawn from the prior sigmas to know how large closure residuals are by nominal errors:
four draws of some thirty parameters each tell it to a tenth."""
NO_ESTIMATE = (PkmcalError, np.linalg.LinAlgError)
"""Errors by which an estimate under a hypothesis fails."""


class PoseCase(NamedTuple):
    """Measurements, and the state from which their estimate starts; None for the nominal one."""

    measurements: Measurements
    start: State | None = None


PoseHypothesis = Hypothesis[PoseCase]


class Diagnosis(NamedTuple):
    """The mistake that explains measured poses.

    hypothesis : None where none does. misfit : rms residual of the poses without the mistake, in
    stated standard deviations. movement : (6,) left perturbation (omega, tau) of a board, or a
    station, that moved; NaN where the data do not determine it. untested : codes and errors of
    hypotheses without an estimate. rivals : other mistakes that are not excluded.
    """

    hypothesis: PoseHypothesis | None
    misfit: float
    movement: Array
    untested: tuple[tuple[str, str], ...]
    rivals: tuple[PoseHypothesis, ...] = ()


def diagnose(machine: Machine, measurements: Measurements, estimate: Estimate) -> Diagnosis:
    """The mistake that explains why poses disagree with the machine.

    machine : nominal. estimate : of these measurements.
    """
    if not np.any(measurements.on_platform[measurements.poses.mount]):
        return Diagnosis(None, np.inf, np.zeros(6), ())  # poses of boards on the base alone
    n_effective = effective_sample_size(machine, measurements)
    estimates: dict[int, Estimate] = {}
    untested: list[tuple[str, str]] = []

    def by_closure(hypotheses: Sequence[PoseHypothesis]) -> Array:
        cases = [one.apply(PoseCase(measurements)).measurements for one in hypotheses]
        null, *values = log_likelihood(
            closure_misfits(machine, [measurements, *cases]), n_effective
        ).tolist()
        best: dict[tuple[str, str], int] = {}
        for k, (one, value) in enumerate(zip(hypotheses, values, strict=True)):
            if value > values[best.setdefault(one.meaning, k)]:
                best[one.meaning] = k
        # of a motor's constants the best is enough: its offset, estimated, takes up the rest
        retained = np.isin(np.arange(len(values)), list(best.values()))
        ratios = np.array(values) - null
        # a mistake in the readings moves the platform by far more than nominal errors do, so
        # closure shows it; a movement or a size may be less, and is estimated in any case
        prior = np.array([one.log_prior for one in hypotheses])
        readings = np.array([one.code.startswith("readings.") for one in hypotheses])
        return np.where(retained & (~readings | (ratios + prior > 0)), ratios, -np.inf)

    def by_estimate(hypotheses: Sequence[PoseHypothesis]) -> Array:
        null = log_likelihood(np.array(pose_misfit(estimate)), n_effective)
        out = np.full(len(hypotheses), -np.inf)
        for k, one in enumerate(hypotheses):
            case = one.apply(PoseCase(measurements))
            try:
                start = case.start or start_from_poses(machine, case.measurements)
                value = bundle(
                    machine, case.measurements, start, hopeless=HOPELESS_POSE_SCALE,
                    scale_readings=False,
                )  # fmt: skip
            except NO_ESTIMATE as error:
                untested.append((one.code, str(error)))
                continue
            estimates[id(one)] = value
            misfit = pose_misfit(value)
            if misfit < TENABLE_MISFIT:
                out[k] = log_likelihood(np.array(misfit), n_effective) - null
        return out

    levels = (
        # nominal errors are in these residuals, so closure drops hypotheses and confirms none
        EvidenceLevel("closure", by_closure, decides=False, most=OPTIONS.most),
        EvidenceLevel("estimate", by_estimate),
    )
    ranked = posterior(pose_hypotheses(machine, measurements, estimate), levels)
    best = decide(ranked)
    if best is None:
        return Diagnosis(None, np.inf, np.zeros(6), tuple(untested))
    hypothesis = best.hypothesis
    value = estimates[id(hypothesis)]
    movement = _movement(machine, hypothesis, value)
    if hypothesis.code == "readings.reversed":
        constant = _constant_by_estimate(machine, hypothesis, measurements.joints, value)
        hypothesis = replace(hypothesis, facts={**hypothesis.facts, "constant": constant})
    # such as a camera that moved beside a board that did
    rivals = [one.hypothesis for one in rivals_of(ranked) if one.log_odds > OPTIONS.report]
    return Diagnosis(hypothesis, pose_misfit(value), movement, tuple(untested), tuple(rivals))


def effective_sample_size(machine: Machine, measurements: Measurements) -> float:
    """Number of independent residuals of measured poses.

    The six numbers of a pose share its errors and count once. Errors that an imperfect model leaves
    vary smoothly over the workspace, so there are no more independent ones than the machine has
    free parameters.
    """
    return float(min(len(measurements.poses), machine.parameters.free_matrix().shape[1]))


def pose_misfit(estimate: Estimate) -> float:
    """Root mean square residual of the better EXPLAINED_POSES_SHARE of the poses, rejected or not,
    in their stated standard deviations: outliers with another cause should hide nothing.
    """
    errors = estimate.pose_residuals * estimate.statistics.pose_scale
    return float(_usual(np.mean(errors**2, axis=1)[None])[0])


def _usual(squares: Array) -> Array:
    """Root mean squares (N,) of the better EXPLAINED_POSES_SHARE of squares (N, n); 0 for n = 0."""
    count = int(np.ceil(EXPLAINED_POSES_SHARE * squares.shape[1]))
    few = np.sort(squares, axis=1)[:, :count]
    return np.sqrt(few.mean(axis=1)) if count else np.zeros(len(squares))


# ------------------------------------------------------------------ evidence: closure


def closure_misfits(machine: Machine, cases: Sequence[Measurements]) -> Array:
    """Misfits (N,) of N cases of measurements where platform poses follow from the nominal machine
    and the readings: as :func:`pose_misfit`.

    Each pair of a station and a mount on the platform is laid by itself, by the best of the closed
    forms. Cases may differ in their readings and in their poses' stations, mounts and values.
    """
    joints = np.stack([case.joints for case in cases])
    fk = machine.forward_result(joints.reshape(-1, joints.shape[-1])).T_base_platform
    body = fk.reshape(*joints.shape[:2], 4, 4)
    # where legs do not meet, the nearest pose is off by as much as the readings are wrong
    body = np.where(np.isfinite(body).all(axis=(-1, -2), keepdims=True), body, np.eye(4))
    out = np.zeros(len(cases))
    shared: dict[tuple[bytes, bytes], list[int]] = {}  # which are laid together
    for k, case in enumerate(cases):
        key = case.poses.station.tobytes(), case.poses.mount.tobytes()
        shared.setdefault(key, []).append(k)
    for group in shared.values():
        poses, on_platform = cases[group[0]].poses, cases[group[0]].on_platform
        observed = np.stack([cases[k].poses.T_station_target for k in group])
        squares: list[Array] = []
        pairs = np.unique(np.stack([poses.station, poses.mount], axis=1), axis=0)
        for s, m in pairs[on_platform[pairs[:, 1]]]:
            rows = np.flatnonzero((poses.station == s) & (poses.mount == m))
            here, there = body[group][:, poses.configuration[rows]], observed[:, rows]
            squares.append(_laid(here, there, poses.whiten[rows]))
        if squares:
            out[group] = _usual(np.concatenate(squares, axis=1))
    return out


def _laid(body: Array, observed: Array, whiten: Array) -> Array:
    """Mean squares (N, n) of the whitened residuals of N runs of n poses of one station and mount,
    by the closed form that leaves least.

    body : T_base_platform (N, n, 4, 4). observed : T_station_target. whiten : (n, 6, 6).
    """
    squares: list[Array] = []
    for pair in closed_forms(body, observed):
        predicted = pair.T_camera_base[:, None] @ body @ pair.T_mount[:, None]
        error = (whiten @ pose_difference(predicted, observed)[..., None])[..., 0]
        squares.append(np.mean(error**2, axis=-1))
    each = np.stack(squares)
    best = _usual(each.reshape(-1, each.shape[-1])).reshape(each.shape[:2]).argmin(axis=0)
    return each[best, np.arange(each.shape[1])]


def contradicted_by_closure(
    machine: Machine, measurements: Measurements, rng: np.random.Generator
) -> bool:
    """Whether poses and readings contradict each other by far more than nominal errors explain.

    These are known by closure of machines that are drawn from the prior sigmas.
    """
    poses = measurements.poses
    if not np.any(measurements.on_platform[poses.mount]):
        return False
    fk = machine.forward_result(measurements.joints).T_base_platform
    exact = np.where(
        measurements.on_platform[poses.mount][:, None, None], fk[poses.configuration], np.eye(4)
    )
    nominal = replace(measurements, poses=replace(poses, T_station_target=exact))
    spread = machine.parameters.tolerance
    expected = [
        closure_misfits(
            machine.with_values(
                machine.parameters.unit_axes(machine.values + spread * rng.normal(size=len(spread)))
            ),
            [nominal],
        )[0]
        for _ in range(NOMINAL_DRAWS)
    ]
    limit = NOMINAL_ERROR_FACTOR * max(float(np.sqrt(np.mean(np.square(expected)))), 1.0)
    return bool(closure_misfits(machine, [measurements])[0] > limit)


# ------------------------------------------------------------------ hypotheses


def pose_hypotheses(
    machine: Machine, measurements: Measurements, estimate: Estimate
) -> list[PoseHypothesis]:
    """All mistakes that measured poses can show."""
    n_effective = effective_sample_size(machine, measurements)
    out = [
        PoseHypothesis(
            one.code,
            one.subject,
            lambda case, one=one: PoseCase(
                replace(case.measurements, joints=one.apply(case.measurements.joints))
            ),
            # a reversed motor's constant is a free parameter
            one.log_prior + parameter_cost(int(one.code == "readings.reversed"), n_effective),
            facts=one.facts,
        )
        for one in reading_hypotheses(measurements.joints, machine.joint_ranges)
    ]
    # heights do not determine where a tracker stands: score tests tell whether it moved
    whole = () if only_heights(estimate) else _movements(measurements, estimate)
    rest = [*whole, *_sizes(machine, measurements, estimate)]
    prior = -log(max(len({one.meaning for one in rest}), 1))
    out += [
        replace(one, log_prior=prior + parameter_cost(one.facts["parameters"], n_effective))
        for one in rest
    ]
    return out


def _movements(measurements: Measurements, estimate: Estimate) -> Iterator[PoseHypothesis]:
    """A board, or a camera, that stands elsewhere from some configuration on."""
    poses = measurements.poses
    for m in np.flatnonzero(measurements.on_platform):
        for s in np.unique(poses.station[poses.mount == m]):
            rows = np.flatnonzero((poses.mount == m) & (poses.station == s))
            rows = rows[np.argsort(poses.configuration[rows], kind="stable")]
            if len(rows) < 2 * FEWEST_POSES_A_SIDE:
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

    The split that leaves the least spread about the two parts' medians, all six numbers in units of
    their own spread. rows : (n,) of one station and one mount, in the order of configurations.
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
        for at in range(FEWEST_POSES_A_SIDE, len(rows) - FEWEST_POSES_A_SIDE + 1)
    ]
    return FEWEST_POSES_A_SIDE + int(np.argmin(rest))


def _movement(machine: Machine, hypothesis: PoseHypothesis, estimate: Estimate) -> Array:
    """(omega, tau) (6,) of what moved, from its pose before to the one after; NaN where the data do
    not determine it, zero where the hypothesis is another.
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


def _constant_by_estimate(
    machine: Machine, hypothesis: PoseHypothesis, joints: Array, estimate: Estimate
) -> float:
    """Sum of a reversed motor's readings and the values that they stand for, m or rad.

    The values follow from the estimated platform poses by the nominal machine, whose offset the
    corrected readings are read with.
    """
    (motor,) = hypothesis.facts["motors"]
    near = joints.copy()
    near[:, motor] = hypothesis.facts["constant"] - joints[:, motor]
    values = machine.inverse(estimate.state.T_base_platform, near)[:, motor]
    reached = np.isfinite(values)
    if not reached.any():
        return hypothesis.facts["constant"]
    return float(np.median((values + joints[:, motor])[reached]))


def _sizes(
    machine: Machine, measurements: Measurements, estimate: Estimate
) -> Iterator[PoseHypothesis]:
    """A board whose squares have another size: its distances are all wrong by one factor."""
    poses = measurements.poses
    boards = [m for m, mount in enumerate(measurements.mounts) if mount.name == "board"]
    rows = np.flatnonzero(np.isin(poses.mount, boards) & measurements.on_platform[poses.mount])
    if not boards or len(rows) < 2 * FEWEST_POSES_A_SIDE:
        return
    state = start_state(machine, measurements, estimate.state.T_camera_base)
    there = state.T_base_platform[poses.configuration[rows], :3, 3]
    in_view = poses.T_station_target[rows, :3, 3]
    size = float(np.sqrt(np.var(there, axis=0).sum() / np.var(in_view, axis=0).sum()))
    if abs(size - 1) < OTHER_SIZE:
        return

    def apply(case: PoseCase) -> PoseCase:
        T = case.measurements.poses.T_station_target.copy()
        T[rows] = pose(T[rows, :3, :3], size * T[rows, :3, 3])
        other = replace(case.measurements.poses, T_station_target=T)
        return PoseCase(replace(case.measurements, poses=other))

    yield PoseHypothesis("board.size", "board", apply, facts={"size": size, "parameters": 1})


# ------------------------------------------------------------------ what follows


def poses_disagree(estimate: Estimate) -> bool:
    """Whether the poses disagree with the machine so much that a mistake is likely."""
    rejected = estimate.pose_weights < 0.5
    return bool(rejected.size) and (
        estimate.statistics.pose_scale > SUSPECT_POSE_SCALE
        or rejected.mean() > SUSPECT_REJECTED_SHARE
        or rejected.sum() >= 2 * FEWEST_POSES_A_SIDE
    )


def check_frozen(session: Session, boards: Boards) -> None:
    """Raise `InputError` where a reading never changes and measured poses contradict the readings.

    Asked before any estimate: one from frozen readings takes a thousand steps and ends nowhere.
    """
    error = frozen_in(session)
    if error is None:
        return
    measurements = measurements_of(session, boards)
    if contradicted_by_closure(session.machine, measurements, np.random.default_rng(0)):
        raise error


def check_poses(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    richer: tuple[RicherModel, ...] = (),
) -> tuple[Finding, ...]:
    """Raise `InputError` where a mistake explains why poses disagree with the machine, or where a
    reading never changes; a note on hypotheses that have no estimate.

    richer : other models of the mechanism file; where one of them fits, the model is at fault.
    """
    if not poses_disagree(estimate) or any(model.scale < SUSPECT_POSE_SCALE for model in richer):
        return ()
    if error := frozen_in(session):
        raise error
    diagnosis = diagnose(session.machine, measurements, estimate)
    if diagnosis.hypothesis is not None:
        misfit = pose_misfit(estimate)
        error = _error(session, diagnosis.hypothesis, diagnosis, misfit)
        others = [_error(session, one, diagnosis, misfit).what for one in diagnosis.rivals]
        if not others:
            raise error
        raise InputError(
            error.what,
            where=error.where,
            found=f"{error.found}; the poses fit as well if {' or '.join(others)}",
            expected=error.expected,
            next_step=error.next_step,
            code=error.code,
        )
    if not diagnosis.untested:
        return ()
    codes = [code for code, _ in diagnosis.untested]
    why = diagnosis.untested[0][1].rstrip(".")
    return (note("poses.mistakes_untested", number=len(codes), mistakes=codes, why=why),)


def _error(
    session: Session, hypothesis: PoseHypothesis, diagnosis: Diagnosis, misfit_before: float
) -> InputError:
    """The error that names the mistake. misfit_before : of the poses with it, in stated sigmas."""
    facts, joints = hypothesis.facts, session.document["joints"]
    residual = f"with that, the poses fit {diagnosis.misfit:.1f} times their noise"
    times = f"{misfit_before:.{int(misfit_before < 10)}f}"
    found = f"poses that the readings miss by {times} times their noise"
    columns = joints["columns"]
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
            found=f"{how_far(diagnosis.movement).removeprefix(', ')}; {residual}",
            expected="a board screwed to the platform, and a camera that stands still",
            next_step=f"Calibrate with the configurations before {after}, or with those from it on",
            code=hypothesis.code,
        )
    if hypothesis.code == "board.size":
        return InputError(
            "the board has another size than its file says",
            where=session.document["board"]["file"],
            found=f"a board {facts['size']:.4f} times as large, by how far the platform moved",
            expected=f"the size as measured with a ruler over many squares; {residual}",
            next_step=f"Multiply square and marker by {facts['size']:.4f}, if a ruler agrees",
            code=hypothesis.code,
        )
    where = f"{joints['file']}, line 1"
    if hypothesis.code == "readings.sign":
        (name,) = (columns[k] for k in facts["motors"])
        what = f"the readings of {name} have the wrong sign"
        where = f"{joints['file']}, column {name}"
        expected = "the readings with the other sign"
        next_step = "Turn the sign of this column round, or the axis in the mechanism file"
    elif hypothesis.code == "readings.reversed":
        ((motor, name),) = ((k, columns[k]) for k in facts["motors"])
        unit = session.machine.joint_units[motor]
        scale, display = DISPLAY_UNITS[unit]
        constant = f"{number(scale * facts['constant'], 0 if unit == 'm' else 1)} {display}"
        what = f"the readings of {name} count the other way"
        where = f"{joints['file']}, column {name}"
        expected = f"{constant}, or nearly so, less the reading"
        next_step = (
            f"Turn the motor's direction round where it is set, or write {constant} less"
            " the reading into this column; what is left of the constant is calibrated"
        )
    elif hypothesis.code == "readings.exchanged":
        one, other = (columns[k] for k in facts["motors"])
        what = f"the readings of {one} and {other} are exchanged"
        expected = "the two columns in the other order"
        next_step = "Exchange the two columns, or the motors in the mechanism file"
    elif hypothesis.code == "readings.shifted":
        what = "the readings are shifted against the poses by one configuration"
        where = joints["file"]
        near = "before" if facts["step"] > 0 else "after"
        expected = f"at each pose the readings of the configuration {near} it"
        next_step = "Look for a row that is missing or was written twice"
    else:
        order = [columns[k] for k in facts["order"]]
        what = "the legs are numbered differently in the readings and in the mechanism file"
        expected = f"the columns in the order {listed(order, len(order))}"
        next_step = "Give the columns the order of the legs in the mechanism file"
    return InputError(
        what, where=where, found=found, expected=f"{expected}; {residual}", next_step=next_step,
        code=hypothesis.code,
    )  # fmt: skip
