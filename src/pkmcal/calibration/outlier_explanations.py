"""Measured poses that the estimate let go, and what explains them: a reading, or a wrong name.

A pose that was measured tells what all motors should have read, whatever they did read. Where a
configuration disagrees and all of its readings but one agree, that reading is wrong; where its pose
agrees with the readings of another configuration, names were mixed up. Either is outvoted by the
other configurations, so the result is right; but whoever took the images wants to know.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, skew
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.score import FALSE_ALARM
from pkmcal.measurements import Measurements
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.session.load import Session
from pkmcal.session.readings import wrong_reading
from pkmcal.wording import listed

UNLIKELY_EXPLANATION_CHANCE = 1e-4
"""Chance below which one reading, or another configuration's, is no explanation; so small because
the machine's own uncertainty, about as large as that of a pose, is not counted."""
MOST_USUAL_MISFIT = 100.0
"""Times its noise that the better half of a session may be off: with more, nothing fits, and no
configuration stands out."""


def outlier_explanations(
    session: Session, measurements: Measurements, estimate: Estimate
) -> Iterator[Finding]:
    """A warning for each configuration that stands against the others and is explained."""
    whole = (measurements.poses.rows == 6) & measurements.on_platform[measurements.poses.mount]
    which = np.flatnonzero(whole)
    if not which.size:
        return
    poses, noise = _platforms(measurements, estimate, which)
    machine, joints, own = estimate.machine, measurements.joints, measurements.poses.configuration
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        off = machine.inverse(poses, joints[own[which]]) - joints[own[which]]
    finite = np.isfinite(off).all(axis=1) & np.isfinite(noise).all(axis=(1, 2))
    which, poses, off, noise = which[finite], poses[finite], off[finite], noise[finite]
    own, m = own[which], off.shape[1]
    if len(which) < 2 * m:
        return
    chi2 = _chi2(off, noise)
    usual = max(float(np.median(chi2)) / m, 1.0)  # what the model leaves out, all poses have
    if usual > MOST_USUAL_MISFIT**2:
        return
    noise = usual * noise
    odd = _chance(m, chi2 / usual) < FALSE_ALARM / len(which)
    odd = np.flatnonzero(odd & (estimate.pose_weights[which] < 0.5))
    # rows of the table that say what the machine did in each odd one, (n, K)
    every = np.broadcast_to(poses[odd, None], (len(odd), len(joints), 4, 4)).reshape(-1, 4, 4)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        rows = machine.inverse(every, np.tile(joints, (len(odd), 1))).reshape(-1, *joints.shape)
    same_station = (
        _chance(m, np.nan_to_num(_chi2(rows - joints, noise[odd, None]), nan=np.inf))
        > UNLIKELY_EXPLANATION_CHANCE
    )
    # its own readings are those that it stands against, however narrowly
    same_station[np.arange(len(odd)), own[odd]] = False
    exchanged = same_station[:, own[odd]] & same_station[:, own[odd]].T
    columns, units = session.document["joints"]["columns"], session.machine.joint_units
    for n, k in enumerate(odd.tolist()):
        name = session.configurations[own[k]]
        if exchanged[n].any():
            if exchanged[n, n:].any():  # told once, at the first of the two
                other = session.configurations[own[odd[n + int(np.argmax(exchanged[n, n:]))]]]
                yield _misnamed(session, name, other, True)
            continue
        sharp = np.linalg.inv(noise[k])
        value, sigma = (sharp @ off[k]) / np.diag(sharp), 1 / np.sqrt(np.diag(sharp))
        explains = (
            _chance(m - 1, chi2[k] / usual - (value / sigma) ** 2) > UNLIKELY_EXPLANATION_CHANCE
        )
        if np.count_nonzero(explains) == 1:
            motor = int(np.argmax(explains))
            one = wrong_reading(columns[motor], units[motor], name)
            row = (
                session.configurations[int(np.argmax(same_station[n]))]
                if same_station[n].any()
                else None
            )
            facts = one.facts(value[[motor]], sigma[[motor]])
            yield doubtful("readings.outvoted", one.subject, **facts, like=row)
        elif same_station[n].any():
            yield _misnamed(
                session, name, session.configurations[int(np.argmax(same_station[n]))], False
            )


def _misnamed(session: Session, name: str, other: str, both: bool) -> Finding:
    names = [name, other] if both else [name]
    where = f"{session.document['joints']['file']}, configuration {listed(names)}"
    return doubtful(
        "configurations.misnamed",
        where,
        configurations=names,
        configuration=name,
        other=other,
        both="yes" if both else "no",
    )


def _platforms(
    measurements: Measurements, estimate: Estimate, which: Integers
) -> tuple[Array, Array]:
    """Where measured poses say that the platform was, T_base_platform (n, 4, 4), and the covariance
    (n, m, m) of the readings that follow from it; NaN where the machine cannot take it.
    """
    poses, state = measurements.poses.select(which), estimate.state
    T_camera_base, T_mount = state.T_camera_base[poses.station], state.T_mount[poses.mount]
    size = np.array([mount.tolerance for mount in measurements.mounts])
    # the papers' methods estimate no size
    size[size > 0] = state.columns.get(BOARD_SIZE, 0.0)
    T_station_target = poses.T_station_target.copy()
    T_station_target[:, :3, 3] *= (1 + size[poses.mount])[:, None]
    T_base_platform = inverse(T_camera_base) @ T_station_target @ inverse(T_mount)
    # a turn and shift of the target, as one of the platform in the base's frame
    turn = T_camera_base[:, :3, :3].mT
    arm = T_base_platform[:, :3, :3] @ T_mount[:, :3, 3:]
    by = np.zeros((len(which), 6, 6))
    by[:, :3, :3] = by[:, 3:, 3:] = turn
    by[:, 3:, :3] = skew(arm[..., 0]) @ turn
    by = by @ np.linalg.inv(poses.whiten)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        root = estimate.machine.inverse_jacobian(T_base_platform) @ by
    statistics = estimate.statistics
    own = (measurements.joint_noise * statistics.reading_scale) ** 2
    return T_base_platform, statistics.pose_scale**2 * root @ root.mT + own * np.eye(root.shape[1])


def _chi2(off: Array, noise: Array) -> Array:
    """Squares (...) of deviations (..., m) in units of their covariance (..., m, m)."""
    return np.sum(off * np.linalg.solve(noise, off[..., None])[..., 0], axis=-1)


def _chance(dof: int, chi2: Array) -> Array:
    from scipy.special import chdtrc

    return chdtrc(dof, chi2)
