"""Local page of a session, a result or a folder of both, as ``pkmcal view`` opens it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pkmcal.viewing.sources import Source
    from pkmcal.web.guard import Guard


@dataclass(frozen=True, repr=False)
class View:
    """Page to view; in a notebook a result shows itself.

    Attributes
    ----------
    source :
        Document of the page, and the routes of its server.

    """

    source: Source

    def __repr__(self) -> str:
        return f"<View of {self.source.document.title}>"

    @property
    def document(self) -> dict[str, Any]:
        """The viewer's document."""
        return self.source.document.model_dump(mode="json")

    def application(self, token: str, port: int) -> Guard:
        """ASGI application of the page at /TOKEN/ on a port of this computer."""
        from pkmcal.web import serving

        return serving.application(self.source.routes(), token, port)

    def show(self, port: int = 0) -> None:
        """Serve the page to this computer, open it in a browser, and wait for Ctrl-C; where no
        browser opens, print the page's address.

        port : 0 for a free one. Raises InputError if it is taken.
        """
        import webbrowser

        from pkmcal import terminal
        from pkmcal.web.serving import serve

        def announce(address: str) -> None:
            if not webbrowser.open(address):
                terminal.out().print(address, soft_wrap=True)

        serve(self.application, port, announce)

    def _repr_html_(self) -> str | None:
        """Page of a result in a frame, for notebooks; None for a page that needs its server."""
        from pkmcal.web.document import MachineDocument, ReportDocument
        from pkmcal.web.page import page_frame, standalone_page

        document = self.source.document
        if not isinstance(document, MachineDocument | ReportDocument):
            return None
        return page_frame(standalone_page(document), document.title)


def view(source: Path | str, *, calibration: Path | str | None = None) -> View:
    """Page of a session, a result, or a folder with several of both; nothing is written by it,
    except the poses that a user saves into session.yaml.

    Parameters
    ----------
    source :
        A session's folder: its images with the machine laid over, which can be moved to its place.
        A result's folder, or its page or JSON document: its report. Another folder: a list of the
        sessions and results in it.
    calibration :
        Folder of the session's calibration; the one in its own folder by default.

    Returns
    -------
    View
        ``view.show()`` serves it and opens a browser; ``view.document``.

    Raises
    ------
    pkmcal.errors.InputError
        There is nothing to view, or a file has a fault.

    """
    from pkmcal.files import given_path
    from pkmcal.viewing.sources import source_of

    path = given_path(source, "a folder of a session, of a result or of several")
    return View(source_of(path, None if calibration is None else Path(calibration)))
