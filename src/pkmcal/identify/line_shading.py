"""Standard deviation of the lines' shading: the common shift of all edges of a side of a tube.

A camera's edge shift is what all its lines have in common, and a tube's radius takes up what both
its sides have, at every station. What is left of the lines' shifts to tell their deviation s is
little where there is one station, and a likelihood that hardly falls from nothing to a tenth of a
pixel has its highest point anywhere. The mean of s^2 over all that the data allow is then the
larger, and honest (Gelman 2006).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.measurements.effects import SHIFT_SIGMA


@dataclass(frozen=True)
class LineShadingOptions:
    """Constants of the estimate of the lines' shading."""

    # degrees of freedom of Student's distribution of the lines' shading: with four, a line that is
    # some five standard deviations off loses its weight, and clean lines lose little
    freedom: float = 4.0
    # rounds of weights and their common deviation, before the next solution
    weighings: int = 2
    # deviations that are tried: the largest, in times of the least, and their number, a tenth apart
    largest_factor: float = 1000.0
    factors: int = 72


LINE_SHADING = LineShadingOptions()


def common_shading(
    shift: Array,
    covariance: Array,
    correlation: Array,
    sigma: Array,
    least: Array | float,
    options: LineShadingOptions = LINE_SHADING,
) -> Array:
    """Standard deviation (B, n) px of each line's shading, estimated from the data.

    shift : (B, n) px, as estimated with the deviations sigma (B, n) px and the correlations alike
    (n, n); covariance : (B, n, n) of that. least : (B or 1, 1) what all have at least.

    With P the inverse of the covariance and R that of the correlations, the data alone say
    ``D = P - R / sigma sigma^T`` of the lines and have the slope ``h = P shift`` at nothing; of
    normal shifts with the covariance ``s^2 R^-1`` they have the likelihood
    ``|R + s^2 D|^-1/2 exp(h^T (D + R / s^2)^-1 h / 2)``. s^2 is its mean over a half-Cauchy
    distribution of s, whose scale is what a whole camera's shift may be.

    Shifts have Student's distribution with F, ``freedom``, degrees: most lines are shaded alike,
    and some show a highlight's border for their own, pixels off. Each line's variance is s^2 / w
    with its weight w = (F + 1) / (F + x^2 / s^2) (Lange, Little, Taylor
    1989), x^2 the square expected of its shift.
    """
    total_information = np.linalg.inv(covariance)
    slope = (total_information @ shift[..., None])[..., 0]
    information = total_information - np.linalg.inv(correlation) / (
        sigma[..., None] * sigma[:, None]
    )
    root = np.linalg.cholesky(correlation)
    expected = shift**2 + np.diagonal(covariance, axis1=-2, axis2=-1)
    tried = np.geomspace(1.0, options.largest_factor, options.factors) * least
    common = np.median(sigma, axis=1, keepdims=True) ** 2
    weight = np.ones_like(shift)
    for _ in range(options.weighings):
        weight = (options.freedom + 1) / (options.freedom + expected / common)
        unit = root / np.sqrt(weight)[..., None]
        common = _mean_variance(unit.mT @ information @ unit, unit.mT @ slope[..., None], tried)
    return np.maximum(np.sqrt(common / weight), least)


def _mean_variance(information: Array, slope: Array, tried: Array) -> Array:
    """The mean (B, 1) of s^2 over the deviations tried (B or 1, T), where the data tell D (B, n, n)
    and have the slope h (B, n, 1) of unknowns with the deviation s each.
    """
    value, vectors = np.linalg.eigh(information)
    along = (vectors.mT @ slope)[..., 0]
    each = 1 + tried[..., None] ** 2 * np.maximum(value, 0.0)[:, None]  # (B, T, n)
    gain = tried[..., None] ** 2 * along[:, None] ** 2 / each
    log_likelihood = np.sum(gain - np.log(each), axis=-1) / 2
    prior = tried / (1 + (tried / SHIFT_SIGMA) ** 2)  # a step of the tried ones is s wide
    share = prior * np.exp(log_likelihood - log_likelihood.max(axis=-1, keepdims=True))
    mean = np.sum(share * tried**2, axis=-1) / np.sum(share, axis=-1)
    return mean[:, None]
