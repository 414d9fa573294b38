"""[A] 3.5, step 4 of four: the platform's joints.

Centres of legs with a length come from their ends (16), then each photograph's platform pose
(18); with it, a leg's axis told in the platform frame gives a revolute axis (7) and the
centre of a passive leg (19), and the joints' equations give universal axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import apply, cross, dot, inverse
from pkmcal.identify.four_step_axes import across, nearest_points, revolute_axes
from pkmcal.identify.registration import ANY_MOTION, SCALE, fit_body, minimise_dense

WIDE = 20.0
"""Tolerances within which the torsion's noise is looked for."""
TORSION_STEPS, SETTLED = 40, 1e-13
ROUNDING = 1e-12
"""Share of the best known direction's information below which a direction is rounding."""


def platform_by_registration(
    b: Array, seen: Booleans, drawing: Array, gauge: Array, motion: Array = ANY_MOTION
) -> Array:
    """Step 4 corrected, [A] 16: platform centres (B, L, 3) from those in K frames.

    min sum |R_k b_j + t_k - B_jk|^2 over b and the poses. b : (B, K, L, 3) m, seen (K, L);
    each frame fixes its pose. motion : (6, d), how the platform moves in those frames.
    """
    weight = np.broadcast_to(seen, b.shape[:-1]).astype(float)
    return fit_body(b, weight, gauge, drawing, motion=motion).points


def platform_by_distances(
    b: Array, seen: Booleans, station: Integers, drawing: Array, gauge: Array
) -> Array:
    """Step 4 as printed, [A] 16: centres whose distances are each station's mean distances.

    b : (B, C, L, 3) in the photographs' frames, seen (C, L), station (C,).
    """
    j, g = np.triu_indices(seen.shape[1], 1)
    both = (seen[:, j] & seen[:, g]).astype(float)
    of_station = (station == np.unique(station)[:, None]).astype(float)
    count = of_station @ both
    d = np.linalg.norm(b[:, :, j] - b[:, :, g], axis=-1)
    known = np.einsum("sc,bcp->bsp", of_station, d * both) / np.maximum(count, 1)
    k, pair = np.nonzero(count)
    j, g, known = j[pair], g[pair], known[:, k, pair]
    row = np.arange(len(j))

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        points = x.reshape(len(x), -1, 3)
        v = points[:, j] - points[:, g]
        distance = np.sqrt(dot(v, v))
        jac = np.zeros((len(x), len(j), points.shape[1], 3))
        jac[:, row, j] = v / distance[..., None]
        jac[:, row, g] = -v / distance[..., None]
        held = (x - drawing.ravel()) @ gauge.T
        value = np.concatenate([distance - known[runs], held], axis=1)
        gauge_rows = np.broadcast_to(gauge, (len(x), *gauge.shape))
        jac = np.concatenate([jac.reshape(len(x), len(j), -1), gauge_rows], axis=1)
        return value / SCALE, jac / SCALE

    start = np.broadcast_to(drawing.ravel(), (len(b), drawing.size)).copy()
    return minimise_dense(rows, start).state.reshape(-1, *drawing.shape)


def platform_axes(
    u: Array, seen: Booleans, T_base_platform: Array, information: Array | None = None
) -> tuple[Array, Booleans]:
    """[A] 18, then 7 in the platform frame: axes v' (B, L, 3) of either sign, (L,) found.

    u : (B, K, L, 3) directions, base frame, and information (B, K, L, 3, 3) on them;
    T_base_platform (B, K, 4, 4) of the same photographs, by registration: (18) as printed, a
    cross product, drops the depth (errata).
    """
    rot = T_base_platform[..., None, :3, :3]
    back = np.swapaxes(rot, -1, -2)
    info = None if information is None else back @ information @ rot
    none = np.zeros(len(seen), dtype=int)
    v, found = revolute_axes((back @ u[..., None])[..., 0], seen, none, 1, info)
    return v[:, 0], found[0]


def passive_centres(
    u: Array, base: Array, seen: Booleans, T_base_platform: Array
) -> tuple[Array, Booleans]:
    """[A] 19: centres b (B, L, 3) of legs without a length, u x AB = 0 with B = R b + t.

    Linear in b: in the platform frame, the point nearest to the leg's axes, as (6) on the base.
    u : (B, K, L, 3), base (B, L, 3) in the base frame. Returns b and (L,) found: two directions.
    """
    back = inverse(T_base_platform)[:, :, None]
    turned = (back[..., :3, :3] @ u[..., None])[..., 0]
    through = apply(back, np.broadcast_to(base[:, None], u.shape))
    none = np.zeros(len(seen), dtype=int)
    b, _ = nearest_points(turned, through, seen, none, 1)
    return b[:, 0], revolute_axes(turned, seen, none, 1)[1][0]


def torsion(u: Array, rot: Array, v: Array, w: Array) -> tuple[Array, Array, Array]:
    """Twist u . (v x R w) of a universal-universal leg and its slopes by v and w (errata, 3-UPU).

    u : (..., 3) leg, v (..., 3) first axis on the base, w on the platform, rot (..., 3, 3)
    from platform to base. Zero on the machine; two joints that share a leg cannot twist.
    """
    turned = (rot @ w[..., None])[..., 0]
    by_v = cross(turned, u)
    by_w = (np.swapaxes(rot, -1, -2) @ cross(u, v)[..., None])[..., 0]
    return dot(v, by_v), by_v, by_w


def universal_axes(
    u: Array, rot: Array, seen: Booleans, drawn: tuple[Array, Array], tolerance: Array
) -> tuple[Array, Array]:
    """First axes of universal-universal legs by the inverse kinematics, [A] 3.5 and errata.

    Least squares of the torsion over the photographs, beside the drawing with its tolerance
    (rad): what the photographs do not tell stays as drawn. Of a leg's four freedoms that is a
    common turn of both axes wherever the platform does not turn, as on a 3-UPU. The torsion's
    own noise is taken from the residuals of a fit that hardly looks at the drawing, so that
    the data decide where they know better.
    u : (B, K, L, 3) base frame. rot : (B, K, 3, 3) platform to base. seen : (K, L).
    drawn : axes v, w (B, L, 3). tolerance : (L,). Returns v, w (B, L, 3) unit.
    """
    legs = _Torsions(u, rot, seen, drawn, (_tangents(drawn[0]), _tangents(drawn[1])))
    x, variance = _settled(legs, np.zeros((len(u), u.shape[2], 4)), WIDE * tolerance)
    x, _ = _settled(legs, x, tolerance, variance)
    v, w, _ = legs.axes(x)
    return v, w


class _Torsions(NamedTuple):
    """What the torsions of :func:`universal_axes` depend on; tangents (B, L, 3, 2) each."""

    u: Array
    rot: Array
    seen: Booleans
    drawn: tuple[Array, Array]
    tangents: tuple[Array, Array]

    def axes(self, x: Array) -> tuple[Array, Array, tuple[Array, Array]]:
        """Unit axes moved by x (B, L, 4) in their tangents, and derivatives (B, L, 3, 4)."""
        axes, slopes = [], []
        for side in (0, 1):
            part = slice(2 * side, 2 * side + 2)
            tangents = self.tangents[side]
            long = self.drawn[side] + (tangents @ x[..., part, None])[..., 0]
            size = np.sqrt(dot(long, long))[..., None]
            unit = long / size
            by_x = np.zeros((*x.shape[:-1], 3, 4))
            by_x[..., part] = across(unit) @ tangents / size[..., None]
            axes.append(unit)
            slopes.append(by_x)
        return axes[0], axes[1], (slopes[0], slopes[1])

    def rows(self, x: Array) -> tuple[Array, Array]:
        """Torsions (B, K, L) and their derivatives (B, K, L, 4) by x."""
        v, w, (v_by, w_by) = self.axes(x)
        value, by_v, by_w = torsion(self.u, self.rot[:, :, None], v[:, None], w[:, None])
        jac = by_v[..., None, :] @ v_by[:, None] + by_w[..., None, :] @ w_by[:, None]
        mask = self.seen
        return np.where(mask, value, 0.0), np.where(mask[..., None], jac[..., 0, :], 0.0)


def _settled(
    legs: _Torsions, x: Array, tolerance: Array, variance: Array | None = None
) -> tuple[Array, Array]:
    """Gauss-Newton from x with the drawing beside; the torsion's variance (B, L) from its
    residuals where it is not given.
    """
    count = np.maximum(np.broadcast_to(legs.seen, legs.u.shape[:-1]).sum(axis=1), 5)
    share, found = np.zeros(x.shape), variance
    for _ in range(TORSION_STEPS):
        value, jac = legs.rows(x)
        found = np.sum(value**2, axis=1) / (count - share.sum(axis=-1))
        found = found if variance is None else variance
        new, share = _beside_drawing(value, jac, x, found / tolerance**2)
        done = np.max(np.abs(new - x), initial=0.0) < SETTLED
        x = new
        if done:
            break
    return x, np.zeros(x.shape[:-1]) if found is None else found


def _beside_drawing(value: Array, jac: Array, x: Array, ridge: Array) -> tuple[Array, Array]:
    """Gauss-Newton's next x (B, L, 4) with the drawing x = 0 weighted by ridge (B, L).

    Also the share of the data in each direction, (B, L, 4): 0 is the drawing's.
    """
    values, vectors = np.linalg.eigh(np.einsum("bkli,bklj->blij", jac, jac))
    values = np.maximum(values, 0.0)
    target = np.einsum("bkli,bklj,blj->bli", jac, jac, x) - np.einsum("bkli,bkl->bli", jac, value)
    along = (np.swapaxes(vectors, -1, -2) @ target[..., None])[..., 0]
    # directions that the data do not know at all stay as drawn even without noise
    total = values + (ridge + ROUNDING * values[..., -1] + 1e-300)[..., None]
    return (vectors @ (along / total)[..., None])[..., 0], values / total


def _tangents(axis: Array) -> Array:
    """Two unit directions (..., 3, 2) across each axis (..., 3)."""
    other = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    return tangent_basis(axis, other)
