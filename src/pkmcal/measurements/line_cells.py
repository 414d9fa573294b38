"""Edges of a leg's side at a station gathered by their normals: near ones are shaded alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr

SHADING_CORRELATION_ANGLE = np.radians(7.0)
"""Angle between the normals of two edges of one side of a tube at one station over which their
shading ceases to be the same, by exp(-angle / SHADING_CORRELATION_ANGLE): what a surface mirrors,
and where its highlight lies, turns with it. Edges of path-traced tubes, of metal and painted, agree
by half at 5 degrees once what all have in common is taken off."""

TUBE_CORRELATION = 0.4
"""The same between edges of two tubes of a leg on one side: they see the same light, and mirror the
same, in part. Of path-traced legs of five finishes 0.2 to 0.6."""
CELLS_AN_ANGLE, CELLS_AN_ANGLE_OF_MANY, MANY_EDGES = 64, 8, 10_000
"""Cells along SHADING_CORRELATION_ANGLE, and where there are so many edges that hardly one would
have a cell of its own: those of a cell are alike to a hundredth, and to a tenth."""


@dataclass(frozen=True)
class LineCells:
    """N edges of L lines in C cells; those of one side of a leg at a station stand side by side.

    cell : (N,) of each edge, -1 where it is a line of its own. first : (sides + 1,) where the
    sides' cells begin. line : (C,). middle : (C, 3) unit normals. count : (C,) edges in each.
    """

    cell: Integers
    first: Integers
    line: Integers
    middle: Array
    count: Integers

    __repr__ = short_repr

    @classmethod
    def of(cls, normal: Array, line: Integers, side: Integers) -> LineCells:
        """The cells of edges with normals (N, 3) and lines (N,), -1 for none, which are on sides
        (L,).
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
        """Of side after side its cells, and how alike two of them err, (c, c): in their shift by
        exp(-angle / SHADING_CORRELATION_ANGLE), if on two tubes by TUBE_CORRELATION of that; in
        their tilt on one tube alone.
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
        """How many edges of its line share an edge's own shading, itself among them, (N,): the sum
        over them of how alike they err. Of n edges with the same normal each counts as one n-th,
        whatever their number; an edge that is a line of its own is alone.
        """
        many = np.ones(len(self.count) + 1)
        for own, _, similar in self.correlated_groups():
            many[own] = similar @ self.count[own]
        return many[self.cell]
