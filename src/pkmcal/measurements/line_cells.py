"""Cells of edges with nearly the same normal, whose shading is correlated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr

SHADING_CORRELATION_ANGLE = np.radians(7.0)
"""Correlation angle of the shading of edges of one side of a tube at one station: the correlation
is exp(-angle / SHADING_CORRELATION_ANGLE), for mirror images and highlights turn with the surface.
Edges of path-traced tubes, of metal and painted, are correlated by half at 5 degrees once their
mean is subtracted."""

TUBE_CORRELATION = 0.4
"""Correlation between the shading of two tubes of a leg on one side: they are lit and mirror alike,
in part. 0.2 to 0.6 for path-traced legs of five finishes."""
CELLS_AN_ANGLE, CELLS_AN_ANGLE_OF_MANY, MANY_EDGES = 64, 8, 10_000
"""Cells along SHADING_CORRELATION_ANGLE, and the coarser ones for many edges: normals of a cell
agree to a hundredth of the angle, and to a tenth."""


@dataclass(frozen=True)
class LineCells:
    """N edges of L lines in C cells; the cells of one side of a leg at a station are contiguous.

    cell : (N,) of each edge, -1 where it is a line of its own. first : (sides + 1,) first cell of
    each side. line : (C,). middle : (C, 3) unit normals. count : (C,) edges in each.
    """

    cell: Integers
    first: Integers
    line: Integers
    middle: Array
    count: Integers

    __repr__ = short_repr

    @classmethod
    def of(cls, normal: Array, line: Integers, side: Integers) -> LineCells:
        """Cells of edges with normals (N, 3) and lines (N,), -1 for none; side : (L,) of lines."""
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
        """Cells of each side, with the correlations (c, c) of their shifts and of their tilts: of
        shifts exp(-angle / SHADING_CORRELATION_ANGLE), times TUBE_CORRELATION between two tubes; of
        tilts the same on one tube, zero between tubes.
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
        """Number of edges of its line that share an edge's own shading, itself included, (N,): the
        sum of their correlations. Each of n edges with the same normal counts as one n-th; the
        number is one for an edge that is a line of its own.
        """
        many = np.ones(len(self.count) + 1)
        for own, _, similar in self.correlated_groups():
            many[own] = similar @ self.count[own]
        return many[self.cell]
