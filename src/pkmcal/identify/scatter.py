"""What edges scatter by: a scale, a shading and how heavy the tails are, of each of a leg's tubes.

How these are found is told in :mod:`pkmcal.identify.edge_noise`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.identify.rows import EdgeBlocks, EdgeData
from pkmcal.measurements import OWN_SHADING, SHADING_SIGMA, EdgeSet

NUMBERS_AN_EDGE = 2
"""Numbers that an edge measures."""
EDGE_SCATTER_FLOOR = 1e-12


@dataclass(frozen=True)
class EdgeScatter:
    """The noise of the edges of a leg's T tubes (first, second, ... of all legs) in B runs.

    scale : (B, T) factor on the stated standard deviations. shading : (B, T) px, of each edge's
    shift outward beside its line's, and tilt : (B, T) px, by which its halves go apart, each as
    far; they count where something is shaded. tails : (B, T) degrees of freedom of their
    distribution. The standard deviations are such that normal errors with them would be worth as
    much as these are. An estimate holds those of its one run, (T,) each (:meth:`of_run`).
    """

    scale: Array
    shading: Array
    tilt: Array
    tails: Array

    __repr__ = short_repr

    @classmethod
    def stated(cls, n_runs: int, n_tubes: int) -> EdgeScatter:
        """What edges are given with."""
        ones = np.ones((n_runs, n_tubes))
        return cls(ones, OWN_SHADING * ones, 0 * ones, np.inf * ones)

    @property
    def parts(self) -> tuple[Array, Array, Array, Array]:
        """All four, in their order."""
        return self.scale, self.shading, self.tilt, self.tails

    def of_run(self, run: int) -> EdgeScatter:
        """One run's alone."""
        return EdgeScatter(*(part[run] for part in self.parts))

    def covariance(self, edges: EdgeSet) -> Array:
        """The covariances (N, 2, 2) of edges with this noise of one run, but for what shifts them
        beside their line.
        """
        root = np.linalg.cholesky(edges.covariance)
        v = np.linalg.solve(root, edges.shift[..., None])
        square = np.sum(v**2, axis=(-2, -1))
        shift, tilt = self.scale[edges.tube] ** 2, self._of_tilt(edges.tube, square) ** 2
        along = ((shift - tilt) / np.where(square > 0, square, 1.0))[:, None, None] * v @ v.mT
        return root @ (tilt[:, None, None] * np.eye(2) + along) @ root.mT

    def _of_tilt(self, tube: Integers, square: Array) -> Array:
        """Factors on the stated deviations of edges' tilts, where a pixel of shift is of the
        square; of the tubes (...) of all runs.
        """
        return np.sqrt(self.scale[..., tube] ** 2 + self.tilt[..., tube] ** 2 * square)

    def trust(self, blocks: EdgeBlocks, square: Array) -> Array:
        """By how much more or less each edge counts than on average, (B, K, G), where the squares
        of its whitened residuals are (B, K, G).
        """
        tails = self.tails[:, blocks.tube]
        return (tails + NUMBERS_AN_EDGE) / (tails + square * worth(tails))

    def squares(self, blocks: EdgeBlocks, rows: Array) -> Array:
        """Squares (B, K, G) of the edges' rows (B, K, r) in use, trust included, as large as those
        of normal errors.
        """
        pairs = rows.reshape(*rows.shape[:2], -1, NUMBERS_AN_EDGE)
        return np.sum(pairs**2, axis=-1) * worth(self.tails)[:, blocks.tube]

    def factor(self, blocks: EdgeBlocks, data: EdgeData, weight: Array) -> Array:
        """What edges with weights (B, K, G) scatter by on average, in times of what they are stated
        with, (B,); 1 of none.
        """
        size = shift_squares(blocks, data)
        scale, shading = (part[:, blocks.tube] for part in (self.scale, self.shading))
        along = (scale**2 + shading**2 * size) / (1 + OWN_SHADING**2 * size)
        square = np.sum(weight * (along + self._of_tilt(blocks.tube, size) ** 2) / 2, axis=(1, 2))
        count = np.sum(weight, axis=(1, 2))
        return np.sqrt(np.where(count > 0, square / np.maximum(count, EDGE_SCATTER_FLOOR), 1.0))

    def close_to(self, other: EdgeScatter, share: float) -> bool:
        """Whether its deviations are another's up to a share, and its tails the same."""
        pairs = zip(self.parts[:-1], other.parts[:-1], strict=True)
        change = [
            (np.abs(new - old) / np.maximum(old, EDGE_SCATTER_FLOOR)).max(initial=0.0)
            for new, old in pairs
        ]
        return max(change) < share and bool(np.all(self.tails == other.tails))

    def beyond(self, before: EdgeScatter, pace: float) -> EdgeScatter:
        """Deviations as many times as far from another's, with these tails."""
        pairs = zip(self.parts[:-1], before.parts[:-1], strict=True)
        least = 0.0, OWN_SHADING, 0.0
        further = (
            np.maximum(old * (new / np.maximum(old, EDGE_SCATTER_FLOOR)) ** pace, floor)
            for (new, old), floor in zip(pairs, least, strict=True)
        )
        return EdgeScatter(*further, self.tails)

    def applied(self, blocks: EdgeBlocks, data: EdgeData) -> EdgeData:
        """The edges with this noise."""
        alone = np.where(blocks.line < 0, SHADING_SIGMA, 0.0) if blocks.line.size else 0.0
        own = np.hypot(self.shading[:, blocks.tube] * np.sqrt(blocks.crowd), alone)
        tilt = self._of_tilt(blocks.tube, shift_squares(blocks, data))
        return replace(data, scale=np.stack([self.scale[:, blocks.tube], tilt], axis=-1), own=own)


def shift_squares(blocks: EdgeBlocks, data: EdgeData) -> Array:
    """Squares of what a pixel outward does to the edges, in the noise as it was stated, (B or 1,
    K, G); none where nothing is shaded.
    """
    return np.where(blocks.crowd > 0, np.sum(data.by_shift**2, axis=-1), 0.0)


def worth(tails: Array) -> Array:
    """The variance of normal errors that tell as much as those of Student's distribution of pairs,
    over the square of its scale.
    """
    return 1 + 2 / (tails + NUMBERS_AN_EDGE)
