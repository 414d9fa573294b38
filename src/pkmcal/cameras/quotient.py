"""Projections p = K (x, y) / w with a depth w of the point and of the model's own parameters."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.contract import Camera
from pkmcal.geometry.rigid import of_components


def quotient_pixels(camera: Camera, points: Array, depth: Array, good: Booleans) -> Array:
    """Pixels (..., 2) of points (..., 3) with depths (...); NaN where ``good`` (...) is false."""
    w = np.where(good, depth, np.nan)
    (fx, fy), (cx, cy) = camera.focal.tolist(), camera.center.tolist()
    return of_components(fx * points[..., 0] / w + cx, fy * points[..., 1] / w + cy)


def quotient_jacobians(
    camera: Camera, points: Array, depth: Array, by_point: Array, by_own: Array, good: Booleans
) -> tuple[Array, Array]:
    """Derivatives of :func:`quotient_pixels` by the point (..., 2, 3) and by the parameters
    (..., 2, n): (dx - (x / w) dw) / w.

    by_point : (..., 3) derivative of the depth by the point. by_own : (..., n - 4) by the
    parameters behind the centre.
    """
    w = np.where(good, depth, np.nan)[..., None]
    xy = points[..., :2] / w
    out = -xy[..., :, None] * by_point[..., None, :]
    out[..., 0, 0] += 1.0
    out[..., 1, 1] += 1.0
    focal = camera.focal[:, None]
    by_parameters = np.zeros((*points.shape[:-1], 2, len(camera.parameters)))
    by_parameters[..., 0, 0], by_parameters[..., 1, 1] = xy[..., 0], xy[..., 1]
    by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
    by_parameters[..., 4:] = focal * -xy[..., :, None] * by_own[..., None, :] / w[..., None]
    return (
        focal * out / w[..., None],
        np.where(good[..., None, None], by_parameters, np.nan),
    )


def field_cosine(alpha: float) -> float:
    """Bound -z / d of the field of a model with the weight alpha of d in its depth: the depth
    vanishes there below a half, and the image folds there above.
    """
    return alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
