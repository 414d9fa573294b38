"""Block ``tool_map``: errors of the tool's pose in slices through the workspace."""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Key, Text

Grid = tuple[tuple[float | None, ...], ...]
"""Values by row, from the lowest coordinate; null where the machine does not reach."""


class MapLayer(Schema):
    """Quantity over the workspace.

    unit : mm or °; empty for a ratio.
    better : whether small or large values are good.
    limit : value at which the field for a wanted accuracy starts.
    slices : its values in each slice.
    evenly : its values at poses spread evenly over the workspace and its orientations, from which
        shares are computed.
    """

    name: Text
    component: Literal["position", "orientation"]
    unit: str
    better: Literal["small", "large"]
    limit: float
    slices: tuple[Grid, ...]
    evenly: tuple[float, ...]


class MapPose(Schema):
    """Measured pose in a slice, mm."""

    key: Key
    tip: Text
    u: float
    v: float


class MapSlice(Schema):
    """Plane of positions at home's orientation, mm.

    across, up, normal : names of the axes.
    level : coordinate along the normal.
    u, v : coordinates of the columns and rows.
    poses : measured poses near the plane.
    """

    across: str
    up: str
    normal: str
    level: float
    u: tuple[float, ...]
    v: tuple[float, ...]
    poses: tuple[MapPose, ...]


class ToolMapBlock(Schema):
    """Contour maps with a choice of layer and slice."""

    kind: Literal["tool_map"] = "tool_map"
    caption: Text
    alt: Text
    slices: tuple[MapSlice, ...]
    layers: tuple[MapLayer, ...]
