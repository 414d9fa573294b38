"""Configurations held out of a calibration, and what it then predicts of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.errors import InputError
from pkmcal.identify.bundle import bundle
from pkmcal.identify.problem import Estimate
from pkmcal.measurements import Measurements
from pkmcal.mechanisms import Machine
from pkmcal.validate.drawn import Errors, errors_on
from pkmcal.validate.held import Prediction, predict
from pkmcal.validate.judged import (
    Promise,
    Ratio,
    Weights,
    blocks,
    fairest,
    promise,
    ratio,
)
from pkmcal.validate.regions import Region, places, regions, spread

LEAST = 3
"""Configurations without which a calibration of the rest means nothing."""


@dataclass(frozen=True)
class Judged:
    """A calibrated machine beside the drawing on n configurations.

    rows : (n,) which. calibrated, drawing : their errors there. before, after : (n,) root mean
    squares of each configuration's residuals by the drawing and by the calibrated machine, weighed
    by how well the photographs see them (:class:`Weights`), m or rad; floor : what the photographs'
    noise alone gives. ratio : before over after. promise : the residuals against the deviations.
    """

    rows: Integers
    calibrated: Errors
    drawing: Errors
    before: Array
    after: Array
    floor: float
    ratio: Ratio
    promise: Promise


def select(measurements: Measurements, keep: Booleans) -> Measurements:
    """The measurements of some configurations (K,); readings keep their rows.

    Boards on the base hang on no configuration and stay.
    """
    edges, poses = measurements.edges, measurements.poses
    on_base = ~measurements.on_platform[poses.mount]
    return replace(
        measurements,
        edges=edges.select(keep[edges.configuration]),
        poses=poses.select(keep[poses.configuration] | on_base),
    )


def judge(
    drawing: Machine,
    covariance: Array,
    measurements: Measurements,
    found: Prediction,
    by_drawing: Prediction | None,
    rows: Integers,
) -> Judged:
    """A prediction of the calibrated machine, beside the drawing, on configurations ``rows``.

    covariance : (P, P) of the calibrated machine. by_drawing : the drawing's own prediction;
    without it the drawing is judged on the calibrated machine's poses.
    """
    seen = np.flatnonzero(found.seen)
    m = measurements.joints.shape[1]
    laid = errors_on(drawing, measurements.joints[seen], found.T_base_platform[seen])
    place = np.searchsorted(seen, rows)
    flat = (place[:, None] * m + np.arange(m)).reshape(-1)
    noise, by = found.noise[np.ix_(flat, flat)], found.by_machine[flat]
    weights = Weights.by(blocks(noise, m))
    old = laid.of(place)
    if by_drawing is not None:
        own = Errors(by_drawing.residuals, by_drawing.position, by_drawing.orientation).of(rows)
        old = fairest(own, old, weights)
    new = Errors(found.residuals, found.position, found.orientation).of(rows)
    before, after = weights.of(old.residuals), weights.of(new.residuals)
    return Judged(
        rows=rows,
        calibrated=new,
        drawing=old,
        before=before,
        after=after,
        floor=weights.floor,
        ratio=ratio(before, after),
        promise=promise(new.residuals, noise, by @ covariance @ by.T),
    )


@dataclass(frozen=True)
class HoldOut:
    """Configurations left out, judged, beside those that the calibration used.

    estimate : from the rest.
    """

    region: Region
    estimate: Estimate
    left_out: Judged
    used: Judged


def hold_out(
    drawing: Machine, measurements: Measurements, whole: Estimate, region: Region
) -> HoldOut:
    """Calibrate without a region's configurations, then predict them.

    whole : an estimate from all, where the search starts. Stations and boards are registered by all
    photographs with the machine held; the machine knows those of the rest alone.
    """
    keep = np.ones(len(measurements.joints), dtype=bool)
    keep[region.rows] = False
    estimate = bundle(drawing, select(measurements, keep), whole.state)
    return judged_without(drawing, measurements, estimate, region)


def judged_without(
    drawing: Machine, measurements: Measurements, estimate: Estimate, region: Region
) -> HoldOut:
    """An estimate that did not see a region's configurations, on them and on those that it saw."""
    found = predict(estimate.machine, measurements, estimate.state)
    out = region.rows[found.seen[region.rows]]
    used = np.setdiff1d(np.flatnonzero(found.seen), out)
    both = (
        judge(drawing, estimate.covariance, measurements, found, None, rows) for rows in (out, used)
    )
    return HoldOut(region, estimate, *both)


def by_regions(
    drawing: Machine, measurements: Measurements, whole: Estimate, n: int
) -> tuple[HoldOut, ...]:
    """Each of n regions of the workspace left out once."""
    rows = np.flatnonzero(whole.configurations)
    _check(n, rows.size - rows.size // n, rows.size, "regions")
    points = places(drawing, whole.state.T_base_platform[rows])
    found = regions(points, rows, n)
    return tuple(hold_out(drawing, measurements, whole, region) for region in found)


def chosen(drawing: Machine, whole: Estimate, n: int) -> Region:
    """Some configurations, n, to hold out, spread over the workspace."""
    rows = np.flatnonzero(whole.configurations)
    _check(n, rows.size - n, rows.size, "configurations held out")
    points = places(drawing, whole.state.T_base_platform[rows])
    return Region(rows[spread(points, n)], "spread over the workspace")


def _check(n: int, left: int, total: int, what: str) -> None:
    if n >= 1 and left >= max(LEAST, total // 2) and not (what == "regions" and n < 2):
        return
    least = 2 if what == "regions" else 1
    most = total if what == "regions" else total - max(LEAST, total // 2)
    if most < least:
        raise InputError(
            "there are too few configurations to hold any out",
            found=f"{total} seen",
            expected=f"{2 * LEAST} at least",
            next_step="Photograph more configurations",
        )
    raise InputError(
        f"this number of {what} is not possible",
        found=str(n),
        expected=f"{least} to {most}, for {total} configurations that were seen",
    )
