"""Result of a command, in one type for all commands.

Every command ends in an :class:`Outcome`. One finisher writes it, prints it and sets the exit
code; one view of the viewer shows it; other programs read its ``document``. Terminal, page and JSON
hold the same tables and figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pkmcal.outcome.finding import Finding, Level, Mark

if TYPE_CHECKING:
    from pkmcal.outcome.blocks import Block
    from pkmcal.outcome.blocks.log_bar import LogBar


@dataclass(frozen=True)
class Verdict:
    """Judgement of a result: usable or not, and why.

    usable : whether the result may be loaded into a controller.
    headline : one sentence.
    findings : reasons against the result (WRONG), warnings (DOUBTFUL) and advice (NOTE).
    """

    usable: bool
    headline: str
    findings: tuple[Finding, ...] = ()

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences of the findings that make the result unusable."""
        return self._texts(Level.WRONG)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the warnings."""
        return self._texts(Level.DOUBTFUL)

    @property
    def advice(self) -> tuple[str, ...]:
        """Sentences on how to improve the result."""
        return self._texts(Level.NOTE)

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the findings, in their order."""
        return tuple(one.code for one in self.findings)

    def of(self, code: str) -> tuple[Finding, ...]:
        """Findings with a code, or with any code of an area such as ``readings``."""
        return tuple(
            one for one in self.findings if one.code == code or one.code.startswith(f"{code}.")
        )

    def document(self) -> dict[str, Any]:
        """Verdict as plain data: its sentences, and the findings with their codes and facts."""
        return {
            "usable": self.usable,
            "headline": self.headline,
            "reasons": self.reasons,
            "warnings": self.warnings,
            "advice": self.advice,
            "findings": [one.document() for one in self.findings],
        }

    def _texts(self, level: Level) -> tuple[str, ...]:
        """Sentences of the findings with a level."""
        return tuple(one.text for one in self.findings if one.level is level)


@dataclass(frozen=True)
class Figure:
    """Card with the number that answers one question.

    values : (number, unit) pairs as text.
    note : small print under the number.
    limit : limit of a usable result, as text; empty without one.
    mark : sign of the number against its limit; None without one.
    """

    question: str
    values: tuple[tuple[str, str], ...]
    note: str
    limit: str = ""
    mark: Mark | None = None


@dataclass(frozen=True)
class Row:
    """Row of a table.

    cells : text of each column after the first.
    mark : sign before the row's name; None for no sign.
    key : what the row belongs to, for the page's selection (``outcome.blocks.base``).
    """

    name: str
    cells: tuple[str, ...]
    mark: Mark | None = None
    key: str = ""


@dataclass(frozen=True)
class Table:
    """Table for the page and the terminal.

    columns : headings; the first is that of the rows' names, so there is one more than a row has
        cells.
    note : text under the table on the page.
    brief : short enough for a terminal.
    folded : collapsed on the page until it is opened.
    first : number of leading columns that a terminal prints, the rows' names included; None for
        all.
    words : indices of the columns that hold text and are aligned to the left.
    shaded : indices of the columns whose cells are shaded by their numbers on the page.
    hints : explanation of each column, empty for none: at its heading on the page, and under the
        table on a terminal and on paper.
    legend : paragraph under the table on a terminal.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""
    brief: bool = True
    folded: bool = False
    first: int | None = None
    words: tuple[int, ...] = ()
    shaded: tuple[int, ...] = ()
    hints: tuple[str, ...] = ()
    legend: str = ""


@dataclass(frozen=True)
class Part:
    """Section of the page; its contents follow the title in the order of the fields.

    text : paragraphs.
    terminal_text : sentences that the terminal prints as well.
    blocks : what the viewer draws of it.
    notes : small print.
    menu : shorter name for the page's navigation.
    expert : collapsed on the page, among the sections for the metrologist.
    of_result : figures that mean nothing if the result must not be used; the page then marks them.
    """

    name: str
    title: str
    text: tuple[str, ...] = ()
    terminal_text: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    menu: str = ""
    expert: bool = False
    of_result: bool = False


@dataclass(frozen=True, repr=False)
class Outcome:
    """Result of a command, for readers and for programs.

    command : name of the command.
    title : title of the page.
    kicker : line above the title, such as a session's name.
    subject : sentence on what was examined.
    origin : identification of the data, such as a session's digest; shown on the page.
    notes : the user's own text.
    verdict : whether the result may be used.
    explanation : line below the headline on the page: what it means, and the next figures.
    comparison : magnitudes below the headline on the page.
    certificate : pairs (name, value) of tolerances and instruments, for the first printed page.
    stamp : the verdict in one to three words.
    level : severity of an unusable result.
    partial : usable, but some of the result does not hold.
    neutral : colours judge nothing, such as a change that was the purpose.
    figures : cards at the top of the page; a terminal prints them if no part has a brief table.
    parts : sections of the page.
    findings : warnings and notes besides those of the verdict.
    closing : last lines on a terminal before the list of files.
    document : all of the result as plain data, m and rad.
    summary : shorter document for ``--json``; None to print ``document``.
    texts : contents of further files by file name.
    """

    command: str
    title: str
    verdict: Verdict
    kicker: str = ""
    subject: str = ""
    origin: tuple[str, ...] = ()
    notes: str = ""
    explanation: str = ""
    comparison: LogBar | None = None
    certificate: tuple[tuple[str, str], ...] = ()
    stamp: str = ""
    level: Level = Level.WRONG
    partial: bool = False
    neutral: bool = False
    figures: tuple[Figure, ...] = ()
    parts: tuple[Part, ...] = ()
    findings: tuple[Finding, ...] = ()
    closing: str = ""
    document: dict[str, Any] = field(default_factory=dict[str, Any])
    summary: dict[str, Any] | None = None
    texts: dict[str, str | bytes] = field(default_factory=dict[str, str | bytes])

    def __repr__(self) -> str:
        return f"<Outcome of pkmcal {self.command}: {self.verdict.headline}>"

    @property
    def mark(self) -> Mark:
        """Sign of the verdict."""
        if self.verdict.usable:
            return Level.DOUBTFUL if self.partial else "good"
        return self.level

    @property
    def exit_code(self) -> int:
        """0 usable; 1 finished, but the result must not be used; 2 wrong input."""
        if any(finding.level is Level.WRONG for finding in self.findings):
            return 2
        return 0 if self.verdict.usable else 1
