"""Block ``space``: a machine in space with its cameras, at one configuration or through many."""

from __future__ import annotations

from typing import Literal

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Key, Line, Text, Vector
from pkmcal.outcome.blocks.machine import Configuration, Machine


class SpacePose(Schema):
    """Configuration of the slider; label : its name."""

    key: Key
    label: Text
    configuration: Configuration


class LegChange(Schema):
    """Change of a leg's lines from one machine to the other, m; drawn enlarged.

    base : of each point of the leg's ``base``, base frame.
    platform : of each point of its ``platform``, platform frame.
    """

    base: Line
    platform: Line


class Ellipsoid(Schema):
    """Uncertainty of a joint centre; drawn enlarged.

    leg : index from 0.
    axes : semi-axes, m, in the frame of the side.
    """

    leg: int
    side: Literal["base", "platform"]
    axes: tuple[Vector, Vector, Vector]


class SpacePoints(Schema):
    """Points with a name in the legend.

    colour : custom property of the style sheet.
    keys, tips : of each point.
    sizes : relative to others; empty for all alike.
    visible : whether they are drawn from the start.
    """

    name: Text
    colour: str
    points: Line
    keys: tuple[Key, ...]
    tips: tuple[Text, ...]
    sizes: tuple[float, ...] = ()
    visible: bool = True


class SpaceArrows(Schema):
    """Small vectors at points, m; drawn enlarged."""

    name: Text
    colour: str
    points: Line
    vectors: Line
    tips: tuple[Text, ...]
    visible: bool = True


class SpacePath(Schema):
    """Polylines with a name in the legend, m, base frame."""

    name: Text
    colour: str
    lines: tuple[Line, ...]
    dashed: bool = False


class Space(Schema):
    """Stage with a machine.

    alt : description for readers who do not see the stage.
    poses : configurations of the slider; with none the machine stays at home.
    names : of the machine before and after ``changes``; the configurations are those after.
    changes : of each leg; one entry for all poses, or one for each of them; none without a second
        machine.
    enlargement : of changes and arrows at the start; a slider changes it.
    sigmas : standard deviations of the ellipsoids.
    ellipsoid_enlargement : of the ellipsoids at the start; likewise.
    """

    kind: Literal["space"] = "space"
    title: Text
    caption: Text
    alt: Text
    machine: Machine
    poses: tuple[SpacePose, ...]
    names: tuple[Text, Text] = ("", "")
    changes: tuple[tuple[LegChange, ...], ...] = ()
    ellipsoids: tuple[Ellipsoid, ...] = ()
    enlargement: float = 1.0
    sigmas: float = 0.0
    ellipsoid_enlargement: float = 1.0
    points: tuple[SpacePoints, ...] = ()
    arrows: tuple[SpaceArrows, ...] = ()
    paths: tuple[SpacePath, ...] = ()
