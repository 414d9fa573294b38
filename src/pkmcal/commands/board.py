"""``pkmcal board``: PDF page of a calibration board in true size."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console


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
    from pkmcal.boards.board import load_board
    from pkmcal.boards.prints import sheet_pdf
    from pkmcal.errors import InputError
    from pkmcal.files import write_bytes

    board_file = file / "board.yaml" if file.is_dir() else file
    target = out or board_file.with_suffix(".pdf")
    pdf, name = sheet_pdf(load_board(board_file, label=str(board_file)), paper)
    there = os.path.lexists(target)
    regular = target.is_file() and not target.is_symlink()
    if there and not (regular and b"/Producer (pkmcal)" in target.read_bytes()):
        raise InputError(
            "this is not a board that pkmcal wrote, and stays as it is",
            where=str(target),
            next_step="Name another file with -o",
        )
    write_bytes(target, pdf)
    if as_json:
        console.print_json({"file": str(target), "paper": name})
        return 0
    console.print_points(
        console.out(),
        [
            (console.MARK_SIGNS["good"], f"The board is in {target}, for paper of size {name}."),
            (
                console.MARK_SIGNS["note"],
                "Print it in actual size (100 %), measure the two rulers, and write what the"
                f" board measures over all into {board_file.name}.",
            ),
        ],
    )
    return 0
