"""Comparison of the calibrated with the nominal machine on the same data, and test of the stated
covariance.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers, rms
from pkmcal.judge.prediction import Prediction, ReadingErrors, errors_on
from pkmcal.levels import NOISE_EXCESS
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import nonzero

RATIO_BOOTSTRAP_DRAWS = 4000
"""Number of bootstrap draws: percentiles of the ratio are known to a hundredth or two."""
RATIO_INTERVAL_PROBABILITY = 0.95
"""Probability of the stated interval of the ratio."""
UNEXPLAINED_RESIDUAL_CHANCE = 1e-3
"""p-value below which the standard deviations do not explain the residuals."""


@dataclass(frozen=True)
class Ratio:
    """Ratio of errors: value, standard deviation, and interval of probability
    RATIO_INTERVAL_PROBABILITY.
    """

    value: float
    sigma: float
    low: float
    high: float

    @property
    def better(self) -> bool:
        """Whether the ratio is significantly above 1."""
        return self.low > 1.0


@dataclass(frozen=True)
class Promise:
    """Test of residuals against the standard deviations by calibration and images.

    chi2, dof, chance : of all residuals.
    factor : root mean square ratio of residuals to standard deviations.
    common : (m,) common offset of each reading in all configurations, m or rad.
    common_sigma : (m,) standard deviation of the common offset.
    common_chance : p-value of all common offsets being zero.
    usual, steady : whether the residuals, and their common offsets, agree with the standard
        deviations times NOISE_EXCESS.
    expected : (n, m) standard deviations of the residuals, m or rad.
    by_noise : (n, m) standard deviations due to the noise of images and readings alone.
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
    def holds(self) -> bool:
        """Whether the standard deviations are credible."""
        return self.usual and self.steady

    @property
    def joint_rms(self) -> Array:
        """Expected root mean squares (m,) of the readings' residuals, m or rad."""
        return weighed_mean_and_rms(self.expected, self.by_noise)[1]


@dataclass(frozen=True)
class WeighedErrors:
    """Errors of one machine, weighted by the observability of each configuration; m and rad.

    joint_mean, joint_rms : (m,) of the readings' residuals ([C] Table 3). position, orientation :
    root mean squares of the tool point's errors.
    """

    joint_mean: Array
    joint_rms: Array
    position: float
    orientation: float


@dataclass(frozen=True)
class NominalComparison:
    """Calibrated and nominal machine compared on n configurations.

    rows : (n,) indices of the configurations.
    calibrated, nominal : errors of both machines.
    before, after : (n,) root mean squares of each configuration's residuals by the nominal and by
        the calibrated machine, weighted by their observability in the images (:class:`Weights`), m
        or rad.
    floor : expected root mean square due to the noise of the images alone.
    ratio : ratio of before to after.
    promise : test of the residuals.
    """

    rows: Integers
    calibrated: ReadingErrors
    nominal: ReadingErrors
    before: Array
    after: Array
    floor: float
    ratio: Ratio
    promise: Promise

    def figures(self, errors: ReadingErrors) -> WeighedErrors:
        """Weighted figures of the nominal or the calibrated machine's errors."""
        sigma = self.promise.by_noise
        mean, root = weighed_mean_and_rms(errors.residuals, sigma)
        each = np.sqrt(np.mean(sigma**2, axis=1))
        position, orientation = (
            float(weighed_mean_and_rms(values, each)[1])
            for values in (errors.position, errors.orientation)
        )
        return WeighedErrors(mean, root, position, orientation)

    def document(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Document for programs, m and rad. names : (K,) of all configurations.

        weighed_rms is that of the verdict, weighted by the observability of each direction.
        """
        test = self.promise
        machines = {
            "drawing": (self.nominal, self.before),
            "calibrated": (self.calibrated, self.after),
        }
        return {
            "configurations": [names[row] for row in self.rows],
            **{
                name: {
                    "weighed_rms": finite_rms(weighed_by_pose),
                    **asdict(self.figures(errors)),
                    "residuals": errors.residuals,
                    "tool_position": errors.position,
                    "tool_orientation": errors.orientation,
                }
                for name, (errors, weighed_by_pose) in machines.items()
            },
            "times_better": asdict(self.ratio),
            "photographs_noise": self.floor,
            "promise": {
                "chi2": test.chi2,
                "dof": test.dof,
                "chance": test.chance,
                "factor": test.factor,
                "kept": test.holds,
                "common": test.common,
                "common_sigma": test.common_sigma,
                "common_chance": test.common_chance,
                "joint_rms": test.joint_rms,
            },
        }


def compare_with_nominal(
    nominal: Machine,
    covariance: Array,
    measurements: Measurements,
    prediction: Prediction,
    by_nominal: Prediction | None,
    rows: Integers,
) -> NominalComparison:
    """Compare the prediction of the calibrated machine with the nominal machine on configurations.

    covariance : (P, P) of the calibrated machine.
    by_nominal : prediction of the nominal machine itself, if any. The nominal machine is evaluated
        at its own poses or at those of the calibrated one, whichever suits it better.
    rows : indices of the configurations.
    """
    observed = np.flatnonzero(prediction.observed)
    m = measurements.joints.shape[1]
    # Covariance by noise, and derivatives, of the residuals at ``rows``.
    place = np.searchsorted(observed, rows)
    flat = (place[:, None] * m + np.arange(m)).reshape(-1)
    noise, by = prediction.noise[np.ix_(flat, flat)], prediction.by_machine[flat]
    weights = Weights.by(np.einsum("kikj->kij", noise.reshape(len(rows), m, len(rows), m)))
    # Errors of both machines.
    calibrated = prediction.errors.of(rows)
    before_errors = errors_on(
        nominal, measurements.joints[observed], prediction.T_base_platform[observed]
    ).of(place)
    if by_nominal is not None:
        own = by_nominal.errors.of(rows)
        if finite_rms(weights.of(own.residuals)) < finite_rms(weights.of(before_errors.residuals)):
            before_errors = own
    before, after = weights.of(before_errors.residuals), weights.of(calibrated.residuals)
    return NominalComparison(
        rows=rows,
        calibrated=calibrated,
        nominal=before_errors,
        before=before,
        after=after,
        floor=weights.floor,
        ratio=improvement_ratio(before, after),
        promise=promise(calibrated.residuals, noise, by @ covariance @ by.T),
    )


def finite_rms(values: Array) -> float:
    """Root mean square of finite values; NaN without any."""
    return rms(values[np.isfinite(values)])


def weighed_mean_and_rms(values: Array, sigma: Array) -> tuple[Array, Array]:
    """Mean and root mean square over n configurations of values (n, ...), weighted by their noise.

    sigma : of the same shape; the weight is 1 / sigma^2, so a badly observed pose hardly counts.
    NaN values are excluded; both results are NaN without any others.
    """
    weight = np.where(np.isfinite(values), sigma**-2.0, 0.0)
    values, total = np.nan_to_num(values), weight.sum(axis=0)
    total = np.where(total > 0, total, np.nan)
    mean = np.sum(weight * values, axis=0) / total
    return mean, np.sqrt(np.sum(weight * values**2, axis=0) / total)


def improvement_ratio(worse: Array, better: Array) -> Ratio:
    """Ratio of the root mean squares of errors ``worse`` (n,) to ``better`` (n,).

    Its uncertainty is that of a bootstrap over the n configurations, both drawn together;
    configurations without one of the two are excluded.
    """
    old, new = worse**2, better**2
    both = np.isfinite(old) & np.isfinite(new)
    old, new = old[both], new[both]
    if not old.size:
        return Ratio(*[float("nan")] * 4)
    rows = np.random.default_rng(0).integers(old.size, size=(RATIO_BOOTSTRAP_DRAWS, old.size))
    drawn = np.sqrt(old[rows].sum(axis=1) / np.maximum(new[rows].sum(axis=1), 1e-300))
    low, high = np.quantile(
        drawn, [0.5 - RATIO_INTERVAL_PROBABILITY / 2, 0.5 + RATIO_INTERVAL_PROBABILITY / 2]
    )
    value = float(np.sqrt(old.sum() / max(new.sum(), 1e-300)))
    return Ratio(value, float(drawn.std()), float(low), float(high))


def promise(residuals: Array, noise: Array, machine: Array) -> Promise:
    """Test of finite residuals (n, m) against covariances (n m, n m) by noise and by the machine.

    The chi-square of all residuals shows effects that the model lacks; an error of the machine,
    which is hidden in the noise of each residual, shows in their common offsets, by generalised
    least squares.
    """
    from scipy.special import chdtrc

    shape, covariance = residuals.shape, noise + machine
    # Whitening of the directions with a variance.
    scale = np.sqrt(np.diag(covariance))
    eigenvalues, eigenvectors = np.linalg.eigh(covariance / (scale[:, None] * scale))
    significant = nonzero(eigenvalues)
    whiten = (eigenvectors[:, significant] / np.sqrt(eigenvalues[significant])).T / scale
    # Chi-square of all residuals, and generalised least squares for their common offsets.
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
        usual=bool(chdtrc(dof, chi2 / NOISE_EXCESS**2) > UNEXPLAINED_RESIDUAL_CHANCE),
        steady=bool(
            chdtrc(dof_common, chi2_common / NOISE_EXCESS**2) > UNEXPLAINED_RESIDUAL_CHANCE
        ),
        expected=np.sqrt(np.diag(covariance)).reshape(shape),
        by_noise=np.sqrt(np.maximum(np.diag(noise), 0.0)).reshape(shape),
    )


@dataclass(frozen=True)
class Weights:
    """Weights of residuals by the observability of each configuration's readings in the images.

    matrices : (n, m, m); the mean of their traces is m, so units are kept. floor : weighted root
    mean square of a perfect machine's residuals, m or rad. Unweighted root mean squares are
    dominated by the direction that an image determines worst, depth, in which any two machines are
    similar.
    """

    matrices: Array
    floor: float

    @classmethod
    def by(cls, noise: Array) -> Weights:
        """Weights by covariances (n, m, m) of the residuals by noise."""
        exact = np.linalg.inv(noise)
        mean = float(np.einsum("kii->k", exact).mean()) / noise.shape[-1]
        return cls(exact / mean, float(1 / np.sqrt(mean)))

    def of(self, residuals: Array) -> Array:
        """Weighted root mean square (n,) of each configuration's residuals (n, m), m or rad."""
        square = np.einsum("ki,kij,kj->k", residuals, self.matrices, residuals)
        return np.sqrt(square / residuals.shape[-1])
