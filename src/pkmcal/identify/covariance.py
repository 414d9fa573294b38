"""How sure the estimate is: covariance, noise scale, rank. All from exact derivatives.

The covariance is the inverse of the reduced information at the solution, told in a gauge. It
covers the noise of edges and readings and the nominal model's tolerances; it does not cover errors
of the model (joint clearance, bending, a wrong lens).
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
from pkmcal.identify.kinds import KindSums, kind_sums
from pkmcal.identify.problem import Problem
from pkmcal.identify.state import State, estimated_unknowns
from pkmcal.identify.unknowns import BatchState
from pkmcal.levels import NAMED_SHARE
from pkmcal.mechanisms import Machine, ParameterTable
from pkmcal.solver.elimination import (
    Linear,
    Reduced,
    condensed,
    divisions,
    eliminate,
    rows_on_shared,
)
from pkmcal.solver.ranks import (
    NORMAL_RANK_TOLERANCE,
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
    """What a problem says at a state: its rows, and what the shared unknowns' covariance is.

    normal : (B, na, na) the reduced normal matrix, where it is known already. The rows of two
    thousand configurations take a gigabyte, so what passes through all of them takes them in
    ``pieces``.
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
        """The same with the configurations' own unknowns eliminated."""
        return eliminate(self.linear)

    def pieces(self) -> Iterator[Information]:
        """What some configurations say after the other, so many as the solver works on at once; the
        rows on shared unknowns only are in each. One piece is this itself.
        """
        cuts = divisions(self.state.T_base_platform.shape[1], self.problem.n_rows)
        if len(cuts) < 2:
            yield self
            return
        for cut in cuts:
            yield Information(self.problem.among(cut), self.problem.state_among(self.state, cut))

    @cached_property
    def rows(self) -> tuple[Array, Array]:
        """All rows on the shared unknowns, the own ones eliminated: Jacobian (B, n, na) and
        residuals (B, n), those on shared unknowns only last; each piece's condensed.
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
    def by_kind(self) -> KindSums:
        """What the rows of each kind say, summed over the configurations."""
        return kind_sums(self.problem, self.state)

    @cached_property
    def root(self) -> Array:
        """F (B, na, na) with F F^T the covariance of the shared unknowns, where nothing is said of
        a direction that is not known.
        """
        normal, prior = self.normal, self.problem.prior
        if normal is None:
            normal = self.by_kind.every + prior.T @ prior
        else:
            inverse, sure = self._inverse
            if sure.all():
                return np.linalg.cholesky(inverse)
        return normal_root(normal, NORMAL_RANK_TOLERANCE, loose=False)

    @cached_property
    def _inverse(self) -> tuple[Array, Booleans]:
        """The normal matrix's inverse, and where that holds half of the digits."""
        return normal_inverse(cast(Array, self.normal))

    @cached_property
    def covariance(self) -> Array:
        """Covariance (B, na, na) of the shared unknowns before any gauge is applied; a direction
        that nothing fixes has a huge variance.

        By the normal matrix where it leaves half of the digits, else by the rows, which leave all.
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
    """The part of the shared unknowns' covariance (B, na, na) that the noise of what was measured
    makes; the rest is how little is known beforehand.
    """
    in_prior = info.problem.prior @ info.covariance
    return info.covariance - in_prior.mT @ in_prior


def reduced_rows(
    info: Information, keep: tuple[str, ...], silent: tuple[str, ...] | None = None
) -> tuple[Array, Array]:
    """What the data say of some unknowns whatever the others are: rows A (n, m) by the named ones,
    in the order of their columns, and residuals y (n,); the problem's first run. They are few, with
    the same normal matrix, gradient and sum of squares as all.

    Each configuration's own unknowns are eliminated and what all other shared unknowns can take up
    is projected out, so ``y + A x`` is left of the residuals where the kept ones move by x (their
    best value is least squares on it). Rows that are known beforehand count too, but for those on
    the ``silent`` unknowns, by default the kept ones: what is asked is not to be known already.

    For parameters that the problem holds, open it first, as drift tests do::

        rows, left = reduced_rows(Information(*problem.opened(state)), ("machine",))

    Frames stay in: their rows are zero along :func:`~pkmcal.identify.gauge.move_generators`.
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
    """Covariance (n, n) of parameters, stations and mounts, told in the gauge; n = P + 6 S + 6 M,
    in the order of :func:`~pkmcal.identify.state.estimated_unknowns`.

    before : the solution as the solver left it. shared : (na, na) covariance there.
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
    """The covariance ``spread shared spread^T`` (n, n) of parameters, stations and mounts in the
    frames of ``before``, told in the gauge.

    spread : (n, m) how they change with what has the covariance shared (m, m).
    """
    estimated = estimated_unknowns(before)
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
    above_limit = nominal > 1e-12 * table.tolerance**2
    share = 1 - np.diag(covariance)[: len(table)] / np.where(above_limit, nominal, 1.0)
    return np.where(above_limit, share, 0.0)


@dataclass(frozen=True)
class ParameterDirection:
    """A combination of parameters: names with weights, largest first, and how well known.

    information : singular value of the data in units of the nominal model's tolerance; 1 means that
    the data know it as well as the nominal model does. vector : (P,) the change of all parameters,
    m and rad, with the largest entry one tolerance.
    """

    names: tuple[str, ...]
    weights: tuple[float, ...]
    information: float
    vector: Array


@dataclass(frozen=True)
class Identifiability:
    """What the data alone can tell of the machine, frames aside.

    n_parameters : free ones. n_frames : freedoms of the frames, and of hinges' beginnings.
    rank : directions the data fix. unidentified : directions that no amount of such data fixes.
    weak : directions that the nominal model knows better than the data.
    """

    n_parameters: int
    n_frames: int
    rank: int
    unidentified: tuple[ParameterDirection, ...]
    weak: tuple[ParameterDirection, ...]
    singular_values: Array

    __repr__ = short_repr

    @property
    def basis(self) -> Array:
        """Changes (n, P) of all parameters that the data cannot see, m and rad."""
        vectors = [d.vector for d in self.unidentified]
        size = next((d.vector.size for d in (*self.unidentified, *self.weak)), self.n_parameters)
        return np.array(vectors).reshape(-1, size)


def identifiability(info: Information, machine: Machine) -> Identifiability:
    """Which combinations of parameters the data fix, nominal model left out; the problem's first
    run.

    Poses, stations, edge shifts and shading are eliminated, frames taken out, and the columns are
    scaled by the nominal model's tolerances.
    """
    problem, state = info.problem, info.state
    table, nz = machine.parameters, problem.unknowns.n_free
    tolerance = table.tolerances_free()
    # what is known beforehand of cameras and shading is not left out: without it, a shift of
    # every line by itself would hide the tubes' radii
    remainder = reduced_rows(info, ("machine",), silent=("machine", "mounts"))[0] * tolerance
    theta, moves = problem.theta(state)[0], conventions(machine)
    shifted = move_generators(machine.layout, theta) @ moves
    shifted = np.linalg.lstsq(problem.free, shifted, rcond=None)[0]
    basis = np.linalg.qr(shifted / tolerance[:, None], mode="complete")[0][:, moves.shape[1] :]
    # a square R has all right vectors, however few rows there are
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
