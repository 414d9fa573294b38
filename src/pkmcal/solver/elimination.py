"""The own unknowns of each configuration eliminated.

The Schur complement of rows that depend on everything is formed as a square root: with
``by_own = Q R`` the reduced rows are ``(I - Q Q^T) by_shared``. Subtracting normal matrices instead
would cancel half the digits, since readings a thousand times sharper than edges dominate both
terms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans

ROWS = 2**15
"""Rows that are worked on at once: as many runs, or configurations of one, as have so many. A call
of NumPy then costs little beside its arithmetic, and what it works on stays in the processor."""


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


def own_factors(by_own: Array, damping: Array) -> tuple[Array, Array]:
    """QR factors of the own Jacobian with Marquardt damping (B,), zero for none.

    The damping's rows sqrt(damping) diag(column norms) are appended, so a configuration that
    its data do not fix stays solvable. q (B, K, r + d, d), r (B, K, d, d).
    """
    norms = np.sqrt(squares(by_own))
    norms = np.where(norms > 0, norms, 1.0)
    extra = np.sqrt(damping)[:, None, None, None] * norms[..., None] * np.eye(by_own.shape[-1])
    return np.linalg.qr(np.concatenate([by_own, extra], axis=-2))


def squares(columns: Array) -> Array:
    """Sums of squares of columns (..., n, m), (..., m)."""
    return np.einsum("...nm,...nm->...m", columns, columns)


def eliminate(linear: Linear, damping: Array) -> Reduced:
    """Own unknowns eliminated with Marquardt damping (B,), zero for none."""
    n_rows = linear.by_own.shape[-2]
    q, r = own_factors(linear.by_own, damping)
    if not np.any(damping > 0):
        q = q[..., :n_rows, :]
    top, value = q[..., :n_rows, :], linear.value[..., None]
    rows = left_of(linear.by_shared, q, top.mT @ linear.by_shared)
    # the damping's rows carry no residual of their own, only -bottom top^T value
    left = value - top @ (top.mT @ value)
    gradient = (linear.by_shared.mT @ left)[..., 0].sum(axis=1)
    gradient = gradient + linear.shared_value @ linear.shared_by
    return Reduced(rows, left[..., 0], top, r, gradient)


def left_of(by_shared: Array, q: Array, along: Array) -> Array:
    """The reduced rows ``by_shared - Q along`` (..., r', na), and those of the damping, which are
    ``-Q along``, where q has them.

    along : Q^T by_shared of all rows, (..., d, na).
    """
    *batch, n_rows, na = by_shared.shape
    out = np.empty((*batch, q.shape[-2], na))
    data = np.matmul(q[..., :n_rows, :], along, out=out[..., :n_rows, :])
    np.subtract(by_shared, data, out=data)
    if q.shape[-2] > n_rows:
        np.negative(np.matmul(q[..., n_rows:, :], along), out=out[..., n_rows:, :])
    return out


def flat(rows: Array) -> Array:
    """Rows (B, K, r, n) of all configurations, (B, K r, n); n may be none."""
    return rows.reshape(rows.shape[0], rows.shape[1] * rows.shape[2], rows.shape[3])


def stacked(linear: Linear, reduced: Reduced) -> tuple[Array, Array]:
    """All rows on the shared unknowns, the own ones eliminated without damping: Jacobian (B, n, na)
    and residuals (B, n). The configurations' rows come first, those on shared unknowns only last.
    """
    n_runs = len(reduced.rows)
    shared = np.broadcast_to(linear.shared_by, (n_runs, *linear.shared_by.shape))
    rows = np.concatenate([flat(reduced.rows), shared], axis=1)
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
