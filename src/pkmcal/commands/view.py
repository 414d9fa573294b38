"""``pkmcal view``: local page of a session, a result or a folder of both."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.serve import serve

EXAMPLES = """\
pkmcal view my-machine
pkmcal view my-machine/calibration
pkmcal view my-machine --calibration out --no-browser --port 8000
"""


def view(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="A session, a result that a command wrote, or a folder with some of these.",
        ),
    ],
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Calibration of the session; SESSION/calibration, where it is, unless given.",
        ),
    ] = None,
    port: Annotated[
        int, console.number_option("view", "port", "N", "A free one unless given.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address, and open nothing.")
    ] = False,
    as_json: console.Json = False,
) -> int:
    """Show images with the machine laid over, or a command's results."""
    from pkmcal.api.view import view as run

    opened = run(source, calibration=calibration)
    return serve(opened.application, port, no_browser=no_browser, as_json=as_json)
