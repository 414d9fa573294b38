"""Inverse-kinematic method of [C]: identification at measured poses, without forward kinematics.

Four forms: ``joint`` (eq. 3), the readings minus those of the inverse kinematics, or ``implicit``
(eq. 5), the closure equations themselves; each as printed or whitened by its noise, including the
pose components that the machine cannot move (errata, [C]). Whitened, the two are one estimate,
close to the joint estimate.

Unknowns are the machine's free parameters and the poses of stations and mounts (and the hinges of
an articulated platform, for each pose); platform poses are measured, not estimated. A fixed matrix
for each pose weights the rows: equally as printed; whitened, by the noise of the measured pose and
the reading, including the components that the machine cannot move (the two tilts of an H4). Any
machine with closure equations.

Unidentifiable directions keep their start: for each such direction, the unknown with the smallest
prior sigma is fixed. The paper fixes d and an angle about z_B for the same reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import apply, cross, dot, inverse, perturb, pose, rotation
from pkmcal.identify.gauge import default_gauge, in_gauge
from pkmcal.identify.measured_platform import MeasuredPlatform, Taken, measured_platform, taken
from pkmcal.identify.rotation_axis import axis_frames
from pkmcal.identify.state import State
from pkmcal.identify.unknowns import Unknowns
from pkmcal.measurements import Measurements
from pkmcal.measurements.readings import PERFECT_CLOSURE_SIGMA
from pkmcal.mechanisms import Machine, kinematics
from pkmcal.mechanisms.closure import Closure, closure, dense
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.solver.elimination import Linear, eliminate, rows_on_shared
from pkmcal.solver.ranks import numerical_rank
from pkmcal.solver.search import Solution, Stop, Values, minimise, of_runs, take

PoseFitForm = Literal["joint", "implicit"]
UNWHITENED_ROW_SIGMA = 1e-4
"""Standard deviation, in m or rad, of rows that are not whitened; it only determines when the
search stops."""
WHITENING_ROUNDS = 2
"""Further whitenings at the solution; after the second the rows change by a thousandth."""
MOST_POSE_FIT_STEPS = 100
PLACEMENT_PRIOR_SIGMA = 0.1
"""Prior sigma of stations and mounts, in rad and m, far larger than a nominal model's."""


# ------------------------------------------------------------------ the rows


class ImplicitState(NamedTuple):
    """Unknowns of B runs.

    z : (B, nz).
    T_camera_base : (B, S, 4, 4).
    T_mount : (B, M, 4, 4).
    internal : (B, N, n).
    """

    z: Array
    T_camera_base: Array
    T_mount: Array
    internal: Array


class _Rows(NamedTuple):
    """Rows (B, N, r) without weights: closure equations, then deviations.

    platform, taken, closure : what the rows were computed from. scale : (B, N, e) factor on the
    closures' derivatives.
    """

    value: Array
    platform: MeasuredPlatform
    taken: Taken
    closure: Closure
    scale: Array

    @property
    def by_pose(self) -> Array:
        """Derivatives of the rows by the platform's whole pose, (B, N, r, 6)."""
        closures = self.scale[..., None] * (self.closure.rows.by_pose @ self.taken.by)
        return np.concatenate([closures, self.taken.off_by], axis=-2)


@dataclass(frozen=True)
class ImplicitProblem:
    """solver.LeastSquares of B runs with N poses each; stations' unknowns perturb T_base_camera.

    layout, nominal model (P,), free (P, nz) : the machine.

    station, mount : (N,), of n_stations and n_mounts.
    T_camera_board : (B, N, 4, 4) and readings : (B, N, m).
    form : see the module.
    weigh : (B, N, r, r) of the rows, constant during the search.
    prior : (c, nz) rows on z.
    keep : (na,) False for fixed unknowns.

    Jacobian of one pose (own columns are eliminated by the Schur complement):

                         z      stations   mounts  | own (hinges)
        closure rows   [ X         X         X     |     X       ]
        deviations     [           X         X     |             ]
    """

    layout: LimbLayout
    nominal: Array
    free: Array
    station: Integers
    mount: Integers
    n_stations: int
    n_mounts: int
    T_camera_board: Array
    readings: Array
    form: PoseFitForm
    weigh: Array
    prior: Array
    keep: Booleans

    @property
    def unknowns(self) -> Unknowns:
        """Columns of the unknowns, na in all."""
        n_free = self.free.shape[1]
        return Unknowns(n_free, self.n_stations, n_mounts=self.n_mounts)

    def theta(self, state: ImplicitState) -> Array:
        """Machine parameters (B, P)."""
        return self.nominal + state.z @ self.free.T

    def residuals(self, state: ImplicitState) -> Values:
        """Weighted rows; NaN where the inverse kinematics has no solution."""
        value = (self.weigh @ self._rows(state).value[..., None])[..., 0]
        return Values(value, state.z @ self.prior.T)

    def linearize(self, state: ImplicitState) -> Linear:
        """Weighted rows and exact Jacobian by z, stations and mounts, zero for fixed unknowns."""
        rows = self._rows(state)
        # closure rows are followed by the deviations, which do not depend on z and the hinges
        off = ((0, 0), (0, 0), (0, rows.taken.off.shape[-1]), (0, 0))
        closures = rows.scale[..., None] * (dense(rows.closure, self.nominal.size) @ self.free)
        stations, mounts = np.eye(self.n_stations)[self.station], np.eye(self.n_mounts)[self.mount]
        by_shared = np.concatenate([
            np.pad(closures, off),
            _placed(rows.by_pose @ rows.platform.by_station, stations),
            _placed(rows.by_pose @ rows.platform.by_mount, mounts),
        ], axis=-1)  # fmt: skip
        by_own = np.pad(rows.scale[..., None] * rows.closure.rows.by_internal, off)
        value = (self.weigh @ rows.value[..., None])[..., 0]
        usable = np.isfinite(value)
        return Linear(
            np.where(usable, value, 0.0),
            np.where(usable[..., None], self.weigh @ (by_shared * self.keep), 0.0),
            np.where(usable[..., None], self.weigh @ by_own, 0.0),
            usable,
            state.z @ self.prior.T,
            np.pad(self.prior, ((0, 0), (0, self.keep.size - self.free.shape[1]))),
        )

    def _rows(self, state: ImplicitState) -> _Rows:
        theta = self.theta(state)[:, None]
        in_view = measured_platform(
            state.T_camera_base[:, self.station], self.T_camera_board, state.T_mount[:, self.mount]
        )
        own = taken(self.layout.motion, in_view.pose)
        internal = state.internal if self.layout.n_internal else None
        readings = self.readings
        if self.form == "joint":
            readings = kinematics.readings_at_poses(self.layout, theta, own.pose)
        c = closure(self.layout, theta, readings, own.pose, internal)
        scale = np.ones(c.rows.value.shape)
        value = c.rows.value
        if self.form == "joint":
            motor = self.layout.row_motor
            read = motor >= 0
            # r = measured - wanted at a zero closure: dr = dc / (dc/dq)
            scale = np.where(read, 1 / np.where(read, c.by_reading, 1.0), 1.0)
            value = np.where(read, (self.readings - readings)[..., np.maximum(motor, 0)], value)
        return _Rows(np.concatenate([value, own.off], axis=-1), in_view, own, c, scale)

    def whitening(self, state: ImplicitState, noise: Array, joint_noise: float) -> Array:
        """Matrices (B, N, r, r) that whiten the rows at a state.

        noise : (N, 6, 6) covariance of the measured poses. The rows' covariance is that of the pose
        and of the reading, propagated through the rows' derivatives.
        """
        rows = self._rows(state)
        by = rows.by_pose @ rows.platform.by_measured
        covariance = by @ noise @ by.mT
        slope = (rows.scale * rows.closure.by_reading)[..., None] * self.layout.of_motor
        e = slope.shape[-2]
        covariance[..., :e, :e] += joint_noise**2 * (slope @ slope.mT)
        covariance[..., :e, :e] += PERFECT_CLOSURE_SIGMA**2 * np.eye(e) * rows.scale[..., None] ** 2
        return np.linalg.inv(np.linalg.cholesky(covariance))

    def platform_poses(self, state: ImplicitState) -> Array:
        """Measured poses (B, N, 4, 4) without the components that the machine cannot move."""
        return self._rows(state).taken.pose

    def ideal(self, state: ImplicitState) -> ImplicitProblem:
        """Problem with poses and readings for which the state has zero residuals.

        Ranks are computed there: at the data, noise gives unidentifiable directions a small
        singular value.
        """
        poses = self.platform_poses(state)
        readings = kinematics.readings_at_poses(self.layout, self.theta(state)[:, None], poses)
        readings = np.where(np.isfinite(readings), readings, self.readings)
        case = state.T_camera_base[:, self.station] @ poses @ state.T_mount[:, self.mount]
        return replace(self, T_camera_board=case, readings=readings)

    def retract(self, state: ImplicitState, shared: Array, own: Array) -> ImplicitState:
        """Retract the state along a step."""
        shared, u = shared * self.keep, self.unknowns
        camera = shared[:, u.stations].reshape(-1, self.n_stations, 6)
        mount = shared[:, u.mounts].reshape(-1, self.n_mounts, 6)
        return ImplicitState(
            state.z + shared[:, u.machine],
            inverse(perturb(inverse(state.T_camera_base), camera)),
            perturb(state.T_mount, mount),
            state.internal + own,
        )

    def select(self, runs: Integers) -> ImplicitProblem:
        """Problem of some runs."""
        weigh = of_runs(self.weigh, runs)
        poses, readings = self.T_camera_board[runs], self.readings[runs]
        return replace(self, T_camera_board=poses, readings=readings, weigh=weigh)


def _placed(values: Array, which: Array) -> Array:
    """Columns (B, N, r, 6) in the block of each pose's own body, one-hot (N, n): (B, N, r, 6 n)."""
    out = which[:, None, :, None] * values[..., None, :]
    return out.reshape(*values.shape[:-1], -1)


# ------------------------------------------------------------------ the method


@dataclass(frozen=True)
class PoseFit:
    """Result of the method on B runs.

    problem : with the final weights and fixed unknowns.
    solution : its state, cost, stops.
    rank : of the Jacobian with all unknowns free.
    """

    problem: ImplicitProblem
    solution: Solution
    rank: int


def inverse_kinematic(machine: Machine, measurements: Measurements, start: State) -> State:
    """Machine, stations and mounts of one session from board poses and readings.

    [C] eq. 5, whitened, with the nominal values and their prior sigmas as a prior. start : from the
    nominal model, see :mod:`pkmcal.identify.hand_eye`. Platform poses follow from the readings and
    the estimated machine. Raises InputError without whole poses of a board on the platform,
    ResultError if the search fails.
    """
    poses = measurements.poses
    rows = np.flatnonzero(measurements.on_platform[poses.mount])
    if not rows.size:
        raise InputError(
            what="the inverse-kinematic method needs poses of a board on the platform",
            found="none",
            next_step="observe: board at a station, or use the method bundle",
            code="method.no_platform_poses",
        )
    poses = poses.select(rows)
    if poses.rows.min() < 6:
        raise InputError(
            what="the inverse-kinematic method needs whole poses",
            found="points or heights, which determine no rotation",
            next_step="measure rotations as well, or use the method bundle",
        )
    problem, state = pose_problem(
        machine,
        replace(measurements, poses=poses),
        poses.T_station_target[None],
        measurements.joints[None, poses.configuration],
        start,
        "implicit",
    )
    noise = np.linalg.inv(poses.whiten.mT @ poses.whiten)
    fit = fit_machine_to_poses(
        machine, problem, state, noise, measurements.joint_noise, use_prior=True
    )
    return _session_state(machine, measurements, start, fit)


def pose_problem(
    machine: Machine,
    measurements: Measurements,
    T_camera_board: Array,
    readings: Array,
    start: State,
    form: PoseFitForm,
) -> tuple[ImplicitProblem, ImplicitState]:
    """Unweighted problem of B runs with the measurements' stations and mounts, and its start.

    T_camera_board : (B, N, 4, 4).
    readings : (B, N, m).
    start : of one run, or with a leading axis B on ``T_camera_base`` and ``T_mount``.

    Raises InputError for the joint form on a machine with several rods on a motor.
    """
    layout, table = machine.layout, machine.parameters
    if form == "joint" and layout.shares_motors:
        raise InputError(
            what=f"mechanism {machine.name!r} has several rods on a motor: no reading fits all",
            expected="the implicit form",
        )
    runs, count = T_camera_board.shape[:2]
    z = table.to_free(start.theta)
    camera = np.broadcast_to(start.T_camera_base, (runs, *start.T_camera_base.shape[-3:]))
    mount = np.broadcast_to(start.T_mount, (runs, *start.T_mount.shape[-3:]))
    n_stations, n_mounts = camera.shape[1], mount.shape[1]
    off = 6 - layout.motion.shape[1]  # rows of deviations, without weight as printed
    problem = ImplicitProblem(
        layout=layout,
        nominal=table.nominal,
        free=table.free_matrix(),
        station=measurements.poses.station,
        mount=measurements.poses.mount,
        n_stations=n_stations,
        n_mounts=n_mounts,
        T_camera_board=T_camera_board,
        readings=readings,
        form=form,
        weigh=np.diag(np.repeat([1 / UNWHITENED_ROW_SIGMA, 0.0], [layout.n_equations, off]))[
            None, None
        ],
        prior=np.zeros((0, z.shape[-1])),
        keep=np.ones(z.shape[-1] + 6 * (n_stations + n_mounts), dtype=bool),
    )
    state = ImplicitState(
        np.broadcast_to(z, (runs, z.shape[-1])).copy(),
        camera.copy(),
        mount.copy(),
        np.zeros((runs, count, layout.n_internal)),
    )
    if layout.n_internal:  # hinge angles at the measured poses
        poses = problem.platform_poses(state)
        internal = kinematics.inverse_result(layout, problem.theta(state)[:, None], poses)[1]
        state = state._replace(internal=np.nan_to_num(internal))
    return problem, state


def fit_machine_to_poses(
    machine: Machine,
    problem: ImplicitProblem,
    start: ImplicitState,
    noise: Array | None,
    joint_noise: float,
    *,
    use_prior: bool,
) -> PoseFit:
    """Estimate of B runs.

    noise : (N, 6, 6) covariance of the poses for whitening; None for the printed form, in which the
    boards' axis of rotation is estimated first and fixed, [C] III.B. use_prior : use the nominal
    values as measurements.
    """
    if use_prior:
        problem = replace(problem, prior=np.diag(1 / machine.parameters.tolerances_free()))
    state = on_axis(problem, start)
    if noise is not None:
        problem = replace(problem, weigh=problem.whitening(state, noise, joint_noise))
    keep, rank = estimable_unknowns(machine, problem, state, whitened=noise is not None)
    problem = replace(problem, keep=keep)
    solution = minimise(problem, state, max_steps=MOST_POSE_FIT_STEPS)
    if noise is not None:
        for _ in range(WHITENING_ROUNDS):
            state, steps = solution.state, solution.steps
            problem = replace(problem, weigh=problem.whitening(state, noise, joint_noise))
            solution = minimise(problem, state, MOST_POSE_FIT_STEPS)
            solution = replace(solution, steps=steps + solution.steps)
    return PoseFit(problem, solution, rank)


def on_axis(problem: ImplicitProblem, state: ImplicitState) -> ImplicitState:
    """State with base and platform rotated so that the boards' axis of rotation is their z axis.

    For machines that turn about one axis, with one camera and one board; other states are
    unchanged. The workspace keeps its position in the camera frame.
    """
    if not _one_axis(problem):
        return state
    frames = axis_frames(problem.T_camera_board[..., :3, :3])
    camera, mount = state.T_camera_base[:, 0], state.T_mount[:, 0]
    axis = frames.camera[..., :, 2]
    sign = np.sign(dot(axis, camera[:, :3, 2]))[:, None]
    # rotate the camera about the middle of the workspace
    middle = problem.platform_poses(state)[..., :3, 3].mean(axis=1)
    turn = turn_between(camera[:, :3, 2], sign * axis) @ camera[:, :3, :3]
    place = apply(camera, middle) - (turn @ middle[..., None])[..., 0]
    # rotate the mount so that the carried axis is z
    carried = (mount[:, :3, :3] @ (sign * frames.board[:, 2])[..., None])[..., 0]
    turned = turn_between(carried, np.array([0.0, 0.0, 1.0])) @ mount[:, :3, :3]
    return state._replace(
        T_camera_base=pose(turn, place)[:, None], T_mount=pose(turned, mount[:, :3, 3])[:, None]
    )


def _one_axis(problem: ImplicitProblem) -> bool:
    alone = problem.n_stations == problem.n_mounts == 1
    return alone and int(problem.layout.motion[:3].any(axis=1).sum()) == 1


def turn_between(a: Array, b: Array) -> Array:
    """Shortest rotations (..., 3, 3) from unit vectors a (..., 3) to b."""
    across = cross(a, np.broadcast_to(b, a.shape))
    size = np.sqrt(dot(across, across))[..., None]
    angle = np.arctan2(size, dot(a, b)[..., None])
    return rotation(across * angle / np.where(size > 0, size, 1.0))


def estimable_unknowns(
    machine: Machine, problem: ImplicitProblem, state: ImplicitState, *, whitened: bool
) -> tuple[Booleans, int]:
    """Estimated unknowns (na,), and the rank of the Jacobian with all of them.

    Computed for the first run. In the printed form the tilts of a board against the axis of
    rotation, which have a second-order influence only ([C] III.C), are fixed.
    """
    first, begin = problem.select(np.array([0])), take(state, np.array([0]))
    linear = first.ideal(begin).linearize(begin)
    jac = rows_on_shared(linear, eliminate(linear))[0][0]
    sizes = np.full(problem.unknowns.count, PLACEMENT_PRIOR_SIGMA)
    sizes[problem.unknowns.machine] = machine.parameters.tolerances_free()
    keep = np.ones(len(sizes), dtype=bool)
    rank, _ = _loose(jac, sizes)
    if not whitened:
        # the axis of rotation determines rotations that the machine itself cannot make: of the
        # mounts, and of the camera for one axis and one camera
        names: tuple[str, ...] = ("stations", "mounts") if _one_axis(problem) else ("mounts",)
        bodies = problem.unknowns.columns(*names).reshape(-1, 6)
        keep[bodies[:, :3][:, ~problem.layout.motion[:3].any(axis=1)]] = False
    loose = _loose(jac[:, keep], sizes[keep])[1]
    keep[np.flatnonzero(keep)[_pivots(loose)]] = False
    return keep, rank


def _loose(jac: Array, sizes: Array) -> tuple[int, Array]:
    """Rank of a Jacobian (rows, n) and its null space (k, n), in units of the prior sigmas.

    Columns are scaled by their largest absolute value, [C] IV.C.
    """
    extreme = np.abs(jac).max(axis=0)
    extreme = np.where(extreme > 0, extreme, 1.0)
    s, vt = np.linalg.svd(jac / extreme)[1:]
    rank = numerical_rank(s)
    return rank, vt[rank:] / (extreme * sizes)


def _pivots(loose: Array) -> list[int]:
    """One column for each row of (k, n), chosen such that fixing the columns fixes the
    rows best.
    """
    rows, chosen = loose.copy(), list[int]()
    for _ in range(len(loose)):
        size = np.sum(rows**2, axis=0)
        k = int(np.argmax(size > 0.99 * size.max()))  # the first of equals
        chosen.append(k)
        along = rows[:, k] / np.linalg.norm(rows[:, k])
        rows = rows - along[:, None] * (along @ rows)
    return chosen


def _session_state(
    machine: Machine, measurements: Measurements, start: State, fit: PoseFit
) -> State:
    """State of the session from the fit, in the default gauge, with poses from the readings."""
    stop, solution = fit.solution.stop[0], fit.solution.state
    if stop in (Stop.NOT_FINITE, Stop.STALLED):
        raise ResultError(what=f"the inverse-kinematic method failed: {stop.value}")
    theta = fit.problem.theta(solution)[0]
    solved = machine.with_values(theta)
    poses = solved.forward_result(measurements.joints, start.T_base_platform)
    cameras, mounts = start.T_camera_base.copy(), start.T_mount.copy()
    for before, after, covariance in (
        (cameras, solution.T_camera_base[0], fit.problem.station),
        (mounts, solution.T_mount[0], fit.problem.mount),
    ):
        before[covariance] = after[covariance]  # the others have no pose among the data
    state = replace(
        start,
        theta=theta,
        T_camera_base=cameras,
        T_mount=mounts,
        T_base_platform=poses.T_base_platform,
        internal=poses.internal,
    )
    state = in_gauge(machine, state, default_gauge(machine))
    return replace(state, theta=machine.parameters.unit_axes(state.theta))
