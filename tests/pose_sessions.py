"""Board poses of true machines without images: [C]'s session, for tests of estimates."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.geometry.rigid import inverse, look_at, perturb, pose, pose_difference, rotation
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.bundle import bundle
from pkmcal.identify.covariance import Information
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.start import start_state
from pkmcal.measurements import EdgeSet, Measurements, Mount, PoseSet
from pkmcal.mechanisms import kinematics

POSE_SIGMA = np.repeat([np.deg2rad(0.03), 2e-4], 3)
"""Noise of a board's pose from an image, rad and m ([C] IV.A)."""
JOINT_NOISE = 1e-5
T_CAMERA_BASE = look_at(np.array([0.92, 0.1, -0.33]), np.array([0.03, 0, -0.45]), np.eye(3)[2])
T_PLATFORM_BOARD = pose(rotation(np.array([0.3, 1.2, 0.4])), np.array([0.03, 0.02, -0.04]))


class Case(NamedTuple):
    """A true machine, its poses (K, 4, 4) and what was measured at them."""

    truth: object
    poses: np.ndarray
    measurements: Measurements


def papers_poses():
    """[C] IV.A: 81 poses in 200 x 200 x 150 mm, three orientations, (81, 4, 4)."""
    sides = [np.linspace(-0.1, 0.1, 3)] * 2 + [np.linspace(-0.525, -0.375, 3)]
    x = np.stack(np.meshgrid(*sides, np.deg2rad([-20, 0, 20]), indexing="ij"), axis=-1)
    return upright(x.reshape(-1, 4))


def workspace(rng, count=200):
    """Poses all over the same volume."""
    return upright(rng.uniform([-0.1, -0.1, -0.525, -0.35], [0.1, 0.1, -0.375, 0.35], (count, 4)))


def upright(x):
    """Poses (n, 4, 4) of (X, Y, Z, theta), (n, 4)."""
    return pose(rotation(x[:, 3:] * np.eye(3)[2]), x[:, :3])


def allowed(machine, poses):
    """The nearest poses that the machine's rods allow."""
    if not machine.layout.n_internal:
        return poses
    value = kinematics.on_manifold(machine.layout, machine.values, poses)
    assert value.converged.all()
    return value.T_base_platform


def measured(truth, poses, rng, noise=1.0):
    """Board poses in one camera, and the readings."""
    poses = allowed(truth, poses)
    n = len(poses)
    in_view = T_CAMERA_BASE @ poses @ T_PLATFORM_BOARD
    in_view = perturb(in_view, noise * POSE_SIGMA * rng.normal(size=(n, 6)))
    joints = truth.inverse(poses)
    assert np.isfinite(joints).all()
    joints = joints + noise * JOINT_NOISE * rng.normal(size=joints.shape)
    none = np.zeros(n, dtype=int)
    whiten = np.broadcast_to(np.diag(1 / POSE_SIGMA), (n, 6, 6))
    items = PoseSet(none, np.arange(n), none, in_view, whiten)
    mounts = (Mount("board", "platform"),)
    data = Measurements(
        EdgeSet.empty(), joints, JOINT_NOISE, 1, none[:1], poses=items, mounts=mounts
    )
    return Case(truth, poses, data)


def papers_case(truth, rng, noise=1.0):
    """71 of the 81 poses, chosen at random."""
    return measured(truth, papers_poses()[rng.permutation(81)[:71]], rng, noise)


def estimated(nominal, case, rng, **options):
    """The joint estimate, the camera known to a degree and a centimetre."""
    guess = perturb(T_CAMERA_BASE, rng.normal(size=6) * np.repeat([0.02, 0.01], 3))
    start = start_state(nominal, case.measurements, guess[None])
    options = {"robust": False, "scale_noise": False, **options}
    return bundle(nominal, case.measurements, start, **options)


def predicted(machine, T_camera_base, T_platform_board, joints):
    """Poses (n, 4, 4) of the true board's place on the platform in the camera's frame."""
    body = machine.forward(joints) @ T_platform_board @ inverse(T_PLATFORM_BOARD)
    return T_camera_base @ body


def errors(truth, value, joints):
    """Root mean square of position (m) and orientation (rad) at readings, after fitting
    the frames.
    """
    expected = T_CAMERA_BASE @ truth.forward(joints)
    off = pose_difference(value, expected)
    return np.sqrt([np.mean(np.sum(part**2, axis=1)) for part in (off[:, 3:], off[:, :3])])


def score(estimate, truth, rng):
    """Position (m) and orientation (rad) errors over the workspace."""
    joints = truth.inverse(allowed(truth, workspace(rng)))
    state = estimate.state
    value = predicted(estimate.machine, state.T_camera_base[0], state.T_mount[0], joints)
    return errors(truth, value, joints)


def spread(info):
    """H with H H^T the covariance of the shared unknowns, without what nothing fixes: the camera's
    height against the board's, which moves no prediction.
    """
    rows = info.reduced.rows.reshape(-1, info.reduced.rows.shape[-1])
    rows = np.concatenate([rows, info.linear.shared_by])
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0] = 1.0
    _, s, vt = np.linalg.svd(np.linalg.qr(rows / scale, mode="r"))
    above_limit = s > 1e-9 * s[0]
    return vt[above_limit].T / s[above_limit] / scale[:, None]


def bound(machine, case, estimate, rng, draws=30):
    """Expected errors by the estimate's own covariance: Cramer-Rao, with the nominal model."""
    assembled = assemble(machine, case.measurements, default_gauge(machine))
    problem = assembled.problem
    state = batch_of(machine, assembled, estimate.state)
    half = spread(Information(problem, state))
    joints = estimate.machine.inverse(allowed(estimate.machine, workspace(rng)))
    own = np.zeros((1, len(case.poses), problem.layout.own_motion.shape[1]))
    centre = predicted(
        estimate.machine, estimate.state.T_camera_base[0], estimate.state.T_mount[0], joints
    )
    squares = []
    for _ in range(draws):
        # a tenth of an error, so that only its first order counts
        step = 0.1 * half @ rng.normal(size=half.shape[1])
        off = problem.retract(state, step[None], own)
        other = machine.with_values(problem.theta(off)[0])
        value = predicted(other, off.T_camera_base[0], off.T_mount[0], joints)
        d = pose_difference(value, centre)
        squares.append([np.mean(np.sum(p**2, axis=1)) for p in (d[:, 3:], d[:, :3])])
    return 10 * np.sqrt(np.mean(squares, axis=0))
