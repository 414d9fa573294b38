"""``pkmcal.board``: a calibration board as a PDF page in true size."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pkmcal.api.result import Result
from pkmcal.boards.board import Board, load_board
from pkmcal.boards.prints import sheet_pdf
from pkmcal.errors import InputError
from pkmcal.files import check_writable, write_bytes
from pkmcal.outcome import Outcome, Verdict
from pkmcal.outcome.finding import note

PDF_PRODUCER = b"/Producer (pkmcal)"
"""Mark of a page that pkmcal wrote, which may be replaced."""


@dataclass(frozen=True, repr=False)
class BoardResult(Result):
    """Page with a board.

    paper : name of its size. pdf : the page. file : file of the board's description.
    """

    board: Board
    paper: str
    pdf: bytes
    file: Path

    @cached_property
    def outcome(self) -> Outcome:
        """The paper's size, and the instruction for printing."""
        return Outcome(
            command="board",
            title="Calibration board",
            verdict=Verdict(True, f"The board is on a page for paper of size {self.paper}."),
            findings=(note("board.print", self.file.name),),
            document={"paper": self.paper},
        )

    @property
    def file_list(self) -> Mapping[str, str]:
        """The page, named after the board's file."""
        return {self.file.with_suffix(".pdf").name: "the page to print"}

    def contents(self) -> dict[str, str | bytes]:
        """The page."""
        return dict.fromkeys(self.file_list, self.pdf)

    def save(self, folder: Path | str, *, force: bool = False) -> None:
        """Write the page into a folder, or as a file whose name ends in .pdf.

        Raises InputError where a file of this name is not a page that pkmcal wrote.
        """
        del force
        target = self.target(Path(folder))
        check_writable(target.parent)
        regular = target.is_file() and not target.is_symlink()
        if os.path.lexists(target) and not (regular and PDF_PRODUCER in target.read_bytes()):
            raise InputError(
                "the file exists and is not a board of pkmcal, so it was not replaced",
                where=str(target),
                next_step="Name another file with -o",
            )
        write_bytes(target, self.pdf)

    def target(self, place: Path) -> Path:
        """File of the page for the argument of ``save``."""
        return place if place.suffix.lower() == ".pdf" else place / next(iter(self.file_list))

    def path_document(self, folder: Path) -> dict[str, Any]:
        """Path of the page."""
        return {"file": str(self.target(folder))}

    def written_files(self, folder: Path) -> Mapping[str, str]:
        """Path of the page with its description."""
        return dict.fromkeys([str(self.target(folder))], "the page to print")


def board(file: Path | str = "board.yaml", *, paper: str | None = None) -> BoardResult:
    """Make the PDF page of a calibration board in true size, without writing files.

    Parameters
    ----------
    file :
        The board's file, or the folder of a session with a board.yaml.
    paper :
        Name of a paper's size, such as ``a4`` or ``letter``; by default the smallest that holds the
        board.

    Returns
    -------
    BoardResult
        ``pdf``, ``paper``, ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The file is invalid, or the board is larger than the paper.

    """
    path = Path(file) / "board.yaml" if Path(file).is_dir() else Path(file)
    described = load_board(path, label=str(path))
    pdf, name = sheet_pdf(described, paper, path.name)
    return BoardResult(described, name, pdf, path)
