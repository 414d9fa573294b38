"""Robust kernels: the weight of a measurement by its distance from the fit, for IRLS.

Which kernel serves where:

- `geman_mcclure_weights`, with a scale that is narrowed step by step, where a search starts far
  away and its outliers are unknown. Outliers lose their influence and inliers a part of theirs.
- `final_weights` for the estimate itself: inliers keep all of their weight, so that covariance and
  effective sample size are those of the clean data, and outliers have none. Edges in images are
  weighted by Student's t in addition (`pkmcal.identify.scatter.EdgeScatter.irls_weight`), because
  the tails of their errors are estimated; `pkmcal.identify.bundle` multiplies both.
- `cauchy_weights` where the weights start from nothing and few iterations follow, such as the
  points of one edge: the kernel keeps some weight at any distance, and so does not depend on where
  the iteration starts as the other two do.
"""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array

CAUCHY_SCALE = 2.0
"""Distance, in standard deviations, at which a Cauchy weight is a half; its efficiency on normal
errors is 0.93."""
FULL_WEIGHT_DISTANCE, NO_WEIGHT_DISTANCE = 4.0, 6.5
"""Distances, in standard deviations, up to which final weights are 1 and from which on they are 0:
of clean pairs of residuals 3 in 10^4 lose part of their weight and none all of it, so efficiency is
above 0.999."""
INLIER_WEIGHT = 0.5
"""Weight from which a measurement counts as an inlier; below it, as rejected."""


def cauchy_weights(square: Array, scale: float = CAUCHY_SCALE) -> Array:
    """Cauchy weights ``1 / (1 + d^2 / c^2)`` of squared distances d^2, scale c."""
    return 1 / (1 + square / scale**2)


def geman_mcclure_weights(distance: Array, scale: Array | float) -> Array:
    """Geman-McClure weights ``(c^2 / (c^2 + d^2))^2`` of distances d, scale c; 0 where nothing can
    be predicted.
    """
    square = scale**2
    weight = (square / (square + np.nan_to_num(distance) ** 2)) ** 2
    return np.where(np.isfinite(distance), weight, 0.0)


def final_weights(distance: Array) -> Array:
    """Weights of distances in standard deviations: 1 up to FULL_WEIGHT_DISTANCE, then half a period
    of a cosine down to 0 at NO_WEIGHT_DISTANCE; 0 where nothing can be predicted.
    """
    x = np.clip(
        (distance - FULL_WEIGHT_DISTANCE) / (NO_WEIGHT_DISTANCE - FULL_WEIGHT_DISTANCE), 0, 1
    )
    return np.where(np.isfinite(distance), 0.5 * (1 + np.cos(np.pi * x)), 0.0)


def final_loss(distance: Array) -> Array:
    """Robust loss ``2 int_0^d w(t) t dt`` of distances with weights :func:`final_weights`.

    Replaces the squares of the distances. Constant from NO_WEIGHT_DISTANCE on, the loss of a
    rejected measurement; the same where nothing can be predicted.
    """
    width = NO_WEIGHT_DISTANCE - FULL_WEIGHT_DISTANCE
    x = np.minimum(np.where(np.isfinite(distance), distance, np.inf), NO_WEIGHT_DISTANCE)
    angle = np.pi * (x - FULL_WEIGHT_DISTANCE) / width
    beyond = (x**2 + FULL_WEIGHT_DISTANCE**2) / 2 + width / np.pi * (
        x * np.sin(angle) + width / np.pi * (np.cos(angle) - 1)
    )
    return np.where(x < FULL_WEIGHT_DISTANCE, x**2, beyond)
