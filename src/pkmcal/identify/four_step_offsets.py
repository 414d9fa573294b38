"""[A] 3.4, step 3 of four: offsets of the readings and constant lengths.

The platform is rigid, so the distances between its joints do not change:
``B = A + (q + q0) u`` ([A] 13) for each leg with a length, q = 0 and q0 the length where it is
constant. Passive legs take no part.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import dot
from pkmcal.identify.four_step_axes import Axes
from pkmcal.identify.registration import SCALE, minimise_dense

COLLAPSED = 0.5
"""A constant length below this part of its drawing is the false minimum B = A."""


def offsets(axes: Axes, a_photo: Array, start: Array, form: str) -> Array:
    """Step 3, [A] 13-14: offsets (B, L) that keep the distances between platform joints.

    printed: differences of consecutive photographs, C_2 as [A] 14 has it. corrected (errata):
    deviations from each pair's mean, sum (d_k - mean d)^2.
    axes : only legs with a length in ``seen``. a_photo : (B, C, L, 3) base centres in each
    photograph's frame. start : (L,) m, the drawing's: a length of zero is a false minimum.
    """
    rows = _Distances(axes, a_photo, form).rows
    return minimise_dense(rows, np.broadcast_to(start, (len(a_photo), len(start))).copy()).state


def deviations(axes: Axes, a_photo: Array, at: Array, form: str) -> tuple[Array, Array]:
    """The criterion's rows (B, r) m at offsets (B, L), and their derivatives (B, r, L)."""
    value, jac = _Distances(axes, a_photo, form).rows(at, np.arange(len(at)))
    return value * SCALE, jac * SCALE


class _Distances:
    """The criterion's rows for a batch of runs."""

    def __init__(self, axes: Axes, a_photo: Array, form: str) -> None:
        self.u = axes.u
        self.fixed = a_photo + axes.readings[..., None] * axes.u
        j, g = np.triu_indices(axes.seen.shape[1], 1)
        both = axes.seen[:, j] & axes.seen[:, g]
        used = np.flatnonzero(both.sum(axis=0) > 1)
        self.j, self.g, both = j[used], g[used], both[:, used]
        self.mix = _consecutive(axes, both) if form == "printed" else _deviations(both)

    def rows(self, x: Array, runs: Integers) -> tuple[Array, Array]:
        """Values and Jacobian for offsets x (b, L) of some runs."""
        u = self.u[runs]
        b = self.fixed[runs] + x[:, None, :, None] * u
        d = b[:, :, self.j] - b[:, :, self.g]
        distance = np.sqrt(np.maximum(dot(d, d), 1e-300))
        e = d / distance[..., None]
        jac = np.zeros((*distance.shape, x.shape[-1]))
        pair = np.arange(len(self.j))
        jac[:, :, pair, self.j] = dot(e, u[:, :, self.j])
        jac[:, :, pair, self.g] = -dot(e, u[:, :, self.g])
        value = np.einsum("pkc,bcp->bkp", self.mix, distance)
        jac = np.einsum("pkc,bcpl->bkpl", self.mix, jac, optimize=True)
        n = value.shape[1] * value.shape[2]
        return value.reshape(len(x), n) / SCALE, jac.reshape(len(x), n, -1) / SCALE


def _deviations(both: Booleans) -> Array:
    """Matrices (pairs, C, C) that take each pair's mean off its distances."""
    w = both.T.astype(float)
    mean = w[:, :, None] * w[:, None, :] / np.maximum(w.sum(axis=1), 1)[:, None, None]
    return np.eye(both.shape[0]) * w[:, :, None] - mean


def _consecutive(axes: Axes, both: Booleans) -> Array:
    """Matrices (pairs, C - 1, C) of differences between consecutive photographs of a station."""
    n = both.shape[0]
    step = np.eye(n, k=1)[:-1] - np.eye(n)[:-1]
    use = (both[1:] & both[:-1]).T * (axes.station[1:] == axes.station[:-1])
    return step * use[:, :, None]
