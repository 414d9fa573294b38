"""Predicted information of candidate measurements on the machine.

The rows of each candidate on the shared unknowns are computed once, by the Jacobian of the joint
estimate at the current machine, with the platform's pose of that configuration eliminated (Schur
complement). The information of any selection is the prior information plus the sum of ``R^T R``
over its candidates. Nuisance parameters (stations, edge shifts, shading, mounts) remain unknowns,
so the predicted covariance is the one that the estimate will state.

      machine  stations, shifts, ...
    [   R_1 (candidate 1)        ]
    [   R_2 (candidate 2)        ]      information = prior + sum_k R_k^T R_k
    [   ...                      ]

The machine is expressed in the p directions that gauge and conventions do not fix, in prior sigmas,
so that no frame is preferred.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.calibration.saved_calibration import CalibrationPrior
from pkmcal.errors import InputError
from pkmcal.identify.gauge import (
    BestFit,
    conventions,
    move_generators,
    station_generators,
    transformation,
)
from pkmcal.identify.problem import Problem
from pkmcal.identify.state import State
from pkmcal.identify.tool import pose_by_parameters, without_frames
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.planning.rig import LegsFrom, Rig, all_pairs
from pkmcal.planning.route import motor_spans
from pkmcal.solver.elimination import eliminate
from pkmcal.wording import listed

UNMEASURED_POSE_SIGMA = 1.0
"""Prior sigma (m and rad) of the poses of stations and mounts, so that every selection has a
covariance. An image has a thousand times more information.
"""
DIRECTION_VARIANCE_FLOOR = 1e-12
"""Minimum variance, in prior sigmas squared, of a direction that a calibration holds exactly, such
as the length of an axis.
"""


@dataclass(frozen=True)
class Candidates:
    """Candidate measurements: n configurations, each measured by one of G groups of stations.

    groups : stations that measure a configuration together.
    group : (n,) index of the group, in increasing order.
    joints : (n, m) readings.
    T_base_platform : (n, 4, 4).
    even : (n,) whether they were drawn evenly over the joints' ranges.
    """

    groups: tuple[tuple[int, ...], ...]
    group: Integers
    joints: Array
    T_base_platform: Array
    even: Booleans

    @classmethod
    def of_all(
        cls, groups: tuple[tuple[int, ...], ...], joints: Array, T_base_platform: Array
    ) -> Candidates:
        """Candidates with each of K configurations for each of the groups.

        The second half of the configurations is taken to be spread evenly.
        """
        n, count = len(groups), len(joints)
        group = np.repeat(np.arange(n), count)
        poses = np.tile(T_base_platform, (n, 1, 1))
        even = np.tile(np.arange(count) >= count // 2, n)
        return cls(groups, group, np.tile(joints, (n, 1)), poses, even)

    def only(self, chosen: Integers) -> Candidates:
        """Selected candidates, which must be in increasing order of their groups."""
        parts = self.joints[chosen], self.T_base_platform[chosen], self.even[chosen]
        return Candidates(self.groups, self.group[chosen], *parts)

    @property
    def pairs(self) -> Integers:
        """Pairs (M, 2) of stations and the candidates that they measure."""
        rows = [np.flatnonzero(self.group == g) for g in range(len(self.groups))]
        return np.concatenate([all_pairs(s, k) for s, k in zip(self.groups, rows, strict=True)])


class Directions(NamedTuple):
    """The p directions of the machine's free parameters z apart from gauge and conventions, in
    prior sigmas.

    to_z, of_z : (nz, p) and the inverse map (p, nz).
    span : (nz, g) changes of z by gauge and conventions.
    """

    to_z: Array
    of_z: Array
    span: Array


@dataclass(frozen=True)
class CandidateRows:
    """Rows of all candidates, with the prior information.

    rows : (n, r, na) on the shared unknowns in their own units.
    group : (n,) index of the group of stations, in increasing order.
    where : (n, m) readings relative to the motors' ranges.
    information : (na, na) prior information, including the nominal model's.
    machine : (p, na) directions of the machine, each with a variance of one by the nominal model.
    work : (M, 6, p) rotation and shift of the platform at M poses of the workspace by each
        direction, rad and m.
    """

    rows: Array
    group: Integers
    where: Array
    information: Array
    machine: Array
    work: Array

    def of(self, chosen: Integers, times: float = 1.0) -> Array:
        """Information (na, na) of a selection of candidates, each measured ``times`` times."""
        rows = self.rows[chosen].reshape(-1, self.rows.shape[-1])
        return self.information + times * (rows.T @ rows)

    def covariance(self, information: Array) -> Array:
        """Covariance (p, p) of the machine's directions, in prior sigmas, for an information (na,
        na).
        """
        scale = np.sqrt(np.diag(information))
        half = np.linalg.cholesky(information / np.outer(scale, scale))
        whitened = np.linalg.solve(half, (self.machine / scale).T)
        return whitened.T @ whitened

    def alone(self, share: float) -> CandidateRows:
        """Candidates that share no unknowns but the machine's: what each of them tells of it by
        itself, stations, shading and mounts eliminated.

        share : of the candidates that are measured, on average.
        """
        start = np.linalg.inv(self.covariance(self.information))
        each = np.stack([self.covariance(self.of(np.array([k]))) for k in range(len(self.rows))])
        rows = rows_of_information(share * (np.linalg.inv(each) - start))
        return replace(self, rows=rows, information=start, machine=np.eye(len(start)))

    def tool(self, covariance: Array) -> tuple[float, float]:
        """Standard deviations of the platform's position (m) and turn (rad) for a covariance (p,
        p).

        Means over the workspace. A calibration's report has the median and the worst of the same in
        its section on the workspace (:mod:`pkmcal.calibration.toolmap`), while its headline is a
        mean over the session's own poses. A plan does not contain the terms that
        :attr:`~pkmcal.identify.bundle.BatchResult.covariance` adds by the residuals: correlated
        errors of edges, and undetected outliers.
        """
        variance = np.einsum("kap,pq,kaq->ka", self.work, covariance, self.work, optimize=True)
        shift, turn = variance[:, 3:].sum(axis=1), variance[:, :3].sum(axis=1)
        return float(np.sqrt(shift).mean()), float(np.sqrt(turn).mean())


def rows_of_information(information: Array) -> Array:
    """Rows R (n, p, p) with ``R^T R`` an information (n, p, p), whose smallest eigenvalues may be
    rounding.
    """
    eigenvalues, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(eigenvalues, 0.0))[..., None] * vectors.mT)


def information_of(
    rig: Rig,
    candidates: Candidates,
    work: Array,
    calibration_prior: CalibrationPrior | None = None,
    rng: np.random.Generator | None = None,
    wanted: int | None = None,
) -> CandidateRows:
    """Rows of all candidates.

    work : T_base_platform (M, 4, 4) of the workspace.
    calibration_prior : prior of an earlier calibration, in place of the nominal model.
    rng : as for :meth:`~pkmcal.planning.rig.LegsFrom.measure`.
    wanted : number of each group that will be measured, by default all: it determines the
        correlation of edges with common shading.

    Raises InputError if a group of stations measures nothing in any configuration.
    """
    machine, joints, poses = rig.machine, candidates.joints, candidates.T_base_platform
    measurements = rig.measured(joints, poses, candidates.pairs, rng)
    _check_observed(rig, candidates, measurements)
    each = len(joints) / len(candidates.groups)
    share = 1.0 if wanted is None or each < 2 else min((wanted - 1) / (each - 1), 1.0)
    assembled, state = rig.assembled(measurements, poses, share)
    problem = assembled.problem
    directions, u = machine_directions(machine, problem), problem.unknowns
    # Rows of each candidate, its platform pose eliminated.
    reduced = eliminate(problem.linearize(state)).rows[0]
    rows = np.zeros((len(joints), *reduced.shape[1:]))
    rows[assembled.observed] = reduced  # candidates without measurements have no information
    # Prior information: of the nominal model, stations and mounts, or of an earlier calibration.
    prior = problem.prior
    if calibration_prior is not None:  # it includes the nominal model's priors
        prior = prior[~prior[:, u.machine].any(axis=1)]
    total = prior.T @ prior
    for part in (u.stations, u.mounts):
        total[part, part] += np.eye(part.stop - part.start) / UNMEASURED_POSE_SIGMA**2
    if calibration_prior is not None:
        at, added = _prior_information(
            calibration_prior, machine, problem, rig.T_station_base, directions
        )
        total[np.ix_(at, at)] += added
    directed = np.zeros((len(directions.of_z), u.count))
    directed[:, u.machine] = directions.of_z
    return CandidateRows(
        rows=rows,
        group=candidates.group,
        where=joints / motor_spans(joints, machine.joint_ranges),
        information=total,
        machine=directed,
        work=tool_by_free(rig, problem, machine.inverse(work), work) @ directions.to_z,
    )


def _check_observed(rig: Rig, candidates: Candidates, measurements: Measurements) -> None:
    """Raise `InputError` if a group of stations measures nothing in any configuration."""
    edges, poses = measurements.edges.configuration, measurements.poses.configuration
    measured = np.unique(candidates.group[np.concatenate([edges, poses])])
    lost = np.setdiff1d(candidates.group, measured)
    if not lost.size:
        return
    names = [rig.names[s] for s in candidates.groups[lost[0]]]
    raise InputError(
        f"{listed(names)} observes nothing in any configuration",
        where=None if rig.where is None else rig.where + names[0],
        found="no leg, or board, in the picture",
        expected="a camera that looks at the machine",
        next_step="Check its pose, or let places be chosen: --places 3",
        code="station.sees_too_little",
    )


def machine_directions(machine: Machine, problem: Problem) -> Directions:
    """Directions of the machine at its present values."""
    tolerance = machine.parameters.tolerances_free()
    moves = move_generators(machine.layout, machine.values) @ conventions(machine)
    frame_changes = np.linalg.lstsq(problem.free, moves, rcond=None)[0]
    basis = np.linalg.qr(frame_changes / tolerance[:, None], mode="complete")[0]
    basis = basis[:, frame_changes.shape[1] :]
    return Directions(tolerance[:, None] * basis, basis.T / tolerance, frame_changes)


def _prior_information(
    prior: CalibrationPrior,
    machine: Machine,
    problem: Problem,
    T_station_base: Array,
    directions: Directions,
) -> tuple[Integers, Array]:
    """Columns of the shared unknowns and the information (k, k) of an earlier calibration on them.

    Its covariance refers to its own gauge. Any gauge is valid, so changes of frames get the
    variance of a prior sigma: they move the kept stations with the machine and are not observable.
    """
    u, n = problem.unknowns, len(machine.values)
    fixed_stations = np.array(prior.stations, dtype=int)
    to_free = np.zeros((u.n_free + 6 * len(fixed_stations), n + 6 * len(fixed_stations)))
    to_free[: u.n_free, :n] = problem.structure.to_free
    to_free[u.n_free :, n:] = np.eye(6 * len(fixed_stations))
    # Variance of frame changes, which move the machine and its kept stations together.
    frames = conventions(machine)
    frame_changes = [directions.span]
    if len(fixed_stations):
        stations = station_generators(T_station_base[fixed_stations]) @ frames[:12]
        frame_changes.append(stations.reshape(-1, frames.shape[1]))
    frame_changes = np.concatenate(frame_changes)
    size = np.append(machine.parameters.tolerances_free(), np.ones(6 * len(fixed_stations)))
    share = frame_changes / size[:, None]
    frame_changes = frame_changes / np.maximum(np.linalg.norm(share, axis=0), 1e-12)
    # Inverse of the covariance, in units of prior sigmas.
    spread = to_free @ prior.covariance @ to_free.T + frame_changes @ frame_changes.T
    eigenvalues, eigenvectors = np.linalg.eigh(spread / np.outer(size, size))
    half = eigenvectors / np.sqrt(np.maximum(eigenvalues, DIRECTION_VARIANCE_FLOOR)) / size[:, None]
    columns = u.stations.start + 6 * fixed_stations[:, None] + np.arange(6)
    at = np.concatenate([np.arange(u.n_free), columns.ravel()])
    return at, half @ half.T


def tool_by_free(rig: Rig, problem: Problem, joints: Array, poses: Array) -> Array:
    """Derivatives (M, 6, nz) of turn and shift of the platform by the machine's free parameters.

    At poses (M, 4, 4) and given readings (M, m), with the frames registered as for a result.
    """
    machine, n = rig.machine, len(rig.machine.values)
    state = State(machine.values, rig.T_station_base, poses)
    free = transformation(machine, state, BestFit())[:n, :n] @ problem.free
    by = pose_by_parameters(machine, joints, poses)
    legs_observed = any(isinstance(one, LegsFrom) for one in rig.instruments)
    return without_frames(machine, poses, by, every=not legs_observed) @ free
