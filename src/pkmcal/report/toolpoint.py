"""What the calibration is for: where the platform is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import inverse, pose_difference
from pkmcal.identify.centres import Centres
from pkmcal.identify.gauge import freedoms, pose_generators, respecting_motion
from pkmcal.identify.words_effect import pose_by_parameters
from pkmcal.mechanisms import Machine


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
