"""What the calibration is for: where the platform is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.centres import Centres
from pkmcal.identify.gauge import freedoms, pose_generators, respecting_motion
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.limbs import closure, dense


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


def tool_point(
    drawing: Machine,
    calibrated: Machine,
    covariance: Array,
    joints: Array,
    poses: Array,
    used: Integers,
    centres: tuple[Centres, ...],
) -> ToolPoint:
    """How well the poses of the configurations ``used`` (n,) are known, and how wrong they were.

    covariance : (P, P) about the best fit of the frames, so that no three joints carry the
    uncertainty of all. joints (K, m), poses T_base_platform (K, 4, 4).
    """
    jacobian = pose_jacobian(calibrated, joints[used], poses[used])
    jacobian = without_frames(calibrated, poses[used], jacobian)
    variance = np.einsum("kip,pq,kiq->ki", jacobian, covariance, jacobian)
    off = _off(drawing, calibrated, joints[used], poses[used], centres)
    good = np.isfinite(off).all(axis=1)
    off[good] = without_frames(calibrated, poses[used][good], off[good][..., None])[..., 0]
    return ToolPoint(
        configurations=used,
        position=np.sqrt(variance[:, 3:].sum(axis=-1)),
        orientation=np.sqrt(variance[:, :3].sum(axis=-1)),
        off_position=np.linalg.norm(off[:, 3:], axis=-1),
        off_orientation=np.linalg.norm(off[:, :3], axis=-1),
    )


def pose_covariance(machine: Machine, covariance: Array, joints: Array, poses: Array) -> Array:
    """Covariance (n, 6, 6) of (omega, tau) of T_base_platform from the parameters' (P, P)."""
    jacobian = pose_jacobian(machine, joints, poses)
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def without_frames(machine: Machine, poses: Array, change: Array) -> Array:
    """Changes (n, 6, m) of poses less what only turns or shifts base and platform as wholes.

    By least squares. Only frame changes that keep the motion, and that no parameters follow (some
    are fixed, or tied): what parameters follow is taken out of their covariance already.
    """
    allowed = respecting_motion(machine.layout.motion)
    followed = np.linalg.qr(freedoms(machine))[0]
    rest = allowed - followed @ (followed.T @ allowed)
    u, s, _ = np.linalg.svd(rest, full_matrices=False)
    rest = u[:, s > 1e-9]
    if not rest.shape[1] or not len(poses):
        return change
    size = float(np.linalg.norm(machine.platform_centers(), axis=-1).max())
    unit = np.array([max(size, 1e-3)] * 3 + [1.0] * 3)[:, None]
    frames = (unit * (pose_generators(poses) @ rest)).reshape(-1, rest.shape[1])
    flat = (unit * change).reshape(len(frames), -1)
    left = flat - frames @ np.linalg.lstsq(frames, flat, rcond=1e-9)[0]
    return left.reshape(change.shape) / unit


def pose_jacobian(machine: Machine, joints: Array, poses: Array) -> Array:
    """Derivatives (n, 6, P) of (omega, tau) of T_base_platform by the parameters.

    From the implicit function closure(theta, X) = 0 at given readings: dX = -(dc/dX)^+ dc/dtheta.
    """
    layout = machine.layout
    internal = machine.forward_result(joints, poses).internal if layout.n_internal else None
    c = closure(layout, machine.values, joints, poses, internal)
    by_theta = dense(c, len(machine.values))
    return -layout.own_motion[:6] @ np.linalg.pinv(layout.by_own(c)) @ by_theta


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
