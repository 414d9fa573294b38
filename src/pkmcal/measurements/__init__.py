"""What was measured: one contract, one file a kind of measurement; sets of measurements."""

from pkmcal.measurements.edges import OWN_SHADING, SHADING_SIGMA, EdgeSet, Rejection
from pkmcal.measurements.line_cells import SHADING_ALIKE_ANGLE, TUBES_ALIKE
from pkmcal.measurements.links import LinkRows, LinkSet
from pkmcal.measurements.poses import PoseSet
from pkmcal.measurements.sets import (
    BREATHING_SIGMA,
    Departure,
    Effect,
    Measurements,
    Mount,
    Observation,
    Set,
    concatenate,
    of_stations,
)

__all__ = [
    "BREATHING_SIGMA",
    "OWN_SHADING",
    "SHADING_ALIKE_ANGLE",
    "SHADING_SIGMA",
    "TUBES_ALIKE",
    "Departure",
    "EdgeSet",
    "Effect",
    "LinkRows",
    "LinkSet",
    "Measurements",
    "Mount",
    "Observation",
    "PoseSet",
    "Rejection",
    "Set",
    "concatenate",
    "of_stations",
]
