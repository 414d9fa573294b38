"""The inverse-kinematic method of [C]: identified at measured poses, without forward kinematics.

Four forms: ``joint`` (eq. 3) or ``implicit`` (eq. 5), each as printed or whitened by its noise with
what the machine cannot move (errata, [C]). Whitened, the two are one estimate, near the joint one.

What the rows cannot tell keeps its first value: of each direction that nothing fixes, the unknown
that is known best beforehand is held. The paper holds d and an angle about z_B for the same reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import apply, cross, dot, pose, rotation
from pkmcal.identify.gauge import apply as in_gauge
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.hand_eye import start_from_poses
from pkmcal.identify.implicit import Form, ImplicitProblem, ImplicitState
from pkmcal.identify.problem import State
from pkmcal.identify.rotation_axis import axis_frames
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.kinematics import inverse_result
from pkmcal.solver import RESTART_DAMPING, Solution, Stop, eliminate, minimise

ROUNDS = 2
"""Whitening again, at the solution: it changes by a thousandth after the second."""
MOST_STEPS = 100
PLACED = 0.1
"""How well stations and mounts are known before any data, rad and m: far less than a drawing."""
RANK_TOLERANCE = 1e-8
"""Singular values of the scaled Jacobian below this share of the largest are zero: with exact
derivatives at data without noise, rounding leaves 1e-12."""


@dataclass(frozen=True)
class PoseFit:
    """The method's result on B runs.

    problem : with the weights and held unknowns of the end. solution : its state, cost, stops.
    held : names of what was held. rank : of the Jacobian with everything free.
    """

    problem: ImplicitProblem
    solution: Solution
    held: tuple[str, ...]
    rank: int


def inverse_kinematic(
    machine: Machine,
    measurements: Measurements,
    start: State | None = None,
    *,
    form: Form = "implicit",
    whitened: bool = True,
    use_drawing: bool | None = None,
) -> State:
    """One session's machine, stations and mounts from boards' poses and readings; [C] eq. 3 and 5.

    start : from the drawing by default, see :mod:`pkmcal.identify.hand_eye`. use_drawing : take
    the drawing's values as measurements with their tolerances; by default where rows are whitened,
    so that the two can be weighed. Platform poses are then by the readings and the new machine.
    Raises InputError without a board on the platform, ResultError where the search fails.
    """
    begin = start_from_poses(machine, measurements) if start is None else start
    fit = fit_session(machine, measurements, begin, form, whitened, use_drawing)
    return _session_state(machine, measurements, begin, fit)


def fit_session(
    machine: Machine,
    measurements: Measurements,
    start: State,
    form: Form = "implicit",
    whitened: bool = True,
    use_drawing: bool | None = None,
) -> PoseFit:
    """The same as a fit of one run, with what was held."""
    poses = measurements.poses
    rows = np.flatnonzero(_usable(measurements))
    if not rows.size:
        raise InputError(
            what="the inverse-kinematic method needs poses of a board on the platform",
            found="none",
            next_step="observe: board at a station, or use the method bundle",
        )
    poses = poses.select(rows)
    problem, state = pose_problem(
        machine,
        replace(measurements, poses=poses),
        poses.T_station_target[None],
        measurements.joints[None, poses.configuration],
        start,
        form,
    )
    noise = np.linalg.inv(np.swapaxes(poses.whiten, -1, -2) @ poses.whiten)
    prior = whitened if use_drawing is None else use_drawing
    return fit_poses(machine, problem, state, noise if whitened else None,
                     measurements.joint_noise, prior)  # fmt: skip


def _usable(measurements: Measurements) -> Booleans:
    if not measurements.mounts:
        return np.zeros(len(measurements.poses), dtype=bool)
    return measurements.on_platform[measurements.poses.mount]


def pose_problem(
    machine: Machine,
    measurements: Measurements,
    T_camera_board: Array,
    readings: Array,
    start: State,
    form: Form,
) -> tuple[ImplicitProblem, ImplicitState]:
    """The problem of B runs on the measurements' stations and mounts, unweighted, and its start.

    T_camera_board : (B, N, 4, 4). readings : (B, N, m). start : of one run, or with a leading
    axis B on ``T_camera_base`` and ``T_mount``.
    """
    layout, table = machine.layout, machine.parameters
    _check_form(machine, form)
    runs, count = T_camera_board.shape[:2]
    z = table.to_free(start.theta)
    camera = np.broadcast_to(start.T_camera_base, (runs, *start.T_camera_base.shape[-3:]))
    mount = np.broadcast_to(start.T_mount, (runs, *start.T_mount.shape[-3:]))
    n_shared = z.shape[-1] + 6 * camera.shape[1] + 6 * mount.shape[1]
    problem = ImplicitProblem(
        layout=layout,
        drawing=table.drawing,
        free=table.free_matrix(),
        station=measurements.poses.station,
        mount=measurements.poses.mount,
        T_camera_board=T_camera_board,
        readings=readings,
        form=form,
        weigh=np.zeros((1, 1, 1, 1)),
        prior=np.zeros((0, z.shape[-1])),
        keep=np.ones(n_shared, dtype=bool),
    )
    problem = replace(problem, weigh=problem.plain())
    state = ImplicitState(
        np.broadcast_to(z, (runs, z.shape[-1])).copy(),
        camera.copy(),
        mount.copy(),
        np.zeros((runs, count, layout.n_internal)),
    )
    return problem, _with_hinges(problem, state)


def _check_form(machine: Machine, form: Form) -> None:
    if form == "joint" and machine.layout.shares_motors:
        raise InputError(
            what=f"mechanism {machine.name!r} has several rods on a motor: no reading fits all",
            expected="the implicit form",
            next_step="use form='implicit'",
        )


def _with_hinges(problem: ImplicitProblem, state: ImplicitState) -> ImplicitState:
    """The state with the hinges' turns that its poses ask for."""
    if not problem.layout.n_internal:
        return state
    poses = problem.platform_poses(state)
    internal = inverse_result(problem.layout, problem.theta(state)[:, None], poses)[1]
    return state._replace(internal=np.nan_to_num(internal))


def fit_poses(
    machine: Machine,
    problem: ImplicitProblem,
    start: ImplicitState,
    noise: Array | None,
    joint_noise: float,
    use_drawing: bool,
) -> PoseFit:
    """The estimate of B runs. noise : (N, 6, 6) of the poses to whiten by; None as printed.

    As printed, the axis that the boards turn about is found first and held, [C] III.B.
    """
    table = machine.parameters
    if use_drawing:
        problem = replace(problem, prior=np.diag(1 / table.tolerances_free()))
    state = on_axis(problem, start)
    problem = problem if noise is None else _whitened(problem, state, noise, joint_noise)
    keep, rank = unknowns_kept(machine, problem, state, whitened=noise is not None)
    problem = replace(problem, keep=keep)
    solution = minimise(problem, state, max_steps=MOST_STEPS)
    steps = solution.steps
    for _ in range(0 if noise is None else ROUNDS):
        problem = _whitened(problem, solution.state, np.asarray(noise), joint_noise)
        solution = minimise(problem, solution.state, MOST_STEPS, RESTART_DAMPING)
        steps = steps + solution.steps
    names = np.array(unknown_names(machine, state), dtype=object)
    return PoseFit(problem, replace(solution, steps=steps), tuple(names[~keep]), rank)


def _whitened(
    problem: ImplicitProblem, state: ImplicitState, noise: Array, joint_noise: float
) -> ImplicitProblem:
    return replace(problem, weigh=problem.whitening(state, noise, joint_noise))


def on_axis(problem: ImplicitProblem, state: ImplicitState) -> ImplicitState:
    """The state with base and platform turned until the boards' one axis of rotation is their z.

    For machines that turn about one axis, where one camera sees one board; others stay as they are.
    The workspace keeps its place before the camera.
    """
    if not _one_axis(problem, state):
        return state
    frames = axis_frames(problem.T_camera_board[..., :3, :3])
    camera, mount = state.T_camera_base[:, 0], state.T_mount[:, 0]
    axis = frames.camera[..., :, 2]
    sign = np.sign(dot(axis, camera[:, :3, 2]))[:, None]
    middle = problem.platform_poses(state)[..., :3, 3].mean(axis=1)
    turn = turn_between(camera[:, :3, 2], sign * axis) @ camera[:, :3, :3]
    place = apply(camera, middle) - (turn @ middle[..., None])[..., 0]
    carried = (mount[:, :3, :3] @ (sign * frames.board[:, 2])[..., None])[..., 0]
    turned = turn_between(carried, np.array([0.0, 0.0, 1.0])) @ mount[:, :3, :3]
    return state._replace(
        T_camera_base=pose(turn, place)[:, None], T_mount=pose(turned, mount[:, :3, 3])[:, None]
    )


def _one_axis(problem: ImplicitProblem, state: ImplicitState) -> bool:
    alone = state.T_camera_base.shape[1] == state.T_mount.shape[1] == 1
    return alone and int(problem.layout.motion[:3].any(axis=1).sum()) == 1


def turn_between(a: Array, b: Array) -> Array:
    """The shortest turns (..., 3, 3) that lay unit vectors a (..., 3) on b."""
    across = cross(a, np.broadcast_to(b, a.shape))
    size = np.sqrt(dot(across, across))[..., None]
    angle = np.arctan2(size, dot(a, b)[..., None])
    return rotation(across * angle / np.where(size > 0, size, 1.0))


def unknowns_kept(
    machine: Machine, problem: ImplicitProblem, state: ImplicitState, *, whitened: bool
) -> tuple[Booleans, int]:
    """Unknowns (na,) that are estimated, and the rank of the Jacobian with all of them.

    By the first run. As printed, the tilts of a board against the axis of rotation have only a
    second-order influence ([C] III.C) and are held.
    """
    first, begin = problem.select(np.array([0])), problem.take(state, np.array([0]))
    jac = scaled_jacobian(first.ideal(begin), begin)
    sizes = np.concatenate([
        machine.parameters.tolerances_free(),
        np.full(6 * (state.T_camera_base.shape[1] + state.T_mount.shape[1]), PLACED),
    ])  # fmt: skip
    keep = np.ones(len(sizes), dtype=bool)
    rank, _ = _loose(jac, sizes)
    if not whitened:
        keep[_tilts(problem, state)] = False
    loose = _loose(jac[:, keep], sizes[keep])[1]
    keep[np.flatnonzero(keep)[_pivots(loose)]] = False
    return keep, rank


def _loose(jac: Array, sizes: Array) -> tuple[int, Array]:
    """Rank of a Jacobian (rows, n) and the directions (k, n) that nothing fixes, in units of what
    is known beforehand. Columns scaled by their extreme value, [C] IV.C.
    """
    extreme = np.abs(jac).max(axis=0)
    extreme = np.where(extreme > 0, extreme, 1.0)
    s, vt = np.linalg.svd(jac / extreme)[1:]
    rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
    return rank, vt[rank:] / (extreme * sizes)


def scaled_jacobian(problem: ImplicitProblem, state: ImplicitState) -> Array:
    """Jacobian (rows, na) of one run with hinges eliminated and the drawing's rows, unscaled."""
    linear = problem.linearize(state)
    rows = eliminate(linear, np.zeros(1)).rows if linear.by_own.shape[-1] else linear.by_shared
    return np.concatenate([rows.reshape(-1, rows.shape[-1]), linear.shared_by])


def _tilts(problem: ImplicitProblem, state: ImplicitState) -> Integers:
    """Columns of what the axis found beforehand tells: the mounts' turns that the machine itself
    cannot make and, where there is one axis and one camera, the camera's.
    """
    off = np.flatnonzero(~problem.layout.motion[:3].any(axis=1))
    stations, mounts = state.T_camera_base.shape[1], state.T_mount.shape[1]
    bodies = np.arange(0 if _one_axis(problem, state) else stations, stations + mounts)
    return (problem.free.shape[1] + 6 * bodies[:, None] + off).ravel()


def _pivots(loose: Array) -> list[int]:
    """One column for each row of (k, n), chosen so that the rows are fixed best."""
    rows, chosen = loose.copy(), list[int]()
    for _ in range(len(loose)):
        size = np.sum(rows**2, axis=0)
        k = int(np.argmax(size > 0.99 * size.max()))  # the first of equals
        chosen.append(k)
        along = rows[:, k] / np.linalg.norm(rows[:, k])
        rows = rows - along[:, None] * (along @ rows)
    return chosen


def unknown_names(machine: Machine, state: ImplicitState) -> tuple[str, ...]:
    """Names of all unknowns, in the order of the Jacobian's columns."""
    parts = ("turn x", "turn y", "turn z", "x", "y", "z")
    stations = [f"station {s + 1}, {p}" for s in range(state.T_camera_base.shape[1]) for p in parts]
    mounts = [f"board {m + 1}, {p}" for m in range(state.T_mount.shape[1]) for p in parts]
    return (*machine.parameters.free_names(), *stations, *mounts)


def _session_state(
    machine: Machine, measurements: Measurements, start: State, fit: PoseFit
) -> State:
    """The fit as a session's state, in the default frames, poses by the readings."""
    stop, found = fit.solution.stop[0], fit.solution.state
    if stop in (Stop.NOT_FINITE, Stop.STALLED):
        raise ResultError(what=f"the inverse-kinematic method failed: {stop.value}")
    theta = fit.problem.theta(found)[0]
    solved = machine.with_values(theta)
    poses = solved.forward_result(measurements.joints, start.T_base_platform)
    state = replace(
        start,
        theta=theta,
        T_camera_base=_updated(start.T_camera_base, found.T_camera_base[0], fit.problem.station),
        T_mount=_updated(start.T_mount, found.T_mount[0], fit.problem.mount),
        T_base_platform=poses.T_base_platform,
        internal=poses.internal,
    )
    state = in_gauge(machine, state, default_gauge(machine))
    return replace(state, theta=machine.parameters.unit_axes(state.theta))


def _updated(before: Array, after: Array, seen: Integers) -> Array:
    """Poses (n, 4, 4), the new ones where something was seen."""
    out = before.copy()
    out[seen] = after[seen]
    return out
