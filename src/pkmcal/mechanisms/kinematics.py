"""Inverse and forward kinematics of any machine, batched over poses.

Forward kinematics is a search for poses that close the machine, from a start in the right assembly:
Levenberg-Marquardt, each row of the batch on its own. A row has its own damping and stops on its
own. With little damping the steps are Newton's, so most rows are solved in four or five; what is
solved is taken out, and the rest goes on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
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
from pkmcal.mechanisms.closure import (
    BaseEnds,
    Closure,
    base_ends,
    by_own,
    closure,
    limb_lines,
    platform_ends,
    platform_parameters,
    rod_lengths,
    rows_between,
    scales,
)
from pkmcal.mechanisms.layout import LimbLayout

MAX_STEPS = 60
CONVERGED_CLOSURE_ERROR = 1e-12
"""Closure error (m) below which a configuration is solved: 100 times rounding at 1 m."""
CONFIGURATIONS_A_CHUNK = 2048
"""Rows of a batch at a time: their numbers stay in a processor's second cache."""
HOPELESS_DAMPING = 1e3
"""Damping at which a step that does not help is the last."""
CLOSURE_ROUNDING = 16 * float(np.finfo(float).eps)
"""Of the longest rod: where a step does not help, a closure error below it is rounding."""
SECOND_RODS_STEPS = 15
"""Steps for a machine's second rods; a pose that they all allow takes four."""
SECOND_RODS_SETTLED = 1e-15
"""A step of readings (rad) and hinges below which nothing changes any more."""
SAME_EQUATION = 1e-9
"""Singular value of the scaled rows below which one of them says what the others do."""
LEVELLING_STEPS = 3
"""Steps to the pose that closes more rows than it has unknowns best; each leaves of the way what
the closure error is of a rod."""
OTHER_MACHINE_GAP = 0.05
"""Of a rod, the closure error beyond which readings are no machine's with errors, but another's."""
STEPS_OUT_OF_REACH = 5
"""Steps in a row out of a limb's reach after which no pose is looked for any more."""
NEAR_SINGULAR = 0.02
"""Smallest singular value of the scaled inverse Jacobian below which a warning is due: a
reading's error then moves the platform fifty times as far."""


class Closed(NamedTuple):
    """Poses (N, 4, 4), internal coordinates (N, n), and the largest closure error (N,), m."""

    poses: Array
    internal: Array
    error: Array


class _Task(NamedTuple):
    """Rows of a batch that are worked on: theta (P,) or (n, P), and what the readings decide.

    platform : the platform groups' parameters. number : (n,) where the results belong.
    rounding : m.
    """

    layout: LimbLayout
    theta: Array
    platform: tuple[Array, ...]
    base: BaseEnds
    number: Integers
    rounding: float


class _State(NamedTuple):
    """Where the rows stand: value (n, E), jac (n, E, d), cost and worst (n,) of the values."""

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

    theta : (P,) or (N, P). Unknowns are the motion's directions only, so a planar machine stays in
    its plane, and the internal coordinates.
    """
    out = Closed(np.empty(start.shape), np.empty(internal.shape), np.empty(len(start)))
    for first in range(0, len(start), CONFIGURATIONS_A_CHUNK):
        rows = slice(first, first + CONFIGURATIONS_A_CHUNK)
        own = theta[rows] if theta.ndim > 1 else theta
        base = base_ends(layout, own, readings[rows])
        poses, phi = start[rows], internal[rows]
        if len(poses) >= POSES_WORTH_BATCH_LAST:
            base, poses, phi = base_batch_last(base), batch_last(poses), batch_last(phi)
        rounding = CLOSURE_ROUNDING * float(np.fmax.reduce(np.abs(base.length), axis=None))
        number, platform = first + np.arange(len(poses)), platform_parameters(layout, own)
        _close(_Task(layout, own, platform, base, number, rounding), poses, phi, out)
    return out


def base_batch_last(base: BaseEnds) -> BaseEnds:
    """What there is of each row, in the batch's order of memory."""
    a, by_reading = (batch_last(x) if x.ndim > 2 else x for x in (base.a, base.by_reading))
    return BaseEnds(a, by_reading, batch_last(base.length) if base.length.ndim > 1 else base.length)


def _close(task: _Task, poses: Array, internal: Array, out: Closed) -> None:
    """Work on some rows and write their results."""
    now = _at(task, poses, internal)
    damping, stuck = np.full(len(poses), 1e-6), np.zeros(len(poses), dtype=bool)
    for _ in range(MAX_STEPS):
        done = stuck | (now.worst <= CONVERGED_CLOSURE_ERROR * 1e-2)
        if 4 * np.count_nonzero(done) >= len(done):
            _write(task, now, out)
            remaining = np.flatnonzero(~done)
            if not remaining.size:
                return
            if remaining.size < len(done):
                task, now = _picked(task, remaining), _State(*(picked(x, remaining) for x in now))
                damping, done = damping[remaining], done[remaining]
        step = damped_step(now.jac, now.value, damping)
        trial = _at(task, *_moved(task.layout, now, step))
        better = trial.cost < now.cost
        if np.count_nonzero(better) == len(better):
            now, stuck, damping = trial, done, np.maximum(damping * 0.05, 1e-14)
            continue
        stuck = done | (~better & ((damping > HOPELESS_DAMPING) | (now.worst < task.rounding)))
        damping = np.where(better, np.maximum(damping * 0.05, 1e-14), damping * 30)
        now = _chosen(better, trial, now)
    _write(task, now, out)


def _at(task: _Task, poses: Array, internal: Array) -> _State:
    platform = platform_ends(task.layout, task.theta, poses, internal, task.platform)
    rows = rows_between(task.layout, task.theta, task.base, platform, poses)
    cost = (rows.value * rows.value).sum(axis=-1)
    worst = np.maximum.reduce(np.abs(rows.value), axis=-1, initial=0.0)
    return _State(poses, internal, rows.value, by_own(task.layout, rows), cost, worst)


def _moved(layout: LimbLayout, now: _State, step: Array) -> tuple[Array, Array]:
    """Poses and internal coordinates a step (n, d + n) back."""
    d = layout.motion.shape[1]
    if d == 6:
        delta = -step[:, :6]
    else:
        delta = fresh(step, (len(step), 6))
        delta[...] = 0.0
        np.negative(step[:, :d], out=delta[:, layout.freedoms])
    return stepped(now.poses, delta), now.internal - step[:, d:]


def _chosen(better: Booleans, trial: _State, now: _State) -> _State:
    """The trial where it is better."""
    out: list[Array] = []
    for new, old in zip(trial, now, strict=True):
        out.append(np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old))
    return _State(*out)


def _picked(task: _Task, rows: Integers) -> _Task:
    """The same for some rows of the batch."""
    base = task.base
    a, by_reading = (picked(x, rows) if x.ndim > 2 else x for x in (base.a, base.by_reading))
    length = picked(base.length, rows) if base.length.ndim > 1 else base.length
    theta = task.theta[rows] if task.theta.ndim > 1 else task.theta
    return task._replace(
        theta=theta,
        platform=platform_parameters(task.layout, theta),
        base=BaseEnds(a, by_reading, length),
        number=task.number[rows],
    )


def _write(task: _Task, now: _State, out: Closed) -> None:
    """The results of a task's rows, at their places."""
    out.poses[task.number], out.internal[task.number] = now.poses, now.internal
    out.error[task.number] = np.where(np.isfinite(now.cost), now.worst, np.inf)


@dataclass(frozen=True)
class ForwardResult:
    """Poses found from readings, and how far to trust each.

    T_base_platform : (..., 4, 4); converged : (...); error : (...) largest closure error, m.
    A machine with more rows than unknowns is closed as well as its readings allow, by least
    squares; converged where that leaves errors of readings and of drawings, see OTHER_MACHINE_GAP.
    internal : (..., n) the hinges' turns of an articulated platform, rad; n = 0 for a rigid one.
    layout, theta, readings : the machine, and what it was closed at.
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
        """(...) smallest singular value of the inverse Jacobian with rotations scaled by the
        platform's radius: 1 is a good machine, 0 a singular pose. Found when first asked for: it
        takes longer than the poses.
        """
        poses, phi = self.T_base_platform, self.internal
        c = closure(self.layout, self.theta, self.readings, poses, phi)
        return singularity_of(self.layout, scaled_rows(c))


def readings_at_poses(
    layout: LimbLayout, theta: Array, poses: Array, near: Array | None = None
) -> Array:
    """Readings (..., m) at poses T_base_platform (..., 4, 4).

    Rods: q = (length - offset) / scale, [B] eq. 4. Cranks and sliders: the carrier's closed form,
    [C] eq. 2, over the scale, nearest to mid-range, or to readings ``near`` (..., m). NaN out of
    reach.
    """
    return inverse_result(layout, theta, poses, near)[0]


def inverse_result(
    layout: LimbLayout, theta: Array, poses: Array, near: Array | None = None
) -> tuple[Array, Array]:
    """Readings (..., m) and internal coordinates (..., n) at poses (..., 4, 4)."""
    shape = np.broadcast_shapes(poses.shape[:-2], theta.shape[:-1])
    internal = _upright(layout, theta, poses, shape)
    legs = _leg_inverse(layout, theta, poses, internal, near)
    if not layout.shares_motors:
        driven = np.flatnonzero(layout.actuated >= 0)
        return legs[..., driven[np.argsort(layout.actuated[driven], kind="stable")]], internal
    columns = layout.actuated[None] == np.arange(layout.n_readings)[:, None]
    readings = legs @ (columns / columns.sum(axis=1, keepdims=True)).T
    return _settled(layout, theta, poses, readings, internal)


def closure_at(layout: LimbLayout, theta: Array, poses: Array) -> Closure:
    """The closure at poses (..., 4, 4), with the readings and hinges' turns that close it best."""
    readings, internal = inverse_result(layout, theta, poses)
    return closure(layout, theta, readings, poses, internal)


def _upright(layout: LimbLayout, theta: Array, poses: Array, shape: tuple[int, ...]) -> Array:
    """Internal coordinates (..., n) that leave the bars' directions as they are, about."""
    out = np.zeros((*shape, layout.n_internal))
    for group in layout.platform if layout.n_internal else ():
        if group.carrier.turns:
            turn = group.carrier.upright(group.of(theta), poses[..., None, :, :])
            out[..., layout.internal[group.legs]] = turn
    return out


def _leg_inverse(
    layout: LimbLayout, theta: Array, poses: Array, internal: Array, readings: Array | None
) -> Array:
    """Each leg's own reading (..., L), zero where it has none; the one nearest to ``readings``
    (..., m), or to mid-range.
    """
    at_zero = base_ends(layout, theta, np.zeros(layout.n_readings))
    platform = platform_ends(layout, theta, poses, internal)
    distance = limb_lines(at_zero, platform)[1]
    # linear in the reading of a rod on a fixed centre
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


def _settled(
    layout: LimbLayout, theta: Array, poses: Array, readings: Array, internal: Array
) -> tuple[Array, Array]:
    """Readings and internal coordinates that close a machine with several rods a motor best.

    Gauss-Newton with the poses held, from each motor's mean of its rods.
    """
    m = layout.n_readings
    pick = layout.of_motor.astype(float)
    x = np.concatenate([readings, internal], axis=-1)
    for _ in range(SECOND_RODS_STEPS):
        c = closure(layout, theta, x[..., :m], poses, x[..., m:])
        jac = np.concatenate([c.by_reading[..., None] * pick, c.rows.by_internal], axis=-1)
        # what is out of reach is NaN and stays so
        jac, value = np.nan_to_num(jac), np.nan_to_num(c.rows.value)
        step = damped_step(jac, value, np.full(value.shape[:-1], 1e-14))
        x = x - step
        if np.abs(step).max(initial=0.0) < SECOND_RODS_SETTLED:
            break
    return x[..., :m], x[..., m:]


def forward(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    start: Array,
    internal: Array | None = None,
) -> ForwardResult:
    """Poses at readings (..., m), from starts (..., 4, 4); theta (..., P) broadcasts.

    Unknowns are the motion's directions only, so a planar machine stays in its plane, and the
    internal coordinates (..., n), from zero where they are not given.
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
        poses, inner, error = _at_least(layout, theta, readings, poses, inner)
        rods = np.nanmedian(np.abs(rod_lengths(layout, theta, readings)), axis=-1)
        converged = error < OTHER_MACHINE_GAP * rods
    return ForwardResult(poses, converged, error, inner, layout, theta, readings)


def _at_least(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array
) -> Closed:
    """Poses (..., 4, 4) near the least of the rows' squares, brought to it.

    Gauss-Newton: near it the squares are level to rounding, and tell a search nothing.
    """
    for _ in range(LEVELLING_STEPS):
        c = closure(layout, theta, readings, poses, internal)
        back = np.linalg.pinv(np.nan_to_num(by_own(layout, c.rows)))
        step = (back @ np.nan_to_num(c.rows.value)[..., None])[..., 0] @ layout.own_motion.T
        poses, internal = perturb(poses, -step[..., :6]), internal - step[..., 6:]
    c = closure(layout, theta, readings, poses, internal)
    worst = np.abs(c.rows.value).max(axis=-1)
    return Closed(poses, internal, np.where(np.isfinite(worst), worst, np.inf))


def scaled_rows(c: Closure) -> Array:
    """Rows (..., E, d + n) by the pose's own freedoms, hinges last, without units: turns, which the
    hinges' are too, count as the platform's joints' ways.
    """
    return by_own(c.layout, c.rows) * own_scale(c.layout, c.theta)[..., None, :]


def singularity_of(layout: LimbLayout, scaled: Array) -> Array:
    """Smallest singular value (...) of :func:`scaled_rows`, of which each is about a unit
    direction: 0 where the platform can move with all joints locked; NaN where they are not known.
    """
    if layout.n_equations < scaled.shape[-1]:  # fewer than its freedoms: it can always move
        return np.zeros(scaled.shape[:-2])
    finite = np.isfinite(scaled).all(axis=(-1, -2))
    least = np.linalg.svd(np.nan_to_num(scaled), compute_uv=False)[..., -1]
    return np.where(finite, least, np.nan)


def own_scale(layout: LimbLayout, theta: Array) -> Array:
    """What one unit of each of the pose's own freedoms is, (..., d + n): 1 m along the base's
    axes, and turns, hinges' too, that move the platform's joints by 1 m.
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
    return np.where(radius > 0, radius, 1.0)  # legs that meet in a point turn nothing


def home_candidates(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Starts for a machine whose file names no home pose: the platform unturned, its joints'
    mean above (and below) the base joints' mean, at the height that the rods reach; (k, 4, 4).
    """
    a, b = base_ends(layout, theta, readings).a, platform_ends(layout, theta, np.eye(4)).b
    shift = a.mean(axis=-2) - b.mean(axis=-2)
    reach = typical_reach(layout, theta, readings)
    if not layout.free[5]:  # in its plane: turned a little, or beside the base's middle
        angles = (0.0, 0.5, -0.5, 1.0, -1.0) if layout.free[2] else (0.0,)
        beside = (0.0,) if layout.free[2] else (0.0, -reach / 3, reach / 3)
        places = [shift + np.array([0.0, y, 0.0]) for y in beside]
        return np.stack([pose(rotation(np.array([0, 0, a])), p) for a in angles for p in places])
    flat = float(np.linalg.norm((b + shift - a)[..., :2], axis=-1).mean())
    height = np.sqrt(max(reach**2 - flat**2, (0.3 * reach) ** 2))
    sides = (-1, 1) if _hangs(layout, theta, a) else (1, -1)
    return np.stack([pose(np.eye(3), shift + np.array([0.0, 0.0, s * height])) for s in sides])


def _hangs(layout: LimbLayout, theta: Array, a: Array) -> bool:
    """Whether cranks reach below their axes at these ends (L, 3), so that the platform does."""
    drops = [(a[g.legs] - g.of(theta)[..., :3])[..., 2] for g in layout.base if g.carrier.driven]
    return bool(drops) and float(np.concatenate(drops).mean()) < 0


def typical_reach(layout: LimbLayout, theta: Array, readings: Array) -> float:
    """Mean length of the rods whose length is known, m."""
    return float(np.abs(rod_lengths(layout, theta, readings)[layout.closing]).mean())


def mobility(layout: LimbLayout, theta: Array, pose: Array) -> int:
    """In how many ways the machine moves near a pose (4, 4): unknowns and readings together, less
    the equations between them that differ. A machine with more readings is redundant.
    """
    c = closure_at(layout, theta, pose)
    every = np.concatenate([scaled_rows(c), c.by_reading[..., None] * layout.of_motor], axis=-1)
    return every.shape[-1] - int(np.linalg.matrix_rank(every, tol=SAME_EQUATION))


def on_manifold(
    layout: LimbLayout, theta: Array, poses: Array, steps: int = MAX_STEPS
) -> ForwardResult:
    """Poses (..., 4, 4) moved to where everything closes that no drive can change.

    Constant rods, joints' axes and second rods of a motor leave a platform only some poses;
    readings follow from these. Gauss-Newton with the shortest step, so a pose that is right stays
    where it is; ``steps`` at most.
    """
    shape = np.broadcast_shapes(poses.shape[:-2], theta.shape[:-1])
    current = np.array(np.broadcast_to(poses, (*shape, 4, 4))).reshape(-1, 4, 4)
    every = theta if theta.ndim == 1 else np.broadcast_to(theta, (*shape, theta.shape[-1]))
    every = every if theta.ndim == 1 else every.reshape(-1, theta.shape[-1])
    free = layout.driven_rows.size < layout.n_equations or layout.shares_motors
    remaining, lost = np.arange(len(current)), np.zeros(len(current), dtype=int)
    for _ in range(steps if free else 0):
        own = every if every.ndim == 1 else every[remaining]
        c = closure_at(layout, own, current[remaining])
        value, blind = undriven(c)
        value, by_pose = np.nan_to_num(value), np.nan_to_num(blind @ c.rows.by_pose @ layout.motion)
        lost[remaining] = np.where(np.isfinite(c.readings).all(axis=-1), 0, lost[remaining] + 1)
        more = np.abs(value).max(axis=-1, initial=0.0) >= CONVERGED_CLOSURE_ERROR * 1e-2
        more &= lost[remaining] < STEPS_OUT_OF_REACH
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
    """Combinations (..., r, E) of the closure's rows that neither drives nor hinges move, and
    their values (..., r).
    """
    layout = c.layout
    passive = np.flatnonzero(layout.row_motor < 0)
    blind = np.eye(layout.n_equations)[passive]
    if layout.shares_motors:
        drives = c.by_reading[..., None] * layout.of_motor
        shifted = np.concatenate([drives, c.rows.by_internal], axis=-1)
        shifted = np.nan_to_num(shifted)
        q = np.linalg.qr(shifted, mode="complete")[0]
        blind = q[..., shifted.shape[-1] :].mT
    return (blind @ c.rows.value[..., None])[..., 0], blind
