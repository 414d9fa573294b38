"""``pkmcal validate``: errors of a calibration on independent data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish

VALIDATION_FILES = {"validation.html": PAGE_DESCRIPTION, "validation.json": NUMBERS_DESCRIPTION}


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
    ] = 0,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Errors on data that the calibration did not see."""
    from pkmcal.files import check_own_folder, default_output
    from pkmcal.judge.validate import validate_calibration as run
    from pkmcal.report.validation import outcome_of
    from pkmcal.session.load import load_session

    loaded = load_session(session)
    folder = out or default_output(loaded.folder / "validation")
    check_own_folder(folder, VALIDATION_FILES, "a validation")
    with console.progress(as_json) as progress:
        outcome = run(calibration, loaded, regions=regions, seed=seed, progress=progress)
    return finish(outcome_of(outcome), folder, VALIDATION_FILES, as_json=as_json)
