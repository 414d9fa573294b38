"""``pkmcal view``: local page of a session, a result or a folder of both."""

from __future__ import annotations

from pathlib import Path

from pkmcal.commands.options import argument, as_json, command, flag, number, option
from pkmcal.commands.serve import serve

EXAMPLES = """\
pkmcal view my-machine
pkmcal view my-machine/calibration
pkmcal view my-machine --calibration out --no-browser --port 8000
"""


@command(
    EXAMPLES,
    argument(
        "source", "PATH", "Session, result of a command, or folder with some of these.", Path
    ),
    option(
        "--calibration", "DIR", "Calibration to overlay on a session's images."
        " [default: SESSION/calibration, if any]", Path,
    ),
    number("view", "port", "N", "Port to listen on.", usual="a free one"),
    flag("--no-browser", "Print the address without opening a browser."),
    as_json(),
)  # fmt: skip
def view(source: Path, calibration: Path | None, port: int, no_browser: bool, as_json: bool) -> int:
    """Show a session's images with the machine overlaid, or results."""
    from pkmcal.api.view import view as run

    opened = run(source, calibration=calibration)
    return serve(opened.application, port, no_browser=no_browser, as_json=as_json)
