"""Innovation test: whether a rejected pose agrees with the estimate from the other measurements.

The configuration of a pose without weight follows the readings, and the pose differs from its
prediction by the errors of the readings. Where readings are coarse, this difference is many
standard deviations of the pose's own noise, although the pose is right. A pose that was rejected
before the solution was reached, or because the readings' noise was stated too small, would then
stay rejected. So a rejected pose is tested by its innovation. With A the unweighted rows of the
pose, r their residuals, and C the covariance of all unknowns from the other measurements and the
prior,

    d^2 = r^T (s^2 I + A C A^T)^-1 r,      s the noise scale of the poses.

C covers a configuration's own unknowns and the shared ones. With Q R the Jacobian by the own
unknowns, W = Q^T J with J the Jacobian by the shared unknowns, and F F^T the covariance of the
shared unknowns,

    A C A^T = A_own R^-1 R^-T A_own^T + G F F^T G^T,      G = A_shared - A_own R^-1 W.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.covariance import Information
from pkmcal.identify.robust import as_pairs
from pkmcal.measurements.rows import RowGroups
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.solver.strips import eliminate_strips


def innovations(info: Information, distance: Array, weight: Array, scale: Array) -> Array:
    """Norms (B, K, G) of the poses; those of rejected poses relative to the covariance of their
    innovations.

    All norms are converted to those of pairs of numbers (:func:`~pkmcal.identify.robust.as_pairs`).

    info : a solution, with the weights in use.
    distance : (B, K, G) norms in the poses' own noise.
    weight : (B, K, G).
    scale : (B,) noise scale of the poses.
    """
    kind = info.problem.row_groups.poses
    rejected = kind.present & (weight < INLIER_WEIGHT)
    if not rejected.any():
        return distance
    out, factor, count = distance.copy(), as_pairs(kind), info.problem.layout.n_equations
    for cut in info.problem.cuts:
        part, state = info.problem.among(cut), info.problem.state_among(info.state, cut)
        # R and W by the weighted rows
        used = eliminate_strips(part.compact(state), np.zeros(len(state.z)))
        # A: the same rows without weights
        whole = RowGroups(*(one.present[None].astype(float) for one in part.row_groups))
        rows = part.weighted(whole).compact(state)
        own, shared = rows.by_own[:, :, count:], rows.by_shared[:, :, count:]
        own = own @ used.inverse
        by = np.concatenate([own, (shared - own @ used.along) @ info.root[:, None]], axis=-1)
        value, n = rows.value[..., part.row_groups.poses.rows], kind.whiten.shape[-1]
        # d^2 of each rejected pose
        for run, k, place in np.argwhere(rejected[:, cut]).tolist():
            at = slice(n * place, n * (place + 1))
            r, a = value[run, k, at], by[run, k, at]
            # by singular values, which are huge along directions that no other row determines
            turn, size, _ = np.linalg.svd(a)
            variance = scale[run] ** 2 + np.pad(size, (0, n - len(size))) ** 2
            row = cut.start + k
            square = np.sum((turn.T @ r) ** 2 / variance)
            out[run, row, place] = scale[run] * np.sqrt(square) * factor[row, place]
    return out
