"""How far a change of the machine moves its platform at given readings, frames aside."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import perturb
from pkmcal.identify.gauge import pose_generators, respecting_motion
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.mechanisms.kinematics import on_manifold

SAMPLES = 40
"""Poses around the session's: what a session's few poses hide, others show."""
TURN, SHIFT = 0.2, 0.12
"""How far they reach: rad, and share of the legs' mean length."""
AS_REGULAR = 0.7
"""Part of the session's own distance from a singular pose that the others keep: near one, any
error counts manifold, and nobody works there."""
SEED = 4


def pose_by_parameters(machine: Machine, joints: Array, poses: Array) -> Array:
    """Derivatives (n, 6, P) of the pose (omega, tau) by the parameters at given readings.

    joints (n, m), poses T_base_platform (n, 4, 4). From the implicit function closure(theta, X) = 0
    at given readings: dX = -(dc/dX)^+ dc/dtheta, with X the pose and, where the platform has
    hinges, their turns.
    """
    layout = machine.layout
    internal = machine.forward_result(joints, poses).internal if layout.n_internal else None
    c = closure(layout, machine.values, joints, poses, internal)
    by_theta = dense(c, len(machine.values))
    return -layout.own_motion[:6] @ np.linalg.pinv(layout.by_own(c)) @ by_theta


def platform_by_parameters(machine: Machine, T_base_platform: Array) -> Array:
    """Displacements of the platform's joints by the parameters, (r, P); frames taken out.

    Joints on side bars count as if they were fixed to the centre bar, which carries the tool.

    Rows are the joints' coordinates at the session's poses (K, 4, 4) and at others around them,
    divided by the root of the number of joints and poses: for a change v of the parameters
    ``norm(out @ v)`` is the joints' displacement (m, root mean square).
    """
    joints, poses = _around(machine, T_base_platform)
    points = closure(machine.layout, machine.values, joints, poses).ends.b_by_pose
    moved = points @ pose_by_parameters(machine, joints, poses)[:, None]
    # whether its parameters can follow or not: frames are conventions
    frames = points @ (pose_generators(poses) @ respecting_motion(machine.layout.motion))[:, None]
    moved = moved.reshape(-1, moved.shape[-1])
    frames = frames.reshape(len(moved), -1)
    u, s, _ = np.linalg.svd(frames, full_matrices=False)
    u = u[:, s > 1e-9 * max(float(s.max(initial=0.0)), 1e-12)]
    moved = moved - u @ (u.T @ moved)
    return moved / np.sqrt(len(poses) * machine.n_legs)


def _around(machine: Machine, T_base_platform: Array) -> tuple[Array, Array]:
    """Readings and poses of the session and of samples about it that the machine can take."""
    rng = np.random.default_rng(SEED)
    layout = machine.layout
    base, platform = machine.base_centers(), machine.platform_centers()
    start = T_base_platform[rng.integers(len(T_base_platform), size=SAMPLES)]
    lift = float(np.linalg.norm(start[:, :3, 3].mean(axis=0) - base.mean(axis=0)))
    size = lift + float(np.linalg.norm(platform, axis=-1).max())
    reach = np.array([TURN] * 3 + [SHIFT * size] * 3)
    step = rng.uniform(-1, 1, (SAMPLES, 6)) * reach
    start = perturb(start, step @ layout.motion @ layout.motion.T)
    # constant legs and joints with axes leave the samples fewer ways: brought back onto them
    found = on_manifold(layout, machine.values, start)
    own = on_manifold(layout, machine.values, T_base_platform).singularity
    kept = found.converged & (found.singularity >= AS_REGULAR * float(np.median(own)))
    poses = np.concatenate([T_base_platform, found.T_base_platform[kept]])
    return machine.inverse(poses), poses
