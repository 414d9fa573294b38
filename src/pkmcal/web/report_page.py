"""Report page of an outcome: its document for the viewer, in one file that needs no network."""

from __future__ import annotations

import re
from datetime import datetime
from importlib.metadata import version
from typing import Literal

from pkmcal.outcome import Outcome, Part
from pkmcal.outcome.blocks.text import Fact, Paragraph
from pkmcal.outcome.finding import Finding, Level
from pkmcal.web import document as shapes
from pkmcal.web.page import standalone_page
from pkmcal.web.tables import table_block
from pkmcal.wording import date_text

LONGEST_HEADLINE = 240
"""Characters of two lines."""
_SENTENCE_END = re.compile(r"(?<=\.) (?=[A-Z])")


def report_page(outcome: Outcome, made: datetime | None = None) -> str:
    """Page with verdict, findings, cards and sections.

    made : time for the head of the page.
    """
    return standalone_page(report_document(outcome, made))


def _tone(outcome: Outcome) -> Literal["good", "partial", "bad", "neutral"]:
    """Tone of the verdict: the colour of its sign."""
    if outcome.neutral:
        return "neutral"
    if outcome.mark == "good":
        return "good"
    return "bad" if outcome.mark is Level.WRONG else "partial"


def report_document(outcome: Outcome, made: datetime | None = None) -> shapes.ReportDocument:
    """Document of the page; see :func:`report_page`."""
    verdict, program = outcome.verdict, f"pkmcal {version('pkmcal')}"
    usable = verdict.usable
    date = (date_text(made),) if made else ()
    stamp = outcome.stamp or ("Usable" if usable else "Do not use")
    headline, explanation, points = verdict_lines(verdict.headline, stamp)
    # remarks: what needs no action
    remarks = [one for one in verdict.findings if is_remark(one)]
    rest = [one for one in verdict.findings if not is_remark(one)]
    others = outcome.findings
    return shapes.ReportDocument(
        program=program,
        title=outcome.title,
        kicker=outcome.kicker or outcome.command,
        subject=outcome.subject,
        origin=(*date, program, *outcome.origin),
        notes=outcome.notes,
        verdict=shapes.Verdict(
            tone=_tone(outcome),
            stamp=stamp,
            headline=headline,
            explanation=outcome.explanation or explanation,
            comparison=outcome.comparison,
            reasons=(*points, *verdict.reasons),
        ),
        warnings=(
            *(one.text for one in rest if one.level is Level.DOUBTFUL),
            *(one.text for one in others if one.level is not Level.NOTE),
        ),
        advice=tuple(one.text for one in rest if one.level is Level.NOTE),
        remarks=tuple(
            one.text for one in (*remarks, *(one for one in others if one.level is Level.NOTE))
        ),
        cards=tuple(
            shapes.Card(
                question=one.question, values=one.values, note=one.note, limit=one.limit,
                mark=one.mark,
            )
            for one in outcome.figures
        ),
        certificate=tuple(Fact(name=name, value=value) for name, value in outcome.certificate),
        sections=tuple(_section(part, usable) for part in outcome.parts),
    )  # fmt: skip


def verdict_lines(text: str, stamp: str) -> tuple[str, str, tuple[str, ...]]:
    """Headline, line below it, and points, so that no paragraph is set as a headline.

    stamp : headline of a text whose first sentence is too long for one.
    """
    first, *rest = _SENTENCE_END.split(text)
    if len(first) > LONGEST_HEADLINE:
        return f"{stamp}.", "", (first, *rest)
    explanation = " ".join(rest)
    if len(explanation) > LONGEST_HEADLINE:
        return first, "", tuple(rest)
    return first, explanation, ()


def is_remark(finding: Finding) -> bool:
    """Whether a warning or note has no effect on the result, so that nothing needs to be done."""
    return finding.level is not Level.WRONG and finding.facts.get("matters") is False


def _section(part: Part, usable: bool) -> shapes.Section:
    blocks = (
        *(Paragraph(text=text) for text in (*part.text, *part.terminal_text)),
        *part.blocks,
        *map(table_block, part.tables),
        *(Paragraph(text=text, small=True) for text in part.notes),
    )
    return shapes.Section(
        name=part.name,
        title=part.title,
        menu=part.menu or part.title,
        expert=part.expert,
        void=part.of_result and not usable,
        blocks=blocks,
    )
