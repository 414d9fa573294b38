"""Options shared by commands, and output to the terminal: results to stdout, progress and errors to
stderr.
"""

from __future__ import annotations

import os
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkmcal.errors import legible
from pkmcal.ranges import RANGES, check_number

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.outcome import Table

TextProgress = Callable[[str, float], None]

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


def number_option(command: str, name: str, metavar: str, described: str, *flags: str) -> Any:
    """Numeric option that is validated by its range in :data:`pkmcal.ranges.RANGES`; the help shows
    the range.

    described : help text. flags : names of the option; ``--name`` by default.
    """
    long = flags[-1] if flags else f"--{name.replace('_', '-')}"

    def check(value: Any) -> Any:
        check_number(command, name, value, long)
        return value

    text = f"{described} [{RANGES[command][name]}]"
    return typer.Option(*(flags or (long,)), metavar=metavar, callback=check, help=text)


def _seed(value: int) -> int:
    check_number("calibrate", "seed", value, "--seed")
    return value


Seed = Annotated[
    int, typer.Option("--seed", metavar="N", callback=_seed, help="Seed for all random numbers.")
]

SessionFolder = Annotated[Path, typer.Argument(metavar="SESSION", help="The session's folder.")]
CalibrationFolder = Annotated[
    Path, typer.Argument(metavar="CALIBRATION", help="The folder that calibrate wrote.")
]
CamerasOf = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="The session, for its cameras, where it is not found."),
]

MARK_SIGNS = {
    "good": "[green]✓[/]",
    "note": "[cyan]·[/]",
    "doubtful": "[yellow]![/]",
    "wrong": "[red]✗[/]",
}
ROW_SOURCE_STYLES = {"paper": "yellow", "prototype": "dim", "ours": ""}
"""Styles of a table's rows by the source of their figures."""
PROGRESS_LINE_INTERVAL = 10.0
"""Seconds between two lines of progress without a terminal."""
WIDEST_NAME = 32
"""Maximum number of characters of a row's name that is not wrapped."""


def folder(given: str) -> Any:
    """Option of the output folder. given : help text."""
    return typer.Option("-o", "--out", metavar="DIR", help=given)


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


def print_error(sentence: str) -> None:
    """Print an error to stderr: wrapped and coloured on a terminal, in one line elsewhere."""
    console = err()
    if console.is_terminal:
        print_points(console, [("[bold red]Error:[/]", sentence)])
    else:
        sys.stderr.write(f"Error: {legible(sentence)}\n")


def print_json(data: Mapping[str, Any]) -> None:
    """Print the single JSON object of a command."""
    from pkmcal.files import json_text

    sys.stdout.write(json_text(data))


def print_points(console: Console, points: Iterable[tuple[str, str]]) -> None:
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
        console.print(before + Text(rest), soft_wrap=True)


def print_files(console: Console, files: Iterable[tuple[str, str]]) -> None:
    """Print paths with their descriptions."""
    files = [(legible(path), what) for path, what in files]
    widest = max(len(path) for path, _ in files)
    for path, what in files:
        console.print(f"  {escaped(path):{widest}}  [dim]{what}[/]", soft_wrap=True)


def print_table(console: Console, table: Table) -> None:
    """Print a table without lines: title, the columns that are for the terminal, and legend."""
    from rich.table import Table as Rich

    columns = table.columns[: table.first]
    marked = any(row.mark for row in table.rows)
    grid = Rich(box=None, padding=(0, 2, 0, 0), header_style="dim")
    if marked:
        grid.add_column()
    short = max((len(row.name) for row in table.rows), default=0) <= WIDEST_NAME
    for place, heading in enumerate(columns):
        left = place == 0 or place in table.words
        grid.add_column(heading, justify="left" if left else "right", no_wrap=not place and short)
    for row in table.rows:
        mark = [MARK_SIGNS[row.mark] if row.mark else ""] if marked else []
        cells = (escaped(text) for text in (row.name, *row.cells)[: len(columns)])
        grid.add_row(*mark, *cells, style=ROW_SOURCE_STYLES[row.source])
    console.print()
    if table.title:
        console.print(legible(table.title), style="bold", markup=False)
    console.print(grid)
    for line in table.legend:
        console.print(f"   {line}", style="dim", markup=False)


def escaped(text: str) -> str:
    """Text of one line, with brackets escaped so that they are not read as markup."""
    from rich.markup import escape

    return escape(legible(text))


@contextmanager
def progress(quiet: bool = False) -> Generator[TextProgress]:
    """Context with a progress callback, which draws a bar on stderr.

    If stderr is not a terminal but a log or a pipe, it prints a plain line every
    PROGRESS_LINE_INTERVAL seconds.
    """
    if quiet:
        yield lambda _text, _share: None
        return
    console = err()
    if not console.is_terminal:
        with _progress_lines() as report:
            yield report
        return
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        BarColumn(bar_width=24),
        TimeElapsedColumn(),
        TextColumn("{task.description}", markup=False),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)


@contextmanager
def _progress_lines() -> Generator[TextProgress]:
    """Context with a progress callback that prints lines at intervals; short commands print
    none.
    """
    begin, over, step = time.monotonic(), threading.Event(), [("", 0.0)]

    def report(text: str, share: float) -> None:
        step[0] = text, share

    def print_lines() -> None:
        while not over.wait(PROGRESS_LINE_INTERVAL):
            text, share = step[0]
            if text:
                passed = f"{share:.0%}, {time.monotonic() - begin:.0f} s"
                sys.stderr.write(f"{legible(text)} ({passed})\n")

    # in a thread, because a step may take minutes without a call of report
    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        over.set()
        thread.join()


def counted(progress: TextProgress, upto: float = 1.0) -> Callable[[int, int], None]:
    """Callback of the numbers of finished and of all images, as progress from 0 to `upto`."""
    return lambda done, total: progress(f"Image {done} of {total}", upto * done / total)


def can_show() -> bool:
    """Whether there is a user with a screen and a browser."""
    if os.environ.get("CI") or not sys.stdout.isatty():
        return False
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
