"""Machine of a stage, and its configurations: all lines and points that the viewer draws of it.

Points are in metres in the base frame and angles in radians, unless a field says otherwise.
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
    """What of a leg does not depend on the configuration.

    number : from 1.
    reading : index of its reading, null without one.
    body : index of the platform's bar on which the leg ends, null for a rigid platform.
    tubes : empty if the file has none; then the rod is drawn with a thin line.
    path : of A over the range of the reading; empty if the reading does not move A.
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
    direction, zero : sentences on what a larger reading does, and where the reading is zero.
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

    base : from where a motor holds the arm, if there is one, to A.
    platform : from the hinge of a bar, if there is one, to B.
    positive : way of the moving point as the reading grows, for an arrow beside it.
    zero : the arm, or A, or the point of the leg from which its length is counted, at reading zero.
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
