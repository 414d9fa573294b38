"""``pkmcal view``: local page of a session's images with the machine overlaid."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.serve import serve

EXAMPLES = """\
pkmcal view my-machine
pkmcal view my-machine --calibration out
pkmcal view my-machine --no-browser --port 8000
"""


def view(
    session: console.SessionFolder,
    calibration: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="SESSION/calibration, where it is, unless given."),
    ] = None,
    port: Annotated[
        int, console.number_option("view", "port", "N", "A free one unless given.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address, and open nothing.")
    ] = False,
    as_json: console.Json = False,
) -> int:
    """Show images with the machine laid over; move it there."""
    from pkmcal.errors import InputError
    from pkmcal.session.load import load_session
    from pkmcal.view.content import Viewed
    from pkmcal.view.server import application

    loaded = load_session(session)
    if not loaded.stations:
        raise InputError(
            "there are no images to be shown",
            where=f"{loaded.folder / 'session.yaml'}, stations",
            expected="a station with a camera",
        )
    beside = loaded.folder / "calibration"
    viewed = Viewed(
        loaded, calibration or (beside if (beside / "calibration.json").is_file() else None)
    )
    if calibration is not None:
        _ = viewed.saved  # raises for an unusable file before the page is served
    return serve(
        lambda token, port: application(viewed, token, port), port,
        no_browser=no_browser, as_json=as_json,
    )  # fmt: skip
