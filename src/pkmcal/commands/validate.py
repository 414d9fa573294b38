"""``pkmcal validate``: errors of a calibration on independent data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.ranges import default

EXAMPLES = """\
pkmcal validate out new-images
pkmcal validate out my-machine --regions 4
pkmcal validate out new-images -o validation --json
"""


def validate(
    calibration: console.CalibrationFolder,
    session: Annotated[
        Path,
        typer.Argument(metavar="SESSION", help="A session with images that it never saw."),
    ],
    out: Annotated[Path | None, console.folder("SESSION/validation unless given.")] = None,
    regions: Annotated[
        int,
        console.number_option("validate", "regions", "N", "Leave out N regions in turn as well."),
    ] = default("validate", "regions"),
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Errors on data that the calibration did not see."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.validate import ValidationResult

        loaded = pkmcal.load_session(session)
        folder = console.output_folder(out, loaded.folder / "validation", ValidationResult)
        result = pkmcal.validate(
            calibration, loaded, regions=regions, seed=seed, progress=progress.work
        )
        return finish(result, folder, progress, as_json=as_json)
