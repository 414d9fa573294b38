"""Outcomes and sentences as text: on a terminal, with its colours, and as a string."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable
from functools import cache
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

from pkmcal.errors import legible
from pkmcal.wording import with_unit

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.outcome import Outcome, Table

MARK_SIGNS = {
    "good": "[green]✓[/]",
    "note": "[cyan]·[/]",
    "doubtful": "[yellow]![/]",
    "wrong": "[red]✗[/]",
}
WIDEST_NAME = 32
"""Maximum number of characters of a row's name that is not wrapped."""


SUMMARY_WIDTH = 80
"""Characters of a line of a summary."""


@cache
def _legible_console() -> type[Console]:
    """Rich's console with all text made legible; only Rich's own control codes reach a terminal."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class LegibleConsole(Console):
        """Console with legible text."""

        def render(
            self, renderable: RenderableType, options: ConsoleOptions | None = None
        ) -> Iterable[Segment]:
            for segment in super().render(renderable, options):
                if segment.control:
                    yield segment
                else:
                    yield Segment(legible(segment.text, keep="\n"), segment.style)

    return LegibleConsole


def out() -> Console:
    """Console for results."""
    return _legible_console()(highlight=False)


def err() -> Console:
    """Console for progress and errors."""
    return _legible_console()(stderr=True, highlight=False)


def print_points(console: Console, points: Iterable[tuple[str, str]], style: str = "") -> None:
    """Print sentences that wrap beside their marks: pairs of mark (in markup) and text."""
    from rich.text import Text

    for mark, text in points:
        before = Text.from_markup(f"{mark} " if mark else "")
        # Paths and numbers are not split; a word that is wider than the terminal runs over.
        lines = textwrap.wrap(
            text,
            max(console.width - before.cell_len, 20),
            break_long_words=False,
            break_on_hyphens=False,
        )
        rest = ("\n" + " " * before.cell_len).join(lines)
        console.print(before + Text(rest), soft_wrap=True, style=style)


def print_files(console: Console, files: Iterable[tuple[str, str]]) -> None:
    """Print paths, each a link to its file where the terminal has links, with descriptions."""
    from rich.style import Style
    from rich.text import Text

    rows = [(legible(path), _link(path), what) for path, what in files]
    widest = max(len(path) for path, _, _ in rows)
    for path, link, what in rows:
        line = Text("  ")
        line.append(path, Style(link=link))
        line.append(" " * (widest - len(path) + 2))
        line.append(what, "dim")
        console.print(line, soft_wrap=True)


def _link(path: str) -> str | None:
    """Address of an existing file or folder."""
    return Path(path).absolute().as_uri() if os.path.lexists(path) else None


def print_table(console: Console, table: Table) -> None:
    """Print a table without lines: title, the columns that are for the terminal, and legend."""
    from rich.table import Table as Rich

    columns = table.columns[: table.first]
    marked = any(row.mark for row in table.rows)
    grid = Rich(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim")
    if marked:
        grid.add_column()
    short = max((len(row.name) for row in table.rows), default=0) <= WIDEST_NAME
    for place, heading in enumerate(columns):
        left = place == 0 or place in table.words
        grid.add_column(heading, justify="left" if left else "right", no_wrap=not place and short)
    for row in table.rows:
        mark = [MARK_SIGNS[row.mark] if row.mark else ""] if marked else []
        cells = (escaped(text) for text in (row.name, *row.cells)[: len(columns)])
        grid.add_row(*mark, *cells)
    console.print()
    if table.title:
        console.print(legible(table.title), style="bold", markup=False)
    console.print(grid)
    explained: dict[str, list[str]] = {}
    for name, hint in zip(columns, table.hints, strict=False):  # hints of further columns remain
        if hint:
            explained.setdefault(hint, []).append(name)
    hints = " ".join(f"{', '.join(names)}: {hint}" for hint, names in explained.items())
    for text in filter(None, (hints, table.legend)):
        print_points(console, [("  ", text)], style="dim")


def escaped(text: str) -> str:
    """Text of one line, with brackets escaped so that they are not read as markup."""
    from rich.markup import escape

    return escape(legible(text))


def print_outcome(out: Console, outcome: Outcome) -> None:
    """Print an outcome for people: verdict, figures, tables and findings."""
    verdict, findings = outcome.verdict, outcome.findings
    if outcome.subject:
        print_points(out, [("", outcome.subject)])
        out.print()
    mark = MARK_SIGNS["note" if outcome.neutral else outcome.mark]
    print_points(out, [(mark, verdict.headline)])
    print_points(out, [("  [red]•[/]", reason) for reason in verdict.reasons])
    brief = any(table.brief for part in outcome.parts for table in part.tables)
    if outcome.figures and not brief:
        out.print()
        widest = max(len(card.question) for card in outcome.figures)
        for card in outcome.figures:
            values = ", ".join(with_unit(value, unit) for value, unit in card.values)
            out.print(f"  {card.question:{widest}}  [bold]{values}[/]", soft_wrap=True)
    for part in outcome.parts:
        for table in part.tables:
            if table.brief:
                print_table(out, table)
        if part.terminal_text:
            out.print()
            print_points(out, [("", text) for text in part.terminal_text])
    points = [
        *((MARK_SIGNS[finding.level], finding.text) for finding in findings),
        *((MARK_SIGNS["doubtful"], text) for text in verdict.warnings),
        *(("[cyan]→[/]", text) for text in verdict.advice),
    ]
    if points:
        out.print()
        print_points(out, points)
    if outcome.closing:
        out.print()
        out.print(outcome.closing, style="yellow", markup=False)


def outcome_text(outcome: Outcome) -> str:
    """Text of an outcome without colours, as a terminal of SUMMARY_WIDTH columns shows it."""
    lines = StringIO()
    print_outcome(_legible_console()(file=lines, width=SUMMARY_WIDTH, highlight=False), outcome)
    return lines.getvalue().rstrip()
