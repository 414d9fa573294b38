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
from pydantic.json_schema import models_json_schema

from pkmcal.files import Schema
from pkmcal.outcome.blocks import Block
from pkmcal.outcome.blocks.base import Text
from pkmcal.outcome.blocks.log_bar import LogBar
from pkmcal.outcome.blocks.machine import Configuration, Machine
from pkmcal.outcome.blocks.text import Fact
from pkmcal.outcome.finding import Mark
from pkmcal.web import session_document as session


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

    tone : good, partial (with exceptions or doubts), bad, or neutral (nothing is judged).
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


class SessionDocument(Head):
    """Page of a session, which requests images, overlays and the stage from the program.

    legs : number of legs.
    calibration : its folder; empty for none. report : address of its report, relative to the page;
        empty for none.
    """

    kind: Literal["session"] = "session"
    legs: int
    calibration: Text
    report: str
    stations: tuple[session.SessionStation, ...]


class FolderEntry(Schema):
    """Session or result in a folder.

    name : path in the folder. href : of its page, relative to the list's; empty if it cannot be
        opened.
    title : of its page. date : of the result; empty where it has none.
    mark, text : verdict, or why it cannot be opened.
    before, after : tool errors by the nominal model and after the calibration; empty without them.
    """

    name: Text
    href: str
    title: Text
    date: Text
    mark: Mark | None
    text: Text
    before: Text
    after: Text


class FolderDocument(Head):
    """Page of a folder with sessions and results.

    note : on what is not listed.
    """

    kind: Literal["folder"] = "folder"
    entries: tuple[FolderEntry, ...]
    note: Text


PageDocument = MachineDocument | ReportDocument
"""Document of a page in one file."""
AnyDocument = PageDocument | SessionDocument | FolderDocument
ViewerDocument = Annotated[AnyDocument, Field(discriminator="kind")]
_MESSAGES = (
    session.ViewRequest,
    session.OverlayAnswer,
    session.EdgesAnswer,
    session.LocalizationAnswer,
    session.SavedAnswer,
)
"""Requests of a session's page and the answers to them, whose types the viewer has too."""


def schema_text() -> str:
    """JSON schema of ``ViewerDocument``, with those of the pages' messages: ``schema.json``."""
    (_, definitions) = models_json_schema(
        [(one, "serialization") for one in _MESSAGES], ref_template="#/$defs/{model}"
    )
    schema = TypeAdapter[AnyDocument](ViewerDocument).json_schema(mode="serialization")
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    own = {**schema["$defs"], **definitions["$defs"]}
    return json.dumps({**dialect, **schema, "$defs": own}, indent=2) + "\n"
