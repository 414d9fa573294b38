"""What the calibration is for: where the platform is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.centres import Centres
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
    spread = pose_covariance(calibrated, covariance, joints[used], poses[used])
    variance = np.einsum("kii->ki", spread)
    off = _off(drawing, calibrated, joints[used], poses[used], centres)
    return ToolPoint(
        configurations=used,
        position=np.sqrt(variance[:, 3:].sum(axis=-1)),
        orientation=np.sqrt(variance[:, :3].sum(axis=-1)),
        off_position=np.linalg.norm(off[:, 3:], axis=-1),
        off_orientation=np.linalg.norm(off[:, :3], axis=-1),
    )


def pose_covariance(machine: Machine, covariance: Array, joints: Array, poses: Array) -> Array:
    """Covariance (n, 6, 6) of (omega, tau) of T_base_platform from the parameters' (P, P).

    From the implicit function closure(theta, X) = 0 at given readings: dX = -(dc/dX)^+ dc/dtheta.
    """
    layout = machine.layout
    c = closure(layout, machine.values, joints, poses)
    by_pose = c.by_pose @ layout.motion
    by_theta = dense(c, len(machine.values))
    jacobian = -layout.motion @ np.linalg.pinv(by_pose) @ by_theta
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


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
