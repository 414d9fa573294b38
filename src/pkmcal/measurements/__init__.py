"""Measurements: the contract of their kinds, one kind a file; sets of measurements."""

from pkmcal.measurements.columns import Column
from pkmcal.measurements.edges import OWN_SHADING, SHADING_SIGMA, EdgeSet, Rejection
from pkmcal.measurements.line_cells import SHADING_CORRELATION_ANGLE, TUBE_CORRELATION
from pkmcal.measurements.links import LinkRows, LinkSet
from pkmcal.measurements.poses import PoseSet
from pkmcal.measurements.sets import (
    BOARD_MOUNT_NAME,
    Measurements,
    Mount,
    Observation,
    Set,
    concatenate,
    edges_of_any,
    of_stations,
)

__all__ = [
    "BOARD_MOUNT_NAME",
    "OWN_SHADING",
    "SHADING_CORRELATION_ANGLE",
    "SHADING_SIGMA",
    "TUBE_CORRELATION",
    "Column",
    "EdgeSet",
    "LinkRows",
    "LinkSet",
    "Measurements",
    "Mount",
    "Observation",
    "PoseSet",
    "Rejection",
    "Set",
    "concatenate",
    "edges_of_any",
    "of_stations",
]
