"""Configurations put aside before a calibration's estimate is made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.arrays import Booleans
from pkmcal.calibration.turns import Turns
from pkmcal.identify.bundle import bundle
from pkmcal.measurements import Observation
from pkmcal.mechanisms import Machine
from pkmcal.validate.holdouts import select
from pkmcal.validate.regions import Region


def set_aside(drawing: Machine, turns: Turns, out: Region) -> Turns:
    """What the last turn left, as if a region's configurations had not been taken.

    They did help to find legs in the photographs; no number of the estimate comes from them.
    """
    keep = np.ones(len(turns.measurements.joints), dtype=bool)
    keep[out.rows] = False
    measurements = select(turns.measurements, keep)
    return turns._replace(
        observation=replace(_without(turns.observation, keep), poses=measurements.poses),
        measurements=measurements,
        estimate=bundle(drawing, measurements, turns.estimate.state),
    )


def _without(observation: Observation, keep: Booleans) -> Observation:
    """An observation of the configurations to keep, (K,), edges renumbered."""
    kept = keep[observation.edges.configuration]
    points = kept[observation.point_edge]
    numbers = np.cumsum(kept) - 1
    return replace(
        observation,
        edges=observation.edges.select(kept),
        rejected=tuple(r for r in observation.rejected if keep[r.configuration]),
        points=observation.points[points],
        point_edge=numbers[observation.point_edge[points]],
    )
