"""Reduced rows of each kind, and their sums over all configurations.

The sums are formed in one pass, in which the rows are evaluated, reduced and discarded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.problem import Problem
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements.readings import joint_rows
from pkmcal.solver.elimination import flat
from pkmcal.solver.strips import Compact, Eliminated, eliminate_strips

EDGE_ROWS, POSE_ROWS, LINK_ROWS, READING_ROWS = range(4)
"""Kinds of rows: the groups in the order of :class:`~pkmcal.measurements.rows.RowGroups`, then the
readings."""
ROW_GROUPS = 4
"""Number of kinds of rows, the length of the axes of :class:`RowSums`."""


class RowSums(NamedTuple):
    """Sums over the configurations c of B runs, by kind k of rows, numbered as
    :data:`EDGE_ROWS`.

    Q_k and A_k are the rows of kind k in Q of a configuration's own Jacobian, and in its reduced
    rows A.

    trace : (B, 4) sum_c tr Q_k^T Q_k.
    normal : (B, 4, na, na) sum_c A_k^T A_k.
    every : (B, na, na) sum_c A^T A of all rows, including those of no kind, such as the closures of
    rods of constant length.
    chi2 : (B, 4) sums of squared residuals.
    value : (B, K, r) residuals, zero for padding and where nothing can be predicted.
    """

    trace: Array
    normal: Array
    every: Array
    chi2: Array
    value: Array


class GroupRows(NamedTuple):
    """Rows of one kind, n in each of K configurations of B runs; zero for padding and where nothing
    can be predicted.

    own : (B, K, n, d) in the orthonormal basis Q of the configuration's own Jacobian.
    shared : (B, K, n, na) reduced rows.
    value : (B, K, n) residuals.
    """

    own: Array
    shared: Array
    value: Array


def row_sums(problem: Problem, state: BatchState) -> RowSums:
    """Sums of a problem's rows at a state."""
    n_runs, na = len(state.z), problem.unknowns.count
    trace, normal = np.zeros((n_runs, ROW_GROUPS)), np.zeros((n_runs, ROW_GROUPS, na, na))
    every, chi2 = np.zeros((n_runs, na, na)), np.zeros((n_runs, ROW_GROUPS))
    values: list[Array] = []
    for cut in problem.cuts:
        part, at = problem.among(cut), problem.state_among(state, cut)
        rows, by_reading = part.compact(at), part.closure(at).by_reading
        eliminated_part = eliminate_strips(rows, np.zeros(n_runs))
        values.append(rows.value)
        every += eliminated_part.strips_normal + eliminated_part.rows_normal
        if part.row_groups.edges.present.any():
            trace[:, EDGE_ROWS] += np.einsum("bcii->b", eliminated_part.own)
            normal[:, EDGE_ROWS] += eliminated_part.strips_normal
        for kind in range(POSE_ROWS, ROW_GROUPS):
            own, shared, _ = _rows_of_kind(part, rows, eliminated_part, by_reading, kind)
            if shared.size:
                trace[:, kind] += np.sum(own**2, axis=(1, 2, 3))
                normal[:, kind] += flat(shared).mT @ flat(shared)
        chi2 += _chi2(part, rows.value, by_reading)
    return RowSums(trace, normal, every, chi2, np.concatenate(values, axis=1))


def group_rows(problem: Problem, state: BatchState, kind: int) -> GroupRows:
    """Rows of poses, readings or links at a state."""
    parts: list[GroupRows] = []
    for cut in problem.cuts:
        part, at = problem.among(cut), problem.state_among(state, cut)
        rows, by_reading = part.compact(at), part.closure(at).by_reading
        eliminated_part = eliminate_strips(rows, np.zeros(len(state.z)))
        parts.append(_rows_of_kind(part, rows, eliminated_part, by_reading, kind))
    return GroupRows(*(np.concatenate(part, axis=1) for part in zip(*parts, strict=True)))


def _rows_of_kind(
    problem: Problem, rows: Compact, eliminated_part: Eliminated, by_reading: Array, kind: int
) -> GroupRows:
    """Rows of poses, readings or links in some configurations.

    by_reading : (B, K, E) derivatives of the closures by the readings.
    """
    equations, start = problem.layout.n_equations, problem.closure_rows.start
    parts = eliminated_part.q, eliminated_part.rows, rows.value[:, :, start:, None]
    if kind == READING_ROWS:
        own, shared, value = (
            _readings(problem, part[:, :, :equations], by_reading) for part in parts
        )
    else:
        at = problem.row_groups[kind].rows
        own, shared, value = (part[:, :, at.start - start : at.stop - start] for part in parts)
    return GroupRows(own, shared, value[..., 0])


def _readings(problem: Problem, closures: Array, by_reading: Array) -> Array:
    """Rows (B, K, m, n) of the readings among the closures' rows (B, K, E, n)."""
    return joint_rows(problem.layout, by_reading[:, :, None], closures.mT).mT


def _chi2(problem: Problem, value: Array, by_reading: Array) -> Array:
    """Sums of squares (B, 4) of residuals (B, K, r), by kind."""
    closures = problem.closure_rows
    readings = _readings(problem, value[..., closures, None], by_reading)[..., 0]
    parts = *(value[..., group.rows] for group in problem.row_groups), readings
    return np.stack([np.sum(part**2, axis=(1, 2)) for part in parts], axis=-1)
