"""``pkmcal watch``: test of whether a machine has changed since its calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish

WATCH_FILES = {"watch.html": PAGE_DESCRIPTION, "watch.json": NUMBERS_DESCRIPTION}


def watch(
    calibration: console.CalibrationFolder,
    session: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION", help="Five new images from one place, with their readings."
        ),
    ],
    out: Annotated[Path | None, console.folder("SESSION/watch unless given.")] = None,
    alpha: Annotated[
        float, console.number_option("watch", "alpha", "P", "Share of false alarms.")
    ] = 0.01,
    same_place: Annotated[
        list[str] | None,
        typer.Option(
            metavar="STATION",
            help="A station whose camera was not touched since the calibration; repeat for more.",
        ),
    ] = None,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Is the machine still as calibrated? Tests each leg."""
    from pkmcal.files import check_own_folder, default_output
    from pkmcal.judge.watch import watch_machine as run
    from pkmcal.report.watch import outcome_of
    from pkmcal.session.load import load_session

    loaded = load_session(session)
    folder = out or default_output(loaded.folder / "watch")
    check_own_folder(folder, WATCH_FILES, "what watch writes", "an earlier look")
    with console.progress(as_json) as progress:
        tests = run(
            calibration,
            loaded,
            alpha=alpha,
            seed=seed,
            same_place=same_place or (),
            progress=progress,
        )
    return finish(outcome_of(tests), folder, WATCH_FILES, as_json=as_json)
