"""Numerical ranks and inverses of matrices whose columns are first scaled to length one, so that
unknowns in metres, radians and pixels can be compared.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans

SINGULAR_VALUE_FLOOR = 1e-150
"""Least singular value or eigenvalue in a division: variances stay finite where all are zero."""
DOUBLE_EPSILON = float(np.finfo(float).eps)
RANK_TOLERANCE = 1e-9
"""Singular values below this share of the largest are zero: rounding leaves 1e-12 to 1e-14
there with exact derivatives, and real directions are many orders above."""
NORMAL_RANK_TOLERANCE = 1e-13
"""The same for eigenvalues of the scaled normal matrix, which hold half of the digits."""


def nonzero(values: Array, tolerance: float = RANK_TOLERANCE) -> Booleans:
    """Whether singular values or eigenvalues (..., m) are above ``tolerance`` of the largest."""
    return values > tolerance * values.max(axis=-1, keepdims=True, initial=0.0)


def numerical_rank(values: Array, tolerance: float = RANK_TOLERANCE) -> int:
    """Number of singular values or eigenvalues (m,) above ``tolerance`` of the largest."""
    return int(np.count_nonzero(nonzero(values, tolerance)))


def column_space(columns: Array) -> Array:
    """Orthonormal basis (n, k) of the space that columns (n, m) span."""
    norm = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns[:, norm > 0] / norm[norm > 0], full_matrices=False)
    return u[:, nonzero(s)]


def scaled_directions(rows: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of rows (..., n, m) with their columns scaled to length one.

    Returns the singular values s (..., m), the right singular vectors vt (..., m, m), and the
    columns' lengths (..., m), 1 for columns that are zero.
    """
    scale = np.sqrt(np.sum(rows**2, axis=-2))
    scale = np.where(scale > 0, scale, 1.0)
    _, s, vt = np.linalg.svd(np.linalg.qr(rows / scale[..., None, :], mode="r"))
    spare = [(0, 0)] * (s.ndim - 1) + [(0, vt.shape[-1] - s.shape[-1])]  # fewer rows than unknowns
    return np.pad(s, spare), vt, scale


def inverse_root(rows: Array, least: float, *, loose: bool) -> Array:
    """Factor F (..., m, m) with ``F F^T = (rows^T rows)^-1``, columns of rows (..., n, m) scaled.

    Directions whose singular value is below ``least`` of the largest are not determined. loose :
    whether they get a huge variance; otherwise they get none, as in a pseudo-inverse.
    """
    s, vt, scale = scaled_directions(rows)
    limit = least * s[..., :1]
    inverse = 1 / np.maximum(s, limit + SINGULAR_VALUE_FLOOR) if loose else _safe_inverse(s, limit)
    return vt.mT * inverse[..., None, :] / scale[..., None]


def rank_of_normal(normal: Array) -> int:
    """Number of directions that a normal matrix (m, m) determines."""
    return numerical_rank(np.linalg.eigvalsh(unit_diagonal(normal)[0]), NORMAL_RANK_TOLERANCE)


def normal_root(normal: Array, least: float, *, loose: bool) -> Array:
    """:func:`inverse_root` of a normal matrix (..., m, m), by its eigenvalues, which hold half of
    the digits.
    """
    scaled, scale = unit_diagonal(normal)
    values, vectors = np.linalg.eigh(scaled)
    limit = least * values[..., -1:]
    inverse = (
        1 / np.maximum(values, limit + SINGULAR_VALUE_FLOOR)
        if loose
        else _safe_inverse(values, limit)
    )
    return vectors * np.sqrt(inverse)[..., None, :] / scale[..., None]


def normal_inverse(normal: Array) -> tuple[Array, Booleans]:
    """Inverses of normal matrices (B, m, m), unknowns scaled, and whether they hold half of their
    digits or more, (B,).
    """
    scaled, scale = unit_diagonal(normal)
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        return np.full_like(normal, np.nan), np.zeros(len(normal), dtype=bool)
    size = np.abs(scaled).sum(axis=-1).max(axis=-1) * np.abs(inverse).sum(axis=-1).max(axis=-1)
    inverse = 0.5 * (inverse + inverse.mT)
    return inverse / (scale[:, :, None] * scale[:, None, :]), size < 1 / np.sqrt(DOUBLE_EPSILON)


def _safe_inverse(values: Array, limit: Array) -> Array:
    """1 / values where the values are above the limit, else 0."""
    above_tolerance = values > limit
    return np.where(above_tolerance, 1 / np.where(above_tolerance, values, 1.0), 0.0)


def unit_diagonal(normal: Array) -> tuple[Array, Array]:
    """A normal matrix (..., m, m) with its unknowns scaled (..., m) to a diagonal of ones."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    return normal / (scale[..., :, None] * scale[..., None, :]), scale
