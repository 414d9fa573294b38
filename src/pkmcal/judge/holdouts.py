"""Predictions of a calibration for configurations that were held out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.calibration.calibrate import Calibration
from pkmcal.calibration.holdout import Neighbours, by_region, select
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.judge.comparison import NominalComparison, compare_with_nominal
from pkmcal.judge.fixed_machine import too_little
from pkmcal.judge.prediction import predict
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine


@dataclass(frozen=True)
class HoldOut:
    """Comparison on configurations that were held out, and on those that the calibration used.

    estimate : without the configurations held out.
    """

    region: Neighbours
    estimate: Estimate
    left_out: NominalComparison
    used: NominalComparison

    def document(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Document for programs. names : (K,) of the configurations."""
        return {
            "where": self.region.name,
            "left_out": self.left_out.document(names),
            "used": self.used.document(names),
        }


def holdout_of(calibration: Calibration) -> HoldOut | None:
    """Comparison on the configurations that a calibration held out; None if it held out none."""
    out = calibration.holdout
    if out is None:
        return None
    nominal = calibration.session.machine
    return judged_without(nominal, out.measurements, calibration.estimate, out.region)


def hold_out(
    nominal: Machine, measurements: Measurements, whole: Estimate, region: Neighbours
) -> HoldOut:
    """Calibrate without a region's configurations and predict them.

    whole : estimate from all data, the starting point. Stations and boards are registered by all
    images with the machine fixed; the machine depends only on the remaining configurations.
    """
    keep = np.ones(len(measurements.joints), dtype=bool)
    keep[region.rows] = False
    estimate = bundle(nominal, select(measurements, keep), whole.state)
    return judged_without(nominal, measurements, estimate, region)


def judged_without(
    nominal: Machine, measurements: Measurements, estimate: Estimate, region: Neighbours
) -> HoldOut:
    """Comparison of an estimate on the configurations of a region that it did not use, and on those
    that it used.

    Raises ResultError if the poses of one of the two follow from their own readings alone.
    """
    measurements = estimate.stated_edge_noise(measurements)
    prediction = predict(estimate.machine, measurements, estimate.state)
    out = region.rows[prediction.observed[region.rows]]
    used = np.setdiff1d(np.flatnonzero(prediction.observed), out)
    if not (len(out) and len(used)):
        raise too_little(estimate.machine, measurements)
    both = (
        compare_with_nominal(nominal, estimate.covariance, measurements, prediction, None, rows)
        for rows in (out, used)
    )
    return HoldOut(region, estimate, *both)


def by_regions(
    nominal: Machine, measurements: Measurements, whole: Estimate, n: int
) -> tuple[HoldOut, ...]:
    """Holdouts of n regions of the workspace, one after the other."""
    regions = by_region(nominal, whole, measurements, n)
    return tuple(hold_out(nominal, measurements, whole, region) for region in regions)
