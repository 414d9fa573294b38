"""Document of the viewer: everything that a page shows, as one versioned JSON object.

Python computes, the viewer draws: points are in metres in the base frame and angles in radians,
unless a field says otherwise. ``schema.json`` beside this file is the JSON schema of
``ViewerDocument``; the viewer's types are generated from it. A change of a field's meaning
raises the document's version.
"""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from pkmcal.files import Schema
from pkmcal.outcome.blocks import Block
from pkmcal.outcome.blocks.base import Line, Pose, Text, Vector
from pkmcal.outcome.blocks.log_bar import LogBar
from pkmcal.outcome.blocks.text import Fact
from pkmcal.outcome.finding import Mark


class Row(Schema):
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
    rows: tuple[Row, ...]


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


class Axis(Schema):
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
    axes: tuple[Axis, ...]
    base_outline: Line
    platform_outline: Line
    cameras: tuple[CameraShape, ...]
    workspace: Line
    home: Configuration


class Sweep(Schema):
    """Configurations with one reading changed from home; null where no pose was found."""

    values: tuple[float, ...]
    configurations: tuple[Configuration | None, ...]


class Head(Schema):
    """What all documents have.

    version : of this format.
    program : name and version of the program that wrote it.
    title : heading of the page.
    """

    version: Literal[1] = 1
    program: str
    title: Text


class MachineDocument(Head):
    """Page of a machine with sliders for its readings.

    subtitle : below the heading.
    notes : sentences below it.
    machine : the machine of the stage.
    sweeps : one for each reading; null if the page asks the program for poses.
    redundant : whether other readings follow if one changes.
    """

    kind: Literal["machine"] = "machine"
    subtitle: Text
    notes: tuple[Text, ...]
    machine: Machine
    sweeps: tuple[Sweep, ...] | None
    redundant: bool


class Verdict(Schema):
    """Judgement at the top of a report.

    tone : good, partial (usable, with exceptions) or bad.
    stamp : one to three words.
    explanation : line below the headline.
    reasons : points below both.
    comparison : magnitudes before and after.
    """

    tone: Literal["good", "partial", "bad"]
    stamp: Text
    headline: Text
    explanation: Text
    comparison: LogBar | None
    reasons: tuple[Text, ...]


class Card(Schema):
    """Card with the numbers that answer one question.

    values : numbers with their units, as text.
    limit : of a usable result; empty without one. mark : of the number against it.
    """

    question: Text
    values: tuple[tuple[Text, Text], ...]
    note: Text
    limit: Text
    mark: Mark | None


class Section(Schema):
    """Section of a report.

    menu : its name in the table of contents.
    mark : the worst of its checks; null without one.
    expert : collapsed, among the sections for the metrologist.
    void : its figures mean nothing, because the result must not be used.
    """

    name: str
    title: Text
    menu: Text
    mark: Mark | None
    expert: bool
    void: bool
    blocks: tuple[Block, ...]


class ReportDocument(Head):
    """Report of a command.

    kicker : line above the title. subject : what was examined. origin : date, program, digest.
    notes : the user's own text.
    warnings, advice, remarks : sentences below the verdict; remarks need no action.
    certificate : tolerances and instruments, for the first printed page.
    """

    kind: Literal["report"] = "report"
    kicker: Text
    subject: Text
    origin: tuple[Text, ...]
    notes: Text
    verdict: Verdict
    warnings: tuple[Text, ...]
    advice: tuple[Text, ...]
    remarks: tuple[Text, ...]
    cards: tuple[Card, ...]
    certificate: tuple[Fact, ...]
    sections: tuple[Section, ...]


ViewerDocument = Annotated[MachineDocument | ReportDocument, Field(discriminator="kind")]


def schema_text() -> str:
    """JSON schema of ``ViewerDocument``, the content of ``schema.json``."""
    schema = TypeAdapter[MachineDocument | ReportDocument](ViewerDocument).json_schema(
        mode="serialization"
    )
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return json.dumps({**dialect, **schema}, indent=2) + "\n"
