"""Errors of the platform's pose by errors of the parameters, before and after calibration.

The platform's pose is the purpose of a calibration; joint centres and lengths are a means to it.
Legs that do not hold the platform (four cables under a spatial one) determine no pose by their
readings. The purpose is then their lengths at given poses, which a controller commands.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.centres import Centres, free_of_gauge, joint_centres
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.gauge import freedoms, pose_generators, respecting_motion
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import by_own, closure, dense, limb_ends
from pkmcal.mechanisms.kinematics import on_manifold
from pkmcal.solver.ranks import nonzero


@dataclass(frozen=True)
class PoseSamplingOptions:
    """Constants of the poses sampled around a session's, which weigh errors outside of its
    workspace.
    """

    # number of samples, and their seed
    count: int = 40
    seed: int = 4
    # range of the rotation, rad
    turn: float = 0.2
    # range of the translation, relative to the machine's size, the mean distance from base to
    # platform plus the platform's radius
    shift: float = 0.12
    # smallest distance of a sample from singular poses, relative to the median over the session:
    # near a singular pose any error is amplified, and no machine works there. Readings determine
    # the worst motion of a sample with at least half of the information that they have in the
    # session's poses. It affects the stated tool errors only; not checked within a factor of two
    regular: float = 0.7


_SAMPLING = PoseSamplingOptions()


def pose_by_parameters(machine: Machine, joints: Array, poses: Array) -> Array:
    """Derivatives (n, 6, P) of the pose (omega, tau) by the parameters at given readings.

    By the implicit function closure(theta, X) = 0 at given readings: dX = -(dc/dX)^+ dc/dtheta,
    where X is the pose and, for platforms with hinges, their angles. The legs hold the platform.

    joints : (n, m) readings.
    poses : (n, 4, 4) T_base_platform.
    """
    layout = machine.layout
    internal = machine.forward_result(joints, poses).internal if layout.n_internal else None
    c = closure(layout, machine.values, joints, poses, internal)
    by_theta = dense(c, len(machine.values))
    return -layout.own_motion[:6] @ np.linalg.pinv(by_own(layout, c.rows)) @ by_theta


def platform_by_parameters(machine: Machine, T_base_platform: Array) -> Array:
    """Displacements (r, P) of the platform's joints by the parameters at given readings, frames
    removed; of legs that do not hold the platform, the errors of their lengths at given poses.

    Rows are coordinates of the joints at the session's poses (K, 4, 4) and at samples around them,
    divided by the root of the number of joints and poses: for a change v of the parameters,
    ``norm(out @ v)`` is the joints' root mean square displacement, m. Joints on side bars are
    treated as fixed to the centre bar, which carries the tool.
    """
    joints, poses = _around(machine, T_base_platform)
    if machine.layout.underdetermined:
        c = closure(machine.layout, machine.values, joints, poses)
        points, shifted = c.rows.by_pose[:, :, None], dense(c, len(machine.values))[:, :, None]
    else:
        points = limb_ends(machine.layout, machine.values, joints, poses).b_by_pose
        shifted = points @ pose_by_parameters(machine, joints, poses)[:, None]
    # all frame changes, whether the parameters can follow or not, since frames are conventions
    frames = points @ (pose_generators(poses) @ respecting_motion(machine.layout.motion))[:, None]
    shifted = shifted.reshape(-1, shifted.shape[-1])
    frames = frames.reshape(len(shifted), -1)
    u, s, _ = np.linalg.svd(frames, full_matrices=False)
    u = u[:, nonzero(s)]
    shifted = shifted - u @ (u.T @ shifted)
    return shifted / np.sqrt(len(poses) * machine.n_legs)


def platform_sigma(estimate: Estimate) -> float:
    """Standard deviation of the platform's joints at given readings, m: root mean square over all
    joints and over the session's poses and samples around them (:func:`platform_by_parameters`).

    Refusals compare this one (:mod:`pkmcal.identify.verdict`). The verdict's headline and the
    report have means over the session's poses of the platform's origin
    (:attr:`ToolAccuracy.position`).
    """
    used = estimate.state.T_base_platform[estimate.configurations]
    by = platform_by_parameters(estimate.machine, used)
    return float(np.sqrt(np.sum((by @ estimate.covariance) * by)))


def _around(machine: Machine, T_base_platform: Array) -> tuple[Array, Array]:
    """Readings and poses of the session, and of samples around it, that the machine can take.

    Raises ResultError if it can take none.
    """
    rng = np.random.default_rng(_SAMPLING.seed)
    layout = machine.layout
    base, platform = machine.base_centers(), machine.platform_centers()
    start = T_base_platform[rng.integers(len(T_base_platform), size=_SAMPLING.count)]
    lift = float(np.linalg.norm(start[:, :3, 3].mean(axis=0) - base.mean(axis=0)))
    size = lift + float(np.linalg.norm(platform, axis=-1).max())
    reach = np.array([_SAMPLING.turn] * 3 + [_SAMPLING.shift * size] * 3)
    step = rng.uniform(-1, 1, (_SAMPLING.count, 6)) * reach
    start = perturb(start, step @ layout.motion @ layout.motion.T)
    # constant legs and joints with axes restrict the poses: samples are projected onto these
    value = on_manifold(layout, machine.values, start)
    own = on_manifold(layout, machine.values, T_base_platform).singularity
    regular = value.converged & (value.singularity >= _SAMPLING.regular * float(np.nanmedian(own)))
    return closed_poses(machine, np.concatenate([T_base_platform, value.T_base_platform[regular]]))


def closed_poses(machine: Machine, poses: Array) -> tuple[Array, Array]:
    """Readings (n, m) and poses (n, 4, 4), of those poses (N, 4, 4) that the machine can take.

    Estimated poses close the machine up to the readings' noise: where cranks and rods are nearly in
    line, no readings close it exactly. Raises ResultError if it can take none.
    """
    joints = machine.inverse(poses)
    closes = np.isfinite(joints).all(axis=-1)
    if not closes.any():
        raise ResultError(
            what="the estimated machine can take none of the poses at which it is judged"
        )
    return joints[closes], poses[closes]


@dataclass(frozen=True)
class ToolAccuracy:
    """Errors of n poses of the platform.

    The covariance after calibration, and the differences from the nominal model's poses; NaN where
    the machine, or the nominal model, cannot take a pose.

    T_base_platform : (n, 4, 4) as calibrated.
    by_parameters : (n, 6, P) derivatives of the poses (omega, tau), left perturbation, frames
        removed.
    parameters : (P, P) covariance of the parameters in the same gauge.
    off : (n, 6) difference from the calibrated pose to the nominal one at the same readings, frames
        aligned.
    by_lengths : (r, P) of legs that do not hold the platform, :func:`platform_by_parameters`; all
        of the above is NaN then.
    """

    T_base_platform: Array
    by_parameters: Array
    parameters: Array
    off: Array
    by_lengths: Array | None = field(default=None, repr=False)

    __repr__ = short_repr

    def first(self, n: int) -> ToolAccuracy:
        """Errors of the first n poses."""
        return replace(
            self,
            T_base_platform=self.T_base_platform[:n],
            by_parameters=self.by_parameters[:n],
            off=self.off[:n],
        )

    @cached_property
    def covariance(self) -> Array:
        """Covariance (n, 6, 6) of (omega, tau), rad and m, by the parameters; without the noise of
        readings.
        """
        return self.by_parameters @ self.parameters @ self.by_parameters.mT

    @property
    def position(self) -> Array:
        """Standard deviations (n,) of the platform's origin, root of the summed variances, m."""
        return np.sqrt(np.maximum(np.trace(self.covariance[:, 3:, 3:], axis1=1, axis2=2), 0.0))

    @property
    def orientation(self) -> Array:
        """Standard deviations (n,) of the platform's rotation, root of the summed variances,
        rad.
        """
        return np.sqrt(np.maximum(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2), 0.0))

    @property
    def sigma(self) -> float:
        """Root mean square of :attr:`position`, m, at the origin; of legs that do not hold the
        platform, that of their lengths. For all joints see :func:`platform_sigma`.
        """
        if self.by_lengths is not None:
            return float(np.sqrt(np.sum((self.by_lengths @ self.parameters) * self.by_lengths)))
        return float(np.sqrt(np.nanmean(self.position**2)))

    def shift(self, change: Array) -> float:
        """Root mean square displacement, m, of that for which :attr:`sigma` is, by a change (P,) of
        the parameters.
        """
        if self.by_lengths is not None:
            return float(np.linalg.norm(self.by_lengths @ change))
        shifted = np.linalg.norm((self.by_parameters @ change)[:, 3:], axis=-1)
        return float(np.sqrt(np.nanmean(shifted**2)))

    @property
    def off_position(self) -> Array:
        """Distances (n,) of the nominal from the calibrated origin, m."""
        return np.linalg.norm(self.off[:, 3:], axis=-1)

    @property
    def off_orientation(self) -> Array:
        """Angles (n,) between the nominal and the calibrated platform, rad."""
        return np.linalg.norm(self.off[:, :3], axis=-1)


def checked_poses(poses: Array) -> Array:
    """Poses as an array (n, 4, 4). Raises InputError for another shape or numbers that are not
    finite.
    """
    array = np.asarray(poses, dtype=float)
    if array.ndim != 3 or array.shape[1:] != (4, 4) or not np.isfinite(array).all():
        raise InputError(
            what="the tool's error is asked for at what are no poses",
            found=f"an array of shape {array.shape}"
            + ("" if np.isfinite(array).all() else ", with numbers that are none"),
            expected="T_base_platform, (n, 4, 4)",
        )
    return array


def centres_and_tool(
    nominal: Machine, estimate: Estimate, joints: Array | None
) -> tuple[tuple[Centres, ...], ToolAccuracy]:
    """Joint centres of an estimate, and errors of the poses of the configurations in use,
    gauge-free.

    joints : (K, m) readings; by default those at which the calibrated machine takes the poses.
    """
    machine, used = estimate.machine, estimate.configurations
    covariance = free_of_gauge(machine, estimate.covariance)
    in_view = estimate.edge_weights.size > 0
    poses = estimate.state.T_base_platform[used]
    readings = None if joints is None else joints[used]
    tool = tool_error(nominal, machine, covariance, poses, readings, legs_observed=in_view)
    return joint_centres(nominal, machine, covariance), tool


def tool_error(
    nominal: Machine,
    calibrated: Machine,
    covariance: Array,
    poses: Array,
    joints: Array | None = None,
    *,
    legs_observed: bool = True,
    fitted: Integers | None = None,
) -> ToolAccuracy:
    """Errors of poses T_base_platform (n, 4, 4) of the calibrated machine and of the nominal model.

    covariance : (P, P) of the parameters about the best fit of the frames
        (:func:`~pkmcal.identify.centres.free_of_gauge`), so that no three joints define the frames.
    joints : (n, m) readings at the poses. By default the poses are first projected onto those that
        rods and axes allow, and the readings are those of the calibrated machine.
    legs_observed : whether legs were measured, which determine the joint centres and thereby the
        frames. A board leaves shifts of joints that do not move the platform undetermined, so
        without legs the frames are aligned by the poses.
    fitted : (k,) poses that align the frames, all by default.
    """
    layout, n, theta = calibrated.layout, len(poses), calibrated.values
    if joints is None:
        closed = on_manifold(layout, theta, poses)
        poses, joints = closed.T_base_platform, calibrated.inverse(closed.T_base_platform)
        reached: Booleans = closed.converged & np.isfinite(joints).all(axis=-1)
    else:
        reached = np.ones(n, dtype=bool)
    if layout.underdetermined:
        none = np.full((n, 6, theta.size + 1), np.nan)
        by_lengths = platform_by_parameters(calibrated, poses)
        return ToolAccuracy(poses, none[..., 1:], covariance, none[..., 0], by_lengths)
    # derivatives, and differences to the nominal model, at the poses that can be taken
    rows = np.flatnonzero(reached)
    jacobian = np.full((n, 6, theta.size), np.nan)
    jacobian[rows] = pose_by_parameters(calibrated, joints[rows], poses[rows])
    off = np.full((n, 6, 1), np.nan)
    off[rows, :, 0] = _off(nominal, calibrated, joints[rows], poses[rows])
    # frames removed from both
    by, off = (
        without_frames(calibrated, poses, change, every=not legs_observed, fitted=fitted)
        for change in (jacobian, off)
    )
    return ToolAccuracy(poses, by, covariance, off[..., 0])


def without_frames(
    machine: Machine,
    poses: Array,
    change: Array,
    *,
    every: bool = False,
    fitted: Integers | None = None,
) -> Array:
    """Changes (n, 6, m) of poses with their best-fitting frame changes of base and platform
    removed.

    The fit is by least squares over the poses with finite changes; rotations are weighted by the
    radius of the platform's joints. Only frame changes that preserve the motion are removed.

    every : remove all of them. By default only those that the parameters cannot follow, because
        some are fixed or tied; the parameters' covariance does not contain the others.
    fitted : (k,) poses for the fit, all by default.
    """
    rest = respecting_motion(machine.layout.motion)
    if not every:
        followed = np.linalg.qr(freedoms(machine))[0]
        u, s, _ = np.linalg.svd(rest - followed @ (followed.T @ rest), full_matrices=False)
        rest = u[:, s > ROUNDING]
    finite = np.asarray(np.isfinite(change).all(axis=(1, 2)))
    values = np.flatnonzero(finite) if fitted is None else fitted[finite[fitted]]
    if not rest.shape[1] or not values.size:
        return change
    size = float(np.linalg.norm(machine.platform_centers(), axis=-1).max())
    unit = np.array([max(size, 1e-3)] * 3 + [1.0] * 3)[:, None]
    frames = pose_generators(poses) @ rest
    rows = (unit * frames[values]).reshape(-1, rest.shape[1])
    flat = (unit * change[values]).reshape(len(rows), -1)
    return change - frames @ np.linalg.lstsq(rows, flat, rcond=1e-9)[0]


def _off(nominal: Machine, calibrated: Machine, joints: Array, poses: Array) -> Array:
    """Differences (n, 6) of the nominal from the calibrated poses, left perturbation; NaN where
    either machine cannot take the pose.

    Only components along the motion count. The registration of joint centres may tilt the frames
    against each other, for a delta or a planar machine with joints at several heights, without a
    tilt of the platform.
    """
    along = calibrated.layout.motion @ calibrated.layout.motion.T
    nothing = np.zeros((calibrated.values.size, calibrated.values.size))
    centres = joint_centres(nominal, calibrated, nothing)
    base, platform = (side.T_calibrated_nominal for side in centres)
    start = pose_difference(inverse(base) @ poses @ platform, poses) @ along
    before = nominal.forward_result(joints, perturb(poses, start))
    after = calibrated.forward_result(joints, poses)
    shifted = base @ before.T_base_platform @ inverse(platform)
    difference = pose_difference(shifted, after.T_base_platform) @ along
    good = before.converged & after.converged
    return np.where(good[:, None], difference, np.nan)
