"""``pkmcal view``: local page of a session's images with the machine overlaid."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pkmcal import terminal
from pkmcal.commands import console

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
    from pkmcal.view.server import (
        LOOPBACK_ADDRESS,
        application,
        listening_socket,
        new_token,
        serve_until_interrupted,
    )

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
    token = new_token()
    with listening_socket(port) as socket_:
        port = socket_.getsockname()[1]
        address = f"http://{LOOPBACK_ADDRESS}:{port}/{token}/"
        app = application(viewed, token, port)
        if as_json:
            console.print_json({"url": address})
        else:
            out = terminal.out()
            out.print(f"The page is at\n\n  {address}\n", soft_wrap=True)
            out.print("It is served to this computer only, until you press Ctrl-C.")
        sys.stdout.flush()
        if not no_browser and not as_json and console.can_show():
            import webbrowser

            webbrowser.open(address)
        serve_until_interrupted(app, socket_)
    return 0
