"""Inverse and forward kinematics of any machine, batched over poses.

Forward kinematics is a Levenberg-Marquardt search for poses that close the machine, from a start in
the right assembly mode. Each row of the batch has its own damping and stops on its own. With little
damping the steps are Newton's, so most rows converge in four or five; converged rows are removed
from the batch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.geometry.batches import (
    POSES_WORTH_BATCH_LAST,
    batch_last,
    damped_step,
    fresh,
    picked,
    stepped,
)
from pkmcal.geometry.rigid import perturb, pose, rotation
from pkmcal.levels import ROUNDING
from pkmcal.mechanisms.closure import (
    BaseEnds,
    Closure,
    at_tangents,
    base_ends,
    by_own,
    closure,
    limb_lines,
    platform_ends,
    platform_parameters,
    rod_growth,
    rod_lengths,
    rows_between,
    scales,
)
from pkmcal.mechanisms.layout import LimbLayout

CONVERGED_CLOSURE_ERROR = 1e-12
"""Closure error (m) below which a configuration is solved: 100 times rounding at 1 m."""
NEAR_SINGULAR = 0.02
"""Smallest singular value of the scaled inverse Jacobian below which a warning is due: an error of
a reading then moves the platform fifty times as far."""


@dataclass(frozen=True)
class KinematicsOptions:
    """Constants of forward and inverse kinematics."""

    # most steps of a search
    most_steps: int = 60
    # rows of a batch processed at a time; their data fit into a processor's second-level cache
    chunk: int = 2048
    # first damping of a row, factors on it after an accepted and after a rejected step, and its
    # lower bound: starts are near the solution, where Newton's full step is best
    first_damping: float = 1e-6
    damping_after_success: float = 0.05
    damping_after_failure: float = 30.0
    least_damping: float = 1e-14
    # damping above which a row stops after a rejected step
    hopeless_damping: float = 1e3
    # closure error due to rounding, as a share of the longest rod; a row below it stops after a
    # rejected step
    rounding: float = 16 * float(np.finfo(float).eps)
    # closure error at which a row stops, relative to CONVERGED_CLOSURE_ERROR: one more step of
    # Newton's method costs little and leaves rounding
    target: float = 1e-2
    # most steps of inverse kinematics with several rods for a motor; a pose that all rods allow
    # takes four
    second_rods_steps: int = 15
    # step of readings (rad) and hinges below which these steps have converged
    second_rods_settled: float = 1e-15
    # Gauss-Newton steps to the least-squares pose of an overdetermined machine; each multiplies the
    # remaining distance by the ratio of the closure error to a rod
    levelling_steps: int = 3
    # closure error, as a share of a rod, above which readings belong to another machine, not to
    # this one with errors
    other_machine_gap: float = 0.05
    # consecutive steps with a limb out of reach after which the search for a pose stops
    steps_out_of_reach: int = 5


KINEMATICS = KinematicsOptions()


class Closed(NamedTuple):
    """Result of a search: poses (N, 4, 4), internal coordinates (N, n), and the largest closure
    error (N,), m.
    """

    poses: Array
    internal: Array
    error: Array


class _Task(NamedTuple):
    """Rows of a batch in progress.

    theta : (P,) or (n, P).
    platform : parameters of the platform groups.
    base : base side of the limbs.
    number : (n,) rows of the output.
    rounding : closure error due to rounding, m.
    """

    layout: LimbLayout
    theta: Array
    platform: tuple[Array, ...]
    base: BaseEnds
    number: Integers
    rounding: float


class _State(NamedTuple):
    """Current state of the rows: value (n, E), jac (n, E, d), cost (n,) sum of squares, worst (n,)
    largest residual.
    """

    poses: Array
    internal: Array
    value: Array
    jac: Array
    cost: Array
    worst: Array


def close(
    layout: LimbLayout, theta: Array, readings: Array, start: Array, internal: Array
) -> Closed:
    """Poses at readings (N, m) from starts (N, 4, 4) with internal coordinates (N, n).

    theta : (P,) or (N, P).

    Unknowns are the motion's freedoms, so a planar machine stays in its plane, and the internal
    coordinates.
    """
    out = Closed(np.empty(start.shape), np.empty(internal.shape), np.empty(len(start)))
    for first in range(0, len(start), KINEMATICS.chunk):
        rows = slice(first, first + KINEMATICS.chunk)
        own = theta[rows] if theta.ndim > 1 else theta
        base = base_ends(layout, own, readings[rows])
        poses, phi = start[rows], internal[rows]
        if len(poses) >= POSES_WORTH_BATCH_LAST:
            base, poses, phi = base_batch_last(base), batch_last(poses), batch_last(phi)
        rounding = KINEMATICS.rounding * float(np.fmax.reduce(np.abs(base.length), axis=None))
        number, platform = first + np.arange(len(poses)), platform_parameters(layout, own)
        _close(_Task(layout, own, platform, base, number, rounding), poses, phi, out)
    return out


def base_batch_last(base: BaseEnds) -> BaseEnds:
    """Base side with the arrays that differ between rows in batch-last memory order."""
    a, by_reading = (batch_last(x) if x.ndim > 2 else x for x in (base.a, base.by_reading))
    length, rate = (batch_last(x) if x.ndim > 1 else x for x in (base.length, base.rate))
    return BaseEnds(a, by_reading, length, rate)


def _close(task: _Task, poses: Array, internal: Array, out: Closed) -> None:
    """Solve the rows of a task and write their results."""
    now = _state_at(task, poses, internal)
    options, closed_error = KINEMATICS, KINEMATICS.target * CONVERGED_CLOSURE_ERROR
    damping = np.full(len(poses), options.first_damping)
    stuck = np.zeros(len(poses), dtype=bool)
    for _ in range(options.most_steps):
        # Write and remove finished rows once they are a quarter of the batch.
        done = stuck | (now.worst <= closed_error)
        if 4 * np.count_nonzero(done) >= len(done):
            _write_results(task, now, out)
            remaining = np.flatnonzero(~done)
            if not remaining.size:
                return
            if remaining.size < len(done):
                task, now = (
                    _task_rows(task, remaining),
                    _State(*(picked(x, remaining) for x in now)),
                )
                damping, done = damping[remaining], done[remaining]
        step = damped_step(now.jac, now.value, damping)
        trial = _state_at(task, *_retracted(task.layout, now, step))
        better = trial.cost < now.cost
        smaller = np.maximum(damping * options.damping_after_success, options.least_damping)
        if np.count_nonzero(better) == len(better):
            now, stuck, damping = trial, done, smaller
            continue
        # Rejected steps increase the damping, or end a row that cannot improve.
        stuck = done | (
            ~better & ((damping > options.hopeless_damping) | (now.worst < task.rounding))
        )
        damping = np.where(better, smaller, damping * options.damping_after_failure)
        now = _State(
            *(
                np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(trial, now, strict=True)
            )
        )
    _write_results(task, now, out)


def _state_at(task: _Task, poses: Array, internal: Array) -> _State:
    """State of the rows at poses (n, 4, 4) and internal coordinates."""
    platform = platform_ends(task.layout, task.theta, poses, internal, task.platform)
    base = at_tangents(task.layout, task.theta, task.base, platform)
    rows = rows_between(task.layout, task.theta, base, platform, poses)
    cost = (rows.value * rows.value).sum(axis=-1)
    worst = np.maximum.reduce(np.abs(rows.value), axis=-1, initial=0.0)
    return _State(poses, internal, rows.value, by_own(task.layout, rows), cost, worst)


def _retracted(layout: LimbLayout, now: _State, step: Array) -> tuple[Array, Array]:
    """Poses and internal coordinates retracted along minus a step (n, d + n)."""
    d = layout.motion.shape[1]
    if d == 6:
        delta = -step[:, :6]
    else:
        delta = fresh(step, (len(step), 6))
        delta[...] = 0.0
        np.negative(step[:, :d], out=delta[:, layout.freedoms])
    return stepped(now.poses, delta), now.internal - step[:, d:]


def _task_rows(task: _Task, rows: Integers) -> _Task:
    """Task restricted to some of its rows."""
    base = task.base
    a, by_reading = (picked(x, rows) if x.ndim > 2 else x for x in (base.a, base.by_reading))
    length, rate = (picked(x, rows) if x.ndim > 1 else x for x in (base.length, base.rate))
    theta = task.theta[rows] if task.theta.ndim > 1 else task.theta
    return task._replace(
        theta=theta,
        platform=platform_parameters(task.layout, theta),
        base=BaseEnds(a, by_reading, length, rate),
        number=task.number[rows],
    )


def _write_results(task: _Task, now: _State, out: Closed) -> None:
    """Write the results of a task's rows into the output."""
    out.poses[task.number], out.internal[task.number] = now.poses, now.internal
    out.error[task.number] = np.where(np.isfinite(now.cost), now.worst, np.inf)


@dataclass(frozen=True)
class ForwardResult:
    """Forward kinematics: poses with their convergence.

    T_base_platform : (..., 4, 4).
    converged : (...). An overdetermined machine (more rows than unknowns) is closed by least
        squares, and has converged if the residual can be due to errors of readings and geometry,
        see ``KinematicsOptions.other_machine_gap``.
    error : (...) largest closure error, m.
    internal : (..., n) hinge angles of an articulated platform, rad; n = 0 for a rigid one.
    layout, theta, readings : the machine, and the readings at which it was closed.
    """

    T_base_platform: Array
    converged: Booleans
    error: Array
    internal: Array
    layout: LimbLayout = field(repr=False)
    theta: Array = field(repr=False)
    readings: Array = field(repr=False)

    __repr__ = short_repr

    @cached_property
    def singularity(self) -> Array:
        """Smallest singular value (...) of the inverse Jacobian with rotations scaled by the
        platform's radius: 1 for a well-conditioned machine, 0 at a singular pose.

        Evaluated on first use; it takes longer than the poses.
        """
        poses, phi = self.T_base_platform, self.internal
        c = closure(self.layout, self.theta, self.readings, poses, phi)
        return singularity_of(scaled_rows(c))


def readings_at_poses(
    layout: LimbLayout, theta: Array, poses: Array, near: Array | None = None
) -> Array:
    """Readings (..., m) at poses T_base_platform (..., 4, 4); NaN out of reach.

    Rods: q = (length - offset) / scale, [B] eq. 4. Cranks and sliders: the carrier's closed form,
    [C] eq. 2, over the scale, with the solution nearest to mid-range, or to readings ``near``
    (..., m).
    """
    return inverse_result(layout, theta, poses, near)[0]


def inverse_result(
    layout: LimbLayout, theta: Array, poses: Array, near: Array | None = None
) -> tuple[Array, Array]:
    """Readings (..., m) and internal coordinates (..., n) at poses (..., 4, 4); arguments as for
    :func:`readings_at_poses`.
    """
    shape = np.broadcast_shapes(poses.shape[:-2], theta.shape[:-1])
    # Each leg on its own, with hinges that keep the bars' directions.
    internal = _initial_internal(layout, theta, poses, shape)
    legs = _leg_readings(layout, theta, poses, internal, near)
    if not layout.shares_motors:
        driven = np.flatnonzero(layout.actuated >= 0)
        return legs[..., driven[np.argsort(layout.actuated[driven], kind="stable")]], internal
    # Several rods for a motor: least squares from the mean over its rods.
    columns = layout.actuated[None] == np.arange(layout.n_readings)[:, None]
    readings = legs @ (columns / columns.sum(axis=1, keepdims=True)).T
    return _least_squares_readings(layout, theta, poses, readings, internal)


def closure_at(layout: LimbLayout, theta: Array, poses: Array) -> Closure:
    """Closure at poses (..., 4, 4), with the readings and hinge angles from inverse kinematics."""
    readings, internal = inverse_result(layout, theta, poses)
    return closure(layout, theta, readings, poses, internal)


def _initial_internal(
    layout: LimbLayout, theta: Array, poses: Array, shape: tuple[int, ...]
) -> Array:
    """Approximate internal coordinates (..., n) that keep the bars' directions."""
    out = np.zeros((*shape, layout.n_internal))
    for group in layout.platform if layout.n_internal else ():
        if group.carrier.turns:
            turn = group.carrier.upright(group.of(theta), poses[..., None, :, :])
            out[..., layout.internal[group.legs]] = turn
    return out


def _leg_readings(
    layout: LimbLayout, theta: Array, poses: Array, internal: Array, readings: Array | None
) -> Array:
    """Reading of each leg (..., L), zero without one; the solution nearest to ``readings``
    (..., m), or to mid-range.
    """
    platform = platform_ends(layout, theta, poses, internal)
    at_zero = base_ends(layout, theta, np.zeros(layout.n_readings))
    at_zero = at_tangents(layout, theta, at_zero, platform)
    line, distance = limb_lines(at_zero, platform)
    if layout.growing.size:
        distance = np.array(distance)
        distance[..., layout.growing] += rod_growth(layout, theta, poses, line).value
    # A rod on a fixed centre is linear in its reading.
    out, scale = np.where(layout.rod_reads, distance - at_zero.length, 0.0), scales(layout, theta)
    for group in layout.base:
        if group.carrier.driven:
            b, rods = platform.b[..., group.legs, :], at_zero.length[..., group.legs]
            near = layout.middle[group.legs]
            if readings is not None:
                near = readings[..., layout.actuated[group.legs]]
            near = scale[..., group.legs] * near
            out[..., group.legs] = group.carrier.reading(group.of(theta), b, rods, near)
    return out / scale


def _least_squares_readings(
    layout: LimbLayout, theta: Array, poses: Array, readings: Array, internal: Array
) -> tuple[Array, Array]:
    """Readings and internal coordinates that close a machine with several rods for a motor by least
    squares.

    Gauss-Newton at fixed poses, started from each motor's mean over its rods.
    """
    m = layout.n_readings
    pick = layout.of_motor.astype(float)
    x = np.concatenate([readings, internal], axis=-1)
    for _ in range(KINEMATICS.second_rods_steps):
        c = closure(layout, theta, x[..., :m], poses, x[..., m:])
        jac = np.concatenate([c.by_reading[..., None] * pick, c.rows.by_internal], axis=-1)
        # x is NaN out of reach, and stays NaN
        jac, value = np.nan_to_num(jac), np.nan_to_num(c.rows.value)
        step = damped_step(jac, value, np.full(value.shape[:-1], KINEMATICS.least_damping))
        x = x - step
        if np.abs(step).max(initial=0.0) < KINEMATICS.second_rods_settled:
            break
    return x[..., :m], x[..., m:]


def forward(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    start: Array,
    internal: Array | None = None,
) -> ForwardResult:
    """Forward kinematics at readings (..., m), from starts (..., 4, 4); theta (..., P) broadcasts.

    internal : (..., n) initial internal coordinates, zero by default.

    Unknowns are the motion's freedoms, so a planar machine stays in its plane, and the internal
    coordinates.
    """
    shape = np.broadcast_shapes(readings.shape[:-1], start.shape[:-2], theta.shape[:-1])
    count = math.prod(shape)

    def rows(array: Array, *tail: int) -> Array:
        whole = array if array.shape == (*shape, *tail) else np.broadcast_to(array, (*shape, *tail))
        return whole.reshape(count, *tail)

    n = layout.n_internal
    fk = close(
        layout,
        theta if theta.ndim == 1 else rows(theta, theta.shape[-1]),
        rows(readings, layout.n_readings),
        rows(start, 4, 4),
        rows(np.zeros(n) if internal is None else internal, n),
    )
    poses, inner = fk.poses.reshape(*shape, 4, 4), fk.internal.reshape(*shape, n)
    error = fk.error.reshape(shape)
    converged = error < CONVERGED_CLOSURE_ERROR
    if layout.overdetermined:
        poses, inner, error = _least_squares_poses(layout, theta, readings, poses, inner)
        rods = np.nanmedian(np.abs(rod_lengths(layout, theta, readings)), axis=-1)
        converged = error < KINEMATICS.other_machine_gap * rods
    return ForwardResult(poses, converged, error, inner, layout, theta, readings)


def driven_towards(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    start: Array,
    internal: Array | None = None,
) -> ForwardResult:
    """Poses that a built machine takes when it is driven towards readings (..., m), with the
    readings of its motors there; arguments as for :func:`forward`.

    An overdetermined machine closes only at readings that agree with each other, so those of
    another machine, such as its nominal model, are replaced by its own at the least-squares pose.
    """
    fk = forward(layout, theta, readings, start, internal)
    if not layout.overdetermined:
        return fk
    exact = on_manifold(layout, theta, fk.T_base_platform)
    return replace(exact, converged=exact.converged & fk.converged)


def _least_squares_poses(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array
) -> Closed:
    """Least-squares poses (..., 4, 4) of an overdetermined machine, from poses near the minimum.

    Gauss-Newton: near the minimum the sum of squares is constant to rounding, so a search by its
    value stalls.
    """
    for _ in range(KINEMATICS.levelling_steps):
        c = closure(layout, theta, readings, poses, internal)
        back = np.linalg.pinv(np.nan_to_num(by_own(layout, c.rows)))
        step = (back @ np.nan_to_num(c.rows.value)[..., None])[..., 0] @ layout.own_motion.T
        poses, internal = perturb(poses, -step[..., :6]), internal - step[..., 6:]
    c = closure(layout, theta, readings, poses, internal)
    worst = np.abs(c.rows.value).max(axis=-1)
    return Closed(poses, internal, np.where(np.isfinite(worst), worst, np.inf))


def scaled_rows(c: Closure) -> Array:
    """Derivatives (..., E, d + n) of the closure by the pose's freedoms and hinges, without units:
    rotations are expressed as displacements of the platform's joints.
    """
    return by_own(c.layout, c.rows) * own_scale(c.layout, c.theta)[..., None, :]


def singularity_of(scaled: Array) -> Array:
    """Smallest singular value (...) of :func:`scaled_rows`, whose rows are about unit vectors: 0 if
    the platform can move with all joints locked; NaN if the rows are not finite.
    """
    finite = np.isfinite(scaled).all(axis=(-1, -2))
    singular_values = np.linalg.svd(np.nan_to_num(scaled), compute_uv=False)
    # one a freedom; with fewer rows than freedoms the last is missing, and 0
    least = singular_values[..., scaled.shape[-1] - 1 :].sum(axis=-1)
    return np.where(finite, least, np.nan)


def own_scale(layout: LimbLayout, theta: Array) -> Array:
    """Unit of each of the pose's freedoms (..., d + n) in :func:`scaled_rows`: 1 m along the base's
    axes, and rotations (of hinges too) that displace the platform's joints by 1 m.
    """
    hinges = np.arange(layout.own_motion.shape[1]) >= layout.motion.shape[1]
    turns = hinges | (np.abs(layout.own_motion[:3]).sum(axis=0) > 0)
    return np.where(turns, 1 / platform_radius(layout, theta)[..., None], 1.0)


def platform_radius(layout: LimbLayout, theta: Array) -> Array:
    """Root mean square distance (...) of the platform's joints from their mean, m."""
    points = [g.carrier.place(g.of(theta), np.eye(4))[0] for g in layout.platform]
    centres = np.concatenate(points, axis=-2)
    spread = centres - centres.mean(axis=-2, keepdims=True)
    radius = np.sqrt(np.mean(np.sum(spread**2, axis=-1), axis=-1))
    return np.where(radius > 0, radius, 1.0)  # legs that meet in one point


def home_candidates(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Starting poses (k, 4, 4) for a machine without a home pose in its file.

    The platform is unrotated, with the mean of its joints above (and below) the mean of the base
    joints, at the height that the rods reach. Planar machines start rotated by several angles, or
    beside the base's middle.
    """
    a, b = base_ends(layout, theta, readings).a, platform_ends(layout, theta, np.eye(4)).b
    shift = a.mean(axis=-2) - b.mean(axis=-2)
    reach = typical_reach(layout, theta, readings)
    if not layout.free[5]:  # planar motion
        angles = (0.0, 0.5, -0.5, 1.0, -1.0) if layout.free[2] else (0.0,)
        beside = (0.0,) if layout.free[2] else (0.0, -reach / 3, reach / 3)
        places = [shift + np.array([0.0, y, 0.0]) for y in beside]
        return np.stack([pose(rotation(np.array([0, 0, a])), p) for a in angles for p in places])
    # Spatial motion: above and below the base.
    flat = float(np.linalg.norm((b + shift - a)[..., :2], axis=-1).mean())
    height = np.sqrt(max(reach**2 - flat**2, (0.3 * reach) ** 2))
    # Cranks whose ends are below their axes on average carry a platform below the base.
    drops = [(a[g.legs] - g.of(theta)[..., :3])[..., 2] for g in layout.base if g.carrier.driven]
    hangs = bool(drops) and float(np.concatenate(drops).mean()) < 0
    sides = (-1, 1) if hangs else (1, -1)
    return np.stack([pose(np.eye(3), shift + np.array([0.0, 0.0, s * height])) for s in sides])


def typical_reach(layout: LimbLayout, theta: Array, readings: Array) -> float:
    """Mean length of the rods with known length, m."""
    return float(np.abs(rod_lengths(layout, theta, readings)[layout.closing]).mean())


def mobility(layout: LimbLayout, theta: Array, pose: Array) -> int:
    """Number of degrees of freedom of the machine near a pose (4, 4).

    The number of unknowns and readings, minus the rank of the equations between them. A machine
    with more readings than this is redundant.
    """
    c = closure_at(layout, theta, pose)
    every = np.concatenate([scaled_rows(c), c.by_reading[..., None] * layout.of_motor], axis=-1)
    return every.shape[-1] - int(np.linalg.matrix_rank(every, tol=ROUNDING))


def on_manifold(
    layout: LimbLayout, theta: Array, poses: Array, steps: int = KINEMATICS.most_steps
) -> ForwardResult:
    """Poses (..., 4, 4) projected onto those that satisfy all constraints which no drive can
    change.

    Constant rods, joints' axes and second rods of a motor constrain the platform; the readings
    follow from the pose. Gauss-Newton with the minimum-norm step, so an admissible pose does not
    change. At most ``steps`` steps.
    """
    shape = np.broadcast_shapes(poses.shape[:-2], theta.shape[:-1])
    current = np.array(np.broadcast_to(poses, (*shape, 4, 4))).reshape(-1, 4, 4)
    every = theta if theta.ndim == 1 else np.broadcast_to(theta, (*shape, theta.shape[-1]))
    every = every if theta.ndim == 1 else every.reshape(-1, theta.shape[-1])
    free = layout.driven_rows.size < layout.n_equations or layout.shares_motors
    closed_error = KINEMATICS.target * CONVERGED_CLOSURE_ERROR
    remaining, out_of_reach = np.arange(len(current)), np.zeros(len(current), dtype=int)
    for _ in range(steps if free else 0):
        own = every if every.ndim == 1 else every[remaining]
        c = closure_at(layout, own, current[remaining])
        # Violated constraints and their derivatives by the pose.
        value, blind = undriven(c)
        value, by_pose = np.nan_to_num(value), np.nan_to_num(blind @ c.rows.by_pose @ layout.motion)
        out_of_reach[remaining] = np.where(
            np.isfinite(c.readings).all(axis=-1), 0, out_of_reach[remaining] + 1
        )
        # Continue with poses that are neither converged nor out of reach.
        more = np.abs(value).max(axis=-1, initial=0.0) >= closed_error
        more &= out_of_reach[remaining] < KINEMATICS.steps_out_of_reach
        remaining = remaining[more]
        if not remaining.size:
            break
        step = -np.linalg.pinv(by_pose[more]) @ value[more][..., None]
        current[remaining] = perturb(current[remaining], (layout.motion @ step)[..., 0])
    current = current.reshape(*shape, 4, 4)
    readings, phi = inverse_result(layout, theta, current)
    c = closure(layout, theta, readings, current, phi)
    reached = np.isfinite(c.rows.value).all(axis=-1)
    off = np.abs(undriven(c)[0]).max(axis=-1, initial=0.0)
    error = np.where(reached, off, np.inf)
    return ForwardResult(
        current, error < CONVERGED_CLOSURE_ERROR, error, phi, layout, theta, readings
    )


def undriven(c: Closure) -> tuple[Array, Array]:
    """Values (..., r) of the combinations of closure rows that neither drives nor hinges change,
    and these combinations (..., r, E).
    """
    layout = c.layout
    passive = np.flatnonzero(layout.row_motor < 0)
    blind = np.eye(layout.n_equations)[passive]
    if layout.shares_motors:
        drives = c.by_reading[..., None] * layout.of_motor
        by_driven = np.concatenate([drives, c.rows.by_internal], axis=-1)
        by_driven = np.nan_to_num(by_driven)
        q = np.linalg.qr(by_driven, mode="complete")[0]
        blind = q[..., by_driven.shape[-1] :].mT
    return (blind @ c.rows.value[..., None])[..., 0], blind
