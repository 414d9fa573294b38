"""Two machines compared on the same data, and a promise tested: figures for a verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.validate.drawn import Errors

REPEATS = 4000
"""Bootstrap draws: percentiles of the ratio are then known to a hundredth or two."""
SURE = 0.95
"""Probability that the stated interval of the ratio holds."""
CHANCE = 1e-3
"""Probability below which residuals are not explained by the deviations."""
MARGIN = 1.5
"""Factor by which residuals may exceed the deviations: these cover noise, and a few tenths more
come from shading and lenses in any photographs."""
RANK = 1e-9
"""Share of the largest eigenvalue, of scaled residuals, below which nothing can deviate."""


@dataclass(frozen=True)
class Ratio:
    """How many times better: value, standard deviation, and the interval that holds it for SURE."""

    value: float
    sigma: float
    low: float
    high: float

    @property
    def better(self) -> bool:
        """Whether it is above 1 beyond doubt."""
        return self.low > 1.0


@dataclass(frozen=True)
class Promise:
    """Residuals against the deviations that calibration and photographs promise.

    chi2, dof, chance : of the test. factor : residuals over promise, root mean square. kept : not
    larger than promised but for MARGIN. expected : (m,) root mean square that is promised for each
    reading, and by_noise : (m,) the part of the photographs' and readings' noise, m or rad.
    """

    chi2: float
    dof: int
    chance: float
    factor: float
    kept: bool
    expected: Array
    by_noise: Array


def rms(values: Array) -> float:
    """Root mean square of what is finite; NaN of nothing."""
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else float("nan")


def ratio(worse: Array, better: Array) -> Ratio:
    """How many times smaller errors ``better`` (n,) are than ``worse``, root mean squares.

    Bootstrap over configurations n, both drawn together; those without one of the two are left out.
    """
    old, new = worse**2, better**2
    both = np.isfinite(old) & np.isfinite(new)
    old, new = old[both], new[both]
    if not old.size:
        return Ratio(*[float("nan")] * 4)
    rows = np.random.default_rng(0).integers(old.size, size=(REPEATS, old.size))
    drawn = np.sqrt(old[rows].sum(axis=1) / np.maximum(new[rows].sum(axis=1), 1e-300))
    low, high = np.quantile(drawn, [0.5 - SURE / 2, 0.5 + SURE / 2])
    value = float(np.sqrt(old.sum() / max(new.sum(), 1e-300)))
    return Ratio(value, float(drawn.std()), float(low), float(high))


def promise(residuals: Array, noise: Array, machine: Array) -> Promise:
    """Test of residuals (n, m), finite, against covariances (n m, n m) by noise and by the machine."""
    from scipy.special import chdtrc

    flat, covariance = residuals.reshape(-1), noise + machine
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / (scale[:, None] * scale))
    known = values > RANK * values[-1]
    chi2 = float(np.sum(((flat / scale) @ vectors[:, known]) ** 2 / values[known]))
    dof = int(known.sum())
    chance = float(chdtrc(dof, chi2))
    shape = residuals.shape
    return Promise(
        chi2=chi2,
        dof=dof,
        chance=chance,
        factor=float(np.sqrt(chi2 / dof)),
        kept=bool(chdtrc(dof, chi2 / MARGIN**2) > CHANCE),
        expected=np.sqrt(np.diag(covariance).reshape(shape).mean(axis=0)),
        by_noise=np.sqrt(np.maximum(np.diag(noise), 0.0).reshape(shape).mean(axis=0)),
    )


@dataclass(frozen=True)
class Weights:
    """How well the photographs see each configuration's readings; ``of`` measures residuals by it.

    Plain root mean squares are ruled by what a photograph sees worst, depth, where any two machines
    look alike. matrices : (n, m, m), the mean of their traces is m, so that units stay. floor : root
    mean square, so weighed, of a perfect machine's residuals, m or rad.
    """

    matrices: Array
    floor: float

    @classmethod
    def by(cls, noise: Array) -> Weights:
        """From covariances (n, m, m) of the residuals by noise."""
        exact = np.linalg.inv(noise)
        mean = float(np.einsum("kii->k", exact).mean()) / noise.shape[-1]
        return cls(exact / mean, float(1 / np.sqrt(mean)))

    def of(self, residuals: Array) -> Array:
        """Root mean square (n,) of each configuration's residuals (n, m), m or rad."""
        square = np.einsum("ki,kij,kj->k", residuals, self.matrices, residuals)
        return np.sqrt(square / residuals.shape[-1])


def blocks(covariance: Array, m: int) -> Array:
    """Each configuration's own part (n, m, m) of a covariance (n m, n m)."""
    n = len(covariance) // m
    return np.einsum("kikj->kij", covariance.reshape(n, m, n, m))


def fairest(own: Errors, laid: Errors, weights: Weights) -> Errors:
    """The drawing's errors on the poses that suit it best: seen by itself, or by the calibration."""
    by_own, by_laid = (rms(weights.of(errors.residuals)) for errors in (own, laid))
    return own if by_own < by_laid else laid
