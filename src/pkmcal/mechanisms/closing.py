"""The search for poses that close a machine: Levenberg-Marquardt, each row of the batch on its own.

A row has its own damping and stops on its own. With little damping the steps are Newton's, so most
rows are solved in four or five; what is solved is taken out, and the rest goes on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.mechanisms.batches import WORTH, batch_last, damped_step, fresh, picked, stepped
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.rows import (
    BaseEnds,
    base_ends,
    platform_ends,
    platform_parameters,
    rows_between,
)

MAX_STEPS = 60
CONVERGED = 1e-12
"""Closure error (m) below which a configuration is solved: 100 times rounding at 1 m."""
CHUNK = 2048
"""Rows of a batch at a time: their numbers stay in a processor's second cache."""
HOPELESS = 1e3
"""Damping at which a step that does not help is the last."""
ROUNDING = 16 * float(np.finfo(float).eps)
"""Of the longest rod: where a step does not help, a closure error below it is rounding."""


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
    for first in range(0, len(start), CHUNK):
        rows = slice(first, first + CHUNK)
        own = theta[rows] if theta.ndim > 1 else theta
        base = base_ends(layout, own, readings[rows])
        poses, phi = start[rows], internal[rows]
        if len(poses) >= WORTH:
            base, poses, phi = base_batch_last(base), batch_last(poses), batch_last(phi)
        rounding = ROUNDING * float(np.fmax.reduce(np.abs(base.length), axis=None))
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
        done = stuck | (now.worst <= CONVERGED * 1e-2)
        if 4 * np.count_nonzero(done) >= len(done):
            _write(task, now, out)
            left = np.flatnonzero(~done)
            if not left.size:
                return
            if left.size < len(done):
                task, now = _picked_task(task, left), _picked(now, left)
                damping, done = damping[left], done[left]
        step = damped_step(now.jac, now.value, damping)
        trial = _at(task, *_moved(task.layout, now, step))
        better = trial.cost < now.cost
        if np.count_nonzero(better) == len(better):
            now, stuck, damping = trial, done, np.maximum(damping * 0.05, 1e-14)
            continue
        stuck = done | (~better & ((damping > HOPELESS) | (now.worst < task.rounding)))
        damping = np.where(better, np.maximum(damping * 0.05, 1e-14), damping * 30)
        now = _chosen(better, trial, now)
    _write(task, now, out)


def _at(task: _Task, poses: Array, internal: Array) -> _State:
    platform = platform_ends(task.layout, task.theta, poses, internal, task.platform)
    rows = rows_between(task.layout, task.theta, task.base, platform, poses)
    cost = (rows.value * rows.value).sum(axis=-1)
    worst = np.maximum.reduce(np.abs(rows.value), axis=-1, initial=0.0)
    return _State(poses, internal, rows.value, task.layout.by_own(rows), cost, worst)


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


def _picked(now: _State, rows: Integers) -> _State:
    return _State(*(picked(x, rows) for x in now))


def _picked_task(task: _Task, rows: Integers) -> _Task:
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
    out.poses[task.number], out.internal[task.number] = now.poses, now.internal
    out.error[task.number] = np.where(np.isfinite(now.cost), now.worst, np.inf)
