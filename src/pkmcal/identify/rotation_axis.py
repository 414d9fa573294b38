"""Test of a board's rotations between its poses: any axis, one axis, or none; [C] III.B, IV.B.

Before any identification, the rotations of a board in one camera show the platform's degrees of
freedom. The hypothesis of the mechanism file (an H4 turns about one axis, a delta does not turn) is
tested by chi2 with the poses' own noise; the scatter of an axis alone is no evidence (errata, [C]).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import (
    cross,
    dot,
    nearest_rotation,
    pose,
    rotation,
    rotation_vector,
    skew,
)
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM
from pkmcal.identify.measured_platform import taken
from pkmcal.levels import FALSE_ALARM
from pkmcal.measurements import PoseSet
from pkmcal.measurements.poses import turn_jacobian
from pkmcal.mechanisms.document import MOTION_DIRECTIONS

Turning = Literal["none", "one axis", "any"]
TURNING_BY_FREEDOMS: dict[int, Turning] = {0: "none", 1: "one axis", 3: "any"}
"""Hypothesis by the number of rotations in a machine's motion."""
ROTATION_AXIS_STEPS = 10
MOST_TURN_PAIRS = 200_000


@dataclass(frozen=True)
class RotationAxis:
    """Test of the rotations of the boards of one camera and mount.

    hypothesis : rotations that the machine's motion allows.
    tilt : (N,) rad, deviation of each pose from the hypothesis.
    expected_tilt : (N,) RMS deviation due to noise alone.
    spread, expected_spread : rad, weighted RMS angle between the axes of pairs of poses and their
        mean, and its value due to noise alone; NaN without pairs that turn.
    chi2, dof, p_value : of the hypothesis; dof 0 and p_value 1 if there is nothing to test.
    """

    hypothesis: Turning
    tilt: Array
    expected_tilt: Array
    spread: float
    expected_spread: float
    chi2: float
    dof: int
    p_value: float

    @property
    def tenable(self) -> bool:
        """Whether noise, or noise a little larger than stated, explains the deviations."""
        return self.chi2 <= SESSION_FALSE_ALARM.usual_scale(self.dof) ** 2 * self.dof

    @property
    def sentence(self) -> str:
        """Result of the test as a sentence."""
        if self.hypothesis == "any":
            return "The platform may turn about any axis, so there is nothing to test."
        rms, expected = (
            np.degrees(np.sqrt(np.mean(x**2))) for x in (self.tilt, self.expected_tilt)
        )
        facts = (
            f"the poses are {rms:.3f}° off, noise alone gives {expected:.3f}°"
            f" (χ² {self.chi2:.0f} on {self.dof} degrees of freedom)"
        )
        one = self.hypothesis == "one axis"
        if self.tenable:
            retained = "turn about one axis" if one else "do not turn"
            return f"The boards {retained}, within their noise: {facts}."
        broken = "do not turn about one axis alone" if one else "turn, and the machine should not"
        return f"The boards {broken}: {facts}. The model leaves something out."


def rotation_axis(poses: PoseSet, motion: str) -> RotationAxis:
    """Test for poses of one camera and one mount; motion : name in the mechanism file.

    Needs one pose more than the hypothesis has unknowns: three for one axis.
    """
    from scipy.special import chdtrc

    hypothesis = TURNING_BY_FREEDOMS[int(MOTION_DIRECTIONS[motion][:3].any(axis=1).sum())]
    rot = poses.T_station_target[:, :3, :3]
    noise = np.linalg.inv(poses.whiten.mT @ poses.whiten)[:, :3, :3]
    if hypothesis == "any":
        unknowns, off, covariance = 0, np.zeros((len(rot), 0)), np.zeros((len(rot), 0, 0))
    elif hypothesis == "one axis":
        unknowns = 4
        off, covariance = _about_one(rot, noise)
    else:
        unknowns = 3
        off, covariance = _unturned(rot, noise)
    chi2 = float(np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0]))
    dof = max(off.size - unknowns, 0)
    spread, expected_spread = _pairwise(rot, noise)
    return RotationAxis(
        hypothesis=hypothesis,
        tilt=np.linalg.norm(off, axis=-1),
        expected_tilt=np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)),
        spread=spread,
        expected_spread=expected_spread,
        chi2=chi2,
        dof=dof,
        p_value=float(chdtrc(dof, chi2)) if dof else 1.0,
    )


class Frames(NamedTuple):
    """Frames of a common axis of rotation: ``measured = camera Rz(angle) board``, (..., 3, 3)
    each.
    """

    camera: Array
    board: Array


def axis_frames(rot: Array) -> Frames:
    """Common axis of rotations (..., N, 3, 3), closed form.

    ``R_k a_board = a_camera`` for all k, so the two are the singular vectors of the mean rotation
    for its singular value 1.
    """
    u, _, vt = np.linalg.svd(rot.mean(axis=-3))
    camera, board = u[..., :, 0], vt[..., 0, :]
    return Frames(facing(camera), facing(board).mT)


def facing(direction: Array) -> Array:
    """Rotation (..., 3, 3) whose z axis is the unit direction (..., 3)."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    x = cross(direction, least)
    x = x / np.sqrt(dot(x, x))[..., None]
    return np.stack([x, cross(direction, x), direction], axis=-1)


def _about_one(rot: Array, noise: Array) -> tuple[Array, Array]:
    """Tilts (N, 2) from one axis and their covariance, by maximum likelihood."""
    frames = axis_frames(rot)
    for _ in range(ROTATION_AXIS_STEPS):
        off, by, own, covariance = _tilts(rot, noise, frames)
        # derivatives of the tilts: the camera's rotation about its x, y, the board's about the
        # axis' x, y
        jac = np.concatenate([-by[..., :2], -(by @ own)[..., :2]], axis=-1)
        weigh = np.linalg.inv(np.linalg.cholesky(covariance))
        rows, value = (weigh @ jac).reshape(-1, 4), (weigh @ off[..., None]).ravel()
        step = -np.linalg.lstsq(rows, value, rcond=1e-9)[0]
        turns = np.concatenate([step.reshape(2, 2), np.zeros((2, 1))], axis=1)
        frames = Frames(frames.camera @ rotation(turns[0]), rotation(turns[1]) @ frames.board)
    off, _, _, covariance = _tilts(rot, noise, frames)
    return off, covariance


def _tilts(rot: Array, noise: Array, frames: Frames) -> tuple[Array, Array, Array, Array]:
    """Tilts of rotations in the frames, with derivatives and covariance.

    Returns tilts (N, 2), their derivatives (N, 2, 3) by the rotations in the frames, these
    rotations (N, 3, 3), and the tilts' covariance (N, 2, 2).
    """
    back = frames.camera.mT
    own = back @ rot @ frames.board.mT
    count = taken(MOTION_DIRECTIONS["schoenflies"], pose(own, np.zeros((len(rot), 3))))
    by = count.off_by[..., :3]
    return count.off, by, own, by @ back @ noise @ frames.camera @ by.mT


def _unturned(rot: Array, noise: Array) -> tuple[Array, Array]:
    """Rotations (N, 3) from the weighted mean orientation, and their covariance."""
    mean = nearest_rotation(rot.mean(axis=0))
    weight = np.linalg.inv(noise)
    for _ in range(ROTATION_AXIS_STEPS):
        off = rotation_vector(rot @ mean.T)
        total = np.sum(weight @ off[..., None], axis=0)
        mean = rotation(np.linalg.solve(weight.sum(axis=0), total)[:, 0]) @ mean
    off = rotation_vector(rot @ mean.T)
    by = turn_jacobian(off)
    return off, by @ noise @ by.mT


def _pairwise(rot: Array, noise: Array) -> tuple[float, float]:
    """RMS scatter (rad) of the axes of rotation between two poses, and its value from noise alone.

    In the camera frame. A rotation phi with noise n of its two poses moves the axis by n / (2
    sin(phi / 2)) across, and each axis has the weight of the inverse of its variance by noise.
    Pairs that noise alone may have turned have no axis.
    """
    from scipy.special import chdtri

    # rotations of all pairs that turn by more than noise
    i, j = _pairs(len(rot))
    turn = rotation_vector(rot[j] @ rot[i].mT)
    angle = np.sqrt(dot(turn, turn))
    square = dot(np.linalg.solve(noise[i] + noise[j], turn[..., None])[..., 0], turn)
    used = square > chdtri(3, FALSE_ALARM / max(len(turn), 1))
    if used.sum() < 2:
        return np.nan, np.nan
    i, j, turn, angle = i[used], j[used], turn[used], angle[used]
    # variance of each axis from the noise of its two poses
    axis = turn / angle[:, None]
    by = turn_jacobian(turn)  # by the later pose; the earlier pose's is its other half
    across = (np.eye(3) - axis[:, :, None] * axis[:, None, :]) @ by / angle[:, None, None]
    back = across @ rot[j] @ rot[i].mT
    covariance = across @ noise[j] @ across.mT
    covariance = covariance + back @ noise[i] @ back.mT
    weight = 1 / np.trace(covariance, axis1=-2, axis2=-1)
    # mean axis, with a common sign
    main = np.linalg.eigh((weight[:, None] * axis).T @ axis)[1][:, -1]
    axis = axis * np.where(axis @ main < 0, -1.0, 1.0)[:, None]
    mean = weight @ axis
    mean = mean / np.linalg.norm(mean)
    apart = np.linalg.norm(skew(mean) @ axis[..., None], axis=(-1, -2))
    square = np.arctan2(apart, dot(axis, mean)) ** 2
    value, expected = np.sqrt([weight @ square / weight.sum(), len(weight) / weight.sum()])
    return float(value), float(expected)


def _pairs(n: int) -> tuple[Integers, Integers]:
    """Pairs i < j of n, in row-major order; an even subset of at most MOST_TURN_PAIRS.

    The number of pairs grows with the square of n, and the subset gives as good a mean.
    """
    first, total = np.arange(n), n * (n - 1) // 2
    before = first * (2 * n - first - 1) // 2
    if total > MOST_TURN_PAIRS:
        number = np.linspace(0, total - 1, MOST_TURN_PAIRS).astype(int)
    else:
        number = np.arange(total)
    i = np.searchsorted(before, number, side="right") - 1
    return i, number - before[i] + i + 1
