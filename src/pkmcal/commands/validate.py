"""``pkmcal validate``: errors of a calibration on independent data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import as_json, calibration, command, number, out, seed, session

EXAMPLES = """\
pkmcal validate out new-images
pkmcal validate out my-machine --regions 4
pkmcal validate out new-images -o validation --json
"""


@command(
    EXAMPLES,
    calibration(),
    session("Session with images that the calibration did not use."),
    number("validate", "regions", "N", "Leave out N regions of the workspace in turn as well."),
    seed("validate"),
    out("SESSION/validation"),
    as_json(),
)
def validate(
    calibration: Path, session: Path, out: Path | None, as_json: bool, **options: Any
) -> int:
    """Measure a calibration's errors on data that it did not use."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.validate import ValidationResult

        loaded = pkmcal.load_session(session)
        folder = console.output_folder(out, loaded.folder / "validation", ValidationResult)
        result = pkmcal.validate(calibration, loaded, progress=progress.work, **options)
        return finish(result, folder, progress, as_json=as_json)
