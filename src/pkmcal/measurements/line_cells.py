"""Edges of one side of a leg at one station, grouped into cells of similar normals.

Edges with similar normals are shaded in the same way, so their errors are correlated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr

SHADING_CORRELATION_ANGLE = np.radians(7.0)
"""Correlation angle of shading, rad: errors of edges of one side of a tube at one station have the
correlation exp(-angle / SHADING_CORRELATION_ANGLE) with the angle between their normals, since a
mirrored image or a highlight moves with the normal. On path-traced tubes, metal and painted, the
correlation is one half at 5 degrees once the mean of all edges is removed."""

TUBE_CORRELATION = 0.4
"""Factor on that correlation between edges of two tubes of a leg on one side, which are lit by and
mirror the same surroundings in part: 0.2 to 0.6 on path-traced legs of five finishes."""
CELLS_AN_ANGLE, CELLS_AN_ANGLE_OF_MANY, MANY_EDGES = 64, 8, 10_000
"""Number of cells per SHADING_CORRELATION_ANGLE, the same for many edges, and the number of edges
from which the second value applies. The correlation between edges of one cell is 1 to within 0.01,
or 0.1."""


@dataclass(frozen=True)
class LineCells:
    """N edges of L lines in C cells; the cells of one side of a leg at a station are contiguous.

    cell : (N,) cell of each edge, -1 for an edge that is a line of its own.
    first : (sides + 1,) first cell of each side, and C.
    line : (C,) line of each cell.
    middle : (C, 3) mean normal of each cell, a unit vector.
    count : (C,) number of edges in each cell.
    """

    cell: Integers
    first: Integers
    line: Integers
    middle: Array
    count: Integers

    __repr__ = short_repr

    @classmethod
    def of(cls, normal: Array, line: Integers, side: Integers) -> LineCells:
        """Group edges into cells.

        normal : (N, 3) unit normals.
        line : (N,) line of each edge, -1 for none.
        side : (L,) side of each line.
        """
        mine = line >= 0
        fine = CELLS_AN_ANGLE if len(line) < MANY_EDGES else CELLS_AN_ANGLE_OF_MANY
        place = np.round(fine * normal / SHADING_CORRELATION_ANGLE).astype(int)
        keys = np.column_stack([side[line[mine]], line[mine], place[mine]])
        keys, at = np.unique(keys, axis=0, return_inverse=True)
        at = at.reshape(-1)
        count = np.bincount(at, minlength=len(keys))
        middle = np.stack([np.bincount(at, n, len(keys)) for n in normal[mine].T], axis=-1)
        middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
        first = np.searchsorted(keys[:, 0], np.arange(side.max(initial=-1) + 2))
        cell = np.full(len(line), -1)
        cell[mine] = at
        return cls(cell, first, keys[:, 1], middle, count)

    def correlated_groups(self) -> Iterator[tuple[slice, Array, Array]]:
        """Cells of each side, with the correlations (c, c) of the shifts and of the tilts.

        Shifts of two edges are correlated by exp(-angle / SHADING_CORRELATION_ANGLE), times
        TUBE_CORRELATION if on two tubes; tilts only on the same tube.
        """
        for start, end in zip(self.first[:-1], self.first[1:], strict=True):
            own = slice(int(start), int(end))
            angle = np.arccos(np.clip(self.middle[own] @ self.middle[own].T, -1, 1))
            np.fill_diagonal(angle, 0.0)  # which rounding leaves at 1e-8
            near = np.exp(-angle / SHADING_CORRELATION_ANGLE)
            same = self.line[own, None] == self.line[own]
            yield own, near * np.where(same, 1.0, TUBE_CORRELATION), np.where(same, near, 0.0)

    @property
    def n_effective(self) -> Array:
        """Number of edges (N,) that share an edge's own shading: the sum of its correlations with
        all edges of its line, itself included.

        Each of n edges with the same normal counts 1/n, so that their total weight is that of one
        edge; the value is 1 for an edge that is a line of its own.
        """
        many = np.ones(len(self.count) + 1)
        for own, _, similar in self.correlated_groups():
            many[own] = similar @ self.count[own]
        return many[self.cell]
