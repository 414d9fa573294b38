"""What edges scatter by: a scale, a shading and how heavy the tails are, of each of a leg's tubes.

How these are found is told in :mod:`pkmcal.identify.edge_noise`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.measurements import OWN_SHADING
from pkmcal.measurements.edges import EdgeBlocks, EdgeData

NUMBERS_AN_EDGE = 2
"""Numbers that an edge measures."""
EDGE_SCATTER_FLOOR = 1e-12
LEAST_OWN_SHADING = OWN_SHADING / 3
"""px; what a session of few edges can tell to be less."""


@dataclass(frozen=True)
class EdgeScatter:
    """The noise of the edges of a leg's T tubes (first, second, ... of all legs) in B runs.

    scale : (B, T) factor on the stated standard deviations. shading : (B, T) px, of each edge
    beside its line's; it counts where something is shaded. dof : (B, T) degrees of freedom of
    their distribution. The standard deviations are such that normal errors with them would be worth
    as much as these are. An estimate holds those of its one run, (T,) each (:meth:`of_run`).
    """

    scale: Array
    shading: Array
    dof: Array

    __repr__ = short_repr

    @classmethod
    def stated(cls, n_runs: int, n_tubes: int) -> EdgeScatter:
        """What edges are given with."""
        full = (n_runs, n_tubes)
        return cls(np.ones(full), np.full(full, OWN_SHADING), np.full(full, np.inf))

    def of_run(self, run: int) -> EdgeScatter:
        """One run's alone."""
        return EdgeScatter(self.scale[run], self.shading[run], self.dof[run])

    def batch(self) -> EdgeScatter:
        """The noise of one run as a batch; the inverse of :meth:`of_run`."""
        return EdgeScatter(self.scale[None], self.shading[None], self.dof[None])

    def irls_weight(self, blocks: EdgeBlocks, square: Array) -> Array:
        """By how much more or less each edge counts than on average, (B, K, G), where the squares
        of its whitened residuals are (B, K, G).
        """
        tails = self.dof[:, blocks.tube]  # infinite of normal ones
        return (1 + NUMBERS_AN_EDGE / tails) / (1 + square * t_variance(tails) / tails)

    def squares(self, blocks: EdgeBlocks, rows: Array) -> Array:
        """Squares (B, K, G) of the edges' rows (B, K, r) in use, trust included, as large as those
        of normal errors.
        """
        pairs = rows.reshape(*rows.shape[:2], -1, NUMBERS_AN_EDGE)
        return np.sum(pairs**2, axis=-1) * t_variance(self.dof)[:, blocks.tube]

    def factor(self, blocks: EdgeBlocks, data: EdgeData, weight: Array) -> Array:
        """What edges with weights (B, K, G) scatter by on average, in times of what they are stated
        with, (B,); 1 of none.
        """
        size = shift_squares(blocks, data)
        scale, shading = (part[:, blocks.tube] for part in (self.scale, self.shading))
        along = (scale**2 + shading**2 * size) / (1 + OWN_SHADING**2 * size)
        square = np.sum(weight * (along + scale**2) / 2, axis=(1, 2))
        count = np.sum(weight, axis=(1, 2))
        return np.sqrt(np.where(count > 0, square / np.maximum(count, EDGE_SCATTER_FLOOR), 1.0))

    def close_to(self, other: EdgeScatter, share: float) -> bool:
        """Whether its deviations are another's up to a share, those of shading up to one of what is
        usual, and its tails the same.
        """
        scale = np.abs(self.scale / other.scale - 1).max(initial=0.0)
        usual = np.maximum(other.shading, OWN_SHADING)
        shading = (np.abs(self.shading - other.shading) / usual).max(initial=0.0)
        return max(scale, shading) < share and bool(np.all(self.dof == other.dof))

    def beyond(self, before: EdgeScatter, pace: float) -> EdgeScatter:
        """Deviations as many times as far from another's, with these tails."""
        scale = before.scale * (self.scale / before.scale) ** pace
        shading = before.shading * (self.shading / before.shading) ** pace
        return replace(self, scale=scale, shading=np.maximum(shading, LEAST_OWN_SHADING))

    def applied(self, blocks: EdgeBlocks, data: EdgeData) -> EdgeData:
        """The edges with this noise."""
        own = np.hypot(self.shading[:, blocks.tube] * np.sqrt(blocks.n_effective), blocks.alone)
        return replace(data, scale=self.scale[:, blocks.tube], own=own)


def shift_squares(blocks: EdgeBlocks, data: EdgeData) -> Array:
    """Squares of what a pixel outward does to the edges, in the noise as it was stated, (B or 1,
    K, G); none where nothing is shaded.
    """
    return np.where(blocks.n_effective > 0, np.sum(data.by_shift**2, axis=-1), 0.0)


def t_variance(tails: Array) -> Array:
    """The variance of normal errors that tell as much as those of Student's distribution of pairs,
    over the square of its scale.
    """
    return 1 + 2 / (tails + NUMBERS_AN_EDGE)
