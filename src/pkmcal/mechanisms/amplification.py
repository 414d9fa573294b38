"""How much a machine amplifies: velocities, forces and errors, from its forward Jacobian.

With J the forward Jacobian of :mod:`pkmcal.mechanisms.velocities`, ``twist = J rates``. The power
of the motors is that of the platform, so in a machine without weight and friction
``motor forces = J^T wrench``: what makes a platform fast makes its motors feel more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import skew
from pkmcal.mechanisms.kinematics import platform_radius
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.velocities import forward_jacobian


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
    known = np.asarray(np.isfinite(jac).all(axis=(-1, -2)))
    values = np.linalg.svd(np.where(known[..., None, None], jac, 0.0), compute_uv=False)
    return np.where(known[..., None], values, np.nan)
