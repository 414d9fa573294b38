"""Inverse and forward kinematics of any rigid-platform machine, batched over poses.

Forward kinematics solves the closure for the pose by Levenberg-Marquardt from a start in the
right assembly; each configuration of the batch has its own damping and stops on its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.geometry.rigid import perturb, pose, rotation
from pkmcal.mechanisms.limbs import LimbLayout, closure, limb_ends, rod_lengths

MAX_STEPS = 60
CONVERGED = 1e-12
"""Closure error (m) below which a configuration is solved: 100 times rounding at 1 m."""
NEAR_SINGULAR = 0.02
"""Smallest singular value of the scaled inverse Jacobian below which a warning is due: a
reading's error then moves the platform fifty times as far."""


@dataclass(frozen=True)
class ForwardResult:
    """Poses found from readings, and how far to trust each.

    T_base_platform : (..., 4, 4); converged : (...); error : (...) largest closure error, m.
    singularity : (...) smallest singular value of the inverse Jacobian with rotations scaled
        by the platform's radius: 1 is a good machine, 0 a singular pose.
    """

    T_base_platform: Array
    converged: Booleans
    error: Array
    singularity: Array


def inverse(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Readings (..., m) at poses T_base_platform (..., 4, 4); [B] eq. 4, q = length - offset.

    Rods on a fixed centre only; the closure is then linear in the reading.
    """
    rows = layout.driven_rows
    zeros = np.zeros((*poses.shape[:-2], rows.size))
    at_zero = closure(layout, theta, zeros, poses)
    return -at_zero.value[..., rows] / at_zero.by_reading[..., rows]


def forward(layout: LimbLayout, theta: Array, readings: Array, start: Array) -> ForwardResult:
    """Poses at readings (..., m), from starts (..., 4, 4); theta (..., P) broadcasts.

    Unknowns are the motion's directions only, so a planar machine stays in its plane.
    """
    shape = np.broadcast_shapes(readings.shape[:-1], start.shape[:-2], theta.shape[:-1])
    current = np.broadcast_to(start, (*shape, 4, 4)).copy()
    damping = np.full(shape, 1e-6)
    c = closure(layout, theta, readings, current)
    cost = np.sum(c.value**2, axis=-1)
    for _ in range(MAX_STEPS):
        active = np.max(np.abs(c.value), axis=-1) > CONVERGED * 1e-2
        if not active.any():
            break
        jac = c.by_pose @ layout.motion
        step = -_damped_solve(jac, c.value, damping)
        step = np.where(active[..., None], step, 0.0)
        trial = perturb(current, step @ layout.motion.T)
        c_trial = closure(layout, theta, readings, trial)
        cost_trial = np.sum(c_trial.value**2, axis=-1)
        better = cost_trial < cost
        if not (better & active).any() and np.all(damping[active] > 1e3):
            break
        current = np.where(better[..., None, None], trial, current)
        cost = np.where(better, cost_trial, cost)
        damping = np.clip(np.where(better, damping * 0.05, damping * 30), 1e-14, 1e6)
        c = closure(layout, theta, readings, current)
    error = np.max(np.abs(c.value), axis=-1)
    return ForwardResult(current, error < CONVERGED, error, singularity(layout, theta, c.by_pose))


def _damped_solve(jac: Array, value: Array, damping: Array) -> Array:
    """Levenberg-Marquardt step with column scaling, (..., d)."""
    normal = np.swapaxes(jac, -1, -2) @ jac
    scale = np.einsum("...ii->...i", normal) + 1e-300
    normal = normal + damping[..., None, None] * scale[..., None] * np.eye(jac.shape[-1])
    gradient = np.swapaxes(jac, -1, -2) @ value[..., None]
    return np.linalg.solve(normal, gradient)[..., 0]


def singularity(layout: LimbLayout, theta: Array, by_pose: Array) -> Array:
    """Smallest singular value of the inverse Jacobian, dimensionless; (...).

    Rotations are scaled by the platform's radius, so a row is about a unit direction; zero
    means that the platform can move with all joints locked.
    """
    centres = np.concatenate([theta[..., g.index[:, :3]] for g in layout.platform], axis=-2)
    spread = centres - centres.mean(axis=-2, keepdims=True)
    radius = np.sqrt(np.mean(np.sum(spread**2, axis=-1), axis=-1))
    radius = np.where(radius > 0, radius, 1.0)[..., None]  # legs that meet in a point turn nothing
    scale = np.concatenate([np.repeat(1 / radius, 3, -1), np.ones((*radius.shape[:-1], 3))], -1)
    jac = (by_pose * scale[..., None, :]) @ layout.motion
    if layout.n_equations < jac.shape[-1]:  # fewer than its freedoms: it can always move
        return np.zeros(jac.shape[:-2])
    return np.linalg.svd(jac, compute_uv=False)[..., -1]


def home_candidates(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Starts for a machine whose file names no home pose: the platform unturned, its joints'
    mean above (and below) the base joints' mean, at the height that the rods reach; (k, 4, 4).
    """
    ends = limb_ends(layout, theta, np.zeros_like(readings), np.eye(4))
    shift = ends.a.mean(axis=-2) - ends.b.mean(axis=-2)
    reach = _reach(layout, theta, readings)
    flat = float(np.linalg.norm((ends.b + shift - ends.a)[..., :2], axis=-1).mean())
    height = np.sqrt(max(reach**2 - flat**2, (0.3 * reach) ** 2))
    starts = [pose(np.eye(3), shift + np.array([0.0, 0.0, s * height])) for s in (1, -1)]
    if layout.motion.shape[1] == 3 and layout.motion[2, 0] == 1:
        starts = [pose(rotation(np.array([0, 0, a])), shift) for a in (0.0, 0.5, -0.5, 1.0, -1.0)]
    return np.stack(starts)


def _reach(layout: LimbLayout, theta: Array, readings: Array) -> float:
    """Mean length of the rods whose length is known, m."""
    return float(np.abs(rod_lengths(layout, theta, readings)[layout.closing]).mean())


def on_manifold(layout: LimbLayout, theta: Array, poses: Array) -> ForwardResult:
    """Poses (..., 4, 4) moved to where everything closes that no drive can change.

    Constant rods and joints' axes leave a platform only some poses; readings follow from these.
    Gauss-Newton with the shortest step, so a pose that is right stays where it is.
    """
    passive = np.ones(layout.n_equations, dtype=bool)
    passive[layout.driven_rows] = False
    current, zeros = np.array(poses), np.zeros((*poses.shape[:-2], layout.driven_rows.size))
    c = closure(layout, theta, zeros, current)
    for _ in range(MAX_STEPS if passive.any() else 0):
        value = c.value[..., passive]
        if np.abs(value).max() < CONVERGED * 1e-2:
            break
        jac = c.by_pose[..., passive, :] @ layout.motion
        step = -np.linalg.pinv(jac) @ value[..., None]
        current = perturb(current, (layout.motion @ step)[..., 0])
        c = closure(layout, theta, zeros, current)
    error = np.abs(c.value[..., passive]).max(axis=-1, initial=0.0)
    return ForwardResult(current, error < CONVERGED, error, singularity(layout, theta, c.by_pose))


def assembly_modes(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    rng: np.random.Generator,
    starts: int = 400,
) -> Array:
    """Distinct poses that close the machine at one set of readings (m,): (k, 4, 4).

    A multi-start search: every mode returned is one; that none is missing is not proven.
    """
    home = home_candidates(layout, theta, readings)[0]
    reach = _reach(layout, theta, readings)
    turns = rng.normal(size=(starts, 3)) * 1.2
    shifts = rng.normal(size=(starts, 3)) * reach
    delta = np.concatenate([turns, shifts], axis=-1) @ layout.motion @ layout.motion.T
    found = forward(layout, theta, readings, perturb(home, delta))
    poses = found.T_base_platform[found.converged]
    kept: list[Array] = []
    for candidate in poses:  # few distinct ones: a loop over results, not over work
        if all(np.abs(candidate - other).max() > 1e-6 for other in kept):
            kept.append(candidate)
    return np.stack(kept) if kept else np.zeros((0, 4, 4))
