"""Operations on batches of small matrices that are stored with the batch axis fastest in memory.

NumPy iterates in memory order. With the first axis (the batch) fastest, one call works on long rows
of numbers, and a thousand poses cost little more than one. Shapes stay (n, ...). Only
:func:`batch_last` chooses this memory order; the other functions return the order of their input.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import dot, skew

POSES_WORTH_BATCH_LAST = 16
"""Fewest poses for which the batch-last memory order is faster."""
NUMBERS_WORTH_CALLS = 100
"""Array size below which call overhead exceeds the arithmetic."""
CYCLIC_PAIRS = ((1, 2), (2, 0), (0, 1))
"""Indices (j, k) of the factors in component i of a cross product, for i = 0, 1, 2."""
CROSS_PRODUCT_SIGNS = -skew(np.eye(3))
"""Levi-Civita symbol: ``(a x b)_i`` is the sum of ``CROSS_PRODUCT_SIGNS[i, j, k] a_j b_k``."""


def batch_last(array: Array) -> Array:
    """Copy (n, ...) of an array with axis 0 fastest in memory."""
    return _first(np.ascontiguousarray(_last(array)))


def _last(array: Array) -> Array:
    """View with the batch axis last; ``np.moveaxis`` takes as long as some arithmetic."""
    return array.transpose(*range(1, array.ndim), 0)


def _first(array: Array) -> Array:
    """View with the batch axis, which is last, moved to the front."""
    return array.transpose(array.ndim - 1, *range(array.ndim - 1))


def is_batch_last(array: Array) -> bool:
    """Whether axis 0 is the fastest in memory."""
    several = array.size > array.shape[0] > 1 if array.ndim > 1 else False
    return several and array.strides[0] == array.itemsize


def fresh(like: Array, shape: tuple[int, ...]) -> Array:
    """Uninitialised array of a shape, in the memory order of ``like``."""
    if is_batch_last(like):
        return _first(np.empty((*shape[1:], shape[0])))
    return np.empty(shape)


def picked(array: Array, rows: Integers) -> Array:
    """Selected rows of a batch, (n, ...) -> (k, ...), in the same memory order."""
    if is_batch_last(array):
        return _first(np.take(_last(array), rows, axis=-1))
    return array[rows]


def turned(rot: Array, p: Array) -> Array:
    """Rotations (..., 3, 3) times vectors (..., 3); leading axes broadcast."""
    if not is_batch_last(rot):
        return (rot @ p[..., None])[..., 0]
    out = fresh(rot, (*np.broadcast_shapes(rot.shape[:-2], p.shape[:-1]), 3))
    part = np.empty_like(out)
    np.multiply(rot[..., 0], p[..., 0, None], out=out)
    for k in (1, 2):
        np.multiply(rot[..., k], p[..., k, None], out=part)
        out += part
    return out


def moments(arm: Array, w: Array, out: Array) -> None:
    """Cross products arm x w, (..., 3) each, written into ``out``, an array like w."""
    if out.size < NUMBERS_WORTH_CALLS:  # one call is then faster than nine
        np.einsum("ijk,...j,...k->...i", CROSS_PRODUCT_SIGNS, arm, w, out=out)
        return
    for k, (i, j) in enumerate(CYCLIC_PAIRS):
        np.multiply(arm[..., i], w[..., j], out=out[..., k])
        out[..., k] -= arm[..., j] * w[..., i]


def stepped(poses: Array, delta: Array) -> Array:
    """Poses (n, 4, 4) retracted along small steps (n, 6), equal to
    :func:`pkmcal.geometry.rigid.perturb` to second order.

    Cayley's map, ``I + 2 / (1 + w.w) ([w]x + [w]x^2)`` with w = omega / 2, gives an exact rotation
    without sines, so it is cheap enough for every step of a search.
    """
    out = np.empty_like(poses)
    w, rot = delta[:, :3] / 2, poses[:, :3, :3]
    if is_batch_last(poses):
        swung = _cross_columns(w, rot)
        swung += _cross_columns(w, swung)
        size = dot(w, w)
    else:
        turn = skew(w)
        swung = turn @ rot
        swung += turn @ swung
        size = (w * w).sum(axis=-1)
    swung *= (2 / (1 + size))[:, None, None]
    np.add(rot, swung, out=out[:, :3, :3])
    np.add(poses[:, :3, 3], delta[:, 3:], out=out[:, :3, 3])
    out[:, 3] = poses[:, 3]
    return out


def _cross_columns(w: Array, matrix: Array) -> Array:
    """Cross products of w (n, 3) with each column of matrices (n, 3, 3)."""
    out = np.empty_like(matrix)
    for k, (i, j) in enumerate(CYCLIC_PAIRS):
        np.multiply(w[:, i, None], matrix[:, j], out=out[:, k])
        out[:, k] -= w[:, j, None] * matrix[:, i]
    return out


def damped_step(jac: Array, value: Array, damping: Array) -> Array:
    """Levenberg-Marquardt steps (..., d) with column scaling, minimising |jac x - value|.

    jac : (..., E, d).
    value : (..., E).
    damping : (...), relative to the square of each column.
    """
    if is_batch_last(jac):
        return _elimination_step(jac, value, damping)
    transposed = jac.mT
    normal = transposed @ jac
    d = jac.shape[-1]
    diagonal = normal.reshape(*normal.shape[:-2], d * d)[..., :: d + 1]
    diagonal *= 1 + damping[..., None]
    diagonal += 1e-300
    return np.linalg.solve(normal, transposed @ value[..., None])[..., 0]


def _elimination_step(jac: Array, value: Array, damping: Array) -> Array:
    """:func:`damped_step` by one elimination over the whole batch (n, E, d), with the batch axis
    fastest.

    No pivoting, because the normal matrices are positive definite. If rounding makes one singular,
    its step is not finite.
    """
    d = jac.shape[-1]
    j, r = _last(jac), _last(value)
    # Normal equations: row k holds columns k..d-1 of the normal matrix, then the right-hand side.
    a = [np.empty((d - k + 1, jac.shape[0])) for k in range(d)]
    part = np.empty_like(a[0])
    with np.errstate(all="ignore"):
        for k, row in enumerate(a):
            np.einsum("en,ekn->kn", j[:, k], j[:, k:], out=row[:-1])
            np.einsum("en,en->n", j[:, k], r, out=row[-1])
            row[0] *= 1 + damping
            row[0] += 1e-300
        # Forward elimination.
        for k, row in enumerate(a):
            row[1:] /= row[0]
            for i in range(k + 1, d):
                # row_i - (a_ki / a_kk) row_k
                share = np.multiply(row[i - k], row[0], out=part[-1])
                np.multiply(row[i - k :], share, out=part[: d - i + 1])
                a[i] -= part[: d - i + 1]
        # Back substitution.
        x = np.empty((d, jac.shape[0]))
        for k in range(d - 1, -1, -1):
            x[k] = a[k][-1]
            for i in range(k + 1, d):
                x[k] -= np.multiply(a[k][i - k], x[i], out=part[0])
    return _first(x)
