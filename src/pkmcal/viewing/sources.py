"""What `pkmcal view` opens: a session, a result or a folder of both, each a document with the
routes of its page.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

from pkmcal.calibration.file_names import (
    CALIBRATION_DOCUMENT_FILE,
    CALIBRATION_FOLDER,
    CALIBRATION_REPORT_FILE,
)
from pkmcal.errors import InputError, PkmcalError
from pkmcal.files import resolved
from pkmcal.outcome.finding import Level, Mark
from pkmcal.session.load import SESSION_FILE_NAME, load_session
from pkmcal.viewing.content import SessionContent
from pkmcal.viewing.server import session_document, session_routes
from pkmcal.viewing.stored_pages import (
    FileState,
    StoredPage,
    file_state,
    is_page,
    pages_in,
    stored_document,
)
from pkmcal.web.document import (
    AnyDocument,
    FolderDocument,
    FolderEntry,
    MachineDocument,
    PageDocument,
    SessionDocument,
    Verdict,
)
from pkmcal.web.serving import page_routes
from pkmcal.wording import count, date_text

if TYPE_CHECKING:
    from starlette.routing import BaseRoute
    from starlette.types import ASGIApp, Receive, Scope, Send

DEEPEST_RESULT = 4
"""Depth of subfolders that are searched."""
MOST_ENTRIES = 200
"""Sessions and results in a list."""
TONE_MARKS: dict[str, Mark | None] = {
    "good": "good",
    "partial": Level.DOUBTFUL,
    "bad": Level.WRONG,
    "neutral": None,
}


@dataclass(frozen=True)
class Source:
    """Document of a page, and the routes below its address."""

    document: AnyDocument
    routes: Callable[[], list[BaseRoute]]


def source_of(path: Path, calibration: Path | None = None) -> Source:
    """Session, result or folder of both, by what a path holds.

    path : a session's folder or its session.yaml; a result's folder, its page, or its JSON
        document; a folder in which, up to ``DEEPEST_RESULT`` levels deep, sessions and results are.
    calibration : of the session, instead of its own.
    Raises InputError for anything else.
    """
    folder = path.parent if path.name == SESSION_FILE_NAME else path
    if (folder / SESSION_FILE_NAME).exists():
        return session_source(folder, calibration)
    if calibration is not None:
        raise InputError(
            "a calibration can be named for a session alone",
            where="--calibration",
            found=f"{path}, which has no {SESSION_FILE_NAME}",
            next_step="Leave --calibration out, or name the session",
        )
    if not path.is_dir():
        return page_source(_page_beside(path))
    pages = pages_in(path)
    if len(pages) == 1:
        return page_source(pages[0])
    if not pages and (path / CALIBRATION_DOCUMENT_FILE).is_file():
        return page_source(path / CALIBRATION_REPORT_FILE)
    return folder_source(path)


def _page_beside(path: Path) -> Path:
    """Page of a result by one of its files; Raises InputError where there is none."""
    if path.suffix == ".json":
        if path.name == CALIBRATION_DOCUMENT_FILE:
            return path.with_name(CALIBRATION_REPORT_FILE)
        return path.with_suffix(".html")
    if path.suffix == ".html":
        return path
    raise InputError(
        "there is nothing to view here" if path.exists() else "this does not exist",
        where=str(path),
        expected="a session, a result that a command wrote, or a folder with some of these",
    )


# ------------------------------------------------------------------ session and result


def session_source(folder: Path, calibration: Path | None = None) -> Source:
    """Session with a calibration as it is at each request, by default in the session's folder."""
    session = load_session(folder, fewest=1)
    if not session.stations:
        raise InputError(
            "there are no images to be shown",
            where=f"{session.folder / SESSION_FILE_NAME}, stations",
            expected="a station with a camera",
            code="images.none",
        )
    folder = calibration or session.folder / CALIBRATION_FOLDER
    content, report = SessionContent(session, folder), folder / CALIBRATION_REPORT_FILE
    if calibration is not None:
        _ = content.saved  # raises for an unusable file before the page is served

    def document() -> SessionDocument:
        has_report = content.calibration is not None and is_page(report)
        return session_document(content, "report/" if has_report else "")

    def routes() -> list[BaseRoute]:
        from starlette.routing import Mount

        report_page = Mount("/report", app=OnDemand(lambda _: page_source(report)))
        return [*session_routes(content, document), report_page]

    return Source(document(), routes)


def page_source(path: Path) -> Source:
    """Page that a command wrote, as its file is at each request. Raises InputError where there is
    none.
    """
    if not path.exists():
        raise InputError(
            "the page of this result is missing",
            where=str(path),
            expected="the page that its command wrote there",
            next_step="Run the command again",
        )
    page = StoredPage(path)

    def document() -> AnyDocument:
        try:
            return page.document()
        except PkmcalError as error:
            return _fault_document(error)

    return Source(page.document(), lambda: page_routes(document))


# ------------------------------------------------------------------ folder


def folder_source(folder: Path) -> Source:
    """List of the sessions and results in a folder, as it is at each request. Raises InputError for
    a folder without any.
    """
    listing = FolderListing(folder)

    def document() -> AnyDocument:
        try:
            return listing.document()
        except PkmcalError as error:
            return _fault_document(error)

    def open_place(n: int) -> Source:
        path = listing.path(n)
        try:
            return session_source(path) if path.is_dir() else page_source(path)
        except PkmcalError as error:
            raise InputError("this cannot be opened", where=str(path), found=str(error)) from error

    def routes() -> list[BaseRoute]:
        from starlette.routing import Mount

        return [*page_routes(document), Mount("/{n:int}", app=OnDemand(open_place))]

    return Source(listing.document(), routes)


class FolderListing:
    """Sessions and results in a folder; each keeps its number in addresses while others come."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers: dict[Path, int] = {}
        self._pages: dict[Path, tuple[FileState, FolderEntry]] = {}
        self._lock = Lock()  # requests are answered in several threads

    def document(self) -> FolderDocument:
        """List of the folder as it is now. Raises InputError for a folder without any."""
        places = list(islice(_places(self._folder, DEEPEST_RESULT), MOST_ENTRIES + 1))
        if not places:
            raise InputError(
                "there is no session and no result in this folder",
                where=str(self._folder),
                expected=f"{SESSION_FILE_NAME}, or a page that a command of pkmcal wrote",
            )
        note = ""
        if len(places) > MOST_ENTRIES:
            places = places[:MOST_ENTRIES]
            note = f"The first {MOST_ENTRIES} are listed; name a folder in it for others."
        with self._lock:
            entries = tuple(map(self._row, places))
        return FolderDocument(
            program=f"pkmcal {version('pkmcal')}",
            title=resolved(self._folder).name,
            entries=entries,
            note=note,
        )

    def path(self, n: int) -> Path:
        """Folder of a session or page of a result by its number. Raises InputError."""
        paths = list(self._numbers)
        if n >= len(paths):
            raise InputError("there is no such entry", where="the page", found=n)
        return paths[n]

    def _row(self, path: Path) -> FolderEntry:
        """Row of a place; a page that has not changed is not read again."""
        number = self._numbers.setdefault(path, len(self._numbers))
        if path.is_dir():
            return _entry(number, path, self._folder)
        state = file_state(path)
        if path not in self._pages or self._pages[path][0] != state:
            self._pages[path] = state, _entry(number, path, self._folder)
        return self._pages[path][1]


def _places(folder: Path, depth: int) -> Iterator[Path]:
    """Folders of sessions and pages of results, below a folder; links to folders are not
    followed.
    """
    if os.path.isfile(folder / SESSION_FILE_NAME):  # noqa: PTH113 - without an error where forbidden
        yield folder
    yield from pages_in(folder)
    if not depth:
        return
    try:
        with os.scandir(folder) as every:
            own = sorted(one.path for one in every if one.is_dir(follow_symlinks=False))
    except OSError:  # a folder that cannot be read has nothing that can be opened
        return
    for path in map(Path, own):
        if not path.name.startswith("."):
            yield from _places(path, depth - 1)


def _entry(n: int, path: Path, folder: Path) -> FolderEntry:
    """Row of a session or a page."""
    name = str(path.relative_to(folder))
    plain = FolderEntry(
        name=name if name != "." else resolved(folder).name, href=f"{n}/", title="Session",
        date="", mark=None, text="", before="", after="",
    )  # fmt: skip
    if path.is_dir():
        return plain.model_copy(update=_session_summary(path))
    try:
        document = stored_document(path)
    except InputError as error:
        update = {"href": "", "title": "", "mark": Level.WRONG, "text": error.what}
        return plain.model_copy(update=update)
    return plain.model_copy(update=_summary(document))


def _session_summary(folder: Path) -> dict[str, object]:
    """Fields of a session's row: date of its newest image or table of readings, number of images,
    and whether its calibration lies beside it.
    """
    try:
        session = load_session(folder, fewest=1)
    except PkmcalError as error:
        return {"mark": Level.WRONG, "text": error.what}
    files = [image.path for station in session.stations for image in station.images]
    files.append(session.folder / session.document["joints"]["file"])
    newest = datetime.fromtimestamp(max(file.stat().st_mtime for file in files))
    calibrated = (folder / CALIBRATION_FOLDER / CALIBRATION_DOCUMENT_FILE).is_file()
    return {
        "date": date_text(newest),
        "text": f"{count(session.images_taken, 'image')}; {'' if calibrated else 'not '}calibrated",
    }


def _summary(document: PageDocument) -> dict[str, object]:
    """Fields of a row from its document."""
    if isinstance(document, MachineDocument):
        return {"title": document.title, "text": document.subtitle}
    before, after = _tool_errors(document.verdict)
    # a date precedes the program in the origin
    date = document.origin[0] if document.origin[:1] != (document.program,) else ""
    return {
        "title": document.title,
        "date": date,
        "mark": TONE_MARKS[document.verdict.tone],
        "text": f"{document.verdict.stamp}: {document.verdict.headline}",
        "before": before,
        "after": after,
    }


def _tool_errors(verdict: Verdict) -> tuple[str, str]:
    """Tool error by the nominal model and after the calibration; empty texts without both."""
    bar = verdict.comparison
    texts = {one.role: one.text for one in bar.magnitudes} if bar is not None else {}
    if "nominal" in texts and "calibrated" in texts:
        return texts["nominal"], texts["calibrated"]
    return "", ""


class OnDemand:
    """ASGI application of pages that are opened when they are first requested.

    open_source : source by the number in the path, 0 without one. An error becomes a page.
    """

    def __init__(self, open_source: Callable[[int], Source]) -> None:
        self._open = open_source
        self._routers: dict[int, ASGIApp] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """ASGI entry point."""
        from starlette.concurrency import run_in_threadpool
        from starlette.routing import Router

        n = scope["path_params"].get("n", 0)
        router = self._routers.get(n)
        if router is None:
            try:
                source = await run_in_threadpool(self._open, n)
                router = self._routers[n] = Router(routes=source.routes())
            except (PkmcalError, OSError) as error:  # not stored: it may be corrected meanwhile
                fault = _fault_document(error)
                router = Router(routes=page_routes(lambda: fault))
        await router(scope, receive, send)


def _fault_document(error: PkmcalError | OSError) -> FolderDocument:
    """Page of what cannot be opened, with the reason."""
    return FolderDocument(
        program=f"pkmcal {version('pkmcal')}",
        title="This cannot be opened",
        entries=(),
        note=str(error),
    )
