"""Rejected poses that the rest of the measurements explain after all.

Where a measured pose has lost its weight, its configuration follows the readings, and the pose is
as far from there as these are wrong. In units of the pose's own noise that is much where readings
are coarse, though nothing is wrong with the pose: rejected while the readings' noise was stated too
small, or on the way to the solution, it would stay so for ever. So a rejected pose is judged by its
innovation. With A the rows that it would have, unweighted, r their residuals, and C the covariance
of all unknowns by the rest of the measurements and by what is known beforehand,

    d^2 = r^T (s^2 I + A C A^T)^-1 r,      s the noise scale of the poses.

C has a configuration's own unknowns and the shared ones: with Q R the Jacobian by its own unknowns,
W = Q^T J what they take up of that by the shared ones, and F F^T the shared unknowns' covariance,

    A C A^T = A_own R^-1 R^-T A_own^T + G F F^T G^T,      G = A_shared - A_own R^-1 W.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.covariance import Information
from pkmcal.identify.robust import as_pairs
from pkmcal.measurements.rows import Kinds
from pkmcal.solver.elimination import divisions
from pkmcal.solver.strips import eliminated

REJECTED_BELOW_WEIGHT = 0.5


def innovations(info: Information, distance: Array, weight: Array, scale: Array) -> Array:
    """Norms (B, K, G) of the poses as those of pairs, of the rejected ones in units of what is
    expected of their innovations.

    info : a solution with weights (B, K, G) in use; distance : the norms in the poses' own noise;
    scale : (B,) of that noise.
    """
    kind = info.problem.kinds.poses
    rejected = kind.present & (weight < REJECTED_BELOW_WEIGHT)
    if not rejected.any():
        return distance
    out, factor, count = distance.copy(), as_pairs(kind), info.problem.layout.n_equations
    for cut in divisions(*info.problem.extent):
        part, state = info.problem.among(cut), info.problem.state_among(info.state, cut)
        used = eliminated(part.compact(state), np.zeros(len(state.z)))
        whole = Kinds(*(one.present[None].astype(float) for one in part.kinds))
        rows = part.weighted(whole).compact(state)
        own, shared = rows.by_own[:, :, count:], rows.by_shared[:, :, count:]
        own = own @ used.inverse
        by = np.concatenate([own, (shared - own @ used.along) @ info.root[:, None]], axis=-1)
        value, n = rows.value[..., part.kinds.poses.rows], kind.whiten.shape[-1]
        for run, k, place in np.argwhere(rejected[:, cut]).tolist():
            at = slice(n * place, n * (place + 1))
            r, a = value[run, k, at], by[run, k, at]
            square = r @ np.linalg.solve(scale[run] ** 2 * np.eye(n) + a @ a.T, r)
            row = cut.start + k
            out[run, row, place] = scale[run] * np.sqrt(square) * factor[row, place]
    return out
