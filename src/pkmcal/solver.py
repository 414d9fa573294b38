"""Least squares: batched Levenberg-Marquardt, robust weights, scaled ranks and inverses.

**Search.** The own unknowns of each configuration are eliminated.

A problem has unknowns that all configurations share, x_a (na), and unknowns of each
configuration alone, x_b (d each). Residual rows are grouped by configuration, so the Jacobian
is ``by_shared`` (B, K, r, na) and ``by_own`` (B, K, r, d); rows that touch shared unknowns only
(drawing values, gauge) stand beside them. B counts independent runs: each has its own damping,
acceptance and stop, and no loop goes over runs or configurations.

The Schur complement is formed as a square root: with ``by_own = Q R`` the reduced rows are
``(I - Q Q^T) by_shared``. Subtracting normal matrices instead would cancel half the digits,
since readings a thousand times sharper than edges dominate both terms.

**States and data of many runs** are arrays, or frozen dataclasses or named tuples of arrays, whose
leading axis counts the runs; see :func:`take`, :func:`put` and :func:`of_runs`.

**Robust weights**, one for a search that lets go of what does not fit (:func:`soft_weights`), one
for its end (:func:`final_weights`).

**Ranks and inverses** are those of matrices whose columns are scaled to length one first: unknowns
in metres, radians and pixels are not to be compared otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any, NamedTuple, Protocol, TypeVar, cast

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

FIRST_DAMPING = 1e-5
RESTART_DAMPING = 1e-9
"""First damping where the start is an answer already, to slightly other weights."""
LEAST_DAMPING = 1e-14
MOST_DAMPING = 1e9
"""Damping beyond which a step is below rounding: nothing downhill was found."""
STEP_TOLERANCE = 1e-7
"""A step that changes all fitted values together by less, in standard deviations, ends the
search: a ten-millionth of what the noise does, and above the rounding of 1e-9 or so."""
REFUSED = 1e-3
"""The same of a step that is refused, though the linear model promises something of it: that little
is its rounding, where a direction is a millionth as well known as the others."""

ROUNDING = 1e-13
"""Of the cost, relative."""

FULL, NONE = 4.0, 6.5
"""Final weights are 1 up to FULL and 0 from NONE standard deviations: of clean pairs of residuals
3 in 10^4 lose part of their weight and none all of it, so efficiency is above 0.999."""
RANK_TOLERANCE = 1e-9
"""Singular values below this share of the largest are zero: rounding leaves 1e-12 to 1e-14
there with exact derivatives, and real directions are many orders above."""

Runs = TypeVar("Runs")
"""An array, or a frozen dataclass or named tuple of arrays, with a leading axis of runs."""


class Stop(Enum):
    """Why a search ended; the text is what the user reads."""

    CONVERGED = "converged"
    STALLED = (
        "no step downhill was found; check the start, the stations' poses first, and that the "
        "readings belong to the photographs"
    )
    STEPS = "the step limit was reached before convergence; start nearer, or allow more steps"
    NOT_FINITE = "nothing can be predicted at the start; check the stations' poses and the drawing"
    RUNNING = "not finished"


class Linear(NamedTuple):
    """Residuals and Jacobian at a point.

    value : (B, K, r). by_shared : (B, K, r, na). by_own : (B, K, r, d).
    usable : (B, K, r) False where nothing can be predicted; such rows are zero.
    shared_value : (B, c) rows on shared unknowns only. shared_by : (c, na).
    """

    value: Array
    by_shared: Array
    by_own: Array
    usable: Booleans
    shared_value: Array
    shared_by: Array


class Values(NamedTuple):
    """Residuals alone: value (B, K, r) with NaN where nothing can be predicted, shared (B, c)."""

    value: Array
    shared_value: Array


class LeastSquares(Protocol):
    """What the solver needs of a problem; ``state`` is the problem's own, opaque here."""

    def residuals(self, state: Any) -> Values:
        """Residuals at a state."""
        ...

    def linearize(self, state: Any) -> Linear:
        """Residuals and exact Jacobian; rows that cannot be predicted are zero."""
        ...

    def moved(self, state: Any, shared: Array, own: Array) -> Any:
        """The state moved by steps (B, na) and (B, K, d)."""
        ...

    def select(self, runs: Integers) -> LeastSquares:
        """The problem of some runs only."""
        ...


def take(state: Runs, runs: Integers) -> Runs:
    """The state of some runs."""
    return _each(lambda array: array[runs], state)


def put(state: Runs, runs: Integers, part: Runs) -> Runs:
    """The state with some runs' values replaced by those of ``part``."""

    def replaced(array: Array, new: Array) -> Array:
        out = array.copy()
        out[runs] = new
        return out

    return _each(replaced, state, part)


def of_runs(data: Runs, runs: Integers) -> Runs:
    """The measured numbers of some runs; what all runs share (a leading axis of 1) stays."""
    return _each(lambda array: array if len(array) == 1 else array[runs], data)


def _each(function: Callable[..., Array], first: Runs, *others: Runs) -> Runs:
    """A function of the arrays of states, array by array."""
    if isinstance(first, np.ndarray):
        return cast(Runs, function(first, *others))
    states: tuple[Any, ...] = (first, *others)
    if not isinstance(first, tuple):
        names = [field.name for field in fields(states[0])]
        states = tuple(tuple(getattr(state, name) for name in names) for state in states)
    return type(first)(*(function(*part) for part in zip(*states, strict=True)))


class Reduced(NamedTuple):
    """The problem after elimination of the own unknowns.

    rows : (B, K, r', na) reduced Jacobian; the data's rows come first, the damping's after.
    value : (B, K, r) what of the residuals the own unknowns cannot take up.
    q, r : QR factors of the own Jacobian, q restricted to the data's rows.
    gradient : (B, na) of half the cost, own unknowns eliminated.
    """

    rows: Array
    value: Array
    q: Array
    r: Array
    gradient: Array


@dataclass(frozen=True)
class Solution:
    """Result of a search: state, cost (B,), steps (B,), stop (B,) of Stop."""

    state: Any
    cost: Array
    steps: Integers
    stop: tuple[Stop, ...]


def own_factors(by_own: Array, damping: Array) -> tuple[Array, Array]:
    """QR factors of the own Jacobian with Marquardt damping (B,), zero for none.

    The damping's rows sqrt(damping) diag(column norms) are appended, so a configuration that
    its data do not fix stays solvable. q (B, K, r + d, d), r (B, K, d, d).
    """
    norms = np.sqrt(np.sum(by_own**2, axis=-2))
    norms = np.where(norms > 0, norms, 1.0)
    extra = np.sqrt(damping)[:, None, None, None] * norms[..., None] * np.eye(by_own.shape[-1])
    return np.linalg.qr(np.concatenate([by_own, extra], axis=-2))


def eliminate(linear: Linear, damping: Array) -> Reduced:
    """Own unknowns eliminated with Marquardt damping (B,), zero for none."""
    n_rows = linear.by_own.shape[-2]
    q, r = own_factors(linear.by_own, damping)
    top, bottom = q[..., :n_rows, :], q[..., n_rows:, :]
    along = top.mT @ linear.by_shared
    rows = linear.by_shared - top @ along
    if np.any(damping > 0):
        rows = np.concatenate([rows, -bottom @ along], axis=-2)
    value = linear.value[..., None]
    # the damping's rows carry no residual of their own, only -bottom top^T value
    left = value - top @ (top.mT @ value)
    gradient = (linear.by_shared.mT @ left)[..., 0].sum(axis=1)
    gradient = gradient + linear.shared_value @ linear.shared_by
    return Reduced(rows, left[..., 0], top, r, gradient)


def _flat(rows: Array) -> Array:
    """Rows (B, K, r, n) of all configurations, (B, K r, n); n may be none."""
    return rows.reshape(rows.shape[0], rows.shape[1] * rows.shape[2], rows.shape[3])


def stacked(linear: Linear, reduced: Reduced) -> tuple[Array, Array]:
    """All rows on the shared unknowns, the own ones eliminated without damping: Jacobian (B, n, na)
    and residuals (B, n). The configurations' rows come first, those on shared unknowns only last.
    """
    n_runs = len(reduced.rows)
    shared = np.broadcast_to(linear.shared_by, (n_runs, *linear.shared_by.shape))
    rows = np.concatenate([_flat(reduced.rows), shared], axis=1)
    value = [reduced.value.reshape(n_runs, -1), linear.shared_value]
    return rows, np.concatenate(value, axis=1)


def reduced_normal(linear: Linear, reduced: Reduced) -> Array:
    """Normal matrix of the shared unknowns, (B, na, na)."""
    rows = _flat(reduced.rows)
    return rows.mT @ rows + linear.shared_by.T @ linear.shared_by


def damped_step(linear: Linear, damping: Array) -> tuple[Array, Array]:
    """Levenberg-Marquardt step: shared (B, na) and own (B, K, d)."""
    reduced = eliminate(linear, damping)
    scaled, scale = _unit_diagonal(reduced_normal(linear, reduced))
    # at least a few rounding units, so that an unidentified direction gives no step
    ridge = np.maximum(damping, 1e-15)[:, None, None] * np.eye(scale.shape[1])
    shared = -np.linalg.solve(scaled + ridge, (reduced.gradient / scale)[..., None])[..., 0] / scale
    fitted = linear.value + (linear.by_shared @ shared[:, None, :, None])[..., 0]
    right = (reduced.q.mT @ fitted[..., None])[..., 0]
    own = -np.linalg.solve(reduced.r, right[..., None])[..., 0]
    return shared, own


def minimise(
    problem: LeastSquares, start: Any, max_steps: int = 100, damping: float = FIRST_DAMPING
) -> Solution:
    """Least squares from ``start``, all runs at once; each stops on its own."""
    values = problem.residuals(start)
    n_runs = values.shared_value.shape[0]
    cost = _cost(values, np.isfinite(values.value))
    steps = np.zeros(n_runs, dtype=int)
    stop = [Stop.RUNNING] * n_runs
    dampings = np.full(n_runs, damping)
    state, active = start, np.arange(n_runs)
    part, here = problem, start
    for _ in range(max_steps):
        new, gain = _try(part, here, dampings[active])
        steps[active] += 1
        here = put(here, np.flatnonzero(gain.accepted), new)
        state = put(state, active, here)
        cost[active] = gain.cost
        dampings[active] = gain.damping
        for run, reason in zip(active, gain.stop, strict=True):
            stop[run] = reason
        keep = np.flatnonzero([reason is Stop.RUNNING for reason in gain.stop])
        if keep.size == 0:
            break
        if keep.size < active.size:
            active = active[keep]
            part, here = problem.select(active), take(state, active)
    final = tuple(Stop.STEPS if s is Stop.RUNNING else s for s in stop)
    return Solution(state, cost, steps, final)


class _Gain(NamedTuple):
    accepted: Booleans
    cost: Array
    damping: Array
    stop: list[Stop]


def _try(problem: LeastSquares, state: Any, damping: Array) -> tuple[Any, _Gain]:
    """One damped step of every run; returns the accepted runs' new states and what came of it."""
    linear = problem.linearize(state)
    shared, own = damped_step(linear, damping)
    trial = problem.moved(state, shared, own)
    usable = linear.usable
    cost = _cost(Values(linear.value, linear.shared_value), usable)
    cost_trial = _cost(problem.residuals(trial), usable)
    change = (linear.by_shared @ shared[:, None, :, None])[..., 0]
    change = change + (linear.by_own @ own[..., None])[..., 0]
    shared_change = shared @ linear.shared_by.T
    size2 = np.sum(change**2, axis=(1, 2)) + np.sum(shared_change**2, axis=1)
    descent = -2 * (
        np.sum(change * linear.value, axis=(1, 2))
        + np.sum(shared_change * linear.shared_value, axis=1)
    )
    ratio = (cost - cost_trial) / np.maximum(descent - size2, 1e-300)
    small = np.sqrt(size2) < STEP_TOLERANCE * (1 + 1e-3 * np.sqrt(cost))
    # a step near the end changes the cost by less than its rounding, and then it cannot be judged
    small |= np.abs(descent - size2) < ROUNDING * cost
    accepted = cost_trial <= cost * (1 + ROUNDING)
    small |= ~accepted & (descent - size2 < (REFUSED * (1 + 1e-3 * np.sqrt(cost))) ** 2)
    next_damping = np.where(
        accepted, damping * np.where(ratio > 0.5, 0.05, np.where(ratio > 0.2, 0.5, 2)), damping * 8
    )
    next_damping = np.clip(next_damping, LEAST_DAMPING, MOST_DAMPING)
    any_usable = np.sum(usable, axis=(1, 2)) > 0
    stop = [_reason(*run) for run in zip(any_usable, small, accepted, damping, strict=True)]
    new = take(trial, np.flatnonzero(accepted))
    return new, _Gain(accepted, np.where(accepted, cost_trial, cost), next_damping, stop)


def _reason(usable: bool, small: bool, accepted: bool, damping: float) -> Stop:
    if not usable:
        return Stop.NOT_FINITE
    if small and damping < 1e-2:  # a strongly damped step is small anywhere
        return Stop.CONVERGED
    return Stop.STALLED if not accepted and damping >= MOST_DAMPING else Stop.RUNNING


def _cost(values: Values, usable: Booleans) -> Array:
    """Sum of squares over usable rows; NaN there means that a leg was lost: infinite."""
    total = np.sum(np.where(usable, values.value, 0.0) ** 2, axis=(1, 2))
    total = total + np.sum(values.shared_value**2, axis=1)
    return np.where(np.isfinite(total), total, np.inf)


def soft_weights(distance: Array, scale: Array | float) -> Array:
    """Geman-McClure weights ``(c^2 / (c^2 + d^2))^2`` of distances; 0 where nothing can be
    predicted. A search begins with a scale so wide that everything counts, and narrows it.
    """
    square = scale**2
    weight = (square / (square + np.nan_to_num(distance) ** 2)) ** 2
    return np.where(np.isfinite(distance), weight, 0.0)


def final_weights(distance: Array) -> Array:
    """Weights of distances in standard deviations: 1 up to FULL, a cosine's way down to 0 at NONE;
    0 where nothing can be predicted.
    """
    x = np.clip((distance - FULL) / (NONE - FULL), 0, 1)
    return np.where(np.isfinite(distance), 0.5 * (1 + np.cos(np.pi * x)), 0.0)


def column_space(columns: Array, least: float = RANK_TOLERANCE) -> Array:
    """An orthonormal basis (n, k) of what columns (n, m) can make together."""
    norm = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns[:, norm > 0] / norm[norm > 0], full_matrices=False)
    return u[:, s > least * s.max(initial=0.0)]


def directions(rows: Array) -> tuple[Array, Array, Array]:
    """How well rows (..., n, m) know each direction of their unknowns, columns made of length one.

    Singular values s (..., m), right vectors vt (..., m, m), and the columns' lengths scale
    (..., m), 1 for those that are zero.
    """
    scale = np.sqrt(np.sum(rows**2, axis=-2))
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(np.linalg.qr(rows / scale[..., None, :], mode="r"))
    spare = [(0, 0)] * (s.ndim - 1) + [(0, vt.shape[-1] - s.shape[-1])]  # fewer rows than unknowns
    return np.pad(s, spare), vt, scale


def inverse_root(rows: Array, least: float, *, loose: bool) -> Array:
    """F (..., m, m) with ``F F^T = (rows^T rows)^-1``, columns of rows (..., n, m) scaled.

    Directions below ``least`` of the largest singular value are not known. loose : they get a huge
    variance; otherwise none, as in a pseudo-inverse.
    """
    s, vt, scale = directions(rows)
    limit = least * s[..., :1]
    inverse = 1 / np.maximum(s, limit) if loose else _of_known(s, limit)
    return vt.mT * inverse[..., None, :] / scale[..., None]


def normal_root(normal: Array, least: float, *, loose: bool) -> Array:
    """The same of a normal matrix (..., m, m), by its eigenvalues; they hold half of the digits."""
    scaled, scale = _unit_diagonal(normal)
    values, vectors = np.linalg.eigh(scaled)
    limit = least * values[..., -1:]
    inverse = 1 / np.maximum(values, limit) if loose else _of_known(values, limit)
    return vectors * np.sqrt(inverse)[..., None, :] / scale[..., None]


def _of_known(values: Array, limit: Array) -> Array:
    """1 / values where they are above the limit, else 0."""
    known = values > limit
    return np.where(known, 1 / np.where(known, values, 1.0), 0.0)


def _unit_diagonal(normal: Array) -> tuple[Array, Array]:
    """A normal matrix (..., m, m) with its unknowns scaled (..., m) to a diagonal of ones."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    return normal / (scale[..., :, None] * scale[..., None, :]), scale
