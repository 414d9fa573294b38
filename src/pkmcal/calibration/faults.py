"""Mistakes in a session that its measured poses betray, as errors that name file and place.

Where poses disagree with the machine, each of the usual mistakes is put right in turn, and the
estimate made again: a motor's readings with the wrong sign, two motors exchanged, a board of
another size, a board or a camera that moved. The one that leaves least is named, if it leaves
little. Besides: richer models of the mechanism, a common factor on all lengths, and whether the
platform turns as the mechanism file says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Literal

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.camera_refinement import CameraRefinement
from pkmcal.calibration.localization import frozen_in
from pkmcal.cameras.contract import USUAL_ASPECT, USUAL_CENTRE, USUAL_DISTORTION, USUAL_FOCAL
from pkmcal.errors import InputError, PkmcalError
from pkmcal.geometry.rigid import inverse, pose, pose_difference
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate, State
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.start import middle_pose, start_state
from pkmcal.identify.unidentified import identified, only_heights
from pkmcal.identify.verdict import POOR_MODEL_POSE_SCALE, RicherModel
from pkmcal.measurements import Measurements, PoseSet
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.reading_hypotheses import (
    ReadingHypothesis,
    exchanged_motors,
    reversed_motors,
)
from pkmcal.outcome.finding import Finding, doubtful, note, wrong
from pkmcal.session.load import Session
from pkmcal.session.station_movement import how_far
from pkmcal.wording import DISPLAY_UNITS, listed, number

SUSPECT_POSE_SCALE = 2.0
"""Factor on the poses' noise, from which mistakes are looked for."""
SUSPECT_LOST_SHARE = 0.1
"""Share of poses given up from which they are."""
CURED_MISFIT_SHARE = 0.5
"""A mistake is believed where, put right, the poses' misfit is at most this part of what it was."""
FEWEST_POSES_A_SIDE = 3
"""Poses on either side of a movement: fewer are outliers."""
OTHER_SIZE = 2e-3
"""Relative difference of a board's size below which the print is as good as printers are."""
SURELY_CURED_MISFIT = 1.5
"""Standard deviations that a mistake put right leaves, below which no other is tried."""
EXPLAINED_POSES_SHARE = 0.85
"""Share of the poses that a mistake put right has to explain."""
CERTAIN_BOARD_MOVE = 12.0
"""Standard deviations by which a board has to have moved, all six numbers together."""
MOST_CURED_MISFIT = 4.0
"""Standard deviations that it may leave: a drawing's own errors are in them."""
UNTOLD_BOARD_SIZE_SIGMA = 0.7
"""Part of its tolerance from which a board's size is known from its file: the data say less."""
BOARD_SIZE_DISAGREEMENT = 2.0
"""Standard deviations between a board's size by its file and by all else from which a hint says so:
one of these in twenty is chance."""
WRONG_SCALE_DEVIATIONS = 3.0
"""Standard deviations by which a reading's scale is told to be another than the drawing's."""
COMMON_FACTOR_CHI2 = 60.0
"""Chi2 by which the drawing has to speak for a common factor on all lengths."""
HOPELESS_POSE_SCALE = 50.0
"""Factor on the poses' noise beyond which, after a first search, a mistake put right is none, and a
richer model no help: what is believed ends below MOST_CURED_MISFIT."""
WRONG_MODEL_READING_SCALE = 100.0
"""Factor on the readings' stated noise from which it is no noise: between a data sheet's figure and
what a mounted encoder does lies a factor of ten or thirty."""
NO_ESTIMATE = (PkmcalError, np.linalg.LinAlgError)
"""Errors by which an estimate under a hypothesis fails."""
FEWEST_POSES = 4
"""Whole poses of one station from which the platform's turning is tested."""


@dataclass(frozen=True)
class Fault:
    """A mistake that explains the poses.

    motor : column of the readings that counts the other way, or is exchanged with the other;
    constant : of the former, a reading and what it stands for together, m or rad. configuration :
    the first after a movement; before : the last before it. size : of the board, true over
    written. transform : (6,) (omega, tau) of the board, or the station, from before to after, NaN
    where the data do not determine it. misfit : what is left, in standard deviations; infinite
    where there is no estimate with the mistake put right, and failure says why.
    """

    kind: Literal["sign", "order", "board moved", "camera moved", "size"]
    misfit: float
    motor: int = -1
    other: int = -1
    station: int = -1
    before: int = -1
    configuration: int = -1
    transform: Array = field(default_factory=lambda: np.zeros(6))
    size: float = 1.0
    constant: float = 0.0
    failure: str = ""


def pose_misfit(estimate: Estimate) -> float:
    """How far off the poses are, in their standard deviations, root mean square of the better
    EXPLAINED_POSES_SHARE of them, given up or not: outliers of another cause should hide nothing.
    """
    return _usual(estimate.pose_residuals * estimate.statistics.pose_scale)


def _usual(error: Array) -> float:
    """Root mean square of the better EXPLAINED_POSES_SHARE of errors (N, 6), 0 of none."""
    each = np.sort(np.mean(error**2, axis=1))
    few = each[: max(int(np.ceil(EXPLAINED_POSES_SHARE * len(each))), 1)]
    return float(np.sqrt(np.mean(few))) if few.size else 0.0


def poses_disagree(estimate: Estimate) -> bool:
    """Whether the poses disagree with the machine so much that a mistake is likely."""
    lost = estimate.pose_weights < 0.5
    return bool(lost.size) and (
        estimate.statistics.pose_scale > SUSPECT_POSE_SCALE
        or lost.mean() > SUSPECT_LOST_SHARE
        or lost.sum() >= 2 * FEWEST_POSES_A_SIDE
    )


def wrong_scale(estimate: Estimate) -> float:
    """How much larger all lengths came out than the drawing's, 1 where no common factor explains
    it: a board whose squares are larger than written makes the whole machine larger.
    """
    machine = estimate.machine
    table = machine.parameters
    length = np.array([unit == "m" and kind != "radius" for unit, kind in zip(
        table.units, table.kinds, strict=True)])  # fmt: skip
    shifted = length & (np.diag(estimate.covariance) > 0)
    new, old = machine.values[shifted], table.drawing[shifted]
    weight = 1 / table.tolerance[shifted] ** 2
    if not np.any(new):
        return 1.0
    back = float(np.sum(weight * new * old) / np.sum(weight * new**2))
    gain = np.sum(weight * (new - old) ** 2) - np.sum(weight * (back * new - old) ** 2)
    remainder = np.sum(weight * (back * new - old) ** 2)
    return 1 / back if gain > COMMON_FACTOR_CHI2 and gain > remainder else 1.0


def diagnose_fault(
    machine: Machine, measurements: Measurements, estimate: Estimate
) -> tuple[Fault | None, tuple[Fault, ...]]:
    """The mistake that explains the poses, None where none does; and those that could not be tried.

    machine : by the drawing. estimate : of these measurements.
    """
    before = pose_misfit(estimate)
    value: Fault | None = None
    # heights do not know where a tracker stands: whether it moved, score tests say
    whole = () if only_heights(estimate) else _movements(machine, measurements, estimate)
    failed: list[Fault] = []
    for fault in chain(
        whole,
        _other_readings(machine, measurements),
        _sizes(machine, measurements, estimate),
    ):
        if fault.failure:
            failed.append(fault)
            continue
        if value is None or fault.misfit < value.misfit:
            value = fault
        # a board that moved and a camera that moved are alike, so both are always tried
        if value.misfit < SURELY_CURED_MISFIT and fault.kind not in ("board moved", "camera moved"):
            break
    if value and value.misfit >= min(CURED_MISFIT_SHARE * before, MOST_CURED_MISFIT):
        value = None
    return value, tuple(failed)


def _other_readings(machine: Machine, measurements: Measurements) -> Iterator[Fault]:
    """One motor's readings counted the other way, or two motors' exchanged, the likeliest first.

    Such a mistake put right leaves no more than the drawing's errors where an estimate starts, and
    one that is not there a misfit as large as before, after many steps: only what halves it at the
    start is estimated.
    """
    failures: dict[str, str] = {}

    def misfit(hypothesis: ReadingHypothesis) -> float:
        try:
            return _first_misfit(machine, replace(measurements, joints=hypothesis.joints))
        except NO_ESTIMATE as error:
            failures[f"{hypothesis.code} {hypothesis.motors}"] = str(error)
            return np.inf

    def fault_of(hypothesis: ReadingHypothesis, failure: str = "") -> Fault:
        kind = "sign" if hypothesis.code == "readings.reversed" else "order"
        motor, *other = hypothesis.motors
        return Fault(
            kind, np.inf, motor=motor, other=other[0] if other else -1,
            constant=hypothesis.constant, failure=failure,
        )  # fmt: skip

    joints = measurements.joints
    reversed_ = reversed_motors(joints, machine.joint_ranges)
    hypotheses = [(misfit(h), h) for h in exchanged_motors(joints)]
    for constants in filter(None, reversed_):
        few = dict.fromkeys((0, len(constants) // 2))  # a wrong sign alone, and the middle
        hypotheses += [(misfit(constants[k]), constants[k]) for k in few]
    limit = CURED_MISFIT_SHARE * _first_misfit(machine, measurements)
    for first, hypothesis in sorted(hypotheses, key=lambda item: item[0]):
        if first == np.inf:
            yield fault_of(hypothesis, failures[f"{hypothesis.code} {hypothesis.motors}"])
        if first > limit:
            continue
        if hypothesis.constant:  # the best of the motor's; its offset, estimated, takes up the rest
            hypothesis = min(reversed_[hypothesis.motors[0]], key=misfit)
        other_readings = replace(measurements, joints=hypothesis.joints)
        yield _tried(fault_of(hypothesis), machine, other_readings)[0]


def _first_misfit(machine: Machine, measurements: Measurements) -> float:
    """:func:`pose_misfit` where an estimate would start, platform poses by the drawing and the
    readings. Raises an error of NO_ESTIMATE where it cannot.
    """
    from pkmcal.papers.hand_eye import start_from_poses

    assembled = assemble(machine, measurements, default_gauge(machine))
    start = batch_of(machine, assembled, start_from_poses(machine, measurements))
    rows = assembled.places.poses.taken(assembled.problem.unweighted(start).poses[0])
    return _usual(np.nan_to_num(rows, nan=np.inf))


def _tried(
    fault: Fault, machine: Machine, measurements: Measurements, start: State | None = None
) -> tuple[Fault, Estimate | None]:
    """A mistake with its misfit, and the estimate from measurements in which it is put right, from
    the drawing unless a start is given; with its failure and None where there is no estimate.
    """
    from pkmcal.papers.hand_eye import start_from_poses

    try:
        if start is None:
            start = start_from_poses(machine, measurements)
        estimate = bundle(
            machine, measurements, start, hopeless=HOPELESS_POSE_SCALE, scale_readings=False
        )
    except NO_ESTIMATE as error:
        return replace(fault, failure=str(error)), None
    return replace(fault, misfit=pose_misfit(estimate)), estimate


def _movements(machine: Machine, measurements: Measurements, estimate: Estimate) -> Iterator[Fault]:
    """A board, or a camera, elsewhere from some configuration on."""
    poses, state = measurements.poses, estimate.state
    for m in np.flatnonzero(measurements.on_platform):
        for s in np.unique(poses.station[poses.mount == m]):
            rows = np.flatnonzero((poses.mount == m) & (poses.station == s))
            rows = rows[np.argsort(poses.configuration[rows], kind="stable")]
            if len(rows) < 2 * FEWEST_POSES_A_SIDE:
                continue
            at = _jump(measurements, estimate, rows)
            later = rows[at:]
            place = int(poses.configuration[rows[at - 1]]), int(poses.configuration[rows[at]])
            body = state.T_camera_base[s] @ state.T_base_platform[poses.configuration[later]]
            in_view = poses.T_station_target[later]
            mount = middle_pose(inverse(body) @ in_view)
            on = np.append(measurements.on_platform, True)
            board = replace(
                measurements,
                poses=replace(poses, mount=_changed(poses.mount, later, len(state.T_mount))),
                mounts=(*measurements.mounts, measurements.mounts[m]),
            )
            start = replace(
                state, T_mount=np.concatenate([state.T_mount, mount[None]]), on_platform=on
            )
            fault = Fault(
                "board moved", np.inf, station=int(s), before=place[0], configuration=place[1]
            )
            fault, tried = _tried(fault, machine, board, start)
            pair = np.array([m, -1])
            if tried is None:
                yield fault
            elif _certain(tried.state.T_mount[pair], tried.mount_covariance[pair]):
                change = _movement(machine, tried.state.T_mount[pair], tried.mount_covariance[pair])
                yield replace(fault, transform=change)
            if len(measurements.edges):
                continue  # its edges would have to move with the camera
            yield from _camera_moved(machine, measurements, state, int(s), later, place)


def _movement(machine: Machine, T: Array, covariance: Array) -> Array:
    """(omega, tau) (6,) from the one of two places (2, 4, 4) to the other, NaN where their
    covariances (2, 6, 6) do not determine it.
    """
    reference = identified(machine, covariance).all(axis=0)
    return np.where(reference, pose_difference(T[1], T[0]), np.nan)


def _certain(T: Array, covariance: Array) -> bool:
    """Whether two places (2, 4, 4) differ by more than their covariances (2, 6, 6) explain."""
    off, spread = pose_difference(T[1], T[0]), covariance.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(spread), 1e-30))
    white = np.linalg.solve(spread / scale / scale[:, None] + 1e-9 * np.eye(6), off / scale)
    return bool(np.sqrt(white @ (off / scale)) > CERTAIN_BOARD_MOVE)


def _camera_moved(
    machine: Machine,
    measurements: Measurements,
    state: State,
    s: int,
    later: Integers,
    place: tuple[int, int],
) -> Iterator[Fault]:
    poses = measurements.poses
    number = measurements.camera_of_station
    there = state.T_base_platform[poses.configuration[later]] @ state.T_mount[poses.mount[later]]
    station = middle_pose(poses.T_station_target[later] @ inverse(there))
    camera = replace(
        measurements,
        poses=replace(poses, station=_changed(poses.station, later, measurements.n_stations)),
        n_stations=measurements.n_stations + 1,
        camera_of_station=np.append(number, number[s]),
    )
    start = replace(state, T_camera_base=np.concatenate([state.T_camera_base, station[None]]))
    fault = Fault("camera moved", np.inf, station=s, before=place[0], configuration=place[1])
    fault, tried = _tried(fault, machine, camera, start)
    if tried is None:
        yield fault
    elif _certain(tried.state.T_camera_base[[s, -1]], tried.station_covariance[[s, -1]]):
        places = inverse(tried.state.T_camera_base[[s, -1]])
        change = _movement(machine, places, tried.station_covariance[[s, -1]])
        yield replace(fault, transform=change)


def _changed(index: Integers, rows: Integers, value: int) -> Integers:
    out = index.copy()
    out[rows] = value
    return out


def _jump(measurements: Measurements, estimate: Estimate, rows: Integers) -> int:
    """Where the board's place on the platform jumps: the number of rows before it.

    The split that leaves the least spread about the two parts' medians, all six numbers in
    units of their own spread.
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


def _sizes(machine: Machine, measurements: Measurements, estimate: Estimate) -> Iterator[Fault]:
    """A board whose squares have another size: its distances are all wrong by one factor."""
    poses = measurements.poses
    boards = [m for m, mount in enumerate(measurements.mounts) if mount.name == "board"]
    rows = np.flatnonzero(np.isin(poses.mount, boards) & measurements.on_platform[poses.mount])
    if not boards or len(rows) < 2 * FEWEST_POSES_A_SIDE:
        return
    state = start_state(machine, measurements, estimate.state.T_camera_base)
    there = state.T_base_platform[poses.configuration[rows], :3, 3]
    in_view = poses.T_station_target[rows, :3, 3]
    spread = np.sqrt(np.var(there, axis=0).sum() / np.var(in_view, axis=0).sum())
    T = poses.T_station_target.copy()
    if abs(spread - 1) < OTHER_SIZE:
        return
    T[rows] = pose(T[rows, :3, :3], spread * T[rows, :3, 3])
    other = replace(measurements, poses=replace(poses, T_station_target=T))
    yield _tried(Fault("size", np.inf, size=float(spread)), machine, other)[0]


def check_poses(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    richer: tuple[RicherModel, ...] = (),
) -> tuple[Finding, ...]:
    """Raise `InputError` where one of the usual mistakes explains why poses do not fit, or where a
    reading never changes; a note where mistakes could not be tried.

    richer : models that were tried; where one of them fits, it is the model that is at fault.
    """
    if not poses_disagree(estimate) or any(model.scale < SUSPECT_POSE_SCALE for model in richer):
        return ()
    if error := frozen_in(session):
        raise error
    fault, failed = diagnose_fault(session.machine, measurements, estimate)
    if fault is not None:
        raise _error(session, fault, pose_misfit(estimate))
    if not failed:
        return ()
    kinds = [one.kind for one in failed]
    why = failed[0].failure.rstrip(".")
    return (note("poses.mistakes_untested", number=len(failed), mistakes=kinds, why=why),)


def refit_fixed_noise(machine: Machine, measurements: Measurements, estimate: Estimate) -> Estimate:
    """The estimate with the readings' noise as it is stated, by which mistakes are looked for: a
    wrong sign, or a model that is too poor, would be taken for noise.
    """
    if estimate.statistics.reading_scale <= 1 or not len(measurements.poses):
        return estimate
    return bundle(machine, measurements, estimate.state, scale_readings=False)


def model_at_fault(richer: tuple[RicherModel, ...], estimate: Estimate) -> bool:
    """Whether a richer model fits what the estimate's, with noise as stated, does not."""
    best = min((model.scale for model in richer), default=np.inf)
    return best < max(POOR_MODEL_POSE_SCALE, CURED_MISFIT_SHARE * estimate.statistics.pose_scale)


def noise_fault(session: Session, estimate: Estimate) -> Iterator[Finding]:
    """A reason where readings scatter by more than the nominal model is off, and so determine
    nothing, or by so much more than is stated that it is no noise.
    """
    s, tolerance = estimate.statistics, session.machine.document.tolerance
    units, noise = set(session.machine.joint_units), session.joint_noise * s.reading_scale
    most = min({"m": tolerance.offset, "rad": tolerance.angle}[unit] for unit in units)
    if s.reading_scale <= 1:
        return
    if noise > most:
        yield wrong("readings.noise_beyond_tolerance", noise=noise, limit=most, units=sorted(units))
    elif s.reading_scale >= WRONG_MODEL_READING_SCALE:
        yield wrong(
            "readings.noise_beyond_encoders",
            noise=noise,
            scale=s.reading_scale,
            units=sorted(units),
        )


def richer_models(
    session: Session, measurements: Measurements, estimate: Estimate
) -> tuple[RicherModel, ...]:
    """How well the mechanism file's richer models fit, where this one is too poor for the poses."""
    if estimate.statistics.pose_scale < POOR_MODEL_POSE_SCALE:
        return ()
    machine = session.machine
    unknowns = machine.parameters.free_matrix().shape[1]
    out: list[RicherModel] = []
    for name in machine.document.models:
        if name == session.model:
            continue
        try:
            other = session.other_model(name)
            same = other.n_legs == machine.n_legs or not len(measurements.edges)
            if other.parameters.free_matrix().shape[1] <= unknowns or not same:
                continue
            start = start_state(other, measurements, estimate.state.T_camera_base)
            fit = bundle(
                other, measurements, start, hopeless=HOPELESS_POSE_SCALE, scale_readings=False
            )
        except NO_ESTIMATE as error:
            out.append(RicherModel(name, np.inf, str(error)))
            continue
        out.append(RicherModel(name, fit.statistics.pose_scale))
    return tuple(out)


def scale_fault(session: Session, estimate: Estimate) -> Iterator[Finding]:
    """A reason where the whole machine came out larger or smaller than drawn."""
    scale = wrong_scale(estimate)
    if scale != 1.0 and estimate.pose_weights.size:
        cause = "board" if session.board else "table"
        yield wrong("machine.scale", value=scale - 1, cause=cause)


def noise_notes(
    session: Session, estimate: Estimate, detections: bool = False, *, explained: bool = False
) -> Iterator[Finding]:
    """Warnings where the data do not allow a noise that session.yaml states.

    detections : whether something was found that makes readings scatter. explained : whether an
    uneven bed is what makes heights scatter, and not their noise.
    """
    if explained:
        return
    s, units = estimate.statistics, sorted(set(session.machine.joint_units))
    if s.reading_scale != 1 and not _within(1.0, s.reading_range):
        least, most = s.reading_range
        yield doubtful(
            "readings.noise",
            "session.yaml, joints.noise",
            noise=session.joint_noise * s.reading_scale,
            stated=session.joint_noise,
            bound=session.joint_noise * most if most is not None and not least else None,
            range=s.reading_range,
            units=units,
            explained="yes" if detections else "no",
        )
    only_trackers = session.trackers and not any("board" in x.observe for x in session.stations)
    if only_trackers and s.pose_range[1] is not None and s.pose_range[1] < 1:
        keys = [f"stations.{table.name}.tracker.noise" for table in session.trackers]
        yield doubtful("poses.noise", f"session.yaml, {keys[0]}", range=s.pose_range, keys=keys)


def lens_notes(cameras: CameraRefinement) -> Iterator[Finding]:
    """A warning for each camera that was refined and whose file states no covariance."""
    for file, camera in zip(cameras.files, cameras.calibrated, strict=True):
        if cameras.refined and camera.covariance is None:
            yield doubtful(
                "camera.no_covariance",
                file,
                focal=USUAL_FOCAL,
                aspect=USUAL_ASPECT,
                centre=USUAL_CENTRE,
                distortion=USUAL_DISTORTION,
            )


def size_notes(
    session: Session, measurements: Measurements, estimate: Estimate
) -> Iterator[Finding]:
    """A note on how large the board is, where that is not known exactly."""
    tolerances = [mount.tolerance for mount in measurements.mounts if mount.tolerance > 0]
    for tolerance, value, sigma in zip(
        tolerances,
        estimate.state.columns.get(BOARD_SIZE, ()),
        estimate.column_sigma(BOARD_SIZE),
        strict=False,
    ):
        file = session.document["board"]["file"]
        if sigma <= UNTOLD_BOARD_SIZE_SIGMA * tolerance:
            yield note("board.size_estimate", file, value=value, sigma=sigma)
            continue
        # of the estimate's two sources, the prior is the file's: the rest is what all else tells
        other = max(1 - (sigma / tolerance) ** 2, np.finfo(float).eps)
        above_limit = {"tolerance": 100 * tolerance}
        if abs(value) / np.sqrt(other) > BOARD_SIZE_DISAGREEMENT * tolerance:
            above_limit |= {"value": value / other, "sigma": sigma / np.sqrt(other)}
            yield note("board.size_disagrees", file, **above_limit)
        else:
            yield note("board.size_by_file", file, **above_limit)


def scale_notes(session: Session, estimate: Estimate, named: tuple[str, ...]) -> Iterator[Finding]:
    """A note on readings whose scale is surely not the nominal one, beside those that are named
    already.
    """
    layout, table = session.machine.layout, session.machine.parameters
    results: dict[str, tuple[float, float]] = {}
    for leg in np.flatnonzero(layout.unsure_scales):
        k, column = layout.scale[leg], int(layout.actuated[leg])
        name = session.document["joints"]["columns"][column]
        share = float(estimate.machine.values[k] / table.drawing[k] - 1)
        sigma = float(np.sqrt(estimate.covariance[k, k]))
        if abs(share) > WRONG_SCALE_DEVIATIONS * sigma > 0 and name not in named:
            results[name] = share, sigma
    if results:
        values, sigmas = zip(*results.values(), strict=True)
        each = [
            f"{100 * abs(share):.3f} ± {100 * sigma:.3f} %"
            f" {'larger' if share > 0 else 'smaller'} ({name})"
            for name, (share, sigma) in results.items()
        ]
        yield note(
            "readings.scale_estimates",
            listed([*results]),
            columns=[*results],
            values=values,
            sigmas=sigmas,
            each=each,
        )


def _within(value: float, limits: tuple[float, float | None]) -> bool:
    low, high = limits
    return low <= value and (high is None or value <= high)


def _error(session: Session, fault: Fault, misfit_before: float) -> InputError:
    """The mistake in words; misfit_before : misfit of the poses with it, in standard deviations."""
    residual = f"with that, the poses fit {fault.misfit:.1f} times their noise"
    times = f"{misfit_before:.{int(misfit_before < 10)}f}"
    value = f"poses that the readings miss by {times} times their noise"
    joints = session.document["joints"]
    if fault.kind == "sign":
        name = joints["columns"][fault.motor]
        if not fault.constant:
            return InputError(
                f"the readings of {name} have the wrong sign",
                where=f"{joints['file']}, column {name}",
                found=value,
                expected=f"the readings with the other sign; {residual}",
                next_step="Turn the sign of this column round, or the axis in the mechanism file",
                code="readings.sign",
            )
        unit = session.machine.joint_units[fault.motor]
        scale, display = DISPLAY_UNITS[unit]
        constant = f"{number(scale * fault.constant, 0 if unit == 'm' else 1)} {display}"
        return InputError(
            f"the readings of {name} count the other way",
            where=f"{joints['file']}, column {name}",
            found=value,
            expected=f"{constant}, or nearly so, less the reading; {residual}",
            next_step=f"Turn the motor's direction round where it is set, or write {constant} less"
            " the reading into this column; what is left of the constant is calibrated",
            code="readings.reversed",
        )
    if fault.kind == "order":
        one, other = (joints["columns"][k] for k in (fault.motor, fault.other))
        return InputError(
            f"the readings of {one} and {other} are exchanged",
            where=f"{joints['file']}, line 1",
            found=value,
            expected=f"the two columns in the other order; {residual}",
            next_step="Exchange the two columns, or the motors in the mechanism file",
            code="readings.exchanged",
        )
    if fault.kind == "size":
        return InputError(
            "the board has another size than its file says",
            where=session.document["board"]["file"],
            found=f"a board {fault.size:.4f} times as large, by how far the platform moved",
            expected=f"the size as measured with a ruler over many squares; {residual}",
            next_step=f"Multiply square and marker by {fault.size:.4f}, if a ruler agrees",
            code="board.size",
        )
    what = "the board was moved on the platform" if fault.kind == "board moved" else \
        "the camera was moved"  # fmt: skip
    before, after = (session.configurations[k] for k in (fault.before, fault.configuration))
    return InputError(
        f"{what} between configuration {before} and {after}",
        where=f"session.yaml, stations.{session.station_names[fault.station]}",
        found=f"{how_far(fault.transform).removeprefix(', ')}; {residual}",
        expected="a board screwed to the platform, and a camera that stands still",
        next_step=f"Calibrate with the configurations before {after}, or with those from it on",
        code="board.moved" if fault.kind == "board moved" else "station.moved",
    )


def turning(session: Session, poses: PoseSet, on_platform: Booleans) -> list[Finding]:
    """Whether the platform turns as the mechanism file says, by every station that saw it whole.

    on_platform : (M,) of the mounts.
    """
    motion = session.machine.document.motion
    if motion == "spatial" or not len(poses):
        return []
    from pkmcal.papers.rotation_axis import rotation_axis

    whole = (poses.rows == 6) & on_platform[poses.mount]
    out: list[Finding] = []
    for s in np.unique(poses.station[whole]).tolist():
        part = poses.select(whole & (poses.station == s))
        if len(part) < FEWEST_POSES:
            continue
        axis = rotation_axis(part, motion)
        name = session.station_names[s]
        off, noise = (
            float(np.rad2deg(np.sqrt(np.mean(tilt**2)))) for tilt in (axis.tilt, axis.expected_tilt)
        )
        facts = {
            "station": name,
            "motion": axis.hypothesis,
            "off": off,
            "noise": noise,
            "chi2": axis.chi2,
            "dof": axis.dof,
        }
        # Noise that is stated a little too small is no reason to doubt a mechanism.
        if axis.tenable:
            out.append(note("poses.turning", name, **facts))
        elif axis.chi2 > POOR_MODEL_POSE_SCALE**2 * axis.dof:
            out.append(doubtful("poses.not_turning", name, **facts))
        else:
            out.append(note("poses.turning_roughly", name, **facts))
    return out
