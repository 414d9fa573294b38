"""``pkmcal watch``: test of whether a machine has changed since its calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import (
    as_json,
    calibration,
    command,
    number,
    option,
    out,
    seed,
    session,
)

EXAMPLES = """\
pkmcal watch out today
pkmcal watch out today --same-place front
pkmcal watch out today -o machine-history
"""


@command(
    EXAMPLES,
    calibration(),
    session("Session with new images and readings; five images from one station suffice."),
    number("watch", "alpha", "P", "False-alarm probability."),
    option(
        "--same-place", "STATION", "Station whose camera has not moved since the calibration."
        " [repeatable; default: none]", multiple=True,
    ),
    seed("watch"),
    out("SESSION/watch", "Folder for the results; an earlier test there starts the run chart."),
    as_json(),
)  # fmt: skip
def watch(calibration: Path, session: Path, out: Path | None, as_json: bool, **options: Any) -> int:
    """Test whether a machine has changed since its calibration."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.watch import WatchResult
        from pkmcal.judge.watch_runs import earlier_runs

        loaded = pkmcal.load_session(session)
        folder = console.output_folder(out, loaded.folder / "watch", WatchResult)
        result = pkmcal.watch(calibration, loaded, progress=progress.work, **options)
        # what is printed has the run chart's history, as the files have
        result = replace(result, earlier=earlier_runs(folder))
        return finish(result, folder, progress, as_json=as_json)
