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
from pkmcal.outcome.blocks.base import Text
from pkmcal.outcome.blocks.log_bar import LogBar
from pkmcal.outcome.blocks.machine import Configuration, Machine
from pkmcal.outcome.blocks.text import Fact
from pkmcal.outcome.finding import Mark


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

    tone : good, partial (usable, with exceptions), bad, or neutral (nothing is judged).
    stamp : one to three words.
    explanation : line below the headline.
    reasons : points below both.
    comparison : magnitudes before and after.
    """

    tone: Literal["good", "partial", "bad", "neutral"]
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
    expert : collapsed, among the sections for the metrologist.
    void : its figures mean nothing, because the result must not be used.
    """

    name: str
    title: Text
    menu: Text
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
