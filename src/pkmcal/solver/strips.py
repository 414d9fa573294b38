"""Rows that are many and depend on few shared unknowns, a few configurations at a time.

Such rows are in *strips* (:class:`Compact`), of which only products are formed
(:attr:`Eliminated.strips_normal`): a sixth of the arithmetic, and as many digits as of the reduced
rows themselves, as no sharp row is among them. With the rows after them they make the normal
equations of a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import reduce
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.solver.elimination import Linear, Memory, left_of, own_factors, squares
from pkmcal.solver.ranks import unit_diagonal

PIECE = 2**17
"""Numbers of the Jacobian that are written at once, a megabyte: what is read again before it is
forgotten then stays in the second cache, and a call of NumPy costs little beside its arithmetic."""


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
            left_of(rest, q[cut, n_strips * n :], along, memory),
            normal[:na, :na],
            along_strips,
            own.mT @ own,
            gradient[:na],
        )


class NormalPart(NamedTuple):
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


def _part(rows: Compact, damping: Array, memory: Memory) -> NormalPart:
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
    cost = cost_of(rows.value, rows.shared_value, rows.usable)
    own = damping[:, None, None] * squares(rows.by_own)
    return NormalPart(matrix, gradient, cost, rows.usable, along, fitted, r, own)


class NormalEquations(NamedTuple):
    """The normal equations of all parts; see :class:`NormalPart`."""

    matrix: Array
    gradient: Array
    cost: Array
    parts: list[NormalPart]

    def step(self, damping: Array) -> tuple[Array, list[Array]]:
        """Levenberg-Marquardt step: shared (B, na) and own (B, K, d) of each part."""
        scaled, scale = unit_diagonal(self.matrix)
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
        fitted = total(np.sum(part.fitted**2, axis=(1, 2)) for part in self.parts)
        damped = zip(self.parts, own, strict=True)
        size2 = (shared[:, None] @ self.matrix @ shared[..., None])[:, 0, 0] + fitted
        size2 = size2 - total(np.sum(part.damped * y**2, axis=(1, 2)) for part, y in damped)
        first = 2 * (fitted - np.sum(shared * self.gradient, axis=1))
        return first, np.maximum(size2, 0.0)


def total(parts: Iterable[Array]) -> Array:
    """Their sum."""
    return reduce(np.add, parts)


def normal_equations(parts: Iterable[Compact], damping: Array, memory: Memory) -> NormalEquations:
    """The normal equations of all parts, each reduced before the next is asked for."""
    done: list[NormalPart] = []
    for rows in parts:
        if done:  # the rows on shared unknowns only stand in the first part
            none = rows.shared_value[:, :0], rows.shared_by[:0]
            rows = rows._replace(shared_value=none[0], shared_by=none[1])
        done.append(_part(rows, damping, memory))
    sums = zip(*((part.matrix, part.gradient, part.cost) for part in done), strict=True)
    matrix, gradient, cost = (total(each) for each in sums)
    return NormalEquations(matrix, gradient, cost, done)


def damped_step(linear: Linear, damping: Array) -> tuple[Array, Array]:
    """Levenberg-Marquardt step: shared (B, na) and own (B, K, d)."""
    shared, own = normal_equations([compact(linear)], damping, Memory()).step(damping)
    return shared, own[0]


def cost_of(value: Array, shared_value: Array, usable: Booleans) -> Array:
    """Sum of squares over usable rows; NaN there means that a leg was lost: infinite."""
    total = np.sum(np.where(usable, value, 0.0) ** 2, axis=(1, 2))
    total = total + np.sum(shared_value**2, axis=1)
    return np.where(np.isfinite(total), total, np.inf)
