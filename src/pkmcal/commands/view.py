"""``pkmcal view``: local page of a session's images with the machine overlaid."""

from __future__ import annotations

from pathlib import Path

from pkmcal.commands.options import as_json, command, flag, number, option, session
from pkmcal.commands.serve import serve

EXAMPLES = """\
pkmcal view my-machine
pkmcal view my-machine --calibration out
pkmcal view my-machine --no-browser --port 8000
"""


@command(
    EXAMPLES,
    session(),
    option(
        "--calibration", "DIR", "Calibration to overlay. [default: SESSION/calibration, if any]",
        Path,
    ),
    number("view", "port", "N", "Port to listen on.", usual="a free one"),
    flag("--no-browser", "Print the address without opening a browser."),
    as_json(),
)  # fmt: skip
def view(
    session: Path, calibration: Path | None, port: int, no_browser: bool, as_json: bool
) -> int:
    """Show images with the machine overlaid, and edit station poses."""
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
