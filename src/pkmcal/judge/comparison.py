"""Two machines compared on the same data, and a promise tested: figures for a verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers, rms
from pkmcal.judge.prediction import Prediction, ReadingErrors, errors_on
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.solver.ranks import nonzero

RATIO_BOOTSTRAP_DRAWS = 4000
"""Bootstrap draws: percentiles of the ratio are then known to a hundredth or two."""
RATIO_INTERVAL_PROBABILITY = 0.95
"""Probability that the stated interval of the ratio holds."""
UNEXPLAINED_RESIDUAL_CHANCE = 1e-3
"""Probability below which residuals are not explained by the deviations."""
ALLOWED_RESIDUAL_EXCESS = 1.5
"""Factor by which residuals may exceed the deviations: these cover noise, and a few tenths more
come from shading and lenses in any photographs."""


@dataclass(frozen=True)
class Ratio:
    """How many times better: value, standard deviation, and the interval that holds it for
    RATIO_INTERVAL_PROBABILITY.
    """

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
    residuals, and what they have in common, are not larger than promised but for
    ALLOWED_RESIDUAL_EXCESS. expected : (n, m) standard deviations that are promised, by_noise :
    (n, m) the part of the photographs' and the readings' noise, m or rad.
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
        """Whether the deviations may be believed."""
        return self.usual and self.steady

    @property
    def joint_rms(self) -> Array:
        """Root mean squares (m,) of the readings' residuals that are promised, m or rad."""
        return weighed_mean_and_rms(self.expected, self.by_noise)[1]


@dataclass(frozen=True)
class WeighedErrors:
    """Of one machine, weighed by how well each configuration was seen; m and rad.

    joint_mean, joint_rms : (m,) of the readings' residuals ([C] Table 3). position, orientation :
    root mean squares of the tool point's errors.
    """

    joint_mean: Array
    joint_rms: Array
    position: float
    orientation: float


@dataclass(frozen=True)
class BesideDrawing:
    """A calibrated machine beside the drawing on n configurations.

    rows : (n,) which. calibrated, drawing : their errors there. before, after : (n,) root mean
    squares of each configuration's residuals by the drawing and by the calibrated machine, weighed
    by how well the photographs see them (:class:`Weights`), m or rad; floor : what the photographs'
    noise alone gives. ratio : before over after. promise : the residuals against the deviations.
    """

    rows: Integers
    calibrated: ReadingErrors
    drawing: ReadingErrors
    before: Array
    after: Array
    floor: float
    ratio: Ratio
    promise: Promise

    def figures(self, errors: ReadingErrors) -> WeighedErrors:
        """Of the drawing's or the calibrated machine's errors."""
        sigma = self.promise.by_noise
        mean, root = weighed_mean_and_rms(errors.residuals, sigma)
        each = np.sqrt(np.mean(sigma**2, axis=1))
        position, orientation = (
            float(weighed_mean_and_rms(values, each)[1])
            for values in (errors.position, errors.orientation)
        )
        return WeighedErrors(mean, root, position, orientation)

    def document(self, names: tuple[str, ...]) -> dict[str, Any]:
        """For programs, m and rad; names : K, of the configurations.

        weighed_rms is the verdict's, by how well each direction was seen.
        """
        test = self.promise
        machines = {
            "drawing": (self.drawing, self.before),
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


def compare_with_drawing(
    drawing: Machine,
    covariance: Array,
    measurements: Measurements,
    prediction: Prediction,
    by_drawing: Prediction | None,
    rows: Integers,
) -> BesideDrawing:
    """A prediction of the calibrated machine, beside the drawing, on configurations ``rows``.

    covariance : (P, P) of the calibrated machine. by_drawing : the drawing's own prediction;
    without it the drawing is judged on the calibrated machine's poses, else on those that suit it
    best.
    """
    visible = np.flatnonzero(prediction.observed)
    m = measurements.joints.shape[1]
    place = np.searchsorted(visible, rows)
    flat = (place[:, None] * m + np.arange(m)).reshape(-1)
    noise, by = prediction.noise[np.ix_(flat, flat)], prediction.by_machine[flat]
    weights = Weights.by(np.einsum("kikj->kij", noise.reshape(len(rows), m, len(rows), m)))
    new = prediction.errors.of(rows)
    old = errors_on(drawing, measurements.joints[visible], prediction.T_base_platform[visible]).of(
        place
    )
    if by_drawing is not None:
        own = by_drawing.errors.of(rows)
        if finite_rms(weights.of(own.residuals)) < finite_rms(weights.of(old.residuals)):
            old = own
    before, after = weights.of(old.residuals), weights.of(new.residuals)
    return BesideDrawing(
        rows=rows,
        calibrated=new,
        drawing=old,
        before=before,
        after=after,
        floor=weights.floor,
        ratio=improvement_ratio(before, after),
        promise=promise(new.residuals, noise, by @ covariance @ by.T),
    )


def finite_rms(values: Array) -> float:
    """Root mean square of what is finite; NaN of nothing."""
    return rms(values[np.isfinite(values)])


def weighed_mean_and_rms(values: Array, sigma: Array) -> tuple[Array, Array]:
    """Mean and root mean square over n configurations of values (n, ...), weighed by their noise.

    sigma : of the same shape; a pose that is hardly seen hardly counts. NaN is left out; of nothing
    else, mean and root mean square are NaN.
    """
    weight = np.where(np.isfinite(values), sigma**-2.0, 0.0)
    values, total = np.nan_to_num(values), weight.sum(axis=0)
    total = np.where(total > 0, total, np.nan)
    mean = np.sum(weight * values, axis=0) / total
    return mean, np.sqrt(np.sum(weight * values**2, axis=0) / total)


def improvement_ratio(worse: Array, better: Array) -> Ratio:
    """How many times smaller errors ``better`` (n,) are than ``worse``, root mean squares.

    Bootstrap over configurations n, both drawn together; those without one of the two are left out.
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
    """Test of finite residuals (n, m) against covariances (n m, n m) by noise and machine.

    All residuals together tell of something that the model leaves out; an error of the machine,
    which hides in the noise of each, is found in what they have in common, by generalised least
    squares.
    """
    from scipy.special import chdtrc

    shape, covariance = residuals.shape, noise + machine
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / (scale[:, None] * scale))
    above_limit = nonzero(values)
    whiten = (vectors[:, above_limit] / np.sqrt(values[above_limit])).T / scale
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
        usual=bool(chdtrc(dof, chi2 / ALLOWED_RESIDUAL_EXCESS**2) > UNEXPLAINED_RESIDUAL_CHANCE),
        steady=bool(
            chdtrc(dof_common, chi2_common / ALLOWED_RESIDUAL_EXCESS**2)
            > UNEXPLAINED_RESIDUAL_CHANCE
        ),
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
