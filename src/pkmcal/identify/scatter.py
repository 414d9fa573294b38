"""Noise of edges: scale, shading and degrees of freedom for each of a leg's tubes.

Estimated in :mod:`pkmcal.identify.edge_noise`.
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
"""Lower bound of an edge's own shading, px: a session of few edges cannot exclude it."""


@dataclass(frozen=True)
class EdgeScatter:
    """Noise of the edges of a leg's T tubes (first, second, ... of all legs) in B runs.

    scale : (B, T) factor on the stated standard deviations.
    shading : (B, T) px, shading of each edge in addition to its line's; used where edges are
        shaded.
    dof : (B, T) degrees of freedom of Student's distribution.

    The standard deviations are those of normal errors with the same information. An estimate holds
    the noise of its single run, (T,) each (:meth:`of_run`).
    """

    scale: Array
    shading: Array
    dof: Array

    __repr__ = short_repr

    @classmethod
    def stated(cls, n_runs: int, n_tubes: int) -> EdgeScatter:
        """Noise as stated: scale 1, usual shading, normal distribution."""
        full = (n_runs, n_tubes)
        return cls(np.ones(full), np.full(full, OWN_SHADING), np.full(full, np.inf))

    def of_run(self, run: int) -> EdgeScatter:
        """Noise of one run, (T,) each."""
        return EdgeScatter(self.scale[run], self.shading[run], self.dof[run])

    def batch(self) -> EdgeScatter:
        """The noise of one run as a batch; the inverse of :meth:`of_run`."""
        return EdgeScatter(self.scale[None], self.shading[None], self.dof[None])

    def irls_weight(self, blocks: EdgeBlocks, square: Array) -> Array:
        """IRLS weight (B, K, G) of each edge, one on average.

        square : (B, K, G) squares of the whitened residuals.
        """
        tails = self.dof[:, blocks.tube]  # infinite for normal errors
        return (1 + NUMBERS_AN_EDGE / tails) / (1 + square * t_variance(tails) / tails)

    def squares(self, blocks: EdgeBlocks, rows: Array) -> Array:
        """Squared residuals (B, K, G) of the edges in use, with their weights, scaled to those of
        normal errors.

        rows : (B, K, r) whitened rows of the edges.
        """
        pairs = rows.reshape(*rows.shape[:2], -1, NUMBERS_AN_EDGE)
        return np.sum(pairs**2, axis=-1) * t_variance(self.dof)[:, blocks.tube]

    def factor(self, blocks: EdgeBlocks, data: EdgeData, weight: Array) -> Array:
        """Scatter (B,) of the edges relative to their stated noise, root mean square; 1 without
        edges.

        weight : (B, K, G) of the edges.
        """
        size = shift_squares(blocks, data)
        scale, shading = (part[:, blocks.tube] for part in (self.scale, self.shading))
        along = (scale**2 + shading**2 * size) / (1 + OWN_SHADING**2 * size)
        square = np.sum(weight * (along + scale**2) / 2, axis=(1, 2))
        count = np.sum(weight, axis=(1, 2))
        return np.sqrt(np.where(count > 0, square / np.maximum(count, EDGE_SCATTER_FLOOR), 1.0))

    def close_to(self, other: EdgeScatter, share: float) -> bool:
        """Whether standard deviations agree up to a relative difference, and degrees of freedom are
        equal.

        share : largest difference, relative for the scale, and relative to the usual value or the
            larger one of ``other`` for the shading.
        """
        scale = np.abs(self.scale / other.scale - 1).max(initial=0.0)
        usual = np.maximum(other.shading, OWN_SHADING)
        shading = (np.abs(self.shading - other.shading) / usual).max(initial=0.0)
        return max(scale, shading) < share and bool(np.all(self.dof == other.dof))

    def beyond(self, before: EdgeScatter, pace: float) -> EdgeScatter:
        """Extrapolate the standard deviations from those of ``before`` by the factor ``pace``,
        geometrically.
        """
        scale = before.scale * (self.scale / before.scale) ** pace
        shading = before.shading * (self.shading / before.shading) ** pace
        return replace(self, scale=scale, shading=np.maximum(shading, LEAST_OWN_SHADING))

    def applied(self, blocks: EdgeBlocks, data: EdgeData) -> EdgeData:
        """Edge data with this noise."""
        own = np.hypot(self.shading[:, blocks.tube] * np.sqrt(blocks.n_effective), blocks.alone)
        return replace(data, scale=self.scale[:, blocks.tube], own=own)


def shift_squares(blocks: EdgeBlocks, data: EdgeData) -> Array:
    """Squared effect of a shift by one pixel outward on the edges, in stated noise, (B or 1, K, G);
    zero for edges without shading.
    """
    return np.where(blocks.n_effective > 0, np.sum(data.by_shift**2, axis=-1), 0.0)


def t_variance(tails: Array) -> Array:
    """Variance of normal errors with the same information as Student's distribution of pairs with
    unit scale.
    """
    return 1 + 2 / (tails + NUMBERS_AN_EDGE)
