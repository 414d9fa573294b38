"""Elimination of the own unknowns (nuisance parameters) of each configuration.

The Schur complement is formed as a square root: with ``by_own = Q R`` the reduced rows are
``(I - Q Q^T) by_shared``. The difference of normal matrices would cancel half the digits, because
readings a thousand times sharper than edges dominate both terms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans

SOLVER_ROWS_AT_ONCE = 2**15
"""Number of rows in one call of NumPy, of several runs or configurations: large compared with the
overhead of a call, small enough for the processor's cache."""
TALL_BLOCK_ROWS = 512
"""Rows of a block that is condensed by itself where there are many rows; with fewer unknowns than
rows this takes a third of the time."""


class Linear(NamedTuple):
    """Residuals and Jacobian at a state: B runs, K configurations of r rows.

    value : (B, K, r).
    by_shared : (B, K, r, na) by the shared unknowns.
    by_own : (B, K, r, d) by the configuration's own unknowns.
    usable : (B, K, r) False where nothing can be predicted; such rows are zero.
    shared_value : (B, c) residuals of the rows on shared unknowns only.
    shared_by : (c, na) their Jacobian.
    """

    value: Array
    by_shared: Array
    by_own: Array
    usable: Booleans
    shared_value: Array
    shared_by: Array


class Reduced(NamedTuple):
    """Rows after elimination of the own unknowns.

    rows : (B, K, r, na) reduced Jacobian.
    value : (B, K, r) residuals projected orthogonally to the own Jacobian.
    q, r : QR factors of the own Jacobian.
    """

    rows: Array
    value: Array
    q: Array
    r: Array


def eliminate(linear: Linear) -> Reduced:
    """Eliminate the own unknowns of all configurations."""
    q, r = np.linalg.qr(linear.by_own)
    none = ~linear.by_own.any(axis=(-2, -1), keepdims=True)
    if none.any():  # nothing to eliminate; the factors of zeros are any orthonormal columns
        q, r = np.where(none, 0.0, q), np.where(none, np.eye(r.shape[-1]), r)
    value = linear.value[..., None]
    rows = linear.by_shared - q @ (q.mT @ linear.by_shared)
    return Reduced(rows, (value - q @ (q.mT @ value))[..., 0], q, r)


def flat(rows: Array) -> Array:
    """Rows (B, K, r, n) of all configurations as (B, K r, n); n may be zero."""
    return rows.reshape(rows.shape[0], rows.shape[1] * rows.shape[2], rows.shape[3])


def rows_on_shared(linear: Linear, reduced: Reduced) -> tuple[Array, Array]:
    """Jacobian (B, n, na) and residuals (B, n) on the shared unknowns after the elimination.

    The configurations' rows come first, those on shared unknowns only last.
    """
    n_runs = len(reduced.rows)
    shared = np.broadcast_to(linear.shared_by, (n_runs, *linear.shared_by.shape))
    rows = np.concatenate([flat(reduced.rows), shared], axis=1)
    value = [reduced.value.reshape(n_runs, -1), linear.shared_value]
    return rows, np.concatenate(value, axis=1)


def condensed(rows: Array, value: Array) -> tuple[Array, Array]:
    """Condense rows (B, n, m) and residuals (B, n) to m + 1 rows by their QR decomposition.

    Normal matrix, gradient and sum of squares stay the same.
    """
    both = np.concatenate([rows, value[..., None]], axis=-1)
    n_runs, n, m = both.shape
    if (
        n > 2 * TALL_BLOCK_ROWS and m < TALL_BLOCK_ROWS
    ):  # in blocks first, which stay in the processor's cache
        whole = n - n % TALL_BLOCK_ROWS
        blocks = both[:, :whole].reshape(n_runs, whole // TALL_BLOCK_ROWS, TALL_BLOCK_ROWS, m)
        reduced = np.asarray(np.linalg.qr(blocks, mode="r")).reshape(n_runs, -1, m)
        both = np.concatenate([reduced, both[:, whole:]], axis=1)
    triangle: Array = np.asarray(np.linalg.qr(both, mode="r"))
    return triangle[..., :-1], triangle[..., -1]


def divisions(count: int, rows: int, at_once: int = SOLVER_ROWS_AT_ONCE) -> list[slice]:
    """Slices of ``count`` items of ``rows`` rows each, of ``at_once`` rows together."""
    each = max(1, at_once // max(1, rows))
    return [slice(first, min(first + each, count)) for first in range(0, count, each)]
