"""Predictions of a calibration for configurations that were held out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.calibration.calibrate import Calibration
from pkmcal.calibration.holdout import Neighbours, by_region, select
from pkmcal.identify.bundle import bundle
from pkmcal.identify.estimate import Estimate
from pkmcal.judge.comparison import BesideDrawing, compare_with_drawing
from pkmcal.judge.prediction import predict
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine


@dataclass(frozen=True)
class HoldOut:
    """Comparison on configurations that were held out, and on those that the calibration used.

    estimate : from the latter.
    """

    region: Neighbours
    estimate: Estimate
    left_out: BesideDrawing
    used: BesideDrawing

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
    drawing = calibration.session.machine
    return judged_without(drawing, out.measurements, calibration.estimate, out.region)


def hold_out(
    drawing: Machine, measurements: Measurements, whole: Estimate, region: Neighbours
) -> HoldOut:
    """Calibrate without a region's configurations and predict them.

    whole : estimate from all data, the starting point. Stations and boards are registered by all
    images with the machine fixed; the machine depends only on the remaining configurations.
    """
    keep = np.ones(len(measurements.joints), dtype=bool)
    keep[region.rows] = False
    estimate = bundle(drawing, select(measurements, keep), whole.state)
    return judged_without(drawing, measurements, estimate, region)


def judged_without(
    drawing: Machine, measurements: Measurements, estimate: Estimate, region: Neighbours
) -> HoldOut:
    """Comparison of an estimate on the configurations of a region that it did not use, and on those
    that it used.
    """
    measurements = estimate.stated_edge_noise(measurements)
    prediction = predict(estimate.machine, measurements, estimate.state)
    out = region.rows[prediction.observed[region.rows]]
    used = np.setdiff1d(np.flatnonzero(prediction.observed), out)
    both = (
        compare_with_drawing(drawing, estimate.covariance, measurements, prediction, None, rows)
        for rows in (out, used)
    )
    return HoldOut(region, estimate, *both)


def by_regions(
    drawing: Machine, measurements: Measurements, whole: Estimate, n: int
) -> tuple[HoldOut, ...]:
    """Holdouts of n regions of the workspace, one after the other."""
    regions = by_region(drawing, whole, measurements, n)
    return tuple(hold_out(drawing, measurements, whole, region) for region in regions)
