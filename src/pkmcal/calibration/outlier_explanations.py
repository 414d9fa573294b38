"""Explanations of rejected poses: a wrong reading, or a wrong name.

A measured pose determines the readings of all motors. If a configuration is an outlier and all but
one of its readings agree with its poses, that reading is wrong; if its poses agree with the
readings of another configuration, names were exchanged. The estimate rejects either, so the result
is right, and a warning names the cause. Hypotheses are transformations of the readings
(:mod:`pkmcal.outcome.hypotheses`), each with the absolute test that the configuration is then no
outlier.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import log
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import inverse, skew
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM, Search
from pkmcal.measurements import Measurements
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.reading_hypotheses import ReadingHypothesis
from pkmcal.outcome.finding import Finding, doubtful
from pkmcal.outcome.hypotheses import (
    EvidenceLevel,
    likely,
    log_likelihood,
    parameter_cost,
    posterior,
)
from pkmcal.session.load import Session
from pkmcal.session.readings import wrong_reading
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import listed


class MeasuredPlatforms(NamedTuple):
    """Platform poses from n measured poses.

    configuration : (n,).
    T_base_platform : (n, 4, 4).
    noise : (n, m, m) covariance of the readings that follow from each pose by inverse kinematics.
    """

    machine: Machine
    configuration: Integers
    T_base_platform: Array
    noise: Array

    def select(self, rows: Integers | Booleans) -> MeasuredPlatforms:
        """Selected poses; rows : indices, or a mask."""
        return MeasuredPlatforms(
            self.machine, self.configuration[rows], self.T_base_platform[rows], self.noise[rows]
        )

    def differences(self, joints: Array) -> Array:
        """Differences (n, m) of the readings by inverse kinematics from the table's, (K, m)."""
        return self.differences_of(joints[self.configuration])

    def differences_of(self, readings: Array) -> Array:
        """Differences (..., n, m) of the readings by inverse kinematics from readings
        (..., n, m).
        """
        shape = readings.shape
        poses = np.broadcast_to(self.T_base_platform, (*shape[:-1], 4, 4)).reshape(-1, 4, 4)
        flat = readings.reshape(-1, shape[-1])
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return (self.machine.inverse(poses, flat) - flat).reshape(shape)

    def squares(self, differences: Array) -> Array:
        """Squares (..., n) of differences in units of their covariance, infinite where the machine
        cannot take a pose.
        """
        value = np.sum(
            differences * np.linalg.solve(self.noise, differences[..., None])[..., 0], axis=-1
        )
        return np.where(np.isfinite(value), value, np.inf)


def outlier_explanations(
    session: Session, measurements: Measurements, estimate: Estimate
) -> Iterator[Finding]:
    """Warnings about configurations that are outliers and have an explanation."""
    whole = (measurements.poses.rows == 6) & measurements.on_platform[measurements.poses.mount]
    which = np.flatnonzero(whole)
    if not which.size:
        return
    joints, m = measurements.joints, measurements.joints.shape[1]
    poses, noise = _platforms(measurements, estimate, which)
    measured = MeasuredPlatforms(
        estimate.machine, measurements.poses.configuration[which], poses, noise
    )
    # poses that the machine can take, enough for a scale of their differences
    off = measured.differences(joints)
    finite = np.flatnonzero(np.isfinite(off).all(axis=1) & np.isfinite(noise).all(axis=(1, 2)))
    measured, off, which = measured.select(finite), off[finite], which[finite]
    if len(which) < 2 * m:
        return
    squares = measured.squares(off)
    usual = max(float(np.median(squares)) / m, 1.0)  # contains the model errors of all poses
    measured = measured._replace(noise=usual * measured.noise)
    # rejected poses that are outliers at that scale
    least = SESSION_FALSE_ALARM.of_test(Search.OUTLIERS, len(which))
    rejected = estimate.pose_weights[which] < INLIER_WEIGHT
    odd = np.unique(measured.configuration[rejected & (_chance(m, squares / usual) < least)])
    named: set[int] = set()
    for k in odd.tolist():
        if k in named:
            continue
        finding, partner = _explained(session, measured, joints, odd, k, least)
        named |= {partner}
        if finding is not None:
            yield finding


def _explained(
    session: Session,
    measured: MeasuredPlatforms,
    joints: Array,
    odd: Integers,
    k: int,
    least: float,
) -> tuple[Finding | None, int]:
    """Explanation of outlier k.

    odd : configurations that are outliers.
    least : p-value below which a configuration is an outlier.

    Returns the finding, None without an explanation, and the configuration with which k is
    exchanged, k if it is not.
    """
    name, names = session.configurations[k], session.configurations
    columns, units = session.document["joints"]["columns"], session.machine.joint_units

    def ratios(hypotheses: Sequence[ReadingHypothesis]) -> Array:
        tables = np.stack([joints, *(one.apply(joints) for one in hypotheses)])
        out = np.zeros(len(tables))
        concerned = [{k}, *({k, one.facts.get("partner", k)} for one in hypotheses)]
        # each configuration that a hypothesis changes, without and with the mistake
        for c in set().union(*concerned):
            poses = measured.select(measured.configuration == c)
            rows = [n for n, some in enumerate(concerned) if c in some]
            readings = np.repeat(tables[rows, c][:, None], len(poses.configuration), axis=1)
            squares = poses.squares(poses.differences_of(readings)).sum(axis=-1)
            n_values = readings.shape[1] * readings.shape[2]
            own = poses.squares(poses.differences(joints)).sum()
            gain = log_likelihood(np.sqrt(np.append(squares, own) / n_values), n_values)
            out[rows] += gain[:-1] - gain[-1]
            freed = np.array([n > 0 and "motor" in hypotheses[n - 1].facts for n in rows])
            out[rows] = np.where(_chance(n_values - freed, squares) < least, -np.inf, out[rows])
        return out[1:]

    # the likeliest mistake, among equally probable ones
    hypotheses = [
        *_wrong_readings(measured, joints, k),
        *(_other_row(k, int(c)) for c in range(len(joints)) if c != k),
        *(_both_misnamed(k, int(c)) for c in odd if c != k),
    ]
    prior = -log(len(hypotheses))
    ranked = posterior(
        [replace(one, log_prior=one.log_prior + prior) for one in hypotheses],
        [EvidenceLevel("readings", ratios)],
    )
    explanations = [one.hypothesis for one in likely(ranked)]
    # exchanged names, then a wrong reading, then the name of another configuration
    exchanged = [one for one in explanations if "partner" in one.facts]
    if exchanged:
        partner = exchanged[0].facts["partner"]
        return _misnamed(session, name, names[partner], True), partner
    motors = [one for one in explanations if "motor" in one.facts]
    like = [names[one.facts["like"]] for one in explanations if "like" in one.facts]
    if len(motors) == 1:
        facts = motors[0].facts
        column = wrong_reading(columns[facts["motor"]], units[facts["motor"]], name)
        value = column.facts(facts["value"], facts["sigma"])
        found = doubtful(
            "readings.outvoted", column.subject, **value, like=like[0] if like else None
        )
        return found, k
    return (_misnamed(session, name, like[0], False) if like else None), k


def _wrong_readings(
    measured: MeasuredPlatforms, joints: Array, k: int
) -> Iterator[ReadingHypothesis]:
    """Hypotheses that one reading of configuration k is wrong, each with the reading's estimate
    from all poses of the configuration.

    Facts: ``motor``, and ``value`` and ``sigma`` (1,), m or rad.
    """
    poses = measured.select(measured.configuration == k)
    sharp = np.linalg.inv(poses.noise)
    information = sharp.sum(axis=0).diagonal()
    value = (sharp @ poses.differences(joints)[..., None]).sum(axis=0)[:, 0] / information
    for motor in range(joints.shape[1]):

        def apply(joints: Array, motor: int = motor) -> Array:
            out = joints.copy()
            out[k, motor] += value[motor]
            return out

        facts = {"motor": motor, "value": value[[motor]], "sigma": information[[motor]] ** -0.5}
        cost = parameter_cost(1, poses.noise.shape[0] * joints.shape[1])
        yield ReadingHypothesis("readings.outvoted", f"motor {motor}", apply, cost, facts=facts)


def _other_row(k: int, other: int) -> ReadingHypothesis:
    """Hypothesis that k has the readings of another configuration. Facts: ``like``, the other."""

    def apply(joints: Array) -> Array:
        out = joints.copy()
        out[k] = joints[other]
        return out

    return ReadingHypothesis("configurations.misnamed", f"as {other}", apply, facts={"like": other})


def _both_misnamed(k: int, other: int) -> ReadingHypothesis:
    """Hypothesis that two configurations are exchanged. Facts: ``partner``, the other."""

    def apply(joints: Array) -> Array:
        out = joints.copy()
        out[[k, other]] = joints[[other, k]]
        return out

    return ReadingHypothesis(
        "configurations.misnamed", f"for {other}", apply, facts={"partner": other}
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
    """Platform poses T_base_platform (n, 4, 4) by measured poses, and the covariance (n, m, m) of
    the readings that follow; NaN where the machine cannot take a pose.
    """
    poses, state = measurements.poses.select(which), estimate.state
    T_camera_base, T_mount = state.T_camera_base[poses.station], state.T_mount[poses.mount]
    size = np.array([mount.tolerance for mount in measurements.mounts])
    # the papers' methods estimate no size
    size[size > 0] = state.columns.get(BOARD_SIZE, 0.0)
    T_station_target = poses.T_station_target.copy()
    T_station_target[:, :3, 3] *= (1 + size[poses.mount])[:, None]
    T_base_platform = inverse(T_camera_base) @ T_station_target @ inverse(T_mount)
    # left perturbation of the target, as a perturbation of the platform in the base frame
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


def _chance(dof: Integers | int, squares: Array) -> Array:
    """Probability of larger squares by normal errors."""
    from scipy.special import chdtrc

    return chdtrc(dof, squares)
