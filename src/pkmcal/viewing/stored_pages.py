"""Documents of the pages that commands wrote, read back from their files."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Annotated, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError

from pkmcal.errors import InputError
from pkmcal.files import check_regular
from pkmcal.web.document import PageDocument
from pkmcal.web.page import DOCUMENT_END, DOCUMENT_START, PAGE_MARK

HEAD_BYTES = 1000
"""Bytes of a file in which the mark of a page stands."""
LARGEST_PAGE_BYTES = 100_000_000

FileState: TypeAlias = tuple[int, int, int] | None


def is_page(path: Path) -> bool:
    """Whether a regular file is a page of the viewer, by its first bytes."""
    try:
        if path.suffix != ".html" or not path.is_file():
            return False
        with path.open("rb") as stream:
            return PAGE_MARK.encode() in stream.read(HEAD_BYTES)
    except OSError:  # a file that cannot be read is no page that can be listed
        return False


def pages_in(folder: Path) -> list[Path]:
    """Pages of the viewer directly in a folder."""
    return sorted(path for path in folder.glob("*.html") if is_page(path))


class StoredPage:
    """Page that a command wrote; it is read again when its file changes.

    Raises InputError where there is no page that can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._document, self._state = stored_document(path), file_state(path)

    def document(self) -> PageDocument:
        """Document of the file as it is now. Raises InputError as `stored_document`."""
        state = file_state(self._path)
        if state != self._state:
            self._document, self._state = stored_document(self._path), state
        return self._document


def file_state(path: Path) -> FileState:
    """Numbers that change when a file is written; None where it is missing."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def stored_document(path: Path) -> PageDocument:
    """Document of a page. Raises InputError for another file, and for a page of another version."""
    try:
        check_regular(path, str(path))
        page = is_page(path) and path.stat().st_size <= LARGEST_PAGE_BYTES
        _, mark, rest = path.read_text("utf-8").partition(DOCUMENT_START) if page else ("", "", "")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text in UTF-8"
        raise InputError(f"cannot be read ({reason})", where=str(path)) from None
    if not mark:
        raise InputError(
            "this is not a page of pkmcal",
            where=str(path),
            expected="a page that a command of pkmcal wrote, such as report.html",
        )
    try:
        return _document_type().validate_json(rest.partition(DOCUMENT_END)[0])
    except ValidationError:
        raise InputError(
            "this page was written by another version of pkmcal, or changed since",
            where=str(path),
            next_step="Open the file itself in a browser, or run its command again",
        ) from None


@cache
def _document_type() -> TypeAdapter[PageDocument]:
    """Validator of a page's document; building it takes as long as reading a report."""
    return TypeAdapter(Annotated[PageDocument, Field(discriminator="kind")])
