"""Findings about an estimate: contradicted noise, an insufficient model, scales, lenses.

Hypotheses about poses that disagree with the machine are in
:mod:`pkmcal.calibration.pose_hypotheses`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.calibration.camera_refinement import CameraRefinement
from pkmcal.calibration.pose_hypotheses import HOPELESS_POSE_SCALE
from pkmcal.cameras.contract import USUAL_ASPECT, USUAL_CENTRE, USUAL_DISTORTION, USUAL_FOCAL
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate, Purpose
from pkmcal.identify.gauge import move_generators
from pkmcal.identify.start import start_state
from pkmcal.identify.verdict import VERDICT, RicherModel
from pkmcal.levels import MAJORITY, NEGLIGIBLE, NOISE_EXCESS, OUTLIER_SIGMAS
from pkmcal.measurements import Measurements, PoseSet
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.mechanisms import Machine
from pkmcal.outcome.finding import Finding, doubtful, note, wrong
from pkmcal.outcome.hypotheses import (
    EvidenceLevel,
    Hypothesis,
    decide,
    estimate_level,
    harmless_misfit,
    log_likelihood,
    parameter_cost,
    posterior,
)
from pkmcal.session.load import Session
from pkmcal.session.readings import rounding_step
from pkmcal.solver.ranks import nonzero
from pkmcal.wording import listed

WRONG_MODEL_READING_SCALE = 100.0
"""Factor on the readings' stated noise above which the scatter is a model error: mounted encoders
are ten or thirty times as noisy as in their data sheets."""


def wrong_scale(estimate: Estimate) -> float:
    """Ratio of all estimated lengths to the nominal lengths; 1 if no common ratio explains their
    difference.

    A board whose squares are larger than stated makes the whole machine larger. The hypothesis of a
    common ratio has to explain most of the squared differences, in prior sigmas: with a poor
    nominal model, or a ratio of one kind of part only, it does not.
    """
    machine = estimate.machine
    table = machine.parameters
    length = np.array([unit == "m" and kind != "radius" for unit, kind in zip(
        table.units, table.kinds, strict=True)])  # fmt: skip
    shifted = length & np.any(table.free_matrix() != 0, axis=1)
    tolerance = table.tolerance[shifted]
    new, old = machine.values[shifted] / tolerance, table.nominal[shifted] / tolerance
    # frames are conventions: errors of the joints that define them are in all other differences
    moves = move_generators(machine.layout, table.nominal)[shifted] / tolerance[:, None]
    u, s, _ = np.linalg.svd(moves, full_matrices=False)
    u = u[:, nonzero(s)]
    new, old = (x - u @ (u.T @ x) for x in (new, old))
    count = new.size - u.shape[1]
    if count < 1 or not new.any():
        return 1.0
    back = float(new @ old) / float(new @ new)
    null, misfit = (np.linalg.norm(x - old) / np.sqrt(count) for x in (new, back * new))

    def ratios(hypotheses: Sequence[Hypothesis[float]]) -> Array:
        values = log_likelihood(np.array([null, misfit]), count)
        return np.repeat(values[1] - values[0], len(hypotheses))

    factor = Hypothesis[float](
        "machine.scale", "all lengths", lambda x: x * back, parameter_cost(1, count)
    )
    best = decide(posterior([factor], [EvidenceLevel("lengths", ratios)]))
    explained = null**2 - misfit**2
    return 1 / back if best is not None and explained > misfit**2 else 1.0


def refit_fixed_noise(machine: Machine, measurements: Measurements, estimate: Estimate) -> Estimate:
    """Estimate with the readings' noise as stated, for the comparison of hypotheses.

    Otherwise the noise scale would absorb a wrong sign, or an insufficient model.
    """
    if estimate.statistics.reading_scale <= 1 or not len(measurements.poses):
        return estimate
    return bundle(machine, measurements, estimate.state, scale_readings=False)


def noise_fault(session: Session, estimate: Estimate) -> Iterator[Finding]:
    """Refusal if the noise of the readings exceeds the prior sigmas, so that they determine
    nothing, or exceeds the stated noise so much that it is a model error.
    """
    s, tolerance = estimate.statistics, session.machine.document.tolerance
    units, noise = set(session.machine.joint_units), session.joint_noise * s.reading_scale
    most = min({"m": tolerance.offset, "rad": tolerance.angle}[unit] for unit in units)
    if s.reading_scale <= 1:
        return
    facts: dict[str, Any] = {
        "noise": noise,
        "units": sorted(units),
        **_rounding(session, noise),
    }
    if noise > most:
        yield wrong("readings.noise_beyond_tolerance", limit=most, **facts)
    elif s.reading_scale >= WRONG_MODEL_READING_SCALE:
        yield wrong("readings.noise_beyond_encoders", scale=s.reading_scale, **facts)


def _rounding(session: Session, noise: float) -> dict[str, Any]:
    """Facts on the step of which all readings are whole multiples, if its rounding scatters more
    than session.yaml states: ``rounded_to`` and ``rounding`` (m or rad) if the rounding explains
    the noise, ``round_command`` otherwise; none without such a step.

    noise : standard deviation of the readings, m or rad.
    """
    units = set(session.machine.joint_units)
    least = np.sqrt(12) * session.joint_noise
    step = rounding_step(session.joints, min(units), least) if len(units) == 1 else None
    if step is None:
        return {}
    rounding = float(step / np.sqrt(12))
    if noise > NOISE_EXCESS * rounding:  # more than rounding explains
        return {"round_command": step}
    return {"rounded_to": step, "rounding": rounding}


def richer_model(
    session: Session, measurements: Measurements, estimate: Estimate
) -> tuple[RicherModel | None, tuple[Finding, ...]]:
    """Richer model of the mechanism file that explains poses for which this model is insufficient.

    None without such a model; and notes on models without an estimate. Each additional parameter
    costs half a log n (:func:`parameter_cost`).
    """
    null, machine = estimate.statistics.pose_scale, session.machine
    count = int(measurements.poses.rows.sum())
    unknowns = machine.parameters.free_matrix().shape[1]
    scales, untested = dict[str, float](), list[Finding]()

    def scale(hypothesis: Hypothesis[Machine]) -> float:
        other = hypothesis.apply(machine)
        start = start_state(other, measurements, estimate.state.T_camera_base)
        fit = bundle(other, measurements, start, hopeless=HOPELESS_POSE_SCALE, scale_readings=False)
        scales[hypothesis.subject] = fit.statistics.pose_scale
        return fit.statistics.pose_scale

    def failed(hypothesis: Hypothesis[Machine], why: str) -> None:
        untested.append(note("poses.model_failed", hypothesis.subject, why=why))

    hypotheses = list[Hypothesis[Machine]]()
    for name in (each for each in machine.document.models if each != session.model):
        other = session.other_model(name)
        more = other.parameters.free_matrix().shape[1] - unknowns
        if more > 0 and (other.n_legs == machine.n_legs or not len(measurements.edges)):
            cost = parameter_cost(more, count)
            if null > harmless_misfit(count, cost):
                hypotheses.append(Hypothesis("machine.model", name, lambda _, to=other: to, cost))
    level = estimate_level(scale, null, count, VERDICT.too_noisy, failed)
    best = decide(posterior(hypotheses, [level]))
    if best is None:
        return None, tuple(untested)
    name = best.hypothesis.subject
    return RicherModel(name, scales[name]), tuple(untested)


def scale_fault(session: Session, estimate: Estimate) -> Iterator[Finding]:
    """Refusal if all estimated lengths have a common ratio to the nominal ones.

    Not for heights alone, which do not determine sizes.
    """
    if estimate.purpose is Purpose.HEIGHT:
        return
    scale = wrong_scale(estimate)
    if scale != 1.0 and estimate.pose_weights.size:
        cause = "board" if session.board else "table"
        yield wrong("machine.scale", value=scale - 1, cause=cause)


def noise_notes(
    session: Session, estimate: Estimate, detections: bool = False, *, explained: bool = False
) -> Iterator[Finding]:
    """Warnings where the data contradict the noise that session.yaml states.

    detections : whether a model violation explains the scatter of readings.
    explained : whether an uneven bed explains the scatter of heights.
    """
    if explained:
        return
    s, units = estimate.statistics, sorted(set(session.machine.joint_units))
    least, most = s.reading_range
    if s.reading_scale != 1 and not (least <= 1 and (most is None or most >= 1)):
        noise = session.joint_noise * s.reading_scale
        yield doubtful(
            "readings.noise",
            "session.yaml, joints.noise",
            noise=noise,
            stated=session.joint_noise,
            bound=session.joint_noise * most if most is not None and not least else None,
            range=s.reading_range,
            units=units,
            explained="yes" if detections else "no",
            **(_rounding(session, noise) if s.reading_scale > 1 else {}),
        )
    only_trackers = session.trackers and not any("board" in x.observe for x in session.stations)
    if only_trackers and s.pose_range[1] is not None and s.pose_range[1] < 1:
        keys = [f"stations.{table.name}.tracker.noise" for table in session.trackers]
        yield doubtful("poses.noise", f"session.yaml, {keys[0]}", range=s.pose_range, keys=keys)


def lens_notes(cameras: CameraRefinement) -> Iterator[Finding]:
    """Warnings about refined cameras whose files state no covariance."""
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
    """Notes on the size of a board that is not stated to be exact."""
    tolerances = [mount.tolerance for mount in measurements.mounts if mount.tolerance > 0]
    for tolerance, value, sigma in zip(
        tolerances,
        estimate.state.columns.get(BOARD_SIZE, ()),
        estimate.column_sigma(BOARD_SIZE),
        strict=False,
    ):
        file = session.document["board"]["file"]
        # most of the information is the data's rather than the file's
        if sigma**2 <= MAJORITY * tolerance**2:
            yield note("board.size_estimate", file, value=value, sigma=sigma)
            continue
        # the prior, which is the file's, is removed: 1 / other is the factor on the estimate
        other = 1 - (sigma / tolerance) ** 2
        facts = {"tolerance": 100 * tolerance}
        # data with a negligible share, as with noise scaled beyond the file's, give no number
        if other > NEGLIGIBLE and abs(value) / np.sqrt(other) > OUTLIER_SIGMAS * tolerance:
            facts |= {"value": value / other, "sigma": sigma / np.sqrt(other)}
            yield note("board.size_disagrees", file, **facts)
        else:
            yield note("board.size_by_file", file, **facts)


def scale_notes(session: Session, estimate: Estimate, named: tuple[str, ...]) -> Iterator[Finding]:
    """Note on readings whose scale differs significantly from the nominal scale; named : columns
    that another finding reports.
    """
    layout, table = session.machine.layout, session.machine.parameters
    results: dict[str, tuple[float, float]] = {}
    for leg in np.flatnonzero(layout.unsure_scales):
        k, column = layout.scale[leg], int(layout.actuated[leg])
        name = session.document["joints"]["columns"][column]
        share = float(estimate.machine.values[k] / table.nominal[k] - 1)
        sigma = float(np.sqrt(estimate.covariance[k, k]))
        if abs(share) > OUTLIER_SIGMAS * sigma > 0 and name not in named:
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


def turning(session: Session, poses: PoseSet, on_platform: Booleans) -> list[Finding]:
    """Test of the platform's rotation against the mechanism file, by each station's whole poses.

    on_platform : (M,) of the mounts.
    """
    motion = session.machine.document.motion
    if motion == "spatial" or not len(poses):
        return []
    from pkmcal.identify.rotation_axis import rotation_axis

    whole = (poses.rows == 6) & on_platform[poses.mount]
    out: list[Finding] = []
    for s in np.unique(poses.station[whole]).tolist():
        part = poses.select(whole & (poses.station == s))
        axis = rotation_axis(part, motion)
        if not axis.dof:
            continue
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
        if axis.tenable:
            out.append(note("poses.turning", name, **facts))
        else:
            out.append(doubtful("poses.not_turning", name, **facts))
    return out
