"""What each measurement that could be made tells of the machine, before it is made.

With the joint estimate's own Jacobian at the machine as it is known, each candidate's rows on the
shared unknowns are worked out once, the platform's pose of that configuration eliminated (the
estimate's own Schur complement). The information of any choice of candidates is then the sum of
``R^T R`` over the chosen and of what is known beforehand; nuisances (stations, edge shifts,
shading, boards' places) stay unknowns, so a choice promises what the estimate then states.

The machine is told in p directions that frames and conventions leave, in tolerances of its drawing,
so that no frame is favoured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.calibration.saved_calibration import CalibrationPrior
from pkmcal.errors import InputError
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import (
    BestFit,
    conventions,
    move_generators,
    station_generators,
    transformation,
)
from pkmcal.identify.problem import Problem
from pkmcal.identify.tool import pose_by_parameters, without_frames
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.planning.rig import LegsFrom, Rig, all_pairs
from pkmcal.planning.route import motor_spans
from pkmcal.solver.elimination import eliminate
from pkmcal.wording import listed

UNMEASURED_PLACE_SIGMA = 1.0
"""m and rad; how well the place of a station, or a board, is known at least: before any
measurement, so that every choice has a covariance. A photograph tells a thousand times more."""
DIRECTION_VARIANCE_FLOOR = 1e-12
"""Variance, in tolerances squared, of what a calibration holds exactly: an axis' own length."""


@dataclass(frozen=True)
class Candidates:
    """What could be measured: n configurations, each by one of G groups of stations.

    groups : stations that all measure a configuration. group : (n,) by which of them, in increasing
    order. joints : (n, m). T_base_platform : (n, 4, 4).
    """

    groups: tuple[tuple[int, ...], ...]
    group: Integers
    joints: Array
    T_base_platform: Array

    @classmethod
    def of_all(
        cls, groups: tuple[tuple[int, ...], ...], joints: Array, T_base_platform: Array
    ) -> Candidates:
        """Each of K configurations by each of the groups."""
        n = len(groups)
        group = np.repeat(np.arange(n), len(joints))
        poses = np.tile(T_base_platform, (n, 1, 1))
        return cls(groups, group, np.tile(joints, (n, 1)), poses)

    def only(self, chosen: Integers) -> Candidates:
        """Some of them; their groups in increasing order."""
        parts = self.group[chosen], self.joints[chosen], self.T_base_platform[chosen]
        return Candidates(self.groups, *parts)

    @property
    def pairs(self) -> Integers:
        """(M, 2) stations and the candidates that they measure."""
        rows = [np.flatnonzero(self.group == g) for g in range(len(self.groups))]
        return np.concatenate([all_pairs(s, k) for s, k in zip(self.groups, rows, strict=True)])


class Directions(NamedTuple):
    """Directions (nz, p) of the machine's free parameters z that frames and conventions leave, each
    a tolerance large, and back from z, (p, nz); span : (nz, g) what those do to z.
    """

    to_z: Array
    of_z: Array
    span: Array


@dataclass(frozen=True)
class CandidateRows:
    """Rows of all candidates, and what they are for.

    rows : (n, r, na) on the shared unknowns in their own units. group : (n,) in increasing order,
    which group of stations measures each. where : (n, m) its readings, in parts of the motors'
    ranges. information : (na, na) information beforehand, with the drawing's. machine : (p, na) the
    machine's directions, of which the drawing alone knows each to one. work : (M, 6, p) turn and
    shift of the platform at M poses of the workspace by each direction, rad and m.
    """

    rows: Array
    group: Integers
    where: Array
    information: Array
    machine: Array
    work: Array

    def of(self, chosen: Integers, times: float = 1.0) -> Array:
        """(na, na) information of a choice of candidates, each measured ``times`` over."""
        rows = self.rows[chosen].reshape(-1, self.rows.shape[-1])
        return self.information + times * (rows.T @ rows)

    def covariance(self, information: Array) -> Array:
        """(p, p) of the machine's directions, in tolerances, by an information (na, na)."""
        scale = np.sqrt(np.diag(information))
        half = np.linalg.cholesky(information / np.outer(scale, scale))
        residual = np.linalg.solve(half, (self.machine / scale).T)
        return residual.T @ residual

    def tool(self, covariance: Array) -> tuple[float, float]:
        """Standard deviations of the platform's position (m) and turn (rad) by a covariance (p, p),
        mean over the workspace: as `calibrate` states them.
        """
        variance = np.einsum("kap,pq,kaq->ka", self.work, covariance, self.work, optimize=True)
        shift, turn = variance[:, 3:].sum(axis=1), variance[:, :3].sum(axis=1)
        return float(np.sqrt(shift).mean()), float(np.sqrt(turn).mean())


def information_of(
    rig: Rig,
    candidates: Candidates,
    work: Array,
    reference_values: CalibrationPrior | None = None,
    rng: np.random.Generator | None = None,
    wanted: int | None = None,
) -> CandidateRows:
    """Rows of all candidates; see the module.

    work : T_base_platform (M, 4, 4) where the tool counts. reference_values : what an earlier
    calibration knows of the machine, in place of its drawing. rng : as for
    :meth:`~pkmcal.planning.rig.LegsFrom.measure`. wanted : how many of each group are to be
    measured in the end, all by default: edges that are shaded alike count together. Raises
    InputError where a group of stations measures nothing at any configuration.
    """
    machine, joints, poses = rig.machine, candidates.joints, candidates.T_base_platform
    measurements = rig.measured(joints, poses, candidates.pairs, rng)
    _check_observed(rig, candidates, measurements)
    each = len(joints) / len(candidates.groups)
    share = 1.0 if wanted is None or each < 2 else min((wanted - 1) / (each - 1), 1.0)
    assembled, state = rig.assembled(measurements, poses, share)
    problem = assembled.problem
    direction, u = machine_directions(machine, problem), problem.unknowns
    reduced = eliminate(problem.linearize(state)).rows[0]
    rows = np.zeros((len(joints), *reduced.shape[1:]))
    rows[assembled.observed] = reduced  # of what shows nothing, nothing is told
    prior = problem.prior
    if reference_values is not None:  # the drawing speaks in it already
        prior = prior[~prior[:, u.machine].any(axis=1)]
    total = prior.T @ prior
    for part in (u.stations, u.mounts):
        total[part, part] += np.eye(part.stop - part.start) / UNMEASURED_PLACE_SIGMA**2
    if reference_values is not None:
        at, values = _prior_information(
            reference_values, machine, problem, rig.T_station_base, direction
        )
        total[np.ix_(at, at)] += values
    directed = np.zeros((len(direction.of_z), u.count))
    directed[:, u.machine] = direction.of_z
    return CandidateRows(
        rows=rows,
        group=candidates.group,
        where=joints / motor_spans(joints, machine.joint_ranges),
        information=total,
        machine=directed,
        work=tool_by_free(rig, problem, machine.inverse(work), work) @ direction.to_z,
    )


def _check_observed(rig: Rig, candidates: Candidates, measurements: Measurements) -> None:
    """Raise `InputError` where a group of stations measures nothing anywhere."""
    edges, poses = measurements.edges.configuration, measurements.poses.configuration
    in_view = np.unique(candidates.group[np.concatenate([edges, poses])])
    lost = np.setdiff1d(candidates.group, in_view)
    if not lost.size:
        return
    names = [rig.names[s] for s in candidates.groups[lost[0]]]
    raise InputError(
        f"from {listed(names)} nothing is seen in any configuration",
        where=None if rig.where is None else rig.where + names[0],
        found="no leg, or board, in the picture",
        expected="a camera that looks at the machine",
        next_step="Check its pose, or let places be chosen: --places 3",
    )


def machine_directions(machine: Machine, problem: Problem) -> Directions:
    """The machine's directions at its present values."""
    tolerance = machine.parameters.tolerances_free()
    moves = move_generators(machine.layout, machine.values) @ conventions(machine)
    shifted = np.linalg.lstsq(problem.free, moves, rcond=None)[0]
    basis = np.linalg.qr(shifted / tolerance[:, None], mode="complete")[0][:, shifted.shape[1] :]
    return Directions(tolerance[:, None] * basis, basis.T / tolerance, shifted)


def _prior_information(
    prior: CalibrationPrior,
    machine: Machine,
    problem: Problem,
    T_station_base: Array,
    sense: Directions,
) -> tuple[Integers, Array]:
    """Where in the shared unknowns, and with which information, an earlier calibration speaks.

    Its covariance stands in its own frames. Any frames would do, so changes of frames are given a
    tolerance's variance: they move the kept stations with the machine, and no measurement minds.
    """
    u, n = problem.unknowns, len(machine.values)
    retained_rows = np.array(prior.stations, dtype=int)
    to_free = np.zeros((u.n_free + 6 * len(retained_rows), n + 6 * len(retained_rows)))
    to_free[: u.n_free, :n] = problem.structure.to_free
    to_free[u.n_free :, n:] = np.eye(6 * len(retained_rows))
    frames = conventions(machine)
    shifted = [sense.span]
    if len(retained_rows):
        stations = station_generators(T_station_base[retained_rows]) @ frames[:12]
        shifted.append(stations.reshape(-1, frames.shape[1]))
    shifted = np.concatenate(shifted)
    size = np.append(machine.parameters.tolerances_free(), np.ones(6 * len(retained_rows)))
    share = shifted / size[:, None]
    shifted = shifted / np.maximum(np.linalg.norm(share, axis=0), 1e-12)
    spread = to_free @ prior.covariance @ to_free.T + shifted @ shifted.T
    values, vectors = np.linalg.eigh(spread / np.outer(size, size))
    half = vectors / np.sqrt(np.maximum(values, DIRECTION_VARIANCE_FLOOR)) / size[:, None]
    columns = u.stations.start + 6 * retained_rows[:, None] + np.arange(6)
    at = np.concatenate([np.arange(u.n_free), columns.ravel()])
    return at, half @ half.T


def tool_by_free(rig: Rig, problem: Problem, joints: Array, poses: Array) -> Array:
    """Turn and shift (M, 6, nz) of the platform at poses (M, 4, 4) by the machine's free
    parameters at given readings (M, m), frames laid over each other as for a result.
    """
    machine, n = rig.machine, len(rig.machine.values)
    state = State(machine.values, rig.T_station_base, poses)
    free = transformation(machine, state, BestFit())[:n, :n] @ problem.free
    by = pose_by_parameters(machine, joints, poses)
    legs_observed = any(isinstance(one, LegsFrom) for one in rig.instruments)
    return without_frames(machine, poses, by, every=not legs_observed) @ free
