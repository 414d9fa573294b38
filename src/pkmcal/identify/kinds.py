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
from pkmcal.solver.elimination import divisions, flat
from pkmcal.solver.strips import Eliminated, eliminated

EDGE_ROWS_KIND, POSE_ROWS_KIND, READING_ROWS_KIND = range(3)
"""Kinds of rows in the axes of :class:`KindSums`."""


class KindSums(NamedTuple):
    """Sums over the configurations c of B runs; kinds k, l of rows as :data:`EDGE_ROWS_KIND`.

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
    n_runs, na = len(state.z), problem.unknowns.count
    own, trace = np.zeros((n_runs, 3, 3)), np.zeros((n_runs, 3))
    cross, normal = np.zeros((n_runs, 3, 3, na, na)), np.zeros((n_runs, 3, na, na))
    every, chi2 = np.zeros((n_runs, na, na)), np.zeros((n_runs, 3))
    values: list[Array] = []
    for cut in divisions(*problem.extent):
        part, at = problem.among(cut), problem.state_among(state, cut)
        rows, by_reading = part.compact(at), part.closure(at).by_reading
        found = eliminated(rows, np.zeros(n_runs))
        values.append(rows.value)
        every += found.strips_normal + found.rows_normal
        kinds = _of_kinds(part, found, by_reading)
        for k, (squares, along, square) in kinds.items():
            trace[:, k] += np.einsum("bcii->b", squares)
            normal[:, k] += square
            for m in (m for m in kinds if m >= k):  # the others are their transposes
                others, beside, _ = kinds[m]
                own[:, k, m] += np.sum(squares * others, axis=(1, 2, 3))
                cross[:, k, m] += flat(along).mT @ flat(beside)
        chi2 += _chi2(part, rows.value, by_reading)
    for k, m in (
        (POSE_ROWS_KIND, EDGE_ROWS_KIND),
        (READING_ROWS_KIND, EDGE_ROWS_KIND),
        (READING_ROWS_KIND, POSE_ROWS_KIND),
    ):
        own[:, k, m], cross[:, k, m] = own[:, m, k], cross[:, m, k].mT
    return KindSums(own, trace, cross, normal, every, chi2, np.concatenate(values, axis=1))


def _of_kinds(
    problem: Problem, found: Eliminated, by_reading: Array
) -> dict[int, tuple[Array, Array, Array]]:
    """Of each kind that there is in some configurations Q_k^T Q_k (B, K, d, d), Q_k^T A_k
    (B, K, d, na) and the sum of A_k^T A_k (B, na, na); by_reading (B, K, E).
    """
    equations = problem.layout.n_equations
    out = dict[int, tuple[Array, Array, Array]]()
    if problem.kinds.edges.present.any():
        along = found.along_strips - found.own @ found.along
        out[EDGE_ROWS_KIND] = found.own, along, found.strips_normal
    for kind, part, rows in (
        (POSE_ROWS_KIND, found.q[:, :, equations:], found.rows[:, :, equations:]),
        (
            READING_ROWS_KIND,
            _readings(problem, found.q[:, :, :equations], by_reading),
            _readings(problem, found.rows[:, :, :equations], by_reading),
        ),
    ):
        if rows.size:
            every = flat(rows)
            out[kind] = part.mT @ part, part.mT @ rows, every.mT @ every
    return out


def _readings(problem: Problem, closures: Array, by_reading: Array) -> Array:
    """Of the closures' rows (B, K, E, n) those of the readings, (B, K, m, n)."""
    return joint_rows(problem.layout, by_reading[:, :, None], closures.mT).mT


def _chi2(problem: Problem, value: Array, by_reading: Array) -> Array:
    """Sums of squares of each kind, (B, 3), of residuals (B, K, r)."""
    closures = problem.closure_rows
    readings = _readings(problem, value[..., closures, None], by_reading)[..., 0]
    parts = value[..., : closures.start], value[..., closures.stop :], readings
    return np.stack([np.sum(part**2, axis=(1, 2)) for part in parts], axis=-1)
