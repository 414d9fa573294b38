"""Information of the rows of each kind, with the own unknowns of configurations eliminated.

Sums over all configurations, found in one pass in which the rows themselves are written, reduced
and forgotten.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements.readings import joint_rows
from pkmcal.solver.elimination import divisions, flat
from pkmcal.solver.strips import Compact, Eliminated, eliminated

EDGE_ROWS_KIND, POSE_ROWS_KIND, READING_ROWS_KIND, LINK_ROWS_KIND = range(4)
ROWS_KINDS = 4
"""Kinds of rows in the axes of :class:`KindSums`."""


class KindSums(NamedTuple):
    """Sums over the configurations c of B runs; kinds k of rows as :data:`EDGE_ROWS_KIND`.

    With Q of the own Jacobian in a configuration and its reduced rows A, Q_k and A_k those of a
    kind: trace sum_c tr Q_k^T Q_k (B, 4), normal sum_c A_k^T A_k (B, 4, na, na). every : sum_c A^T
    A (B, na, na) of all rows, those that are of no kind, as of rods of constant length, among them.
    chi2 : (B, 4). value : (B, K, r) residuals, zero where nothing can be predicted or is there.
    """

    trace: Array
    normal: Array
    every: Array
    chi2: Array
    value: Array


class KindRows(NamedTuple):
    """Rows of one kind in K configurations of B runs, n of each: own (B, K, n, d) of the
    orthonormal basis of the configuration's own Jacobian, shared (B, K, n, na) reduced, and their
    residuals (B, K, n); zero where nothing can be predicted or is there.
    """

    own: Array
    shared: Array
    value: Array


def kind_sums(problem: Problem, state: BatchState) -> KindSums:
    """Sums over the rows of a problem at a state."""
    n_runs, na = len(state.z), problem.unknowns.count
    trace, normal = np.zeros((n_runs, ROWS_KINDS)), np.zeros((n_runs, ROWS_KINDS, na, na))
    every, chi2 = np.zeros((n_runs, na, na)), np.zeros((n_runs, ROWS_KINDS))
    values: list[Array] = []
    for cut in divisions(*problem.extent):
        part, at = problem.among(cut), problem.state_among(state, cut)
        rows, by_reading = part.compact(at), part.closure(at).by_reading
        eliminated_part = eliminated(rows, np.zeros(n_runs))
        values.append(rows.value)
        every += eliminated_part.strips_normal + eliminated_part.rows_normal
        if part.kinds.edges.present.any():
            trace[:, EDGE_ROWS_KIND] += np.einsum("bcii->b", eliminated_part.own)
            normal[:, EDGE_ROWS_KIND] += eliminated_part.strips_normal
        for kind in (POSE_ROWS_KIND, READING_ROWS_KIND, LINK_ROWS_KIND):
            own, shared, _ = _rows_of_kind(part, rows, eliminated_part, by_reading, kind)
            if shared.size:
                trace[:, kind] += np.sum(own**2, axis=(1, 2, 3))
                normal[:, kind] += flat(shared).mT @ flat(shared)
        chi2 += _chi2(part, rows.value, by_reading)
    return KindSums(trace, normal, every, chi2, np.concatenate(values, axis=1))


def kind_rows(problem: Problem, state: BatchState, kind: int) -> KindRows:
    """The rows of poses, readings or links at a state."""
    parts: list[KindRows] = []
    for cut in divisions(*problem.extent):
        part, at = problem.among(cut), problem.state_among(state, cut)
        rows, by_reading = part.compact(at), part.closure(at).by_reading
        eliminated_part = eliminated(rows, np.zeros(len(state.z)))
        parts.append(_rows_of_kind(part, rows, eliminated_part, by_reading, kind))
    return KindRows(*(np.concatenate(part, axis=1) for part in zip(*parts, strict=True)))


def _rows_of_kind(
    problem: Problem, rows: Compact, eliminated_part: Eliminated, by_reading: Array, kind: int
) -> KindRows:
    """The rows of poses, readings or links in some configurations; by_reading (B, K, E)."""
    equations, start = problem.layout.n_equations, problem.closure_rows.start
    parts = eliminated_part.q, eliminated_part.rows, rows.value[:, :, start:, None]
    if kind in (POSE_ROWS_KIND, LINK_ROWS_KIND):
        last = problem.kinds.links.rows.start - start
        cut = slice(equations, last) if kind == POSE_ROWS_KIND else slice(last, None)
        own, shared, value = (part[:, :, cut] for part in parts)
    else:
        own, shared, value = (
            _readings(problem, part[:, :, :equations], by_reading) for part in parts
        )
    return KindRows(own, shared, value[..., 0])


def _readings(problem: Problem, closures: Array, by_reading: Array) -> Array:
    """Rows of the readings (B, K, m, n) from those of the closures (B, K, E, n)."""
    return joint_rows(problem.layout, by_reading[:, :, None], closures.mT).mT


def _chi2(problem: Problem, value: Array, by_reading: Array) -> Array:
    """Sums of squares of each kind, (B, 4), of residuals (B, K, r)."""
    closures = problem.closure_rows
    readings = _readings(problem, value[..., closures, None], by_reading)[..., 0]
    poses, links = (value[..., kind.rows] for kind in problem.kinds[1:])
    parts = value[..., : closures.start], poses, readings, links
    return np.stack([np.sum(part**2, axis=(1, 2)) for part in parts], axis=-1)
