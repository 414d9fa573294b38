"""Machine of a stage, and its configurations: lines and points for the viewer.

Points are in metres in the base frame and angles in radians, unless a field states otherwise.
"""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Line, Pose, Text, Vector


class Property(Schema):
    """Row of a table of properties."""

    label: Text
    value: Text


class Tube(Schema):
    """Visible cylinder of a leg; ``start`` and ``stop`` from A towards B, m."""

    radius: float
    start: float
    stop: float


class Leg(Schema):
    """Properties of a leg that do not depend on the configuration.

    number : from 1.
    reading : index of its reading, null without one.
    body : index of the platform's bar on which the leg ends, null for a rigid platform.
    tubes : empty if the file has none; the rod is then drawn as a thin line.
    path : positions of A over the range of the reading; empty if the reading does not move A.
    rows : its parameters.
    """

    number: int
    reading: int | None
    body: int | None
    tubes: tuple[Tube, ...]
    path: Line
    rows: tuple[Property, ...]


class Reading(Schema):
    """Joint reading: its range and the sense of its sign.

    unit : m or rad.
    low, high : range of the slider.
    stated : whether this is the range of the mechanism file; otherwise it is an assumption.
    legs : indices of the legs that it moves.
    direction, zero : sentences on the effect of a larger reading, and on the position at zero.
    """

    name: Text
    unit: Literal["m", "rad"]
    low: float
    high: float
    stated: bool
    legs: tuple[int, ...]
    direction: Text
    zero: Text


class JointAxis(Schema):
    """Axis of a joint: a point and a unit direction, in the frame of the body that holds it."""

    leg: int
    side: Literal["base", "platform"]
    point: Vector
    direction: Vector
    label: Text


class LegConfiguration(Schema):
    """Lines of a leg in one configuration.

    base : from the motor of the arm, if there is one, to A.
    platform : from the hinge of a bar, if there is one, to B.
    positive : direction of the moving point for an increasing reading, for an arrow beside it.
    zero : position of the arm, of A, or of the point from which the leg's length is counted, at
        reading zero.
    """

    base: Line
    platform: Line
    positive: Line
    zero: Line


class Configuration(Schema):
    """Machine at one set of readings.

    readings : in m or rad.
    T_base_platform : rows of the matrix.
    rotation : rotation vector of the platform, rad.
    legs : in their order.
    beyond : indices of the readings outside their stated ranges.
    """

    readings: tuple[float, ...]
    T_base_platform: Pose
    rotation: Vector
    legs: tuple[LegConfiguration, ...]
    beyond: tuple[int, ...]


class CameraShape(Schema):
    """Camera at its station: the border of the image at some depth, and rays to its corners."""

    name: Text
    position: Vector
    lines: tuple[Line, ...]


class Machine(Schema):
    """Machine of a stage.

    name, motion : of the mechanism file.
    base_outline, platform_outline : closed polygons through joints; the latter in the platform
        frame.
    workspace : positions of the platform's origin at readings within their ranges.
    home : the first configuration.
    """

    name: Text
    motion: Text
    legs: tuple[Leg, ...]
    readings: tuple[Reading, ...]
    axes: tuple[JointAxis, ...]
    base_outline: Line
    platform_outline: Line
    cameras: tuple[CameraShape, ...]
    workspace: Line
    home: Configuration
