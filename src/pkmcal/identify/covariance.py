"""Covariance and rank of the estimate, from exact derivatives.

The covariance is the inverse of the reduced information at the solution, expressed in a gauge. It
covers the noise of edges and readings and the nominal model's prior sigmas. Errors of the model
(joint clearance, bending, a wrong lens) are added by :mod:`pkmcal.identify.discrepancy` as far as
residuals contain them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from pkmcal.arrays import Array, Booleans, short_repr
from pkmcal.identify.gauge import (
    Gauge,
    alignment,
    carried_errors,
    changed_frames,
    conventions,
    generators,
    move_generators,
    projector,
    transformation,
)
from pkmcal.identify.problem import Problem
from pkmcal.identify.row_sums import RowSums, row_sums
from pkmcal.identify.state import State, estimated_unknowns
from pkmcal.identify.unknowns import BatchState
from pkmcal.levels import NAMED_SHARE
from pkmcal.mechanisms import Machine, ParameterTable
from pkmcal.solver.elimination import (
    Linear,
    Reduced,
    condensed,
    eliminate,
    rows_on_shared,
)
from pkmcal.solver.ranks import (
    NORMAL_RANK_TOLERANCE,
    RANK_TOLERANCE,
    column_space,
    inverse_root,
    nonzero,
    normal_inverse,
    normal_root,
)
from pkmcal.solver.search import take

ROWS_RANK_TOLERANCE = 1e-12
"""Relative singular value of the scaled rows of data, nominal model and gauge below which a
direction counts as unknown."""


@dataclass(frozen=True)
class Information:
    """Linearized rows of a problem at a state, and the covariance of the shared unknowns.

    normal : (B, na, na) reduced normal matrix, if it is already computed.

    The rows of two thousand configurations take a gigabyte, so computations over all of them
    iterate over ``pieces``.
    """

    problem: Problem
    state: BatchState
    normal: Array | None = None

    @cached_property
    def linear(self) -> Linear:
        """Residuals and Jacobian."""
        return self.problem.linearize(self.state)

    @cached_property
    def reduced(self) -> Reduced:
        """Linearized rows with the configurations' own unknowns eliminated."""
        return eliminate(self.linear)

    def pieces(self) -> Iterator[Information]:
        """Parts of the problem, each with as many configurations as the solver processes at once.

        Each part contains all rows on shared unknowns only. A small problem is a single part.
        """
        cuts = self.problem.cuts
        if len(cuts) < 2:
            yield self
            return
        for cut in cuts:
            yield Information(self.problem.among(cut), self.problem.state_among(self.state, cut))

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """Rows on the shared unknowns with the own ones eliminated: Jacobian (B, n, na) and
        residuals (B, n).

        Rows on shared unknowns only are last; those of each piece are condensed.
        """
        parts: list[tuple[Array, Array]] = []
        for piece in self.pieces():
            rows, value = rows_on_shared(piece.linear, piece.reduced)
            own = rows.shape[1] - len(self.problem.prior)
            if not parts:
                parts = [(rows[:, own:], value[:, own:])]
            parts.insert(-1, condensed(rows[:, :own], value[:, :own]))
        rows, values = zip(*parts, strict=True)
        return np.concatenate(rows, axis=1), np.concatenate(values, axis=1)

    @cached_property
    def by_kind(self) -> RowSums:
        """Sums over the configurations of each kind's normal matrix and squares."""
        return row_sums(self.problem, self.state)

    @cached_property
    def root(self) -> Array:
        """F (B, na, na) with F F^T the covariance of the shared unknowns; unidentifiable directions
        have zero variance.
        """
        normal, prior = self.normal, self.problem.prior
        if normal is None:
            normal = self.by_kind.every + prior.T @ prior
        else:
            inverse, sure = self._inverse
            if sure.all():
                try:
                    return np.linalg.cholesky(inverse)
                except np.linalg.LinAlgError:
                    pass  # the rounding of a matrix with huge derivatives made it indefinite
        return normal_root(normal, NORMAL_RANK_TOLERANCE, loose=False)

    @cached_property
    def root_of_rows(self) -> Array:
        """As ``root``, from the rows, which hold all digits: by the normal matrix, directions of
        rounding would count as determined.
        """
        return inverse_root(self.rows[0], RANK_TOLERANCE, loose=False)

    @cached_property
    def _inverse(self) -> tuple[Array, Booleans]:
        """Inverse of the normal matrix, and the runs (B,) in which half of its digits are
        significant.
        """
        return normal_inverse(cast(Array, self.normal))

    @cached_property
    def covariance(self) -> Array:
        """Covariance (B, na, na) of the shared unknowns before any gauge; an unidentifiable
        direction has a huge variance.

        Computed from the normal matrix where half of the digits remain significant, otherwise from
        the rows, whose condition number is its square root.
        """
        if self.normal is not None:
            inverse, sure = self._inverse
            if sure.all():
                return inverse
            if sure.any():
                rest = np.flatnonzero(~sure)
                part = Information(self.problem.select(rest), take(self.state, rest))
                inverse = inverse.copy()
                inverse[rest] = part.covariance
                return inverse
        half = inverse_root(self.rows[0], ROWS_RANK_TOLERANCE, loose=True)
        return half @ half.mT


def covariance_by_noise(info: Information) -> Array:
    """Part of the shared unknowns' covariance (B, na, na) due to measurement noise; the rest is due
    to the priors.
    """
    in_prior = info.problem.prior @ info.covariance
    return info.covariance - in_prior.mT @ in_prior


def reduced_rows(
    info: Information, keep: tuple[str, ...], silent: tuple[str, ...] | None = None
) -> tuple[Array, Array]:
    """Information of the data on the named unknowns, all others marginalized, of the problem's
    first run.

    Returns rows A (n, m), in the order of the named unknowns' columns, and residuals y (n,). Rows
    are condensed: they have the same normal matrix, gradient and sum of squares as all rows.

    Each configuration's own unknowns are eliminated, and the range of all other shared unknowns is
    projected out: ``y + A x`` are the residuals that remain when the named unknowns change by x and
    all others are re-estimated, and the least-squares solution x is the estimate. Prior rows are
    included, except those on the ``silent`` unknowns, by default the named ones, so that A is the
    information of the data alone. To include parameters that the problem holds, open it first::

        rows, residuals = reduced_rows(Information(*problem.opened(state)), ("machine",))

    Gauge freedoms remain: the rows are zero along :func:`~pkmcal.identify.gauge.move_generators`.
    """
    problem, (rows, value) = info.problem, (part[0] for part in info.rows)
    retained = problem.unknowns.columns(*keep)
    prior_columns = problem.prior[
        :, retained if silent is None else problem.unknowns.columns(*silent)
    ]
    used = np.append(
        np.ones(len(rows) - len(prior_columns), dtype=bool), ~prior_columns.any(axis=1)
    )
    rows, value = rows[used], value[used]
    q = column_space(np.delete(rows, retained, axis=1))
    rows = rows[:, retained]
    return rows - q @ (q.T @ rows), value - q @ (q.T @ value)


def machine_covariance(
    problem: Problem, machine: Machine, before: State, shared: Array, gauge: Gauge
) -> Array:
    """Covariance (n, n) of parameters, stations and mounts in the gauge; n = P + 6 S + 6 M, in the
    order of :func:`~pkmcal.identify.state.estimated_unknowns`.

    before : the solution as the solver left it.
    shared : (na, na) covariance of the shared unknowns there.
    """
    solved, estimated = problem.unknowns, estimated_unknowns(before)
    spread = np.zeros((estimated.count, solved.count))
    spread[estimated.machine, solved.machine] = problem.free
    spread[estimated.stations, solved.stations] = np.eye(6 * solved.n_stations)
    spread[estimated.mounts, solved.mounts] = np.eye(6 * solved.n_mounts)
    return prior_in_gauge(machine, before, spread, shared, gauge)


def prior_in_gauge(
    machine: Machine, before: State, spread: Array, shared: Array, gauge: Gauge
) -> Array:
    """Covariance ``spread shared spread^T`` (n, n) of parameters, stations and mounts, transformed
    from the frames of ``before`` into the gauge.

    spread : (n, m) derivative by the quantities whose covariance is ``shared`` (m, m).
    """
    estimated = estimated_unknowns(before)
    # exact change of the frames, then the S-transformation of the errors
    e, f = alignment(machine, before, gauge)
    after = changed_frames(machine.layout, before, e, f)
    spread = carried_errors(machine.layout, before, e, f) @ spread
    spread = transformation(machine, after, gauge) @ spread
    for index in np.concatenate(machine.layout.turning):  # an axis' length is one, known exactly
        axis = after.theta[index] / np.linalg.norm(after.theta[index])
        spread[index] -= np.outer(axis, axis @ spread[index])
    out = spread @ shared @ spread.T
    # constrained and fixed coordinates are exactly known; the product leaves rounding there
    without_variance = np.diag(out)[estimated.machine] < 1e-18 * machine.parameters.tolerance**2
    without_variance = np.flatnonzero(without_variance)
    out[without_variance, :], out[:, without_variance] = 0.0, 0.0
    return 0.5 * (out + out.T)


def data_share(machine: Machine, theta: Array, covariance: Array, gauge: Gauge) -> Array:
    """1 - posterior variance / prior variance in the gauge, (P,); 0 where both vanish."""
    table, free = machine.parameters, machine.parameters.free_matrix()
    change = projector(machine, theta, gauge)
    spread = free - generators(machine.layout, theta) @ (change @ free)
    nominal = np.sum((spread * table.tolerances_free()) ** 2, axis=1)
    has_prior = nominal > 1e-12 * table.tolerance**2
    share = 1 - np.diag(covariance)[: len(table)] / np.where(has_prior, nominal, 1.0)
    return np.where(has_prior, share, 0.0)


@dataclass(frozen=True)
class ParameterDirection:
    """Combination of parameters, with the information that the data have on it.

    names, weights : largest components, in descending order.
    information : singular value of the data's rows in units of the prior sigmas; at 1 the data
        determine the direction as well as the nominal model does.
    vector : (P,) change of all parameters, m and rad, with the largest entry one prior sigma.
    """

    names: tuple[str, ...]
    weights: tuple[float, ...]
    information: float
    vector: Array


@dataclass(frozen=True)
class Identifiability:
    """Directions of the machine that the data alone determine, apart from frames.

    n_parameters : number of free parameters.
    n_frames : number of gauge freedoms, of the frames and of the zeros of hinges.
    rank : number of directions that the data determine.
    unidentified : directions in the null space of the data.
    weak : directions that the nominal model determines better than the data.
    singular_values : (n,) of the data's rows in units of the prior sigmas, in descending order.
    directions : (n, P) their changes of all parameters, m and rad, each of length one in prior
        sigmas.
    """

    n_parameters: int
    n_frames: int
    rank: int
    unidentified: tuple[ParameterDirection, ...]
    weak: tuple[ParameterDirection, ...]
    singular_values: Array
    directions: Array

    __repr__ = short_repr

    @property
    def basis(self) -> Array:
        """Basis (n, P) of the null space: changes of all parameters that do not affect the data, m
        and rad.
        """
        vectors = [d.vector for d in self.unidentified]
        size = next((d.vector.size for d in (*self.unidentified, *self.weak)), self.n_parameters)
        return np.array(vectors).reshape(-1, size)


def identifiability(info: Information, machine: Machine) -> Identifiability:
    """Rank of the data on the machine, without the nominal model, of the problem's first run.

    Poses, stations, edge shifts and shading are marginalized, frames projected out, and the columns
    are scaled by the nominal model's prior sigmas.
    """
    problem, state = info.problem, info.state
    table, nz = machine.parameters, problem.unknowns.n_free
    tolerance = table.tolerances_free()
    # Priors of cameras and shading are used: without them, independent shifts of all lines would
    # be equivalent to changes of the tubes' radii.
    remainder = reduced_rows(info, ("machine",), silent=("machine", "mounts"))[0] * tolerance
    theta, moves = problem.theta(state)[0], conventions(machine)
    shifted = move_generators(machine.layout, theta) @ moves
    shifted = np.linalg.lstsq(problem.free, shifted, rcond=None)[0]
    basis = np.linalg.qr(shifted / tolerance[:, None], mode="complete")[0][:, moves.shape[1] :]
    # the R factor is square, so vt is complete however few rows there are
    _, s, vt = np.linalg.svd(np.linalg.qr(remainder @ basis, mode="r"), full_matrices=True)
    s = np.pad(s, (0, len(vt) - len(s)))
    directions = vt @ basis.T
    lost = ~nonzero(s)
    vectors = (directions * tolerance) @ problem.free.T
    made = [
        _direction(table, d, v, float(x)) for d, v, x in zip(directions, vectors, s, strict=True)
    ]
    return Identifiability(
        n_parameters=nz,
        n_frames=moves.shape[1],
        rank=int(np.sum(~lost)),
        unidentified=tuple(m for m, gone in zip(made, lost, strict=True) if gone),
        weak=tuple(m for m, gone in zip(made, lost, strict=True) if not gone and m.information < 1),
        singular_values=s,
        directions=vectors,
    )


def _direction(
    table: ParameterTable, weights: Array, vector: Array, value: float
) -> ParameterDirection:
    order = np.argsort(-np.abs(weights), kind="stable")
    order = order[np.abs(weights[order]) > NAMED_SHARE * np.abs(weights).max()][:8]
    names = table.free_names()
    size = np.abs(vector / table.tolerance).max()
    return ParameterDirection(
        tuple(names[k] for k in order),
        tuple(float(weights[k]) for k in order),
        value,
        vector / size,
    )
