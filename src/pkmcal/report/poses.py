"""Report section on boards and trackers: errors of their poses, and where targets are mounted."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.faults import turning
from pkmcal.geometry.rigid import rotation_vector
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.unidentified import identified
from pkmcal.measurements import Observation, PoseSet
from pkmcal.outcome import Part, Row, Table
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.plot import Plot, Point, panels, rounded
from pkmcal.report.charts import NORMAL_90, bar_plot, box, row_plot
from pkmcal.report.residuals import SIGMAS_IN_WORDS, level_bar, level_plot
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import brief, count, decimals, number

MOST_WORST_POSES = 12
"""Poses in the list of the worst."""
POSE_JUMPS_TEXT = (
    "Bars by configuration: a jump that stays means that something was moved, a single tall bar"
    " that this one measurement, or its readings, are wrong."
)


def section(session: Session, observation: Observation, estimate: Estimate) -> Part | None:
    """Section of the report; None for a session without measured poses."""
    poses = observation.poses
    if not len(poses):
        return None
    error = errors(poses, estimate)
    more_than_heights = bool(np.any(poses.whiten[..., :5] != 0))
    turns = (one.text for one in turning(session, poses, estimate.state.on_platform))
    # root mean square residual of each configuration's poses, in standard deviations
    number = np.bincount(poses.configuration, weights=poses.rows)
    square = np.bincount(
        poses.configuration, weights=np.sum(estimate.pose_residuals**2, axis=1)
    ).tolist()
    bars = [
        level_bar(session.configurations[k], float(np.sqrt(square[k] / n)), n)
        for k, n in enumerate(number.tolist())
        if n
    ]
    return Part(
        "poses",
        "Board" if session.board else "Measured poses",
        (f"{' '.join([*_summary(poses, estimate, error), *turns])} {POSE_JUMPS_TEXT}",),
        blocks=panels(
            level_plot("poses-by-configuration", "Poses, by configuration", bars),
            _bars(session, poses, error[:, 3:] * 1e3, "mm", "How far off"),
            _bars(session, poses, np.rad2deg(error[:, :3]), "°", "How far turned"),
        ),
        tables=(
            *_mounts(session, estimate),
            *([_worst(session, poses, estimate, error)] if more_than_heights else []),
        ),
    )


def errors(poses: PoseSet, estimate: Estimate) -> Array:
    """Predicted minus measured pose (N, 6), rad and m, station frame.

    NaN for unmeasured components.
    """
    white = estimate.pose_residuals * estimate.statistics.pose_scale
    error = (np.linalg.pinv(poses.whiten) @ white[..., None])[..., 0]
    measured = np.any(poses.whiten != 0, axis=-2)
    return np.where(measured, error, np.nan)


def _summary(poses: PoseSet, estimate: Estimate, error: Array) -> tuple[str, ...]:
    """Sentences on number, errors and noise of the poses."""
    inliers = estimate.pose_weights >= INLIER_WEIGHT
    s = estimate.statistics
    n_rejected = "" if inliers.all() else f", {int(np.sum(~inliers))} rejected"
    configurations = count(len(np.unique(poses.configuration)), "configuration")
    sizes = [_length(error[inliers, 3:]) * 1e3, float(np.rad2deg(_length(error[inliers, :3])))]
    sizes_text = [
        f"{brief(x)}{u}" for x, u in zip(sizes, (" mm", "°"), strict=True) if np.isfinite(x)
    ]
    # the noise factor is at least 1; the residuals may be smaller
    times = s.pose_scale if s.pose_scale > 1 else np.sqrt(s.chi2_poses / max(s.dof_poses, 1))
    return (
        f"{count(len(poses), 'pose')} measured in {configurations}{n_rejected}.",
        f"They are {' and '.join(sizes_text)} off the calibrated machine (root mean"
        " square), which is"
        f" {number(times, 2)} times their stated noise.",
    )


def _length(values: Array) -> float:
    """Root mean square length of vectors (n, 3), without unmeasured components."""
    finite = np.isfinite(values)
    if not finite.any():
        return float("nan")
    return float(np.sqrt(np.mean(np.nansum(values**2, axis=-1))))


def _mounts(session: Session, estimate: Estimate) -> tuple[Table, ...]:
    """Table of the targets' poses on platform or base; none where all of them are open."""
    state, rows = estimate.state, list[Row]()
    for m, name in enumerate(mount_names(session, len(state.T_mount))):
        T, sigma = state.T_mount[m], np.sqrt(np.maximum(np.diag(estimate.mount_covariance[m]), 0))
        determined = identified(estimate.machine, estimate.mount_covariance[m])
        if not determined.any():
            continue
        place = _texts(T[:3, 3], sigma[3:], determined[3:], 1e3)
        turn = _texts(rotation_vector(T[:3, :3]), sigma[:3], determined[:3], 180 / np.pi)
        rows.append(Row(name, ("platform" if state.on_platform[m] else "base", *place, *turn)))
    if not rows:
        return ()
    table = Table(
        "Where it sits",
        ("Target", "Frame", "x, mm", "y, mm", "z, mm", "rx, °", "ry, °", "rz, °"),
        tuple(rows),
        "Place and rotation vector of the target's own axes in the body's frame, ± σ. Open: these"
        " measurements do not determine it, and nothing that they predict depends on it.",
        brief=False,
        words=(1,),
    )
    return (table,)


def mount_names(session: Session, n: int) -> list[str]:
    """Names of the mounts: the board if there is one, the trackers, then the links' points."""
    others = [table.name for table in session.trackers] + [one.kind for one in session.links]
    return ["board"] * (n - len(others)) + others


def _texts(values: Array, sigma: Array, valid: Booleans, factor: float) -> list[str]:
    """Numbers with standard deviations; ``open`` where the data do not determine them."""
    out: list[str] = []
    for value, spread, sure in zip(values.tolist(), sigma.tolist(), valid, strict=True):
        text = number(value * factor, decimals(spread * factor))
        text = f"{text} ± {brief(spread * factor)}" if spread else text
        out.append(text if sure else "open")
    return out


def _bars(session: Session, poses: PoseSet, error: Array, unit: str, title: str) -> Plot | None:
    """Largest error of each configuration's poses."""
    size = np.linalg.norm(np.nan_to_num(error), axis=-1)
    if not np.isfinite(error).any():
        return None
    largest = np.zeros(len(session.configurations))
    np.maximum.at(largest, poses.configuration, size)
    bars: list[Point] = []
    for k in np.unique(poses.configuration).tolist():
        name, value = session.configurations[k], float(largest[k])
        tip = f"configuration {name}: {brief(value)} {unit}"
        key = configuration_key(name)
        bars.append(Point(x=name, y=rounded(value), tip=tip, key=key, colour="quiet"))
    slug = title.lower().replace(" ", "-")
    alt = f"{title}: bars of the poses' errors in {unit}"
    return bar_plot(slug, title, "configurations", f"largest of each, {unit}", bars, alt)


def axes(poses: PoseSet, estimate: Estimate) -> Plot | None:
    """Box plots of the whitened residuals of the poses' six numbers."""
    names = ("turn 1", "turn 2", "turn 3", "place 1", "place 2", "place 3")
    measured = np.any(poses.whiten != 0, axis=-1)
    boxes = [
        box(name, estimate.pose_residuals[measured[:, k], k], "σ", 2)
        for k, name in enumerate(names)
    ]
    return row_plot(
        "poses-by-number",
        "Poses, by the six numbers",
        SIGMAS_IN_WORDS,
        boxes,
        "Boxes of the poses' residuals by their six numbers",
        NORMAL_90,
        "About and along the station's x, y and z.",
    )


def _worst(session: Session, poses: PoseSet, estimate: Estimate, error: Array) -> Table:
    """Table of the poses with the largest residuals, in standard deviations."""
    level = np.sqrt(np.sum(estimate.pose_residuals**2, axis=1) / np.maximum(poses.rows, 1))
    rows: list[Row] = []
    for k in np.argsort(-level, kind="stable")[:MOST_WORST_POSES].tolist():
        turn = float(np.rad2deg(np.linalg.norm(error[k, :3])))
        cells = (
            session.configurations[poses.configuration[k]],
            brief(_length(error[k : k + 1, 3:]) * 1e3),
            brief(turn),
            number(float(level[k]), 1),
            "rejected" if estimate.pose_weights[k] < INLIER_WEIGHT else "used",
        )
        rows.append(Row(session.station_names[poses.station[k]], cells))
    columns = ("Station", "Configuration", "Off, mm", "Turned, °", "In σ", "Use")
    title = "The poses that fit worst"
    return Table(title, columns, tuple(rows), brief=False, folded=True, words=(1, 5))


def target_places(observation: Observation, estimate: Estimate) -> tuple[Array, Integers]:
    """Estimated positions of the targets (N, 3), base frame, m, and their configurations (N,)."""
    poses, state = observation.poses, estimate.state
    on = state.on_platform[poses.mount]
    body = np.where(on[:, None, None], state.T_base_platform[poses.configuration], np.eye(4))
    return (body @ state.T_mount[poses.mount])[:, :3, 3], poses.configuration
