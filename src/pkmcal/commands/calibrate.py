"""``pkmcal calibrate``: calibration of a session's machine, written to files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import (
    OUTPUT_GROUP,
    as_json,
    choice,
    command,
    flag,
    force,
    number,
    option,
    out,
    seed,
    session,
)
from pkmcal.ranges import CalibrationMethod

EXAMPLES = """\
pkmcal calibrate my-machine
pkmcal calibrate my-machine -o out --holdout 5
pkmcal calibrate my-machine --refine-camera --seed 1 --json
"""


@command(
    EXAMPLES,
    session(),
    choice("method", CalibrationMethod, "bundle, the joint estimate, or a method of the papers."),
    option(
        "--model",
        "NAME",
        "Model under models in the mechanism file, such as design. [default: the file's own ties]",
    ),
    flag("--refine-camera", "Estimate the cameras' intrinsics as well."),
    number("calibrate", "holdout", "N", "Configurations left out and predicted."),
    seed("calibrate"),
    out("SESSION/calibration"),
    force(),
    flag("-q --quiet", "Print nothing if the result is usable.", group=OUTPUT_GROUP),
    as_json(),
)
def calibrate(
    session: Path, model: str | None, out: Path | None, force: bool, quiet: bool, as_json: bool,
    **options: Any,
) -> int:  # fmt: skip
    """Calibrate a session's machine; write the model and a report."""
    import pkmcal

    with console.progress(quiet or as_json) as progress:
        from pkmcal.api.calibrate import CalibrationResult
        from pkmcal.calibration.file_names import CALIBRATION_FOLDER

        loaded = pkmcal.load_session(session, model)
        folder = console.output_folder(
            out, loaded.folder / CALIBRATION_FOLDER, CalibrationResult, force=force
        )
        result = pkmcal.calibrate(loaded, progress=progress.work, **options)
        return finish(result, folder, progress, force=force, as_json=as_json, quiet=quiet)
