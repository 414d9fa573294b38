"""Standard deviation s of the lines' shading: the common shift of all edges of one side of a tube.

Data of one station contain little information about s: the camera's edge shift absorbs what all its
lines have in common, and a tube's radius absorbs what both of its sides have in common. The
likelihood of s is then almost flat between zero and a tenth of a pixel, and the position of its
maximum is arbitrary. The estimate of s^2 is therefore its posterior mean under a half-Cauchy prior
of s (Gelman 2006), which is larger than the maximum-likelihood value.
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
    # five standard deviations off loses most of its weight, and clean lines lose little
    freedom: float = 4.0
    # alternations of the weights and s, before the next solution of the joint estimate
    weighings: int = 2
    # grid of values of s: ratio of the largest to the smallest, and their number (steps of 10 %)
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

    shift : (B, n) px, estimated shifts of the lines.
    covariance : (B, n, n) px^2, posterior covariance of the shifts.
    correlation : (n, n) prior correlation of the shifts.
    sigma : (B, n) px, prior standard deviations with which the shifts were estimated.
    least : (B or 1, 1) px, lower bound of the result.

    With P the inverse of the covariance and R the inverse of the correlation, the data alone have
    the information ``D = P - R / (sigma sigma^T)`` on the shifts and the gradient ``h = P shift``
    at zero shift. For normal shifts of the covariance ``s^2 R^-1`` the marginal likelihood of s is
    ``|R + s^2 D|^-1/2 exp(h^T (D + R / s^2)^-1 h / 2)``. s^2 is its posterior mean under a
    half-Cauchy prior of s with the scale SHIFT_SIGMA, the prior sigma of a camera's edge shift.

    Shifts have Student's distribution with F (``freedom``) degrees of freedom, because the border
    of a highlight may shift a single line by pixels. The variance of a line is s^2 / w with the
    weight w = (F + 1) / (F + x^2 / s^2), where x^2 is the expected square of its shift (Lange,
    Little, Taylor 1989).
    """
    # information of the data alone, without the prior of this estimate
    total_information = np.linalg.inv(covariance)
    slope = (total_information @ shift[..., None])[..., 0]
    information = total_information - np.linalg.inv(correlation) / (
        sigma[..., None] * sigma[:, None]
    )
    root = np.linalg.cholesky(correlation)
    expected = shift**2 + np.diagonal(covariance, axis1=-2, axis2=-1)
    tried = np.geomspace(1.0, options.largest_factor, options.factors) * least
    common = np.median(sigma, axis=1, keepdims=True) ** 2
    # Student weights and the posterior mean of s^2 in alternation
    weight = np.ones_like(shift)
    for _ in range(options.weighings):
        weight = (options.freedom + 1) / (options.freedom + expected / common)
        unit = root / np.sqrt(weight)[..., None]
        common = _mean_variance(unit.mT @ information @ unit, unit.mT @ slope[..., None], tried)
    return np.maximum(np.sqrt(common / weight), least)


def _mean_variance(information: Array, slope: Array, tried: Array) -> Array:
    """Posterior mean (B, 1) of s^2, px^2, under a half-Cauchy prior of s.

    information : (B, n, n) D of n whitened unknowns, each with the prior sigma s.
    slope : (B, n, 1) h, gradient at zero.
    tried : (B or 1, T) px, geometric grid of values of s.
    """
    value, vectors = np.linalg.eigh(information)
    along = (vectors.mT @ slope)[..., 0]
    each = 1 + tried[..., None] ** 2 * np.maximum(value, 0.0)[:, None]  # (B, T, n)
    gain = tried[..., None] ** 2 * along[:, None] ** 2 / each
    log_likelihood = np.sum(gain - np.log(each), axis=-1) / 2
    # half-Cauchy density times s, since the steps of the geometric grid are proportional to s
    prior = tried / (1 + (tried / SHIFT_SIGMA) ** 2)
    share = prior * np.exp(log_likelihood - log_likelihood.max(axis=-1, keepdims=True))
    mean = np.sum(share * tried**2, axis=-1) / np.sum(share, axis=-1)
    return mean[:, None]
