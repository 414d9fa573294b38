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

    chi2, dof, chance : of all residuals. factor : residuals over promise, root mean square.
    common : (m,) what each reading is off in all configurations alike, m or rad, and common_sigma :
    (m,) its standard deviation; common_chance : of all of them being zero. usual, steady : whether
    residuals, and what they have in common, are not larger than promised but for MARGIN.
    expected : (n, m) standard deviations that are promised, by_noise : (n, m) the part of the
    photographs' and the readings' noise, m or rad.
    """

    chi2: float
    dof: int
    chance: float
    factor: float
    common: Array
    common_sigma: Array
    common_chance: float
    usual: bool
    steady: bool
    expected: Array
    by_noise: Array

    @property
    def kept(self) -> bool:
        """Whether the deviations may be believed."""
        return self.usual and self.steady


def rms(values: Array) -> float:
    """Root mean square of what is finite; NaN of nothing."""
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else float("nan")


def weighed(values: Array, sigma: Array) -> tuple[Array, Array]:
    """Mean and root mean square over n configurations of values (n, ...), weighed by their noise.

    sigma : of the same shape; a pose that is hardly seen hardly counts. NaN is left out.
    """
    weight = np.where(np.isfinite(values), sigma**-2.0, 0.0)
    values, total = np.nan_to_num(values), weight.sum(axis=0)
    mean = np.sum(weight * values, axis=0) / total
    return mean, np.sqrt(np.sum(weight * values**2, axis=0) / total)


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
    """Test of finite residuals (n, m) against covariances (n m, n m) by noise and machine.

    All residuals together tell of something that the model leaves out; an error of the machine,
    which hides in the noise of each, is found in what they have in common, by generalised least
    squares.
    """
    from scipy.special import chdtrc

    shape, covariance = residuals.shape, noise + machine
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / (scale[:, None] * scale))
    known = values > RANK * values[-1]
    whiten = (vectors[:, known] / np.sqrt(values[known])).T / scale
    white = whiten @ residuals.reshape(-1)
    design = whiten @ np.tile(np.eye(shape[1]), (shape[0], 1))
    spread = np.linalg.pinv(design.T @ design)
    common = spread @ design.T @ white
    chi2, chi2_common = float(white @ white), float(common @ design.T @ white)
    dof, dof_common = len(white), int(np.linalg.matrix_rank(design))
    return Promise(
        chi2=chi2,
        dof=dof,
        chance=float(chdtrc(dof, chi2)),
        factor=float(np.sqrt(chi2 / dof)),
        common=common,
        common_sigma=np.sqrt(np.diag(spread)),
        common_chance=float(chdtrc(dof_common, chi2_common)),
        usual=bool(chdtrc(dof, chi2 / MARGIN**2) > CHANCE),
        steady=bool(chdtrc(dof_common, chi2_common / MARGIN**2) > CHANCE),
        expected=np.sqrt(np.diag(covariance)).reshape(shape),
        by_noise=np.sqrt(np.maximum(np.diag(noise), 0.0)).reshape(shape),
    )


@dataclass(frozen=True)
class Weights:
    """How well the photographs see each configuration's readings; ``of`` measures residuals by it.

    Plain root mean squares are ruled by what a photograph sees worst, depth, where any two machines
    look alike. matrices : (n, m, m), the mean of their traces is m, so that units stay. floor :
    root mean square, so weighed, of a perfect machine's residuals, m or rad.
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
    """The drawing's errors on the poses that suit it best: its own, or the calibrated machine's."""
    by_own, by_laid = (rms(weights.of(errors.residuals)) for errors in (own, laid))
    return own if by_own < by_laid else laid
