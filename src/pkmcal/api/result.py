"""Results of the public functions: one contract for the terminal, files, the page and JSON.

A result has the attributes of what was computed, such as those of a plan, and those of
:class:`Result`. The command line prints and writes them.
"""

from __future__ import annotations

import webbrowser
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from datetime import datetime
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from types import MappingProxyType
from typing import Any, ClassVar, Self

from pkmcal.arrays import short_repr
from pkmcal.files import check_own_folder, json_text, resolved, write_folder
from pkmcal.outcome import Outcome
from pkmcal.outcome.finding import Finding
from pkmcal.terminal import outcome_text

PAGE_DESCRIPTION = "open it in a browser"
NUMBERS_DESCRIPTION = "everything, for programs"


def page_and_numbers(stem: str) -> Mapping[str, str]:
    """A page and a document of the same name, with their descriptions."""
    return MappingProxyType({f"{stem}.html": PAGE_DESCRIPTION, f"{stem}.json": NUMBERS_DESCRIPTION})


class Result(ABC):
    """Result of a function of :mod:`pkmcal`, with the text, the files and the JSON of its
    command.
    """

    __repr__ = short_repr

    @classmethod
    def of(cls, value: Any, **more: Any) -> Self:
        """Result with the fields of a dataclass from which this class is derived."""
        return cls(**{one.name: getattr(value, one.name) for one in fields(value)}, **more)

    @property
    @abstractmethod
    def outcome(self) -> Outcome:
        """Verdict, tables, figures and sections of the page; made when first needed."""

    @property
    @abstractmethod
    def file_list(self) -> Mapping[str, str]:
        """Names of the files that ``save`` writes, with their descriptions."""

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings, each with its code, level and facts."""
        return (*self.outcome.verdict.findings, *self.outcome.findings)

    @cached_property
    def document(self) -> dict[str, Any]:
        """The object that the command prints with ``--json``, except for paths of files."""
        return printed_document(self.outcome)

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 0 usable, 1 not to be used, 2 wrong input."""
        return self.outcome.exit_code

    def summary(self) -> str:
        """Text that the command prints, without colours."""
        return "\n\n".join(map(outcome_text, self.printed_outcomes))

    @property
    def printed_outcomes(self) -> Sequence[Outcome]:
        """Outcomes that the command prints."""
        return (self.outcome,)

    def contents(self) -> dict[str, str | bytes]:
        """Contents of the files by name: the page, the document, and texts of the outcome."""
        return self.contents_of(self.outcome, self.file_list)

    @staticmethod
    def contents_of(outcome: Outcome, names: Iterable[str]) -> dict[str, str | bytes]:
        """Contents of files by name, with the page and the document of an outcome."""
        from pkmcal.web.report_page import report_page

        texts, made = dict(outcome.texts), datetime.now()
        for name in names:
            if name not in texts:
                page = name.endswith(".html")
                texts[name] = report_page(outcome, made) if page else json_text(outcome.document)
        return texts

    @abstractmethod
    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write the command's files, all or none.

        Raises InputError if the folder holds anything but an earlier result that may be replaced,
        or cannot be written. force : replace an earlier result that would be kept.
        """

    def show(self) -> Path:
        """Write the files into a temporary folder, open the page in a browser, and return its path.

        A result without a page opens as the list of its files.
        """
        folder = resolved(Path(mkdtemp(prefix="pkmcal-")))
        self.save(folder)
        page = next((n for n in self.file_list if n.endswith((".html", ".pdf"))), "")
        webbrowser.open((folder / page).as_uri())
        return folder / page

    def _repr_html_(self) -> str | None:
        """The page in a frame, for notebooks; None for a result without a page."""
        from pkmcal.web.page import page_frame
        from pkmcal.web.report_page import report_page

        if not any(name.endswith(".html") for name in self.file_list):
            return None
        return page_frame(report_page(self.outcome), self.outcome.title)

    def path_document(self, folder: Path) -> dict[str, Any]:
        """Paths of the saved files, for ``--json``."""
        return {"files": {name: str(folder / name) for name in self.file_list}}

    def written_files(self, folder: Path) -> Mapping[str, str]:
        """Paths of the saved files with their descriptions."""
        return {str(folder / name): what for name, what in self.file_list.items()}

    def next_step(self, folder: Path) -> str:
        """Line that follows the saved files on a terminal; empty for none."""
        del folder
        return ""


class FolderResult(Result, ABC):
    """Result in a folder of its own, whose files have fixed names.

    own_files : all files that a result of this kind may write, with their descriptions. kind : the
    result's and an earlier result's name in the message about a folder with other files.
    """

    own_files: ClassVar[Mapping[str, str]]
    kind: ClassVar[tuple[str, str | None]]

    @property
    def file_list(self) -> Mapping[str, str]:
        """Names of the files that ``save`` writes, with their descriptions."""
        return self.own_files

    @classmethod
    def check_folder(cls, folder: Path | str, *, force: bool = False) -> list[str]:
        """Names of an earlier result's files in a folder.

        Raises InputError where the folder holds anything else, or cannot be written. Call it before
        the work whose result goes there. force : the earlier result need not be kept.
        """
        del force
        return check_own_folder(Path(folder), cls.own_files, *cls.kind)

    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write the command's files, all or none; they replace those of an earlier result.

        folder : a new or empty one, or one of an earlier result of this kind. force : replace an
        earlier calibration or difference too, which is otherwise kept in a dated folder beside it;
        that folder is returned, None if nothing was kept. Raises InputError if the folder holds
        anything else, or cannot be written.
        """
        over = self.check_folder(folder, force=force)
        write_folder(Path(folder), self.contents(), over)
        return None


def printed_document(outcome: Outcome) -> dict[str, Any]:
    """The object that a command prints for programs, except for paths of files."""
    document = outcome.document if outcome.summary is None else outcome.summary
    return {"exit_code": outcome.exit_code, **document}
