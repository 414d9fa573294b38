"""Reduced rows of the edges, shift and tilt separated, with their hat matrix.

The two residuals of an edge, in the noise of the solution, are rotated into the shift, along the
change by a shift outward, and the tilt, across it. The hat matrix of both is the part ``q q^T`` of
the configuration's own unknowns plus the part ``t t^T`` of the shared ones with ``t = F^T J``,
where J are the reduced rows and ``F F^T`` is the covariance of the shared unknowns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.covariance import Information
from pkmcal.identify.problem import Problem
from pkmcal.identify.scatter import NUMBERS_AN_EDGE
from pkmcal.solver.elimination import divisions
from pkmcal.solver.strips import Eliminated, StripLayout, eliminate_strips


@dataclass(frozen=True)
class ReducedEdges:
    """Reduced edges of some configurations of B runs: N strips of r numbers, shift and tilt of one
    edge after the other.

    problem : restricted to these configurations.
    first : number of the first configuration.
    layout : layout of the strips.
    value : (B, N, r) residuals.
    own : (B, N, d, r) rows q by the own unknowns in an orthonormal basis.
    numbers : (B, w, N, r) rows by the shared unknowns of the strips' columns.
    by_linked : (B, N, d, r) rows by the own unknowns of linked configurations, which are shared.
    eliminated : elimination of the own unknowns.
    """

    problem: Problem
    first: int
    layout: StripLayout
    value: Array
    own: Array
    numbers: Array
    by_linked: Array
    eliminated: Eliminated

    @property
    def at(self) -> tuple[Integers, Integers]:
        """Configuration (N, 1) and position (N, r / 2) of each edge; -1 for padding."""
        return _edges_at(self.layout)

    def placed(self, numbers: Array) -> Array:
        """Scatter numbers (B, N, r) to the edges' positions, (B, K', G, 2)."""
        count, places = self.problem.blocks.present.shape
        # an extra place at the end receives the padding, whose place is -1
        out = np.zeros((len(numbers), count, places + 1, NUMBERS_AN_EDGE))
        edges = numbers.shape[-1] // NUMBERS_AN_EDGE  # not -1, for there may be no configuration
        out[:, *self.at] = numbers.reshape(*numbers.shape[:2], edges, NUMBERS_AN_EDGE)
        return out[:, :, :-1]

    def shared(self, half: Array) -> Iterator[tuple[slice, Array]]:
        """Rows t = F^T J, (B, N', na, r), for each group of strips with the same columns.

        half : (B, na, na) root F of the covariance.
        """
        at = self.layout.configuration
        of_own = (self.eliminated.along @ half[:, None]).mT
        by_shared = np.pad(half, ((0, 0), (0, 1), (0, 0)))  # zero for padding columns
        linked = self.layout.linked
        for cut, columns in zip(self.layout.groups, self.layout.columns, strict=True):
            taken = by_shared[:, None, columns].mT @ self.numbers[:, :, cut].swapaxes(1, 2)
            if linked is not None:
                taken = taken + by_shared[:, linked[at[cut]]].mT @ self.by_linked[:, cut]
            yield cut, taken - of_own[:, at[cut]] @ self.own[:, cut]


def reduced_edges(info: Information) -> Iterator[ReducedEdges]:
    """Reduced edges of a solution, some configurations at a time."""
    problem, n_runs = info.problem, len(info.state.z)
    configurations, n_rows = problem.extent
    for cut in divisions(configurations, n_rows * n_runs, problem.rows_at_once):
        part, state = problem.among(cut), problem.state_among(info.state, cut)
        rows = part.compact(state)
        eliminated_part, layout = eliminate_strips(rows, np.zeros(n_runs)), rows.strips.layout
        # direction of a shift outward in each edge's residuals
        v = part.data.by_shift
        norm = np.sqrt(np.sum(v**2, axis=-1, keepdims=True))
        unit = np.where(norm > 0, v / np.where(norm > 0, norm, 1.0), [1.0, 0.0])
        numbers = _turned(rows.strips.numbers, unit[:, *_edges_at(layout)])
        # own unknowns eliminated; those of linked configurations are shared instead
        d = layout.n_own
        by_own = numbers[:, :d].swapaxes(1, 2)
        own = eliminated_part.inverse.mT[:, layout.configuration] @ by_own
        by_linked = by_own[:, :, :0]
        if layout.linked is not None:
            shares = (layout.linked[:, 0] >= 0)[layout.configuration, None, None]
            own, by_linked = np.where(shares, 0.0, own), np.where(shares, by_own, 0.0)
        yield ReducedEdges(
            part,
            cut.start,
            layout,
            numbers[:, -1],
            own,
            numbers[:, d:-1],
            by_linked,
            eliminated_part,
        )


def _edges_at(layout: StripLayout) -> tuple[Integers, Integers]:
    """Configuration and place of the edges in strips; see :attr:`ReducedEdges.at`."""
    return layout.configuration[:, None], layout.rows[:, ::NUMBERS_AN_EDGE] // NUMBERS_AN_EDGE


def _turned(numbers: Array, unit: Array) -> Array:
    """Rotate the two rows of each edge.

    numbers : (B, ..., N, n) of strips of edges.
    unit : (B, N, n / 2, 2) direction of the first of the new rows; the second is perpendicular.
    """
    first, second = numbers[..., ::NUMBERS_AN_EDGE], numbers[..., 1::NUMBERS_AN_EDGE]
    x, y = np.moveaxis(unit, -1, 0)[:, :, None]
    out = np.empty_like(numbers)
    out[..., ::NUMBERS_AN_EDGE] = x * first + y * second
    out[..., 1::NUMBERS_AN_EDGE] = x * second - y * first
    return out
