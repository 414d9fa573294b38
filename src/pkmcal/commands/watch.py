"""``pkmcal watch``: test of whether a machine has changed since its calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.ranges import default

EXAMPLES = """\
pkmcal watch out today
pkmcal watch out today --same-place front
pkmcal watch out today -o watch      (again with later sessions: a run chart)
"""


def watch(
    calibration: console.CalibrationFolder,
    session: Annotated[
        Path,
        typer.Argument(
            metavar="SESSION", help="Five new images from one place, with their readings."
        ),
    ],
    out: Annotated[
        Path | None,
        console.folder("SESSION/watch unless given; one with an earlier test adds its run chart."),
    ] = None,
    alpha: Annotated[
        float, console.number_option("watch", "alpha", "P", "Share of false alarms.")
    ] = default("watch", "alpha"),
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
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.watch import WatchResult

        loaded = pkmcal.load_session(session)
        folder = console.output_folder(out, loaded.folder / "watch", WatchResult)
        result = pkmcal.watch(
            calibration, loaded, alpha=alpha, same_place=same_place or (), seed=seed,
            progress=progress.work,
        )  # fmt: skip
        return finish(result, folder, progress, as_json=as_json)
