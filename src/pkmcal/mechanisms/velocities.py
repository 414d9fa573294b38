"""Velocities: Jacobians between readings and platform, their amplification, and signs of
assemblies.

A twist is (omega, tau), rad/s and m/s, the rate of the left perturbation of
:mod:`pkmcal.geometry.rigid`: omega rotates the platform about its own origin, tau moves the origin,
both along the base frame's axes. [B] eq. 6-7 in general form: the derivatives of the closure give
``by_pose twist + by_internal hinges' rates + by_reading readings' rates = 0``.

Amplification: with J the forward Jacobian, ``twist = J rates``. Without weight and friction, motor
power equals platform power, so ``motor forces = J^T wrench``: what makes a platform fast increases
the forces on its motors.

Signs: the sign of the inverse Jacobian's determinant is constant between singular poses. Every path
between two poses with different signs crosses a singular pose. Equal signs prove nothing: two
assembly modes may have the same sign, and only a path between them decides.
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
"""Smallest singular value of a scaled Jacobian for which rates are computed. Poses are accurate to
1e-12 m (:data:`pkmcal.mechanisms.kinematics.CONVERGED_CLOSURE_ERROR`), so below it rates have less
than three correct digits."""


def inverse_jacobian(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Inverse Jacobian (..., m, 6), ``rates = out @ twist``; [B] eq. 6-7.

    theta : (..., P).
    poses : T_base_platform (..., 4, 4).

    The derivative of inverse kinematics. Units: m/rad and m/m for a rod or slider, rad/rad and
    rad/m for a crank. A machine with fewer than six freedoms can make only twists in the span of
    :func:`forward_jacobian`; for others the result is the derivative of inverse kinematics
    nevertheless. NaN if a limb cannot reach, and at a serial singularity (a crank in line with its
    rod), where the twist does not determine the reading's rate.
    """
    c = closure_at(layout, theta, poses)
    if layout.shares_motors:
        return _shared_motor_jacobian(c)
    rows = layout.driven_rows[np.argsort(layout.row_motor[layout.driven_rows])]
    legs = np.flatnonzero(layout.closing)[rows]
    gain = c.by_reading[..., rows]
    usable = np.abs(gain) > LEAST_GAIN_FOR_RATES * _reading_scale(c.base)[..., legs]
    return -c.rows.by_pose[..., rows, :] / np.where(usable, gain, np.nan)[..., None]


def forward_jacobian(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Forward Jacobian (..., 6, m), ``twist = out @ rates``.

    theta : (..., P).
    poses : T_base_platform (..., 4, 4).

    Constant rods, joints' axes, bars and the file's motion hold exactly: each column is a twist
    that the machine can make. NaN if a limb cannot reach, and at singular poses, where the platform
    can move with all motors locked. If several rods hold one freedom, consistent rates are mapped
    exactly and others by least squares.
    """
    c = closure_at(layout, theta, poses)
    scale = own_scale(layout, theta)
    inverted = _pseudo_inverse(scaled_rows(c))
    return -layout.own_motion[:6] @ (
        scale[..., :, None] * (inverted @ by_motors(layout, c.by_reading))
    )


def _shared_motor_jacobian(c: Closure) -> Array:
    """Inverse Jacobian (..., m, 6) of machines with several rods for a motor: least squares over
    all rows for the readings' and hinges' rates, as in inverse kinematics.
    """
    layout, m = c.layout, c.layout.n_readings
    # Scale readings and hinges to unit displacements, so that the rank is without units.
    legs = np.flatnonzero(layout.closing)
    by_motor = layout.actuated[legs][:, None] == np.arange(m)
    largest = np.where(by_motor, _reading_scale(c.base)[..., legs, None], 0.0).max(axis=-2)
    hinges = own_scale(layout, c.theta)[..., layout.motion.shape[1] :]
    shape = np.broadcast_shapes(largest.shape[:-1], hinges.shape[:-1])
    parts = (1 / largest, hinges)
    scale = np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)
    # Solve drives rates + hinges rates = -by_pose twist by least squares.
    drives = by_motors(layout, c.by_reading)
    jac = np.concatenate([drives, c.rows.by_internal], axis=-1) * scale[..., None, :]
    rates = -_pseudo_inverse(jac) @ c.rows.by_pose
    return (scale[..., :, None] * rates)[..., :m, :]


def _reading_scale(base: BaseEnds) -> Array:
    """Displacement of each limb's end, or change of its length, by unit reading, (..., L)."""
    return np.sqrt(dot(base.by_reading, base.by_reading)) + np.abs(base.rate)


def _pseudo_inverse(jac: Array) -> Array:
    """Pseudo-inverse (..., d, E) of scaled rows (..., E, d); NaN if they are rank deficient."""
    if jac.shape[-2] < jac.shape[-1]:
        return np.full((*jac.shape[:-2], jac.shape[-1], jac.shape[-2]), np.nan)
    finite = np.asarray(np.isfinite(jac).all(axis=(-1, -2)))
    u, s, vt = np.linalg.svd(np.where(finite[..., None, None], jac, 0.0), full_matrices=False)
    usable = finite[..., None] & (s[..., -1:] > LEAST_GAIN_FOR_RATES)
    weights = np.where(usable, 1 / np.where(usable, s, 1.0), np.nan)
    return vt.mT @ (weights[..., None] * u.mT)


@dataclass(frozen=True)
class Amplification:
    """Amplification at poses (...); NaN at singular or unreachable poses.

    A unit of joint speed is a vector of all readings' rates of length 1, in m/s, or in rad/s for
    cranks; for a machine with both, 1 m/s counts as 1 rad/s.

    fastest, slowest : (...) largest and smallest speed of the point, m/s per unit of joint speed,
        over the directions of the file's motion; 0 if the motors cannot move it in some of them.
    quickest_turn, slowest_turn : (...) the same for rotation, rad/s. Zero if the machine does not
        rotate.
    force : (..., m) largest force of each motor, N (torque of a crank, N m), for 1 N on the point
        in any direction.
    torque : (..., m) the same for a moment of 1 N m about the point.
    condition : (...) ratio of largest to smallest speed over the machine's own freedoms, with
        rotations scaled by the platform's radius to speeds of its joints; 1 is best.
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
    """Amplification at poses T_base_platform (..., 4, 4), theta (..., P).

    p_platform : (3,) point of the platform, m, platform frame; by default its origin.

    Forces are static, without the machine's own weight.
    """
    jac = forward_jacobian(layout, theta, poses)
    turning, moving = jac[..., :3, :], jac[..., 3:, :]
    if p_platform is not None:
        arm = (poses[..., :3, :3] @ p_platform[:, None])[..., 0]
        moving = moving - skew(arm) @ turning
    # Singular values of J for speed, rotation, and both with rotations scaled to speeds.
    scale = platform_radius(layout, theta)[..., None, None]
    scaled = _singular_values(np.concatenate([scale * turning, moving], axis=-2))
    speeds, turns = _singular_values(moving), _singular_values(turning)
    free = layout.free
    n_moves, n_turns = (
        min(int(np.count_nonzero(part)), layout.n_readings) for part in (free[3:], free[:3])
    )
    own = min(layout.motion.shape[1], layout.n_readings)
    with np.errstate(divide="ignore"):  # freedoms that no motor moves
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
    """Singular values (..., k), descending; NaN if the matrix is not finite."""
    finite = np.asarray(np.isfinite(jac).all(axis=(-1, -2)))
    values = np.linalg.svd(np.where(finite[..., None, None], jac, 0.0), compute_uv=False)
    return np.where(finite[..., None], values, np.nan)


def sign_of(scaled: Array) -> Array:
    """Sign (...) of the determinant of scaled rows (..., E, d), 1 or -1; see
    :func:`pkmcal.mechanisms.kinematics.scaled_rows`.

    0 if the rows are not finite, and for machines whose numbers of rows and freedoms differ.
    """
    if scaled.shape[-1] != scaled.shape[-2]:
        return np.zeros(scaled.shape[:-2])
    finite = np.asarray(np.isfinite(scaled).all(axis=(-1, -2)))
    square = np.where(finite[..., None, None], scaled, np.eye(scaled.shape[-1]))
    return np.where(finite, np.sign(np.linalg.det(square)), 0.0)


def same_assembly(layout: LimbLayout, theta: Array, poses: Array, reference: Array) -> Booleans:
    """Whether poses (..., 4, 4) may belong to the assembly mode of a reference (4, 4), (...).

    False is certain: every path between the two crosses a singular pose. True is only a necessary
    condition, see the module's docstring. True for machines without a determinant, and for poses
    that a limb cannot reach.
    """
    one, other = (assembly_sign(layout, theta, some) for some in (poses, reference))
    return np.asarray(one * other >= 0)


def assembly_sign(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Sign (...) of the determinant at poses (..., 4, 4), which changes on paths across a singular
    pose.

    0 if the numbers of rows and freedoms differ, and if a limb cannot reach.
    """
    return sign_of(scaled_rows(closure_at(layout, theta, poses)))
