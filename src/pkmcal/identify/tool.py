"""Where the platform is: what errors of the parameters do to it, how sure that is, and how wrong
the drawing was. A calibration is for this; joints and lengths are the way to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.centres import Centres, free_of_gauge, joint_centres
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import freedoms, pose_generators, respecting_motion
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


@dataclass(frozen=True)
class ToolPoint:
    """Uncertainty and change of the platform's pose at the configurations in use.

    configurations : (n,) their numbers. position, orientation : (n,) standard deviations of the
    platform's origin (m, root of the summed variances) and of its rotation (rad).
    off_position, off_orientation : (n,) how far the drawing's pose is from the calibrated one at
    the same readings (m, rad), frames laid over each other; NaN where the drawing has no pose.
    """

    configurations: Integers
    position: Array
    orientation: Array
    off_position: Array
    off_orientation: Array


def centres_and_tool(
    drawing: Machine, estimate: Estimate, joints: Array
) -> tuple[tuple[Centres, ...], ToolPoint]:
    """Joint centres and the platform's poses of an estimate, no frame favoured; joints (K, m)."""
    covariance = free_of_gauge(estimate)
    centres = joint_centres(drawing, estimate.machine, covariance)
    tool = tool_point(
        drawing,
        estimate.machine,
        covariance,
        joints,
        estimate.state.T_base_platform,
        np.flatnonzero(estimate.configurations),
        centres,
        legs_seen=estimate.edge_weights.size > 0,
    )
    return centres, tool


def tool_point(
    drawing: Machine,
    calibrated: Machine,
    covariance: Array,
    joints: Array,
    poses: Array,
    used: Integers,
    centres: tuple[Centres, ...],
    *,
    legs_seen: bool = True,
) -> ToolPoint:
    """How well the poses of the configurations ``used`` (n,) are known, and how wrong they were.

    covariance : (P, P) about the best fit of the frames, so that no three joints carry the
    uncertainty of all. joints (K, m), poses T_base_platform (K, 4, 4). legs_seen : whether legs
    tell where the joints are, and these the frames. A board leaves open what shifts joints and
    moves nothing, so without legs frames are by the poses themselves.
    """
    jacobian = pose_by_parameters(calibrated, joints[used], poses[used])
    jacobian = without_frames(calibrated, poses[used], jacobian, every=not legs_seen)
    variance = np.einsum("kip,pq,kiq->ki", jacobian, covariance, jacobian)
    off = _off(drawing, calibrated, joints[used], poses[used], centres)
    good = np.isfinite(off).all(axis=1)
    left = without_frames(calibrated, poses[used][good], off[good][..., None], every=not legs_seen)
    off[good] = left[..., 0]
    return ToolPoint(
        configurations=used,
        position=np.sqrt(variance[:, 3:].sum(axis=-1)),
        orientation=np.sqrt(variance[:, :3].sum(axis=-1)),
        off_position=np.linalg.norm(off[:, 3:], axis=-1),
        off_orientation=np.linalg.norm(off[:, :3], axis=-1),
    )


def without_frames(machine: Machine, poses: Array, change: Array, *, every: bool = False) -> Array:
    """Changes (n, 6, m) of poses less what only turns or shifts base and platform as wholes.

    By least squares. Only frame changes that keep the motion, and, but for ``every`` one, that no
    parameters follow (some are fixed, or tied): what parameters follow is taken out of their
    covariance already.
    """
    rest = respecting_motion(machine.layout.motion)
    if not every:
        followed = np.linalg.qr(freedoms(machine))[0]
        u, s, _ = np.linalg.svd(rest - followed @ (followed.T @ rest), full_matrices=False)
        rest = u[:, s > 1e-9]
    if not rest.shape[1] or not len(poses):
        return change
    size = float(np.linalg.norm(machine.platform_centers(), axis=-1).max())
    unit = np.array([max(size, 1e-3)] * 3 + [1.0] * 3)[:, None]
    frames = (unit * (pose_generators(poses) @ rest)).reshape(-1, rest.shape[1])
    flat = (unit * change).reshape(len(frames), -1)
    left = flat - frames @ np.linalg.lstsq(frames, flat, rcond=1e-9)[0]
    return left.reshape(change.shape) / unit


def _off(
    drawing: Machine, calibrated: Machine, joints: Array, poses: Array, centres: tuple[Centres, ...]
) -> Array:
    """Differences (n, 6) of the drawing's poses from the calibrated ones, left perturbation."""
    base, platform = (side.T_calibrated_drawing for side in centres)
    before = drawing.forward_result(joints, inverse(base) @ poses @ platform)
    after = calibrated.forward_result(joints, poses)
    moved = base @ before.T_base_platform @ inverse(platform)
    difference = pose_difference(moved, after.T_base_platform)
    good = before.converged & after.converged
    return np.where(good[:, None], difference, np.nan)
