"""Edges of a line gathered by their normals: near ones are shaded alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.measurements import SHADING_ALIKE_ANGLE

CELLS_AN_ANGLE, CELLS_AN_ANGLE_OF_MANY, MANY_EDGES = 64, 8, 10_000
"""Cells along SHADING_ALIKE_ANGLE, and where there are so many edges that hardly one would have a
cell of its own: those of a cell are alike to a hundredth, and to a tenth."""


@dataclass(frozen=True)
class LineCells:
    """N edges of L lines in C cells; those of a line stand side by side.

    cell : (N,) of each edge, -1 where it is a line of its own. first : (L + 1,) where the lines'
    cells begin. middle : (C, 3) unit normals. count : (C,) edges in each.
    """

    cell: Integers
    first: Integers
    middle: Array
    count: Integers

    __repr__ = short_repr

    @classmethod
    def of(cls, normal: Array, line: Integers) -> LineCells:
        """The cells of edges with normals (N, 3) and lines (N,), -1 for none."""
        fine = CELLS_AN_ANGLE if len(line) < MANY_EDGES else CELLS_AN_ANGLE_OF_MANY
        place = np.round(fine * normal / SHADING_ALIKE_ANGLE).astype(int)
        mine = line >= 0
        keys, at = np.unique(np.column_stack([line, place])[mine], axis=0, return_inverse=True)
        at = at.reshape(-1)
        count = np.bincount(at, minlength=len(keys))
        middle = np.stack([np.bincount(at, n, len(keys)) for n in normal[mine].T], axis=-1)
        middle = middle / np.linalg.norm(middle, axis=-1, keepdims=True)
        first = np.searchsorted(keys[:, 0], np.arange(line.max(initial=-1) + 2))
        cell = np.full(len(line), -1)
        cell[mine] = at
        return cls(cell, first, middle, count)

    def alike(self) -> Iterator[tuple[slice, Array]]:
        """Of line after line its cells, and how alike the edges of two of them are shaded, (c, c):
        exp(-angle / SHADING_ALIKE_ANGLE).
        """
        for start, end in zip(self.first[:-1], self.first[1:], strict=True):
            own = slice(int(start), int(end))
            angle = np.arccos(np.clip(self.middle[own] @ self.middle[own].T, -1, 1))
            np.fill_diagonal(angle, 0.0)  # which rounding leaves at 1e-8
            yield own, np.exp(-angle / SHADING_ALIKE_ANGLE)

    @property
    def crowd(self) -> Array:
        """How many edges of its line share an edge's own shading, itself among them, (N,): the sum
        over them of what :meth:`alike` says. Of n edges with the same normal each counts as one
        n-th, whatever their number; an edge that is a line of its own is alone.
        """
        many = np.ones(len(self.count) + 1)
        for own, alike in self.alike():
            many[own] = alike @ self.count[own]
        return many[self.cell]
