"""Least squares: batched Levenberg-Marquardt, robust weights, scaled ranks and inverses.

**Search.** The own unknowns of each configuration are eliminated.

A problem has unknowns that all configurations share, x_a (na), and unknowns of each
configuration alone, x_b (d each). Residual rows are grouped by configuration, so the Jacobian
is ``by_shared`` (B, K, r, na) and ``by_own`` (B, K, r, d); rows that touch shared unknowns only
(drawing values, gauge) stand beside them. B counts independent runs: each has its own damping,
acceptance and stop, and no loop goes over runs or configurations.

The Schur complement of rows that depend on everything is formed as a square root: with
``by_own = Q R`` the reduced rows are ``(I - Q Q^T) by_shared``. Subtracting normal matrices instead
would cancel half the digits, since readings a thousand times sharper than edges dominate both
terms. Rows that are many and depend on few shared unknowns are in *strips* (:class:`Compact`), of
which only products are formed (:attr:`Eliminated.strips_normal`): a sixth of the arithmetic, and as
many digits, as no sharp row is among them.

**States and data of many runs** are arrays, or frozen dataclasses or named tuples of arrays, whose
leading axis counts the runs; see :func:`take`, :func:`put` and :func:`of_runs`.

**Robust weights**, one for a search that lets go of what does not fit (:func:`soft_weights`), one
for its end (:func:`final_weights`).

**Ranks and inverses** are those of matrices whose columns are scaled to length one first: unknowns
in metres, radians and pixels are not to be compared otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from enum import Enum
from functools import reduce
from math import prod
from typing import Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

LEAST_DAMPING = 1e-14
"""Damping that a search begins with, as good as none: near an answer, and starts mostly are, a full
step is the best, and any damping costs steps along what is known little of."""
GROWTH = 8.0
"""Factor on it after a step that was refused, and that factor's after each more in a row: from
nothing to a hundredth in five."""
STRONG = 1e-2
"""Damping from which on a step is small anywhere, so that its size tells nothing."""
MOST_DAMPING = 1e9
"""Damping beyond which a step is below rounding: nothing downhill was found."""
STEP_TOLERANCE = 1e-7
"""A step that changes all fitted values together by less, in standard deviations, ends the
search: a ten-millionth of what the noise does, and above the rounding of 1e-9 or so."""
REFUSED = 1e-3
"""The same of a step that the residuals refuse, though the linear model promises something: so
little is their rounding, where a direction is a millionth as well known as the others."""

LEAST = 1e-150
"""Of a singular value or an eigenvalue; where all are zero nothing is known, and that is finite."""
EPSILON = float(np.finfo(float).eps)
ROUNDING = 1e-13
"""Of the cost, relative."""

ROWS = 2**15
"""Rows that are worked on at once: as many runs, or configurations of one, as have so many. A call
of NumPy then costs little beside its arithmetic, and what it works on stays in the processor."""
PIECE = 2**17
"""Numbers of the Jacobian that are written at once, a megabyte: what is read again before it is
forgotten then stays in the second cache, and a call of NumPy costs little beside its arithmetic."""

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
    """Residuals alone: value (B, K, r) with NaN where nothing can be predicted, shared (B, c).

    rows : gives the Jacobian there, where it costs less to go on from what these took.
    """

    value: Array
    shared_value: Array
    rows: Callable[[], Compact] | None = None


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


class Memory:
    """Arrays that are written over again and again.

    A fresh array of megabytes costs the system as much time as it takes to fill it.
    """

    def __init__(self) -> None:
        self._flat: dict[str, Array] = {}

    def empty(self, name: str, shape: tuple[int, ...]) -> Array:
        """An array of this shape with anything in it; what had the name before is lost."""
        size = prod(shape)
        if name not in self._flat or self._flat[name].size < size:
            self._flat[name] = np.empty(size)
        return self._flat[name][:size].reshape(shape)


class Compact(NamedTuple):
    """As :class:`Linear`, but for the Jacobian by the shared unknowns, which is written a few
    configurations at a time.

    Most rows depend on few of the shared unknowns, and many on the same few, as all edges of one
    leg do: a *strip* is n rows of every configuration with w columns of their own. Strips come
    first among a configuration's rows, one after the other; the rows after them have all columns.

    n_shared : na. strips : (L, w) columns of each strip, na where it has fewer than w. write : the
    strips (L, k, n, w) and the rows after them (k, r', na) of one run and some configurations, in
    memory where the next are written as well.
    """

    value: Array
    by_own: Array
    usable: Booleans
    shared_value: Array
    shared_by: Array
    n_shared: int
    strips: Integers
    write: Callable[[int, slice, Memory], tuple[Array, Array]]

    def linear(self) -> Linear:
        """The same with the Jacobian in memory as a whole."""
        by_shared = np.zeros((*self.value.shape, self.n_shared + 1))
        for run in range(len(by_shared)):
            strips, rest = self.write(run, slice(None), Memory())
            n = strips.shape[2]
            for k, (columns, strip) in enumerate(zip(self.strips, strips, strict=True)):
                by_shared[run, :, n * k : n * (k + 1), columns] = np.moveaxis(strip, -1, 0)
            by_shared[run, :, n * len(strips) :, :-1] = rest
        return Linear(self.value, by_shared[..., :-1], *self[1:5])


def compact(linear: Linear) -> Compact:
    """The same of a Jacobian that stands in memory."""
    none = np.zeros((0, 0), dtype=int)

    def write(run: int, configurations: slice, memory: Memory) -> tuple[Array, Array]:
        del memory
        rows = linear.by_shared[run, configurations]
        return np.zeros((0, len(rows), 0, 0)), rows

    rest = linear.usable, linear.shared_value, linear.shared_by, linear.by_shared.shape[-1]
    return Compact(linear.value, linear.by_own, *rest, none, write)


@runtime_checkable
class Divisible(LeastSquares, Protocol):
    """A problem of which some configurations can be looked at alone, so that the Jacobian of all
    never stands in memory at once.
    """

    def among(self, configurations: slice) -> Divisible:
        """The problem of some configurations, with all that they share."""
        ...

    def state_among(self, state: Any, configurations: slice) -> Any:
        """What that problem needs of a state."""
        ...

    def compact(self, state: Any) -> Compact:
        """As :meth:`linearize`."""
        ...

    @property
    def extent(self) -> tuple[int, int]:
        """Configurations K and rows of each, r."""
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


def _count(state: Any) -> int:
    """Runs of a state."""
    if isinstance(state, np.ndarray):
        return len(state)
    first = state[0] if isinstance(state, tuple) else getattr(state, fields(state)[0].name)
    return len(cast(Array, first))


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
    """Result of a search: state, cost (B,), steps (B,), stop (B,) of Stop.

    normal : (B, na, na) the reduced normal matrix where the last step was made, which is at the end
    but for that step.
    """

    state: Any
    cost: Array
    steps: Integers
    stop: tuple[Stop, ...]
    normal: Array


def own_factors(by_own: Array, damping: Array) -> tuple[Array, Array]:
    """QR factors of the own Jacobian with Marquardt damping (B,), zero for none.

    The damping's rows sqrt(damping) diag(column norms) are appended, so a configuration that
    its data do not fix stays solvable. q (B, K, r + d, d), r (B, K, d, d).
    """
    norms = np.sqrt(_squares(by_own))
    norms = np.where(norms > 0, norms, 1.0)
    extra = np.sqrt(damping)[:, None, None, None] * norms[..., None] * np.eye(by_own.shape[-1])
    return np.linalg.qr(np.concatenate([by_own, extra], axis=-2))


def _squares(columns: Array) -> Array:
    """Sums of squares of columns (..., n, m), (..., m)."""
    return np.einsum("...nm,...nm->...m", columns, columns)


def eliminate(linear: Linear, damping: Array) -> Reduced:
    """Own unknowns eliminated with Marquardt damping (B,), zero for none."""
    n_rows = linear.by_own.shape[-2]
    q, r = own_factors(linear.by_own, damping)
    if not np.any(damping > 0):
        q = q[..., :n_rows, :]
    top, value = q[..., :n_rows, :], linear.value[..., None]
    rows = _left_of(linear.by_shared, q, top.mT @ linear.by_shared, Memory())
    # the damping's rows carry no residual of their own, only -bottom top^T value
    left = value - top @ (top.mT @ value)
    gradient = (linear.by_shared.mT @ left)[..., 0].sum(axis=1)
    gradient = gradient + linear.shared_value @ linear.shared_by
    return Reduced(rows, left[..., 0], top, r, gradient)


def _left_of(by_shared: Array, q: Array, along: Array, memory: Memory) -> Array:
    """The reduced rows ``by_shared - Q along`` (..., r', na), and those of the damping, which are
    ``-Q along``, where q has them.

    along : Q^T by_shared of all rows, (..., d, na).
    """
    *batch, n_rows, na = by_shared.shape
    out = memory.empty("reduced rows", (*batch, q.shape[-2], na))
    data = np.matmul(q[..., :n_rows, :], along, out=out[..., :n_rows, :])
    np.subtract(by_shared, data, out=data)
    if q.shape[-2] > n_rows:
        np.negative(np.matmul(q[..., n_rows:, :], along), out=out[..., n_rows:, :])
    return out


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


def condensed(rows: Array, value: Array) -> tuple[Array, Array]:
    """Rows (B, n, m) and residuals (B, n) as m + 1 with the same normal matrix, gradient and sum of
    squares: the triangle of their QR decomposition.
    """
    both = np.concatenate([rows, value[..., None]], axis=-1)
    triangle: Array = np.asarray(np.linalg.qr(both, mode="r"))
    return triangle[..., :-1], triangle[..., -1]


def divisions(count: int, rows: int) -> list[slice]:
    """Configurations, of so many rows each, that are worked on together; see ROWS."""
    each = max(1, ROWS // max(1, rows))
    return [slice(first, min(first + each, count)) for first in range(0, count, each)]


class _Part(NamedTuple):
    """The normal equations of some configurations' rows, their own unknowns eliminated, and what a
    step needs of them once the rows are forgotten.

    matrix : (B, na, na) and gradient (B, na) of the shared unknowns. cost : (B,). usable :
    (B, K, r). along, fitted : Q^T by_shared (B, K, d, na) and Q^T value (B, K, d), with
    ``by_own = Q R``. r : (B, K, d, d). damped : (B, K, d) the damping of the own unknowns' squares.
    """

    matrix: Array
    gradient: Array
    cost: Array
    usable: Booleans
    along: Array
    fitted: Array
    r: Array
    damped: Array

    def own(self, shared: Array) -> Array:
        """The own unknowns' step (B, K, d) after the shared one (B, na)."""
        right = self.fitted + (self.along @ shared[:, None, :, None])[..., 0]
        return -np.linalg.solve(self.r, right[..., None])[..., 0]


class Eliminated(NamedTuple):
    """Some configurations of one run with their own unknowns eliminated, ``by_own = Q R``.

    cut : which they are. along : Q^T J, (k, d, na), J the Jacobian by the shared unknowns.
    rest : (k, r', na) reduced rows after the strips, and the damping's where there is any.

    Of the strips' rows J_s what their products need, which is far less than the rows themselves:
    normal J_s^T J_s (na, na), along_strips Q_s^T J_s (k, d, na), own Q_s^T Q_s (k, d, d).
    gradient : (na,) of half the cost.
    """

    cut: slice
    along: Array
    rest: Array
    normal: Array
    along_strips: Array
    own: Array
    gradient: Array

    @property
    def strips_normal(self) -> Array:
        """Normal matrix (na, na) of the strips' reduced rows ``J_s - Q_s W`` with W = Q^T J:
        ``J_s^T J_s - V^T W - W^T V`` with ``V = Q_s^T J_s - Q_s^T Q_s W / 2``.

        Readings a thousand times sharper than edges have no part in these differences: W is in
        units of the own unknowns' directions, of which edges see as much as of the shared ones.
        """
        na = len(self.normal)
        half = self.along_strips - 0.5 * (self.own @ self.along)
        both = half.reshape(-1, na).T @ self.along.reshape(-1, na)
        return self.normal - both - both.T


def eliminated(
    rows: Compact, run: int, q: Array, left: Array, memory: Memory
) -> Iterator[Eliminated]:
    """Pieces of one run whose Jacobian, written, reduced and forgotten, stays in the processor's
    cache.

    q : (K, r'', d) as of :func:`own_factors`; more than the rows' where damped. left : (K, r) what
    of the residuals the own unknowns cannot take up.
    """
    (count, n_rows), d, na = rows.value.shape[1:], q.shape[-1], rows.n_shared
    n_strips, width = rows.strips.shape
    pieces = -(-count * n_rows * (width if n_strips else na) // PIECE)
    for cut in (slice(count * k // pieces, count * (k + 1) // pieces) for k in range(pieces)):
        strips, rest = rows.write(run, cut, memory)
        k, n = strips.shape[1:3]
        own, after = q[cut, : n_strips * n], q[cut, n_strips * n : n_rows]
        along_strips = memory.empty("along strips", (k, d, na + 1))
        along_strips.fill(0.0)
        normal, gradient = np.zeros((na + 1, na + 1)), np.zeros(na + 1)
        flat = strips.reshape(n_strips, k * n, width)
        split = own.reshape(k, n_strips, n, d).transpose(1, 0, 3, 2)
        by_left = left[cut, : n_strips * n].reshape(k, n_strips, n).swapaxes(0, 1)
        by_left = by_left.reshape(n_strips, k * n, 1)
        products = flat.mT @ flat, (flat.mT @ by_left)[..., 0], split @ strips
        for columns, square, slope, part in zip(rows.strips, *products, strict=True):
            normal[columns[:, None], columns] += square
            gradient[columns] += slope
            along_strips[..., columns] += part
        along_strips = along_strips[..., :na]
        along = along_strips + after.mT @ rest
        gradient[:na] += left[cut, n_strips * n :].ravel() @ rest.reshape(-1, na)
        yield Eliminated(
            cut,
            along,
            _left_of(rest, q[cut, n_strips * n :], along, memory),
            normal[:na, :na],
            along_strips,
            own.mT @ own,
            gradient[:na],
        )


def _part(rows: Compact, damping: Array, memory: Memory) -> _Part:
    """A part's normal equations."""
    (n_runs, count, n_rows, d), na = rows.by_own.shape, rows.n_shared
    q, r = own_factors(rows.by_own, damping)
    if not np.any(damping > 0):
        q = q[..., :n_rows, :]
    top = q[..., :n_rows, :]
    fitted = (top.mT @ rows.value[..., None])[..., 0]
    # the damping's rows carry no residual of their own, only -bottom top^T value
    left = rows.value - (top @ fitted[..., None])[..., 0]
    along = np.empty((n_runs, count, d, na))
    matrix = np.tile(rows.shared_by.T @ rows.shared_by, (n_runs, 1, 1))
    gradient = rows.shared_value @ rows.shared_by
    for run in range(n_runs):
        for piece in eliminated(rows, run, q[run], left[run], memory):
            along[run, piece.cut] = piece.along
            rest = piece.rest.reshape(-1, na)
            matrix[run] += piece.strips_normal + rest.T @ rest
            gradient[run] += piece.gradient
    cost = _cost(Values(rows.value, rows.shared_value), rows.usable)
    own = damping[:, None, None] * _squares(rows.by_own)
    return _Part(matrix, gradient, cost, rows.usable, along, fitted, r, own)


class _Normal(NamedTuple):
    """The normal equations of all parts; see :class:`_Part`."""

    matrix: Array
    gradient: Array
    cost: Array
    parts: list[_Part]

    def step(self, damping: Array) -> tuple[Array, list[Array]]:
        """Levenberg-Marquardt step: shared (B, na) and own (B, K, d) of each part."""
        scaled, scale = _unit_diagonal(self.matrix)
        # at least a few rounding units, so that an unidentified direction gives no step
        ridge = np.maximum(damping, 1e-15)[:, None, None] * np.eye(scale.shape[1])
        right = (self.gradient / scale)[..., None]
        shared = -np.linalg.solve(scaled + ridge, right)[..., 0] / scale
        return shared, [part.own(shared) for part in self.parts]

    def promise(self, shared: Array, own: list[Array]) -> tuple[Array, Array]:
        """By how much the linear model lessens the cost along a step, to first order, and the
        square of its change of all residuals, (B,) each.

        With ``by_own = Q R`` the residuals' change is ``rows shared - Q fitted``, so that both
        follow from what is left of the rows; the damping's own share is taken out.
        """
        fitted = _total(np.sum(part.fitted**2, axis=(1, 2)) for part in self.parts)
        damped = zip(self.parts, own, strict=True)
        size2 = (shared[:, None] @ self.matrix @ shared[..., None])[:, 0, 0] + fitted
        size2 = size2 - _total(np.sum(part.damped * y**2, axis=(1, 2)) for part, y in damped)
        first = 2 * (fitted - np.sum(shared * self.gradient, axis=1))
        return first, np.maximum(size2, 0.0)


def _total(parts: Iterable[Array]) -> Array:
    return reduce(np.add, parts)


def _normal(parts: Iterable[Compact], damping: Array, memory: Memory) -> _Normal:
    """The normal equations of all parts, each reduced before the next is asked for."""
    done: list[_Part] = []
    for rows in parts:
        if done:  # the rows on shared unknowns only stand in the first part
            none = rows.shared_value[:, :0], rows.shared_by[:0]
            rows = rows._replace(shared_value=none[0], shared_by=none[1])
        done.append(_part(rows, damping, memory))
    sums = zip(*((part.matrix, part.gradient, part.cost) for part in done), strict=True)
    matrix, gradient, cost = (_total(each) for each in sums)
    return _Normal(matrix, gradient, cost, done)


def damped_step(linear: Linear, damping: Array) -> tuple[Array, Array]:
    """Levenberg-Marquardt step: shared (B, na) and own (B, K, d)."""
    shared, own = _normal([compact(linear)], damping, Memory()).step(damping)
    return shared, own[0]


def minimise(problem: LeastSquares, start: Any, max_steps: int = 100) -> Solution:
    """Least squares from ``start``, all runs at once; each stops on its own."""
    if isinstance(problem, Divisible):
        values, rows = None, problem.extent
    else:
        values = problem.residuals(start)
        rows = values.value.shape[1:]
    n_runs, few = _count(start), max(1, ROWS // max(1, prod(rows)))
    if n_runs <= few:
        return _minimised(_Divided.of(problem, n_runs, *rows), start, values, max_steps)
    found: list[Solution] = []
    for first in range(0, n_runs, few):
        runs = np.arange(first, min(first + few, n_runs))
        part = _Divided.of(problem.select(runs), len(runs), *rows)
        found.append(_minimised(part, take(start, runs), None, max_steps))
    return Solution(
        _each(lambda *states: np.concatenate(states), *(one.state for one in found)),
        np.concatenate([one.cost for one in found]),
        np.concatenate([one.steps for one in found]),
        tuple(reason for one in found for reason in one.stop),
        np.concatenate([one.normal for one in found]),
    )


class _Divided(NamedTuple):
    """A problem with its parts of some configurations each, small enough for the processor's cache,
    and the memory that they write to in turn.
    """

    problem: LeastSquares
    parts: list[tuple[slice, LeastSquares]]
    memory: Memory

    @classmethod
    def of(cls, problem: LeastSquares, n_runs: int, count: int, rows: int) -> _Divided:
        """A problem of so many runs and configurations of so many rows, divided where it can be."""
        cuts = divisions(count, n_runs * rows)
        if not isinstance(problem, Divisible) or len(cuts) < 2:
            return cls(problem, [(slice(0, count), problem)], Memory())
        return cls(problem, [(cut, problem.among(cut)) for cut in cuts], Memory())

    def select(self, runs: Integers) -> _Divided:
        """The same of some runs."""
        parts = [(cut, part.select(runs)) for cut, part in self.parts]
        return self._replace(problem=self.problem.select(runs), parts=parts)

    def rows(self, state: Any, values: Values | None) -> Iterator[Compact]:
        """Residuals and Jacobian of one part after the other; values : the residuals there, where
        they are known.
        """
        if len(self.parts) == 1 and values is not None and values.rows is not None:
            yield values.rows()
            return
        for cut, part in self.parts:
            if isinstance(part, Divisible):
                yield part.compact(part.state_among(state, cut))
            else:
                yield compact(part.linearize(state))

    def residuals(self, state: Any) -> Iterator[Values]:
        """Residuals of one part after the other; those of shared unknowns only in the first."""
        for k, (cut, part) in enumerate(self.parts):
            if len(self.parts) > 1 and isinstance(part, Divisible):
                state_of_part = part.state_among(state, cut)
            else:
                state_of_part = state
            values = part.residuals(state_of_part)
            yield values._replace(shared_value=values.shared_value[:, :0]) if k else values


def _minimised(problem: _Divided, start: Any, values: Values | None, max_steps: int) -> Solution:
    """The same of few runs; values : the residuals at the start, where they are known."""
    n_runs = _count(start)
    cost, steps = np.full(n_runs, np.inf), np.zeros(n_runs, dtype=int)
    stop = [Stop.RUNNING] * n_runs
    search = _Search.begun(n_runs)
    state, active = start, np.arange(n_runs)
    part, here, at = problem, start, values
    normal: Array | None = None
    for _ in range(max_steps):
        new, gain = _try(part, here, at, take(search, active))
        steps[active] += 1
        here, at = _kept(here, new, gain)
        state = put(state, active, here)
        cost[active], search = gain.cost, put(search, active, gain.search)
        normal = gain.normal if normal is None else put(normal, active, gain.normal)
        for run, reason in zip(active, gain.stop, strict=True):
            stop[run] = reason
        keep = np.flatnonzero([reason is Stop.RUNNING for reason in gain.stop])
        if keep.size == 0:
            break
        if keep.size < active.size:
            active = active[keep]
            part, here, at = problem.select(active), take(state, active), None
    final = tuple(Stop.STEPS if s is Stop.RUNNING else s for s in stop)
    return Solution(state, cost, steps, final, cast(Array, normal))


def _kept(here: Any, new: Any, gain: _Gain) -> tuple[Any, Values | None]:
    """The state with the steps that were accepted, and the residuals there where they are known."""
    if gain.accepted.all():
        return new, gain.values
    runs = np.flatnonzero(gain.accepted)
    return put(here, runs, take(new, runs)), None


class _Search(NamedTuple):
    """Where a search stands, (B,) each.

    damping : of the next step. growth : by how much more of it, should that be refused. size : of
    the last step's change of all residuals; infinite where it was damped or refused.
    """

    damping: Array
    growth: Array
    size: Array

    @classmethod
    def begun(cls, n_runs: int) -> _Search:
        """Before the first step."""
        return cls(*(np.full(n_runs, x) for x in (LEAST_DAMPING, GROWTH, np.inf)))

    def after(self, accepted: Booleans, ratio: Array, size: Array) -> _Search:
        """After a step of a size that kept a ratio of what it promised."""
        less = np.where(ratio > 0.5, 0.05, np.where(ratio > 0.2, 0.5, 2.0))
        damping = self.damping * np.where(accepted, less, self.growth)
        return _Search(
            np.clip(damping, LEAST_DAMPING, MOST_DAMPING),
            np.where(accepted, GROWTH, GROWTH * self.growth),
            np.where(accepted & self.undamped, size, np.inf),
        )

    @property
    def undamped(self) -> Booleans:
        """Whether the next step is a full one."""
        return self.damping <= LEAST_DAMPING

    def left(self, size: Array) -> Array:
        """How much is left to go after a full step of this size. Steps that shrink by a factor q
        each leave ``q / (1 - q)`` of the last (Hairer and Wanner, Solving Ordinary Differential
        Equations II, IV.8).
        """
        told = self.undamped & np.isfinite(self.size) & (size < self.size)
        return np.where(told, size**2 / np.where(told, self.size - size, 1.0), np.inf)


class _Gain(NamedTuple):
    """What came of a step. values : the first part's residuals after it."""

    accepted: Booleans
    values: Values
    cost: Array
    search: _Search
    normal: Array
    stop: list[Stop]


def _try(
    problem: _Divided, state: Any, values: Values | None, search: _Search
) -> tuple[Any, _Gain]:
    """One damped step of every run; returns the states after it and what came of it.

    values : the residuals at the state, where they are known.
    """
    damping = search.damping
    normal = _normal(problem.rows(state, values), damping, problem.memory)
    shared, own = normal.step(damping)
    trial = problem.problem.moved(state, shared, np.concatenate(own, axis=1))
    usable = [part.usable for part in normal.parts]
    after = problem.residuals(trial)
    values = next(after)
    cost, cost_trial = normal.cost, _cost(values, usable[0])
    for part, use in zip(after, usable[1:], strict=True):
        cost_trial = cost_trial + _cost(part, use)
    descent, size2 = normal.promise(shared, own)
    ratio = (cost - cost_trial) / np.maximum(descent - size2, 1e-300)
    size, tolerance = np.sqrt(size2), 1 + 1e-3 * np.sqrt(cost)
    small = size < STEP_TOLERANCE * tolerance
    # a step near the end changes the cost by less than its rounding, and then it cannot be judged
    small |= np.abs(descent - size2) < ROUNDING * cost
    accepted = cost_trial <= cost * (1 + ROUNDING)
    small |= accepted & (search.left(size) < STEP_TOLERANCE * tolerance)
    # a step that is refused for its rounding is better taken: all that is known of it is good
    little = ~accepted & (descent - size2 < (REFUSED * tolerance) ** 2) & (damping < STRONG)
    small, accepted = small | little, accepted | (little & (cost_trial - cost < REFUSED**2))
    any_usable = _total(np.sum(part, axis=(1, 2)) for part in usable) > 0
    stop = [_reason(*run) for run in zip(any_usable, small, accepted, damping, strict=True)]
    cost, search = np.where(accepted, cost_trial, cost), search.after(accepted, ratio, size)
    return trial, _Gain(accepted, values, cost, search, normal.matrix, stop)


def _reason(usable: bool, small: bool, accepted: bool, damping: float) -> Stop:
    if not usable:
        return Stop.NOT_FINITE
    if small and damping < STRONG:
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
    inverse = 1 / np.maximum(s, limit + LEAST) if loose else _of_known(s, limit)
    return vt.mT * inverse[..., None, :] / scale[..., None]


def normal_root(normal: Array, least: float, *, loose: bool) -> Array:
    """The same of a normal matrix (..., m, m), by its eigenvalues; they hold half of the digits."""
    scaled, scale = _unit_diagonal(normal)
    values, vectors = np.linalg.eigh(scaled)
    limit = least * values[..., -1:]
    inverse = 1 / np.maximum(values, limit + LEAST) if loose else _of_known(values, limit)
    return vectors * np.sqrt(inverse)[..., None, :] / scale[..., None]


def normal_inverse(normal: Array) -> tuple[Array, Booleans]:
    """Inverses of normal matrices (B, m, m), unknowns scaled, and where they hold half of their
    digits or more, (B,).
    """
    scaled, scale = _unit_diagonal(normal)
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        return np.full_like(normal, np.nan), np.zeros(len(normal), dtype=bool)
    size = np.abs(scaled).sum(axis=-1).max(axis=-1) * np.abs(inverse).sum(axis=-1).max(axis=-1)
    inverse = 0.5 * (inverse + inverse.mT)
    return inverse / (scale[:, :, None] * scale[:, None, :]), size < 1 / np.sqrt(EPSILON)


def _of_known(values: Array, limit: Array) -> Array:
    """1 / values where they are above the limit, else 0."""
    known = values > limit
    return np.where(known, 1 / np.where(known, values, 1.0), 0.0)


def _unit_diagonal(normal: Array) -> tuple[Array, Array]:
    """A normal matrix (..., m, m) with its unknowns scaled (..., m) to a diagonal of ones."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    return normal / (scale[..., :, None] * scale[..., None, :]), scale
