"""What commands say: results to stdout, progress and errors to stderr, each kind in one way."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Progress = Callable[[str, float], None]

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Of all random draws.")]

MARKS = {"good": "[green]✓[/]", "doubtful": "[yellow]![/]", "wrong": "[red]✗[/]"}


def out() -> Console:
    """The console of results."""
    from rich.console import Console

    return Console(highlight=False)


def err() -> Console:
    """The console of progress and errors."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def print_error(sentence: str) -> None:
    """One error to stderr: wrapped and coloured on a terminal, one line elsewhere."""
    console = err()
    if not console.is_terminal:
        sys.stderr.write(f"Error: {sentence}\n")
        return
    console.print(_hanging("Error:", "bold red", sentence))


def print_json(data: Mapping[str, Any]) -> None:
    """The one JSON object of a command."""
    from pkmcal.files import json_text

    sys.stdout.write(json_text(data))


def print_points(console: Console, points: Iterable[tuple[str, str]]) -> None:
    """Sentences with a mark before each: (mark in markup, text)."""
    for mark, text in points:
        console.print(_hanging(mark, "", text))


def print_files(console: Console, files: Iterable[tuple[str, str]]) -> None:
    """Paths, each with what it is; on one line each where they fit."""
    table = plain_table()
    table.add_column(overflow="fold")
    table.add_column(style="dim")
    for path, what in files:
        table.add_row(escaped(path), what)
    console.print(table)


def plain_table(**options: Any) -> Table:
    """A table without lines, indented by two."""
    from rich.table import Table

    settings: dict[str, Any] = {"box": None, "pad_edge": False, "show_header": False}
    settings |= {"padding": (0, 2, 0, 2 if not options.get("title") else 0)}
    return Table(**{**settings, **options})


def escaped(text: str) -> str:
    """Text that may hold brackets, safe from being taken for markup."""
    from rich.markup import escape

    return escape(text)


@contextmanager
def progress(quiet: bool = False) -> Generator[Progress]:
    """A bar on stderr for as long as the block runs; nothing where that is no terminal."""
    console = err()
    if quiet or not console.is_terminal:
        yield lambda _text, _share: None
        return
    from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeElapsedColumn

    columns = (BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)


def counted(told: Progress, upto: float = 1.0) -> Callable[[int, int], None]:
    """A callback of photographs done and in all, told as a share of `upto`."""
    return lambda done, total: told(f"Photograph {done} of {total}", upto * done / total)


def _hanging(mark: str, style: str, text: str) -> Table:
    """A mark, and text that wraps beside it."""
    table = plain_table(padding=(0, 1, 0, 0))
    table.add_column(style=style, no_wrap=True)
    table.add_column(overflow="fold")
    table.add_row(mark, escaped(text))
    return table
