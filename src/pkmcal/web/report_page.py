"""Report page of an outcome: its document for the viewer, in one file that needs no network."""

from __future__ import annotations

from datetime import datetime
from importlib.metadata import version

from pkmcal.outcome import Outcome, Part
from pkmcal.outcome.blocks.text import CheckLine, Checks, Paragraph
from pkmcal.web import document as shapes
from pkmcal.web.page import standalone_page


def report_page(outcome: Outcome, made: datetime | None = None) -> str:
    """Page with verdict, findings, cards and sections.

    made : time for the head of the page.
    """
    return standalone_page(report_document(outcome, made))


def report_document(outcome: Outcome, made: datetime | None = None) -> shapes.ReportDocument:
    """Document of the page; see :func:`report_page`."""
    verdict, program = outcome.verdict, f"pkmcal {version('pkmcal')}"
    usable, partial = verdict.usable, outcome.partial
    notes = [finding.text for finding in outcome.findings if finding.level == "note"]
    others = [finding.text for finding in outcome.findings if finding.level != "note"]
    date = (f"{made.day} {made:%B %Y, %H:%M}",) if made else ()
    return shapes.ReportDocument(
        program=program,
        title=outcome.title,
        kicker=outcome.kicker or outcome.command,
        subject=outcome.subject,
        origin=(*date, program, *outcome.origin),
        notes=outcome.notes,
        verdict=shapes.Verdict(
            tone="bad" if not usable else "partial" if partial else "good",
            stamp=outcome.stamp or ("Usable" if usable else "Do not use"),
            headline=verdict.headline,
            reasons=verdict.reasons,
        ),
        warnings=(*verdict.warnings, *others),
        advice=verdict.advice,
        remarks=tuple(notes),
        cards=tuple(
            shapes.Card(question=one.question, values=one.values, note=one.note)
            for one in outcome.figures
        ),
        sections=tuple(_section(part) for part in outcome.parts),
    )


def _section(part: Part) -> shapes.Section:
    checks = tuple(CheckLine(text=one.sentence, passed=one.passed) for one in part.checks)
    blocks = (
        *(Paragraph(text=text) for text in (*part.text, *part.terminal_text)),
        *part.blocks,
        *((Checks(checks=checks),) if checks else ()),
        *(Paragraph(text=text, small=True) for text in part.notes),
    )
    return shapes.Section(
        name=part.name, title=part.title, menu=part.menu or part.title, blocks=blocks
    )
