"""What the rows of each kind say once the configurations' own unknowns are eliminated.

Sums over all configurations, found in one pass in which the rows themselves are written, reduced
and forgotten.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.problem import Problem
from pkmcal.identify.rows import joint_rows
from pkmcal.identify.unknowns import BatchState
from pkmcal.solver import Eliminated, Memory, divisions, eliminated, own_factors

EDGES, POSES, READINGS = range(3)
"""Kinds of rows in the axes of :class:`KindSums`."""


class KindSums(NamedTuple):
    """Sums over the configurations c of B runs; kinds k, l of rows as :data:`EDGES`.

    With Q of the own Jacobian in a configuration and its reduced rows A, Q_k and A_k those of a
    kind: own sum_c tr(Q_k^T Q_k Q_l^T Q_l) (B, 3, 3), trace sum_c tr Q_k^T Q_k (B, 3), cross
    sum_c (Q_k^T A_k)^T Q_l^T A_l (B, 3, 3, na, na), normal sum_c A_k^T A_k (B, 3, na, na).
    every : sum_c A^T A (B, na, na) of all rows, those that are of no kind, as of rods of constant
    length, among them. chi2 : (B, 3). value : (B, K, r) residuals, zero where nothing can be
    predicted or is there.
    """

    own: Array
    trace: Array
    cross: Array
    normal: Array
    every: Array
    chi2: Array
    value: Array


def kind_sums(problem: Problem, state: BatchState) -> KindSums:
    """Those of a problem's rows at a state."""
    n_runs, na, memory = len(state.z), problem.unknowns.count, Memory()
    own, trace = np.zeros((n_runs, 3, 3)), np.zeros((n_runs, 3))
    cross, normal = np.zeros((n_runs, 3, 3, na, na)), np.zeros((n_runs, 3, na, na))
    every, chi2 = np.zeros((n_runs, na, na)), np.zeros((n_runs, 3))
    values: list[Array] = []
    for cut in divisions(*problem.extent):
        part, at = problem.among(cut), problem.state_among(state, cut)
        rows, by_reading = part.compact(at), part.closure(at).by_reading
        q = own_factors(rows.by_own, np.zeros(n_runs))[0][..., : part.n_rows, :]
        values.append(rows.value)
        for run in range(n_runs):
            for piece in eliminated(rows, run, q[run], rows.value[run], memory):
                flat = piece.rest.reshape(-1, na)
                every[run] += piece.strips_normal + flat.T @ flat
                kinds = _of_kinds(part, piece, q[run], by_reading[run])
                for k, (squares, along, square) in enumerate(kinds):
                    trace[run, k] += np.einsum("cii->", squares)
                    normal[run, k] += square
                    for m, (others, beside, _) in enumerate(kinds):
                        own[run, k, m] += np.sum(squares * others)
                        cross[run, k, m] += along.reshape(-1, na).T @ beside.reshape(-1, na)
            chi2[run] += _chi2(part, rows.value[run], by_reading[run])
    return KindSums(own, trace, cross, normal, every, chi2, np.concatenate(values, axis=1))


def _of_kinds(
    problem: Problem, piece: Eliminated, q: Array, by_reading: Array
) -> tuple[tuple[Array, Array, Array], ...]:
    """Of each kind in some configurations Q_k^T Q_k (k, d, d), Q_k^T A_k (k, d, na) and the sum of
    A_k^T A_k (na, na); q (K, r, d) and by_reading (K, E) of all.
    """
    na, equations = piece.rest.shape[-1], problem.layout.n_equations
    along = piece.along_strips - piece.own @ piece.along
    out = [(piece.own, along, piece.strips_normal)]
    after, slopes = q[piece.cut, problem.closure_rows.start :], by_reading[piece.cut]
    for part, rows in (
        (after[:, equations:], piece.rest[:, equations:]),
        (
            _readings(problem, after[:, :equations], slopes),
            _readings(problem, piece.rest[:, :equations], slopes),
        ),
    ):
        flat = rows.reshape(-1, na)
        out.append((part.mT @ part, part.mT @ rows, flat.T @ flat))
    return tuple(out)


def _readings(problem: Problem, closures: Array, by_reading: Array) -> Array:
    """Of the closures' rows (K, E, n) those of the readings, (K, m, n)."""
    return joint_rows(problem.layout, by_reading[:, None], closures.mT).mT


def _chi2(problem: Problem, value: Array, by_reading: Array) -> Array:
    """Sums of squares of each kind, (3,), of residuals (K, r)."""
    closures = problem.closure_rows
    parts = value[:, : closures.start], value[:, closures.stop :]
    readings = _readings(problem, value[:, closures, None], by_reading)
    return np.array([np.sum(part**2) for part in (*parts, readings)])
