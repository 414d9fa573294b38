"""Velocities: how fast the readings change when the platform moves, and the other way round.

A twist is (omega, tau), rad/s and m/s, the rate of the left perturbation of
:mod:`pkmcal.geometry.rigid`: omega turns the platform about its own origin, tau moves that origin,
both along the base frame's axes. [B] eq. 6-7 in general: the closure's derivatives give
``by_pose twist + by_internal hinges' rates + by_reading readings' rates = 0``.

Amplification: with J the forward Jacobian, ``twist = J rates``. The power of the motors is that of
the platform, so in a machine without weight and friction ``motor forces = J^T wrench``: what makes
a platform fast makes its motors feel more.

Signs: the inverse Jacobian's determinant says on which side of the singular poses a pose lies.
Between two poses with different signs every path crosses a singular pose. Equal signs promise
nothing: two assemblies may have the same, and only a path between them tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import dot, skew
from pkmcal.mechanisms.closure import BaseEnds, Closure, by_motors
from pkmcal.mechanisms.kinematics import closure_at, own_scale, platform_radius, scaled_rows
from pkmcal.mechanisms.layout import LimbLayout

LEAST_GAIN_FOR_RATES = 1e-9
"""Smallest singular value of a scaled Jacobian that still gives rates: a pose is right to 1e-12 m
(:data:`pkmcal.mechanisms.kinematics.CONVERGED_CLOSURE_ERROR`), so below it not three digits would
be right."""


def inverse_jacobian(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Readings' rates from the twist, (..., m, 6): ``rates = out @ twist``, [B] eq. 6-7.

    theta (..., P), poses T_base_platform (..., 4, 4). Units: m/rad and m/m of a rod or slider,
    rad/rad and rad/m of a crank. It is the derivative of the inverse kinematics; a machine with
    fewer than six freedoms can make only the twists that :func:`forward_jacobian` spans, and of
    others it says what inverse kinematics would. NaN where a limb cannot reach, and at a serial
    singularity (a crank in line with its rod), where the twist tells the rate of no reading.
    """
    c = closure_at(layout, theta, poses)
    if layout.shares_motors:
        return _of_shared(c)
    rows = layout.driven_rows[np.argsort(layout.row_motor[layout.driven_rows])]
    legs = np.flatnonzero(layout.closing)[rows]
    gain = c.by_reading[..., rows]
    usable = np.abs(gain) > LEAST_GAIN_FOR_RATES * _reading_scale(layout, c.base)[..., legs]
    return -c.rows.by_pose[..., rows, :] / np.where(usable, gain, np.nan)[..., None]


def forward_jacobian(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Twist from the readings' rates, (..., 6, m): ``twist = out @ rates``.

    theta (..., P), poses T_base_platform (..., 4, 4). Constant rods, joints' axes, bars and the
    motion that the file names hold exactly: each column is a twist that the machine can make. NaN
    where a limb cannot reach, and where the pose is singular: there the platform can move with all
    motors locked. Where two rods or more hold the same freedom, rates that fit one pose only are
    answered exactly and others by least squares.
    """
    c = closure_at(layout, theta, poses)
    scale = own_scale(layout, theta)
    inverted = _pseudo_inverse(scaled_rows(c))
    return -layout.own_motion[:6] @ (
        scale[..., :, None] * (inverted @ by_motors(layout, c.by_reading))
    )


def _of_shared(c: Closure) -> Array:
    """Readings' rates (..., m, 6) of machines with several rods a motor: with the hinges' rates,
    the best that all rows say, as the inverse kinematics settles them.
    """
    layout, m = c.layout, c.layout.n_readings
    legs = np.flatnonzero(layout.closing)
    by_motor = layout.actuated[legs][:, None] == np.arange(m)
    largest = np.where(by_motor, _reading_scale(layout, c.base)[..., legs, None], 0.0).max(axis=-2)
    hinges = own_scale(layout, c.theta)[..., layout.motion.shape[1] :]
    shape = np.broadcast_shapes(largest.shape[:-1], hinges.shape[:-1])
    parts = (1 / largest, hinges)
    scale = np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)
    drives = by_motors(layout, c.by_reading)
    jac = np.concatenate([drives, c.rows.by_internal], axis=-1) * scale[..., None, :]
    rates = -_pseudo_inverse(jac) @ c.rows.by_pose
    return (scale[..., :, None] * rates)[..., :m, :]


def _reading_scale(layout: LimbLayout, base: BaseEnds) -> Array:
    """How far a unit of its reading moves each limb's end or changes its length, (..., L)."""
    return np.sqrt(dot(base.by_reading, base.by_reading)) + layout.rod_reads


def _pseudo_inverse(jac: Array) -> Array:
    """Pseudo-inverse (..., d, E) of scaled rows (..., E, d); NaN where they lose a freedom."""
    if jac.shape[-2] < jac.shape[-1]:
        return np.full((*jac.shape[:-2], jac.shape[-1], jac.shape[-2]), np.nan)
    finite = np.asarray(np.isfinite(jac).all(axis=(-1, -2)))
    u, s, vt = np.linalg.svd(np.where(finite[..., None, None], jac, 0.0), full_matrices=False)
    usable = finite[..., None] & (s[..., -1:] > LEAST_GAIN_FOR_RATES)
    weights = np.where(usable, 1 / np.where(usable, s, 1.0), np.nan)
    return vt.mT @ (weights[..., None] * u.mT)


@dataclass(frozen=True)
class Amplification:
    """At poses (...); NaN where the pose is singular or out of reach.

    A unit of joint speed is a vector of all readings' rates of length 1, in m/s, or in rad/s for
    cranks; of a machine with both, 1 m/s counts as 1 rad/s.

    fastest, slowest : (...) largest and smallest speed of the point, m/s per unit of joint speed,
        over the directions of the file's motion; 0 where the motors cannot move it in some of them.
    quickest_turn, slowest_turn : (...) the same of the platform's turning, rad/s. Zero where the
        machine does not turn.
    force : (..., m) the largest force of each motor, N (of a crank its torque, N m), for 1 N on the
        point in any direction. torque : (..., m) for a moment of 1 N m about the point.
    condition : (...) largest over smallest speed, turns scaled by the platform's radius so that
        they count as its joints' speeds; 1 is best. Smallest is over the machine's own freedoms.
    """

    fastest: Array
    slowest: Array
    quickest_turn: Array
    slowest_turn: Array
    force: Array
    torque: Array
    condition: Array


def amplification(
    layout: LimbLayout, theta: Array, poses: Array, p_platform: Array | None = None
) -> Amplification:
    """The maps' values at poses T_base_platform (..., 4, 4), theta (..., P).

    p_platform : (3,) the point of the platform that is meant, m, platform frame; its origin when
    absent. Static: the machine's own weight is not in the forces.
    """
    jac = forward_jacobian(layout, theta, poses)
    turning, moving = jac[..., :3, :], jac[..., 3:, :]
    if p_platform is not None:
        arm = (poses[..., :3, :3] @ p_platform[:, None])[..., 0]
        moving = moving - skew(arm) @ turning
    scale = platform_radius(layout, theta)[..., None, None]
    scaled = _singular_values(np.concatenate([scale * turning, moving], axis=-2))
    speeds, turns = _singular_values(moving), _singular_values(turning)
    free = layout.free
    n_moves, n_turns = (
        min(int(np.count_nonzero(part)), layout.n_readings) for part in (free[3:], free[:3])
    )
    own = min(layout.motion.shape[1], layout.n_readings)
    with np.errstate(divide="ignore"):  # a freedom that no motor moves
        condition = scaled[..., 0] / scaled[..., own - 1]
    zero = np.zeros(speeds.shape[:-1])
    return Amplification(
        fastest=speeds[..., 0],
        slowest=speeds[..., n_moves - 1],
        quickest_turn=turns[..., 0] if n_turns else zero,
        slowest_turn=turns[..., n_turns - 1] if n_turns else zero,
        force=np.sqrt(np.sum(moving**2, axis=-2)),
        torque=np.sqrt(np.sum(turning**2, axis=-2)),
        condition=condition,
    )


def _singular_values(jac: Array) -> Array:
    """Singular values (..., k), falling; NaN where the matrix is not known."""
    finite = np.asarray(np.isfinite(jac).all(axis=(-1, -2)))
    values = np.linalg.svd(np.where(finite[..., None, None], jac, 0.0), compute_uv=False)
    return np.where(finite[..., None], values, np.nan)


def sign_of(scaled: Array) -> Array:
    """Sign (...) of the determinant of scaled rows (..., E, d), 1 or -1; see
    :func:`pkmcal.mechanisms.kinematics.scaled_rows`. 0 where they are not known, and for machines
    with more or fewer rows than freedoms, which have none.
    """
    if scaled.shape[-1] != scaled.shape[-2]:
        return np.zeros(scaled.shape[:-2])
    finite = np.asarray(np.isfinite(scaled).all(axis=(-1, -2)))
    square = np.where(finite[..., None, None], scaled, np.eye(scaled.shape[-1]))
    return np.where(finite, np.sign(np.linalg.det(square)), 0.0)


def same_assembly(layout: LimbLayout, theta: Array, poses: Array, reference: Array) -> Booleans:
    """Whether poses (..., 4, 4) may belong to the reference's assembly (4, 4), (...).

    False is sure: every path between the two crosses a singular pose. True is necessary only, see
    the module's docstring; machines without a determinant are always True, as are poses that a limb
    cannot reach.
    """
    one, other = (assembly_sign(layout, theta, some) for some in (poses, reference))
    return np.asarray(one * other >= 0)


def assembly_sign(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """The sign (...) of poses' assemblies, (..., 4, 4): it changes where a way from one to another
    crosses a singular pose. 0 where rows and freedoms differ in number, and where a limb cannot
    reach.
    """
    return sign_of(scaled_rows(closure_at(layout, theta, poses)))
