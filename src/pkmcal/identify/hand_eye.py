"""Robot-world/hand-eye calibration: camera and board from board poses and readings.

No rough pose is needed. Forward kinematics of the nominal model gives the platform's poses, the
images give the board's, so ``T_camera_board = T_camera_base T_base_platform T_platform_board`` is
the robot-world/hand-eye problem ([C] III.C). Rotations determine both unknown rotations if the
platform turns about two axes or more; if it turns about one axis, or not at all, positions are
needed. Unidentifiable directions (the board's height along the only axis of rotation, the board's
whole position on a platform that does not turn) are zero.

The nominal model is off by millimetres and degrees, so poses instead of corners are fitted, with
weights to match, and a pose that disagrees with the others has a small weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import (
    dot,
    from_quaternion,
    inverse,
    perturb,
    pose,
    pose_difference,
    quaternion,
    register,
    skew,
)
from pkmcal.identify.length_registration import determines_legs, register_by_lengths
from pkmcal.identify.start import middle_pose
from pkmcal.identify.state import State
from pkmcal.levels import MAJORITY
from pkmcal.measurements import Measurements
from pkmcal.measurements.poses import PoseBlocks, PoseData, pose_rows
from pkmcal.mechanisms import Machine
from pkmcal.solver.elimination import Linear
from pkmcal.solver.kernels import cauchy_weights
from pkmcal.solver.search import Values, minimise, take

DRAWN_POSE_TURN_SIGMA = 0.03
"""Standard deviation (rad) of the nominal model's platform poses: two degrees."""
DRAWN_POSE_SHIFT_SHARE = 0.02
"""Standard deviation of their positions, relative to the limbs' length: 10 mm of half a metre."""
HAND_EYE_ROUNDS = 4
LEAST_PAIR_CONFIGURATIONS = 3
"""Configurations in which a station must see a mount: two motions about different axes determine
both poses (R. Y. Tsai and R. K. Lenz, 1989)."""
HAND_EYE_RANKS = (1, 2, 4)


class Pair(NamedTuple):
    """Pose of one station and one mount, T_camera_base and T_mount, (B, 4, 4) each."""

    T_camera_base: Array
    T_mount: Array


@dataclass(frozen=True)
class PairProblem:
    """Least-squares problem of B runs: ``observed = T_camera_base body T_mount``, K poses each.

    Implements :class:`pkmcal.solver.search.LeastSquares`.

    body, observed : (B, K, 4, 4).
    weight : (B, K).
    whiten : (K, 6, 6), or (6, 6) for all poses, as in :class:`~pkmcal.measurements.sets.Poses`.
    size : prior sigma of the mount's position about zero, m.
    """

    body: Array
    observed: Array
    weight: Array
    whiten: Array
    size: float

    def differences(self, state: Pair) -> Array:
        """Whitened errors (B, K, 6) of the predicted poses, without weights."""
        predicted = state.T_camera_base[:, None] @ self.body @ state.T_mount[:, None]
        return (self.whiten @ pose_difference(predicted, self.observed)[..., None])[..., 0]

    def residuals(self, state: Pair) -> Values:
        """Weighted errors and the prior of the mount's position."""
        value = np.sqrt(self.weight)[..., None] * self.differences(state)
        return Values(value, state.T_mount[:, :3, 3] / self.size)

    def linearize(self, state: Pair) -> Linear:
        """Residuals and exact Jacobian: six columns of the camera, six of the mount."""
        one = np.zeros((self.body.shape[1], 1), dtype=int)
        none = np.zeros((*one.shape, 0), dtype=int)
        blocks = PoseBlocks(one, one, one == 0, np.ones(1, dtype=bool), none)
        data = PoseData(
            self.observed[:, :, None],
            np.broadcast_to(self.whiten, (*self.weight.shape[1:], 6, 6))[None, :, None],
            self.weight[:, :, None],
            np.zeros((1, 1, 1, 6, 0)),
        )  # fmt: skip
        camera, mount = state.T_camera_base[:, None], state.T_mount[:, None]
        rows = pose_rows(blocks, data, camera, self.body, mount, np.zeros((1, 0)))
        value = rows.value[:, :, 0]
        return Linear(
            value,
            np.concatenate([rows.by_station, rows.by_mount], axis=-1)[:, :, 0],
            np.zeros((*value.shape, 0)),
            np.ones(value.shape, dtype=bool),
            state.T_mount[:, :3, 3] / self.size,
            np.eye(12)[9:] / self.size,
        )

    def retract(self, state: Pair, shared: Array, own: Array) -> Pair:
        """Retract the pair along a step; a pose has no unknowns of its own."""
        del own
        camera = perturb(state.T_camera_base, shared[:, :6])
        return Pair(camera, perturb(state.T_mount, shared[:, 6:]))

    def select(self, runs: Integers) -> PairProblem:
        """Problem of some runs."""
        parts = (self.body[runs], self.observed[runs], self.weight[runs])
        return replace(self, body=parts[0], observed=parts[1], weight=parts[2])


def whitener(turn: float, shift: float) -> Array:
    """Whitening (6, 6) of errors of standard deviations ``turn`` (rad) and ``shift`` (m)."""
    return np.diag(1 / np.repeat([turn, shift], 3))


def solve_pairs(body: Array, observed: Array, size: float) -> Pair:
    """Camera and mount of B runs from the platform's poses and the board's, (B, K, 4, 4) each.

    size : the limbs' length, m. Starts in closed form, then iteratively reweighted least squares
    from each start; the result is the one with the smallest median error. Raises ResultError if the
    poses do not determine the camera's rotation.
    """
    # all starts of all runs as one batch
    starts = closed_forms(body, observed)
    n, runs = len(starts), len(body)
    every = Pair(*(np.concatenate(parts) for parts in zip(*starts, strict=True)))
    body, observed = (np.concatenate([part] * n) for part in (body, observed))
    problem = PairProblem(
        body,
        observed,
        np.ones(body.shape[:2]),
        whitener(DRAWN_POSE_TURN_SIGMA, DRAWN_POSE_SHIFT_SHARE * size),
        size,
    )
    apart = np.zeros(body.shape[:2])
    for _ in range(HAND_EYE_ROUNDS):
        every = minimise(problem, every).state
        apart = np.linalg.norm(problem.differences(every), axis=-1)
        usual = np.maximum(np.median(apart, axis=1, keepdims=True), 1e-9)
        problem = replace(problem, weight=cauchy_weights((apart / usual) ** 2))
    # start with the smallest median error, for each run
    best = np.argmin(np.median(apart, axis=1).reshape(n, runs), axis=0)
    chosen = best * runs + np.arange(runs)
    pair = take(every, chosen)
    _check_identifiable(problem.select(chosen), pair)
    return pair


def closed_forms(body: Array, observed: Array) -> list[Pair]:
    """Starts for :func:`solve_pairs`, each of B runs: one for each number of rotations
    (HAND_EYE_RANKS) that the platform's rotations may leave undetermined.
    """
    return [_placed(body, observed, *turns) for turns in _turns(body, observed)]


def _check_identifiable(problem: PairProblem, pair: Pair) -> None:
    linear = problem.linearize(pair)
    rows = linear.by_shared.reshape(len(linear.value), -1, 12)
    normal = rows.mT @ rows + linear.shared_by.T @ linear.shared_by
    # prior as weak as a full turn
    normal = normal + np.diag(np.tile(np.repeat([0.1, 1e-3 / problem.size], 3) ** 2, 2))
    turn = np.linalg.inv(normal)[:, :3, :3]
    # a standard deviation of half a radian, as of a mount that counts as unidentified
    if np.sqrt(np.linalg.eigvalsh(turn)[:, -1]).max() > MAJORITY:
        raise ResultError(
            what="the boards' poses do not determine how the camera stands to the machine",
            found="configurations along a line, or all alike",
            expected="configurations that move the platform in two directions, or turn it",
            next_step="add such configurations, or give the station's rough pose",
            code="station.unidentifiable",
        )


def _turns(body: Array, observed: Array) -> list[tuple[Array, Array]]:
    """Candidate rotations of camera and mount, (B, 3, 3) each.

    ``q_measured = q_camera q_body q_mount`` is linear in either unknown, so the sum over the poses
    has the two as its leading singular vectors. Two singular values are equal where the platform
    turns about one axis, all four where it does not turn; in the space of equal values the rotation
    nearest to the one that aligns the positions is chosen.
    """
    q_body, q_measured = (quaternion(poses[..., :3, :3]) for poses in (body, observed))
    # signs from the rotations since the first pose, which both sides share
    sign = np.sign(dot(q_body, q_body[:, :1]) * dot(q_measured, q_measured[:, :1]))
    sign = np.where(sign == 0, 1.0, sign)
    # q_camera . (q_measured conj(q_mount) conj(q_body)) is linear in q_mount
    conjugate = np.diag([1.0, -1.0, -1.0, -1.0])
    # right : matrices of p -> p q of the conjugate
    right = _left_product(q_body @ conjugate)
    right[..., 1:, 1:] -= 2 * skew((q_body @ conjugate)[..., 1:])
    each = _left_product(q_measured) @ right @ conjugate
    u, _, vt = np.linalg.svd(np.sum(sign[..., None, None] * each, axis=1))
    aligned = quaternion(register(body[..., :3, 3], observed[..., :3, 3])[..., :3, :3])
    along = u.mT @ aligned[..., None]
    out: list[tuple[Array, Array]] = []
    for rank in HAND_EYE_RANKS:
        coefficients = along * (np.arange(4) < rank)[:, None]
        camera, mount = u @ coefficients, vt.mT @ coefficients
        out.append((from_quaternion(camera[..., 0]), from_quaternion(mount[..., 0])))
    return out


def _left_product(q: Array) -> Array:
    """Matrix (..., 4, 4) of ``p -> q p``, scalar first."""
    out = q[..., :1, None] * np.eye(4)
    out[..., 0, 1:], out[..., 1:, 0] = -q[..., 1:], q[..., 1:]
    out[..., 1:, 1:] += skew(q[..., 1:])
    return out


def _placed(body: Array, observed: Array, camera: Array, mount: Array) -> Pair:
    """Pair with least-squares positions for known rotations.

    ``t_observed = R_camera (R_body t_mount + t_body) + t_camera`` is linear; t_mount has a prior at
    zero with the limbs' length.
    """
    rot = camera[:, None] @ body[..., :3, :3]
    right = observed[..., :3, 3] - (camera[:, None] @ body[..., :3, 3:])[..., 0]
    off_rot = (rot - rot.mean(axis=1, keepdims=True)).reshape(len(body), -1, 3)
    off = (right - right.mean(axis=1, keepdims=True)).reshape(len(body), -1, 1)
    normal = off_rot.mT @ off_rot + DRAWN_POSE_SHIFT_SHARE**2 * np.eye(3)
    t_mount = np.linalg.solve(normal, off_rot.mT @ off)
    t_camera = right.mean(axis=1) - (rot.mean(axis=1) @ t_mount)[..., 0]
    return Pair(pose(camera, t_camera), pose(mount, t_mount[..., 0]))


def start_from_poses(
    machine: Machine, measurements: Measurements, T_camera_base: Array | None = None
) -> State:
    """Start of the joint estimate from measured poses, readings and the nominal model.

    T_camera_base : (S, 4, 4) rough T_camera_base, NaN for stations without one; None without
    any. Raises InputError for a station without any relation to the machine.
    """
    poses = measurements.poses
    whole = determines_legs(poses) and measurements.on_platform[poses.mount].all()
    if machine.layout.underdetermined and whole:
        return _start_by_lengths(machine, measurements)
    fk = machine.forward_result(measurements.joints)
    n_stations = measurements.n_stations
    usable = fk.converged & np.isfinite(fk.T_base_platform).all(axis=(-1, -2))
    poses = np.where(usable[:, None, None], fk.T_base_platform, np.nan)
    stations = (
        np.full((n_stations, 4, 4), np.nan)
        if T_camera_base is None
        else np.array(T_camera_base, float)
    )
    stations, mounts = _carried_on(machine, measurements, poses, stations)
    lost = np.flatnonzero(np.isnan(stations[:, 0, 0]))
    if lost.size:
        raise InputError(
            what=f"nothing ties station {lost[0] + 1} of {n_stations} to the machine",
            expected=f"a board on the platform in {LEAST_PAIR_CONFIGURATIONS} configurations, a"
            " board that another station also sees, or a rough pose",
            next_step="give the station's pose: in session.yaml",
            code="station.unattached",
        )
    return State(
        machine.values,
        stations,
        fk.T_base_platform,
        T_mount=np.where(np.isnan(mounts), np.eye(4), mounts),
        on_platform=measurements.on_platform,
        internal=fk.internal,
    )


def _start_by_lengths(machine: Machine, measurements: Measurements) -> State:
    """Start at measured poses of one station and one mount on a platform that legs do not hold."""
    poses, joints = measurements.poses, measurements.joints
    (T_camera_base,), (T_mount,), _ = register_by_lengths(
        machine,
        joints[None, poses.configuration],
        poses.T_station_target[None],
        poses.whiten,
        measurements.joint_noise,
    )
    T_base_platform = np.tile(machine.home(), (len(joints), 1, 1))
    T_base_platform[poses.configuration] = (
        inverse(T_camera_base) @ poses.T_station_target @ inverse(T_mount)
    )
    stations = np.tile(T_camera_base, (measurements.n_stations, 1, 1))
    mounts = np.tile(T_mount, (len(measurements.on_platform), 1, 1))
    return State(
        machine.values,
        stations,
        T_base_platform,
        T_mount=mounts,
        on_platform=measurements.on_platform,
        internal=np.zeros((len(joints), machine.layout.n_internal)),
    )


def _carried_on(
    machine: Machine, measurements: Measurements, poses: Array, stations: Array
) -> tuple[Array, Array]:
    """Poses of stations (S, 4, 4) and mounts (M, 4, 4), NaN where undetermined.

    Known poses are propagated to stations and mounts that share a measured pose with them. When no
    pose can be propagated, the pair of station and mount with the most common poses is solved by
    :func:`solve_pairs`. poses : T_base_platform (K, 4, 4), NaN where unknown.
    """
    in_view, on_platform = measurements.poses, measurements.on_platform
    stations, mounts = stations.copy(), np.full((len(on_platform), 4, 4), np.nan)
    moving = on_platform[in_view.mount]
    body = np.tile(np.eye(4), (len(in_view), 1, 1))
    body[moving] = poses[in_view.configuration[moving]]
    good = np.isfinite(body[:, 0, 0])
    target = in_view.T_station_target
    # known stations to mounts, known mounts to stations, else the pair with the most poses
    while True:
        has_station = np.isfinite(stations[in_view.station, 0, 0])
        has_mount = np.isfinite(mounts[in_view.mount, 0, 0])
        to_mount, to_station = good & has_station & ~has_mount, good & has_mount & ~has_station
        if to_mount.any():
            m = in_view.mount[to_mount][0]
            rows = to_mount & (in_view.mount == m)
            T_camera_body = stations[in_view.station[rows]] @ body[rows]
            mounts[m] = middle_pose(inverse(T_camera_body) @ target[rows])
        elif to_station.any():
            s = in_view.station[to_station][0]
            rows = to_station & (in_view.station == s)
            stations[s] = middle_pose(
                target[rows] @ inverse(body[rows] @ mounts[in_view.mount[rows]])
            )
        else:
            fit = good & moving & ~has_station
            pair, count = np.unique(
                [in_view.station[fit], in_view.mount[fit]], axis=1, return_counts=True
            )
            if count.max(initial=0) < LEAST_PAIR_CONFIGURATIONS:
                return stations, mounts
            s, m = pair[:, np.argmax(count)]
            rows = good & (in_view.station == s) & (in_view.mount == m)
            solved = solve_pairs(body[None, rows], target[None, rows], size_of(machine))
            stations[s], mounts[m] = solved.T_camera_base[0], solved.T_mount[0]


def size_of(machine: Machine) -> float:
    """Mean length of the limbs at home, m."""
    ends = machine.ends_at(machine.middle_readings(), machine.home())
    return float(np.linalg.norm(ends.b - ends.a, axis=-1).mean())
