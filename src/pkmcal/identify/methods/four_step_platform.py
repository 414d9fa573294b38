"""[A] 3.4-3.5, steps 3 and 4 of four: offsets and constant lengths, then the platform's joints.

The platform is rigid, so the distances between its joints are constant: ``B = A + (q + q0) u``
([A] 13) for each leg with a length, with q = 0 and q0 the length for a constant leg. Passive legs
do not enter.

Centres of legs with a length follow from their ends (16), then the platform pose of each image
(18); with the pose, a leg's axis in the platform frame gives a revolute axis (7) and the centre of
a passive leg (19), and the joints' equations give universal axes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import apply, cross, dot, inverse
from pkmcal.identify.methods.leg_axes import Axes, across_directions, nearest_points, revolute_axes
from pkmcal.identify.methods.registration import (
    ANY_MOTION,
    REGISTRATION_UNIT_SIGMA,
    fit_body,
    minimise_dense,
    points_by,
)

COLLAPSED_LENGTH_SHARE = 0.5
"""Length of a constant leg, relative to its nominal length, below which it is in the false minimum
B = A."""
TORSION_NOISE_TOLERANCES = 20.0
"""Prior sigmas by which the nominal axes are weakened while the torsion's noise is estimated."""
TORSION_STEPS, TORSION_SETTLED = 40, 1e-13
ROUNDED_INFORMATION_SHARE = 1e-12
"""Information of a direction, relative to the best determined direction's, that is rounding."""


def joint_distance_offsets(axes: Axes, a_photo: Array, start: Array, form: str) -> Array:
    """Step 3, [A] 13-14: offsets (B, L) for constant distances between platform joints.

    axes : only legs with a length are visible.
    a_photo : (B, C, L, 3) base centres in each image's frame.
    start : (L,) m, nominal; a length of zero is a false minimum.
    """

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        value, jac = joint_distance_deviations(axes.of_runs(runs), a_photo[runs], x, form)
        return value / REGISTRATION_UNIT_SIGMA, jac / REGISTRATION_UNIT_SIGMA

    return minimise_dense(rows, np.broadcast_to(start, (len(a_photo), len(start))).copy()).state


def joint_distance_deviations(
    axes: Axes, a_photo: Array, at: Array, form: str
) -> tuple[Array, Array]:
    """Residuals (B, r) m of step 3 at offsets (B, L), and their derivatives (B, r, L).

    printed : differences between consecutive images of a station, C_2 of [A] 14. corrected
    (errata) : deviations from each pair's mean, sum (d_k - mean d)^2.
    """
    # pairs of joints that are seen together at least twice
    j, g = np.triu_indices(axes.visible.shape[1], 1)
    both = axes.visible[:, j] & axes.visible[:, g]
    used = both.sum(axis=0) > 1
    j, g, both = j[used], g[used], both[:, used]
    # distance d of each pair of platform joints, and its derivatives by the two offsets
    b = a_photo + (axes.readings + at[:, None])[..., None] * axes.u
    d = b[:, :, j] - b[:, :, g]
    distance = np.sqrt(np.maximum(dot(d, d), 1e-300))
    e = d / distance[..., None]
    slope = np.zeros((*distance.shape, at.shape[-1]))
    pair = np.arange(len(j))
    slope[:, :, pair, j] = dot(e, axes.u[:, :, j])
    slope[:, :, pair, g] = -dot(e, axes.u[:, :, g])
    rows = np.concatenate([distance[..., None], slope], axis=-1)
    # criterion: consecutive differences, or deviations from each pair's mean
    if form == "printed":
        same = axes.station[1:] == axes.station[:-1]
        use = both[1:] & both[:-1] & same[:, None]
        rows = np.where(use[..., None], rows[:, 1:] - rows[:, :-1], 0.0)
    else:
        mean = np.einsum("cp,bcpl->bpl", both / both.sum(axis=0), rows)
        rows = np.where(both[..., None], rows - mean[:, None], 0.0)
    rows = rows.reshape(len(rows), -1, rows.shape[-1])
    return rows[..., 0], rows[..., 1:]


def platform_by_registration(
    b: Array, visible: Booleans, nominal: Array, gauge: Array, motion: Array = ANY_MOTION
) -> Array:
    """Step 4 corrected, [A] 16: platform centres (B, L, 3) from the centres in K frames.

    min sum |R_k b_j + t_k - B_jk|^2 over b and the poses. b : (B, K, L, 3) m, visible (K, L); each
    frame must determine its pose. motion : (6, d) of the platform in those frames.
    """
    weight = np.broadcast_to(visible, b.shape[:-1]).astype(float)
    return fit_body(b, weight, gauge, nominal, motion=motion).points


def platform_by_distances(
    b: Array, visible: Booleans, station: Integers, nominal: Array, gauge: Array
) -> Array:
    """Step 4 as printed, [A] 16: centres with each station's mean distances.

    b : (B, C, L, 3) in the images' frames, visible (C, L), station (C,).
    """
    j, g = np.triu_indices(visible.shape[1], 1)
    both = (visible[:, j] & visible[:, g]).astype(float)
    of_station = (station == np.unique(station)[:, None]).astype(float)
    count = of_station @ both
    d = np.linalg.norm(b[:, :, j] - b[:, :, g], axis=-1)
    measured = np.einsum("sc,bcp->bsp", of_station, d * both) / np.maximum(count, 1)
    k, pair = np.nonzero(count)
    j, g, measured = j[pair], g[pair], measured[:, k, pair]
    row = np.arange(len(j))

    def distances(points: Array, runs: Integers) -> tuple[Array, Array]:
        v = points[:, j] - points[:, g]
        distance = np.sqrt(dot(v, v))
        jac = np.zeros((*distance.shape, *points.shape[1:]))
        jac[:, row, j] = v / distance[..., None]
        jac[:, row, g] = -v / distance[..., None]
        return distance - measured[runs], jac

    return points_by(distances, nominal, gauge, len(b))


def platform_axes(
    u: Array, visible: Booleans, T_base_platform: Array, information: Array | None = None
) -> tuple[Array, Booleans]:
    """[A] 18, then 7 in the platform frame: axes v' (B, L, 3) of either sign, (L,) identifiable.

    u : (B, K, L, 3) directions, base frame, with information (B, K, L, 3, 3).
    T_base_platform : (B, K, 4, 4) of the same images, by registration; (18) as printed, a cross
    product, ignores the depth (errata).
    """
    rot = T_base_platform[..., None, :3, :3]
    back = rot.mT
    info = None if information is None else back @ information @ rot
    none = np.zeros(len(visible), dtype=int)
    v, value = revolute_axes((back @ u[..., None])[..., 0], visible, none, 1, info)
    return v[:, 0], value[0]


def passive_centres(
    u: Array, base: Array, visible: Booleans, T_base_platform: Array
) -> tuple[Array, Booleans]:
    """[A] 19: centres b (B, L, 3) of legs without a length, u x AB = 0 with B = R b + t.

    Linear in b: the point nearest to the leg's axes in the platform frame, as (6) on the base.
    u : (B, K, L, 3), base : (B, L, 3) in the base frame. Returns b and (L,) whether the leg has two
    directions.
    """
    back = inverse(T_base_platform)[:, :, None]
    turned = (back[..., :3, :3] @ u[..., None])[..., 0]
    through = apply(back, np.broadcast_to(base[:, None], u.shape))
    none = np.zeros(len(visible), dtype=int)
    b, _ = nearest_points(turned, through, visible, none, 1)
    return b[:, 0], revolute_axes(turned, visible, none, 1)[1][0]


def torsion(u: Array, rot: Array, v: Array, w: Array) -> tuple[Array, Array, Array]:
    """Twist u . (v x R w) of a universal-universal leg (errata, 3-UPU), and derivatives by v and w.

    u : (..., 3) leg.
    v : (..., 3) first axis on the base, w : on the platform.
    rot : (..., 3, 3) from platform to base. Zero on the machine: two universal joints of one leg
        cannot twist.
    """
    turned = (rot @ w[..., None])[..., 0]
    by_v = cross(turned, u)
    by_w = (rot.mT @ cross(u, v)[..., None])[..., 0]
    return dot(v, by_v), by_v, by_w


def universal_axes(
    u: Array, rot: Array, visible: Booleans, drawn: tuple[Array, Array], tolerance: Array
) -> tuple[Array, Array]:
    """First axes of universal-universal legs by the inverse kinematics, [A] 3.5 and errata.

    Least squares of the torsion over the images, with the nominal axes and their prior sigmas (rad)
    as a prior: unidentifiable directions stay nominal. One of a leg's four degrees of freedom, a
    common rotation of both axes, is unidentifiable where the platform does not rotate, as on a
    3-UPU. The torsion's noise is estimated from the residuals of a fit with a weak prior, so that
    the data decide where they are more accurate.

    u : (B, K, L, 3) base frame.
    rot : (B, K, 3, 3) platform to base.
    visible : (K, L).
    drawn : nominal axes v, w (B, L, 3).
    tolerance : (L,). Returns v, w (B, L, 3) unit.
    """

    def rows(x: Array) -> tuple[Array, Array]:
        """Torsions (B, K, L) of axes tilted by x (B, L, 4), and their derivatives."""
        (v, v_by), (w, w_by) = _tilted(drawn[0], x[..., :2]), _tilted(drawn[1], x[..., 2:])
        value, by_v, by_w = torsion(u, rot[:, :, None], v[:, None], w[:, None])
        jac = [by_v[..., None, :] @ v_by[:, None], by_w[..., None, :] @ w_by[:, None]]
        slope = np.concatenate(jac, axis=-1)[..., 0, :]
        return np.where(visible, value, 0.0), np.where(visible[..., None], slope, 0.0)

    count = np.maximum(visible.sum(axis=0), 5)
    start = np.zeros((len(u), u.shape[2], 4))
    x, variance = _compared_with_nominal(rows, start, count, TORSION_NOISE_TOLERANCES * tolerance)
    x, _ = _compared_with_nominal(rows, x, count, tolerance, variance)
    return _tilted(drawn[0], x[..., :2])[0], _tilted(drawn[1], x[..., 2:])[0]


def _tilted(axis: Array, x: Array) -> tuple[Array, Array]:
    """Unit axes (..., 3) tilted by x (..., 2), and derivatives (..., 3, 2)."""
    tangents = tangent_basis(axis, np.eye(3)[np.argmin(np.abs(axis), axis=-1)])
    shifted = axis + (tangents @ x[..., None])[..., 0]
    size = np.sqrt(dot(shifted, shifted))[..., None]
    return shifted / size, across_directions(shifted / size) @ tangents / size[..., None]


def _compared_with_nominal(
    rows: Callable[[Array], tuple[Array, Array]],
    x: Array,
    count: Integers,
    tolerance: Array,
    variance: Array | None = None,
) -> tuple[Array, Array]:
    """Gauss-Newton from x (B, L, 4) with the prior x = 0 and its sigma (L,).

    Returns x and the torsion's variance (B, L): as given, or from the residuals of count (L,)
    images; a direction that the data determine takes one degree of freedom, a direction of the
    prior none.
    """
    share = np.zeros(x.shape)
    noise = np.zeros(x.shape[:-1]) if variance is None else variance
    for _ in range(TORSION_STEPS):
        value, jac = rows(x)
        if variance is None:
            noise = np.sum(value**2, axis=1) / (count - share.sum(axis=-1))
        normal = np.einsum("bkli,bklj->blij", jac, jac)
        values, vectors = np.linalg.eigh(normal)
        values = np.maximum(values, 0.0)
        right = (normal @ x[..., None])[..., 0] - np.einsum("bkli,bkl->bli", jac, value)
        along = (vectors.mT @ right[..., None])[..., 0]
        # unobserved directions stay nominal even without noise
        hold = noise / tolerance**2 + ROUNDED_INFORMATION_SHARE * values[..., -1] + 1e-300
        share = values / (values + hold[..., None])
        before, x = x, (vectors @ (along / (values + hold[..., None]))[..., None])[..., 0]
        if np.max(np.abs(x - before), initial=0.0) < TORSION_SETTLED:
            break
    return x, noise
