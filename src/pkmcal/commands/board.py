"""``pkmcal board``: PDF page of a calibration board in true size."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish

EXAMPLES = """\
pkmcal board
pkmcal board my-machine --paper a3
pkmcal board board.yaml -o board.pdf
"""


def board(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="board.yaml, or a session with one.")
    ] = Path("board.yaml"),
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="PDF", help="[board.pdf beside FILE]")
    ] = None,
    paper: Annotated[
        str | None,
        typer.Option(metavar="PAPER", help="a4, letter, a3 … [the smallest]"),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Write a board as a PDF page to print in true size."""
    import pkmcal

    with console.progress(as_json) as progress:
        result = pkmcal.board(file, paper=paper)
        path = out or result.file.with_suffix(".pdf")
        return finish(result, path, progress, as_json=as_json)
