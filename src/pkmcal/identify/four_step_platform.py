"""[A] 3.5, step 4 of four: the platform's joints.

Centres of legs with a length come from their ends (16), then each photograph's platform pose
(18); with it, a leg's axis told in the platform frame gives a revolute axis (7) and the
centre of a passive leg (19), and the joints' equations give universal axes.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import apply, cross, dot, inverse
from pkmcal.identify.four_step_axes import nearest_points, revolute_axes
from pkmcal.identify.registration import ANY_MOTION, SCALE, fit_body, minimise_dense

TORSION_STEPS = 40
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


def platform_axes(u: Array, seen: Booleans, T_base_platform: Array) -> tuple[Array, Booleans]:
    """[A] 18, then 7 in the platform frame: axes v' (B, L, 3) of either sign, (L,) found.

    u : (B, K, L, 3) directions, base frame; T_base_platform (B, K, 4, 4) of the same
    photographs, by registration: (18) as printed, a cross product, drops the depth (errata).
    """
    turned = (np.swapaxes(T_base_platform[..., None, :3, :3], -1, -2) @ u[..., None])[..., 0]
    v, found = revolute_axes(turned, seen, np.zeros(len(seen), dtype=int), 1)
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
    b, found = nearest_points(turned, through, seen, np.zeros(len(seen), dtype=int), 1)
    return b[:, 0], found[0]


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
    own noise is taken from the residuals, so that data decide where they know better.
    u : (B, K, L, 3) base frame. rot : (B, K, 3, 3) platform to base. seen : (K, L).
    drawn : axes v, w (L, 3). tolerance : (L,). Returns v, w (B, L, 3) unit.
    """
    bases = [_tangents(axis) for axis in drawn]
    x = np.zeros((len(u), u.shape[2], 4))
    count = np.maximum(np.broadcast_to(seen, u.shape[:-1]).sum(axis=1), 5)
    share = np.full(x.shape, 0.0)
    for _ in range(TORSION_STEPS):
        value, jac = _torsion_rows(u, rot, seen, drawn, bases, x)
        variance = np.sum(value**2, axis=1) / (count - share.sum(axis=-1))
        new, share = _beside_drawing(value, jac, x, variance / tolerance**2)
        done = np.max(np.abs(new - x), initial=0.0) < 1e-13
        x = new
        if done:
            break
    v, w, _ = _turned(drawn, bases, x)
    return v, w


def _torsion_rows(
    u: Array,
    rot: Array,
    seen: Booleans,
    drawn: tuple[Array, Array],
    bases: list[Array],
    x: Array,
) -> tuple[Array, Array]:
    """Torsions (B, K, L) and their derivatives (B, K, L, 4) by the axes' tangents x (B, L, 4)."""
    v, w, (v_by, w_by) = _turned(drawn, bases, x)
    value, by_v, by_w = torsion(u, rot[:, :, None], v[:, None], w[:, None])
    jac = (by_v[..., None, :] @ v_by[:, None] + by_w[..., None, :] @ w_by[:, None])[..., 0, :]
    return np.where(seen, value, 0.0), np.where(seen[..., None], jac, 0.0)


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
    """Two unit directions (L, 3, 2) across each axis (L, 3)."""
    other = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    return tangent_basis(axis, other)


def _turned(
    drawn: tuple[Array, Array], bases: list[Array], x: Array
) -> tuple[Array, Array, tuple[Array, Array]]:
    """Axes moved by x (B, L, 4) in their tangents, unit, and their derivatives (B, L, 3, 4)."""
    axes, slopes = [], []
    for side in (0, 1):
        part = x[..., 2 * side : 2 * side + 2]
        long = drawn[side] + (bases[side] @ part[..., None])[..., 0]
        size = np.sqrt(dot(long, long))[..., None]
        unit = long / size
        flat = bases[side] - unit[..., None] * (unit[..., None, :] @ bases[side])
        by_x = np.zeros((*x.shape[:-1], 3, 4))
        by_x[..., 2 * side : 2 * side + 2] = flat / size[..., None]
        axes.append(unit)
        slopes.append(by_x)
    return axes[0], axes[1], (slopes[0], slopes[1])
