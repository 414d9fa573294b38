"""On which side of the singular poses: the sign of the inverse Jacobian's determinant.

Between two poses with different signs every path crosses a singular pose. Equal signs promise
nothing: two assemblies may have the same, and only a path between them tells.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.mechanisms.kinematics import inverse_result, scaled_rows
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.rows import pose_rows


def determinant_of(scaled: Array) -> Array:
    """Determinant (...) of scaled rows (..., E, d), see
    :func:`pkmcal.mechanisms.kinematics.scaled_rows`. NaN where they are not known, and for machines
    with more or fewer rows than freedoms, which have none.
    """
    if scaled.shape[-1] != scaled.shape[-2]:
        return np.full(scaled.shape[:-2], np.nan)
    known = np.asarray(np.isfinite(scaled).all(axis=(-1, -2)))
    square = np.where(known[..., None, None], scaled, np.eye(scaled.shape[-1]))
    return np.where(known, np.linalg.det(square), np.nan)


def sign_of(scaled: Array) -> Array:
    """Sign (...) of :func:`determinant_of`: 1 or -1; 0 where there is none."""
    return np.nan_to_num(np.sign(determinant_of(scaled)))


def assembly_sign(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array
) -> Array:
    """The sign (...) of assemblies: poses (..., 4, 4) and hinges' turns (..., n) that close the
    machine at readings (..., m).
    """
    rows = pose_rows(layout, theta, readings, poses, internal)
    return sign_of(scaled_rows(layout, theta, rows))


def same_assembly(layout: LimbLayout, theta: Array, poses: Array, reference: Array) -> Booleans:
    """Whether poses (..., 4, 4) may belong to the reference's assembly (4, 4), (...).

    False is sure: every path between the two crosses a singular pose. True is necessary only, see
    the module's docstring; machines without a determinant are always True, as are poses that a limb
    cannot reach.
    """
    signs = []
    for some in (poses, reference):
        readings, internal = inverse_result(layout, theta, some)
        signs.append(assembly_sign(layout, theta, readings, some, internal))
    return np.asarray(signs[0] * signs[1] >= 0)
