"""``pkmcal board``: PDF page of a calibration board in true size."""

from __future__ import annotations

from pathlib import Path

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import argument, as_json, command, option, out

EXAMPLES = """\
pkmcal board
pkmcal board my-machine --paper a3
pkmcal board board.yaml -o board.pdf
"""


@command(
    EXAMPLES,
    argument(
        "file", "FILE", "board.yaml, or a session with one. [default: board.yaml]", Path,
        default=Path("board.yaml"),
    ),
    option("--paper", "SIZE", "Paper size: a4, letter, a3... [default: the smallest that fits]"),
    out("board.pdf beside FILE", "PDF file.", "PDF"),
    as_json(),
)  # fmt: skip
def board(file: Path, paper: str | None, out: Path | None, as_json: bool) -> int:
    """Write a calibration board as a PDF page to print in true size."""
    import pkmcal

    with console.progress(as_json) as progress:
        result = pkmcal.board(file, paper=paper)
        path = out or result.file.with_suffix(".pdf")
        return finish(result, path, progress, as_json=as_json)
