"""What commands take alike, and how they say things: results to stdout, progress and errors to
stderr, each kind in one way.
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
    """A numeric option with its range in :data:`pkmcal.ranges.RANGES`, which its help tells.

    described : its help. flags : as they are written; ``--name`` unless given.
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
    int, typer.Option("--seed", metavar="N", callback=_seed, help="Of all random draws.")
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
"""Of a table's rows, by whose figures they are."""
PROGRESS_LINE_INTERVAL = 10.0
"""Seconds from one line about the progress to the next, where there is no terminal."""
WIDEST_NAME = 32
"""Letters of a row's name up to which it stays on one line."""


def folder(given: str) -> Any:
    """The option of the folder in which results go; given : its help."""
    return typer.Option("-o", "--out", metavar="DIR", help=given)


@cache
def _legible_console() -> type[Console]:
    """Rich's console, on which all text is legible; only Rich's own colours control a terminal."""
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class LegibleConsole(Console):
        """As Rich's."""

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
    """The console of results."""
    return _legible_console()(highlight=False)


def err() -> Console:
    """The console of progress and errors."""
    return _legible_console()(stderr=True, highlight=False)


def print_error(sentence: str) -> None:
    """One error to stderr: wrapped and coloured on a terminal, one line elsewhere."""
    console = err()
    if console.is_terminal:
        print_points(console, [("[bold red]Error:[/]", sentence)])
    else:
        sys.stderr.write(f"Error: {legible(sentence)}\n")


def print_json(data: Mapping[str, Any]) -> None:
    """The one JSON object of a command."""
    from pkmcal.files import json_text

    sys.stdout.write(json_text(data))


def print_points(console: Console, points: Iterable[tuple[str, str]]) -> None:
    """Sentences that wrap beside the mark before each: (mark in markup, text)."""
    from rich.text import Text

    for mark, text in points:
        before = Text.from_markup(f"{mark} " if mark else "")
        # Paths and numbers stay whole; a word that is wider than the terminal runs over.
        lines = textwrap.wrap(
            text,
            max(console.width - before.cell_len, 20),
            break_long_words=False,
            break_on_hyphens=False,
        )
        rest = ("\n" + " " * before.cell_len).join(lines)
        console.print(before + Text(rest), soft_wrap=True)


def print_files(console: Console, files: Iterable[tuple[str, str]]) -> None:
    """Paths, each with what it is."""
    files = [(legible(path), what) for path, what in files]
    widest = max(len(path) for path, _ in files)
    for path, what in files:
        console.print(f"  {escaped(path):{widest}}  [dim]{what}[/]", soft_wrap=True)


def print_table(console: Console, table: Table) -> None:
    """A table without lines: its title, as many columns as a terminal is to show, its legend."""
    from rich.table import Table as Rich

    columns = table.columns[: table.first]
    marked = any(row.mark for row in table.rows)
    display = Rich(box=None, padding=(0, 2, 0, 0), header_style="dim")
    if marked:
        display.add_column()
    short = max((len(row.name) for row in table.rows), default=0) <= WIDEST_NAME
    for place, heading in enumerate(columns):
        left = place == 0 or place in table.words
        display.add_column(
            heading, justify="left" if left else "right", no_wrap=not place and short
        )
    for row in table.rows:
        mark = [MARK_SIGNS[row.mark] if row.mark else ""] if marked else []
        cells = (escaped(text) for text in (row.name, *row.cells)[: len(columns)])
        display.add_row(*mark, *cells, style=ROW_SOURCE_STYLES[row.source])
    console.print()
    if table.title:
        console.print(legible(table.title), style="bold", markup=False)
    console.print(display)
    for line in table.legend:
        console.print(f"   {line}", style="dim", markup=False)


def escaped(text: str) -> str:
    """Text of one line that may hold brackets, safe from being taken for markup."""
    from rich.markup import escape

    return escape(legible(text))


@contextmanager
def progress(quiet: bool = False) -> Generator[TextProgress]:
    """A bar on stderr for as long as the block runs; where that is no terminal, such as a log or a
    pipe, a plain line every PROGRESS_LINE_INTERVAL seconds.
    """
    if quiet:
        yield lambda _text, _share: None
        return
    console = err()
    if not console.is_terminal:
        with _lines() as values:
            yield values
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
def _lines() -> Generator[TextProgress]:
    """Lines about what is being done, as long as the block runs; none of what ends before."""
    begin, over, step = time.monotonic(), threading.Event(), [("", 0.0)]

    def report(text: str, share: float) -> None:
        step[0] = text, share

    def print_lines() -> None:
        while not over.wait(PROGRESS_LINE_INTERVAL):
            text, share = step[0]
            if text:
                passed = f"{share:.0%}, {time.monotonic() - begin:.0f} s"
                sys.stderr.write(f"{legible(text)} ({passed})\n")

    # by itself, for a step may take minutes in which nothing else is told
    thread = threading.Thread(target=print_lines, daemon=True)
    thread.start()
    try:
        yield report
    finally:
        over.set()
        thread.join()


def counted(progress: TextProgress, upto: float = 1.0) -> Callable[[int, int], None]:
    """A callback of photographs done and in all, told as a share of `upto`."""
    return lambda done, total: progress(f"Photograph {done} of {total}", upto * done / total)


def can_show() -> bool:
    """Whether there is a person with a browser in front of a screen."""
    if os.environ.get("CI") or not sys.stdout.isatty():
        return False
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True
