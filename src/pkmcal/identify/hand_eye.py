"""Where camera and board are, from measured board poses and readings alone; no rough pose needed.

Forward kinematics of the drawing gives the platform's poses, the photographs give the board's, so
``T_camera_board = T_camera_base T_base_platform T_platform_board`` is the robot-world/hand-eye
problem ([C] III.C). Rotations give both turns where the platform turns about two axes or more;
where it turns about one, or not at all, positions decide. What neither tells (the board's height
along the only axis of rotation, all of its place on a platform that does not turn) stays zero.

The drawing is off by millimetres and degrees, so poses and not corners are fitted, with weights
to match, and a pose that disagrees with the others counts less.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import (
    dot,
    inverse,
    perturb,
    pose,
    pose_difference,
    register,
    rotation_vector,
    skew,
)
from pkmcal.identify.mounts import mean_pose
from pkmcal.identify.pose_rows import turn_jacobian
from pkmcal.identify.problem import State
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.solver import Linear, Values, minimise, take

TURN = 0.03
"""Standard deviation (rad) that the drawing's poses are given: two degrees."""
SHIFT = 0.02
"""The same of positions, as a share of the limbs' length: 10 mm of half a metre."""
ROUNDS = 4
UNKNOWN = 0.3
"""Standard deviation (rad) of the camera's turn above which the poses do not tell it."""
LEAST = 3
"""Configurations that a station and a mount need together."""
RANKS = (1, 2, 4)


class Pair(NamedTuple):
    """One station and one mount: T_camera_base and T_mount, (B, 4, 4) each."""

    T_camera_base: Array
    T_mount: Array


@dataclass(frozen=True)
class PairProblem:
    """solver.LeastSquares of B runs: ``seen = T_camera_base body T_mount``, K poses each.

    body, seen : (B, K, 4, 4). weight : (B, K). turn, shift : rad and m that count as one standard
    deviation. size : m, the standard deviation of the mount's place, zero expected.
    """

    body: Array
    seen: Array
    weight: Array
    turn: float
    shift: float
    size: float

    def differences(self, state: Pair) -> Array:
        """Errors (B, K, 6) of the predicted poses, in standard deviations, without weights."""
        predicted = state.T_camera_base[:, None] @ self.body @ state.T_mount[:, None]
        return pose_difference(predicted, self.seen) / self._sigma

    @property
    def _sigma(self) -> Array:
        return np.repeat([self.turn, self.shift], 3)

    def residuals(self, state: Pair) -> Values:
        """Weighted errors and the mount's place."""
        value = np.sqrt(self.weight)[..., None] * self.differences(state)
        return Values(value, state.T_mount[:, :3, 3] / self.size)

    def linearize(self, state: Pair) -> Linear:
        """Residuals and exact Jacobian: six numbers of the camera, six of the mount."""
        values = self.residuals(state)
        camera, mount = state.T_camera_base[:, None], state.T_mount[:, None]
        rot = camera[..., :3, :3] @ self.body[..., :3, :3]
        arm = self.body[..., :3, :3] @ mount[..., :3, 3:] + self.body[..., :3, 3:]
        place = (camera[..., :3, :3] @ arm)[..., 0]
        turn = turn_jacobian(self.differences(state)[..., :3] * self.turn)
        by = np.zeros((*values.value.shape, 12))
        by[..., :3, :3], by[..., :3, 6:9] = turn, turn @ rot
        by[..., 3:, :3], by[..., 3:, 3:6] = -skew(place), np.eye(3)
        by[..., 3:, 9:] = rot
        by = np.sqrt(self.weight)[..., None, None] * by / self._sigma[:, None]
        usable = np.ones(values.value.shape, dtype=bool)
        prior = np.eye(12)[9:] / self.size
        return Linear(
            values.value, by, np.zeros((*usable.shape, 0)), usable, values.shared_value, prior
        )

    def moved(self, state: Pair, shared: Array, own: Array) -> Pair:
        """The pair after a step; a pose has no unknowns of its own."""
        del own
        camera = perturb(state.T_camera_base, shared[:, :6])
        return Pair(camera, perturb(state.T_mount, shared[:, 6:]))

    def select(self, runs: Integers) -> PairProblem:
        """Some runs only."""
        parts = (self.body[runs], self.seen[runs], self.weight[runs])
        return replace(self, body=parts[0], seen=parts[1], weight=parts[2])


def solve_pairs(body: Array, seen: Array, size: float) -> Pair:
    """Camera and mount of B runs from the platform's poses and the board's, (B, K, 4, 4) each.

    size : the limbs' length, m. Closed forms as starts, then least squares with poses that
    disagree weighing less; of the starts the one that ends best.
    Raises ResultError where the poses do not tell how the camera stands.
    """
    starts = [_placed(body, seen, *turns) for turns in _turns(body, seen)]
    n, runs = len(starts), len(body)
    every = Pair(*(np.concatenate(parts) for parts in zip(*starts, strict=True)))
    tiled = [np.concatenate([part] * n) for part in (body, seen)]
    weight = np.ones(tiled[0].shape[:2])
    problem = PairProblem(tiled[0], tiled[1], weight, TURN, SHIFT * size, size)
    for _ in range(ROUNDS):
        every = minimise(problem, every).state
        problem = replace(problem, weight=_weights(problem, every))
    apart = np.linalg.norm(problem.differences(every), axis=-1)
    best = np.argmin(np.median(apart, axis=1).reshape(n, runs), axis=0)
    chosen = best * runs + np.arange(runs)
    pair = take(every, chosen)
    _check_told(problem.select(chosen), pair)
    return pair


def _weights(problem: PairProblem, pair: Pair) -> Array:
    """Weights (B, K) that fall beyond the poses' usual disagreement, after Cauchy."""
    distance = np.linalg.norm(problem.differences(pair), axis=-1)
    usual = np.maximum(np.median(distance, axis=1, keepdims=True), 1e-9)
    return 1 / (1 + (distance / (2.4 * usual)) ** 2)


def _check_told(problem: PairProblem, pair: Pair) -> None:
    linear = problem.linearize(pair)
    rows = linear.by_shared.reshape(len(linear.value), -1, 12)
    normal = np.swapaxes(rows, -1, -2) @ rows + linear.shared_by.T @ linear.shared_by
    # as loose as a full turn where nothing tells
    normal = normal + np.diag(np.tile(np.repeat([0.1, 1e-3 / problem.size], 3) ** 2, 2))
    turn = np.linalg.inv(normal)[:, :3, :3]
    if np.sqrt(np.linalg.eigvalsh(turn)[:, -1]).max() > UNKNOWN:
        raise ResultError(
            what="the boards' poses do not tell how the camera stands to the machine",
            found="configurations along a line, or all alike",
            expected="configurations that move the platform in two directions, or turn it",
            next_step="add such configurations, or give the station's rough pose",
        )


def _turns(body: Array, seen: Array) -> list[tuple[Array, Array]]:
    """Possible turns of camera and mount, (B, 3, 3) each.

    ``q_seen = q_camera q_body q_mount`` is linear in either, so the sum over the poses has the two
    as its leading singular vectors. Where the platform turns about one axis two singular values
    are equal, where it does not turn all four: of what they leave open, the nearest to the turn
    that lays the positions on one another.
    """
    m = _summed(quaternion(body[..., :3, :3]), quaternion(seen[..., :3, :3]))
    u, _, vt = np.linalg.svd(m)
    laid = quaternion(register(body[..., :3, 3], seen[..., :3, 3])[..., :3, :3])
    along = np.swapaxes(u, -1, -2) @ laid[..., None]
    out = []
    for rank in RANKS:
        kept = along * (np.arange(4) < rank)[:, None]
        camera, mount = u @ kept, np.swapaxes(vt, -1, -2) @ kept
        out.append((matrix(camera[..., 0]), matrix(mount[..., 0])))
    return out


def _summed(body: Array, seen: Array) -> Array:
    """``sum_k s_k N_k`` (B, 4, 4) with ``q_camera^T N_k q_mount = q_seen . (q_camera q_body
    q_mount)``. Signs s_k by the turns from the first pose, which both sides share.
    """
    sign = np.sign(dot(body, body[:, :1]) * dot(seen, seen[:, :1]))
    sign = np.where(sign == 0, 1.0, sign)
    # q_camera . (q_seen conj(q_mount) conj(q_body)) is linear in q_mount
    conjugate = np.diag([1.0, -1.0, -1.0, -1.0])
    n = _left(seen) @ _right(body @ conjugate) @ conjugate
    return np.sum(sign[..., None, None] * n, axis=1)


def _left(q: Array) -> Array:
    """Matrix (..., 4, 4) of ``p -> q p``, scalar first."""
    out = q[..., :1, None] * np.eye(4)
    out[..., 0, 1:], out[..., 1:, 0] = -q[..., 1:], q[..., 1:]
    out[..., 1:, 1:] += skew(q[..., 1:])
    return out


def _right(q: Array) -> Array:
    """Matrix (..., 4, 4) of ``p -> p q``."""
    out = _left(q)
    out[..., 1:, 1:] -= 2 * skew(q[..., 1:])
    return out


def quaternion(rot: Array) -> Array:
    """Unit quaternions (..., 4), scalar first, of rotations (..., 3, 3)."""
    omega = rotation_vector(rot)
    angle = np.sqrt(dot(omega, omega))[..., None]
    axis = omega / np.where(angle > 0, angle, 1.0)
    return np.concatenate([np.cos(angle / 2), np.sin(angle / 2) * axis], axis=-1)


def matrix(q: Array) -> Array:
    """Rotations (..., 3, 3) of quaternions (..., 4) of any length but zero."""
    q = q / np.sqrt(dot(q, q))[..., None]
    w, v = q[..., :1, None], q[..., 1:]
    k = skew(v)
    return np.eye(3) + 2 * (w * k + k @ k)


def _placed(body: Array, seen: Array, camera: Array, mount: Array) -> Pair:
    """Places for known turns: ``t_seen = R_camera (R_body t_mount + t_body) + t_camera``, linear;
    t_mount is held to zero within the limbs' length.
    """
    rot = camera[:, None] @ body[..., :3, :3]
    right = seen[..., :3, 3] - (camera[:, None] @ body[..., :3, 3:])[..., 0]
    off_rot = (rot - rot.mean(axis=1, keepdims=True)).reshape(len(body), -1, 3)
    off = (right - right.mean(axis=1, keepdims=True)).reshape(len(body), -1, 1)
    normal = np.swapaxes(off_rot, -1, -2) @ off_rot + SHIFT**2 * np.eye(3)
    t_mount = np.linalg.solve(normal, np.swapaxes(off_rot, -1, -2) @ off)
    t_camera = right.mean(axis=1) - (rot.mean(axis=1) @ t_mount)[..., 0]
    return Pair(pose(camera, t_camera), pose(mount, t_mount[..., 0]))


def start_from_poses(
    machine: Machine, measurements: Measurements, known: Array | None = None
) -> State:
    """A start for the joint estimate, from the measured poses and readings by the drawing.

    known : (S, 4, 4) rough T_camera_base, NaN for stations without one; None without any.
    Raises InputError for a station that nothing ties to the machine.
    """
    found = machine.forward_result(measurements.joints)
    shape = (measurements.n_stations, 4, 4)
    stations = np.full(shape, np.nan) if known is None else np.array(known, dtype=float)
    mounts = np.full((len(measurements.mounts), 4, 4), np.nan)
    usable = found.converged & np.isfinite(found.T_base_platform).all(axis=(-1, -2))
    poses = np.where(usable[:, None, None], found.T_base_platform, np.nan)
    stations, mounts = _spread(machine, measurements, poses, stations, mounts)
    lost = np.flatnonzero(np.isnan(stations[:, 0, 0]))
    if lost.size:
        raise InputError(
            what=f"nothing ties station {lost[0] + 1} of {len(stations)} to the machine",
            expected=f"a board on the platform in {LEAST} configurations, a board that another"
            " station also sees, or a rough pose",
            next_step="give the station's pose: in session.yaml",
        )
    n_cameras = int(np.max(measurements.camera_of_station)) + 1
    unseen = np.isnan(mounts[:, 0, 0])
    mounts[unseen] = np.eye(4)
    return State(
        machine.values,
        stations,
        found.T_base_platform,
        np.zeros(n_cameras),
        T_mount=mounts,
        on_platform=measurements.on_platform,
        internal=found.internal,
    )


def _spread(
    machine: Machine, measurements: Measurements, poses: Array, stations: Array, mounts: Array
) -> tuple[Array, Array]:
    """Stations and mounts, what is known carried on to what shares a pose with it."""
    seen = measurements.poses
    body = np.where(
        measurements.on_platform[seen.mount][:, None, None],
        poses[seen.configuration] if len(seen) else np.zeros((0, 4, 4)),
        np.eye(4),
    )
    good = np.isfinite(body[:, 0, 0])
    while True:
        carried = _carried(measurements, body, good, stations, mounts)
        if carried is not None:
            stations, mounts = carried
            continue
        pair = _best_pair(measurements, good, stations)
        if pair is None:
            return stations, mounts
        s, m = pair
        rows = good & (seen.station == s) & (seen.mount == m)
        solved = solve_pairs(body[None, rows], seen.T_station_target[None, rows], size_of(machine))
        stations, mounts = stations.copy(), mounts.copy()
        stations[s], mounts[m] = solved.T_camera_base[0], solved.T_mount[0]


def _carried(
    measurements: Measurements, body: Array, good: Array, stations: Array, mounts: Array
) -> tuple[Array, Array] | None:
    """One more mount by a known station, or station by a known mount; None where there is none."""
    seen = measurements.poses
    has_station = np.isfinite(stations[seen.station, 0, 0])
    has_mount = np.isfinite(mounts[seen.mount, 0, 0])
    for known, new, of in (
        (has_station, ~has_mount, seen.mount),
        (has_mount, ~has_station, seen.station),
    ):
        rows = good & known & new
        if not rows.any():
            continue
        one = int(of[np.flatnonzero(rows)[0]])
        rows = rows & (of == one)
        stations, mounts = stations.copy(), mounts.copy()
        measured, moved = seen.T_station_target[rows], body[rows]
        if of is seen.mount:
            mounts[one] = mean_pose(inverse(stations[seen.station[rows]] @ moved) @ measured)
        else:
            stations[one] = mean_pose(measured @ inverse(moved @ mounts[seen.mount[rows]]))
        return stations, mounts
    return None


def _best_pair(measurements: Measurements, good: Array, stations: Array) -> tuple[int, int] | None:
    """The unknown station and the mount on the platform with the most poses, LEAST at least."""
    seen, n_mounts = measurements.poses, len(measurements.mounts)
    fit = good & np.isnan(stations[seen.station, 0, 0])
    fit &= measurements.on_platform[seen.mount] if n_mounts else False
    count = np.bincount(
        (seen.station * n_mounts + seen.mount)[fit], minlength=measurements.n_stations * n_mounts
    )
    if not count.size or count.max() < LEAST:
        return None
    s, m = divmod(int(np.argmax(count)), n_mounts)
    return s, m


def size_of(machine: Machine) -> float:
    """The limbs' mean length at home, m."""
    ends = limb_ends(machine.layout, machine.values, machine.middle_readings(), machine.home())
    return float(np.linalg.norm(ends.b - ends.a, axis=-1).mean())
