"""``pkmcal calibrate``: calibration of a session's machine, written to files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.ranges import default

EXAMPLES = """\
pkmcal calibrate my-machine
pkmcal calibrate my-machine -o out --holdout 5
pkmcal calibrate my-machine --refine-camera --seed 1 --json
"""


def calibrate(
    session: console.SessionFolder,
    out: Annotated[Path | None, console.folder("SESSION/calibration unless given.")] = None,
    method: Annotated[
        Literal["bundle", "four-step", "linear", "inverse-kinematic"],
        typer.Option(
            metavar="NAME",
            help="bundle, or the papers' own: four-step, linear, inverse-kinematic.",
        ),
    ] = "bundle",
    model: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="A model that the mechanism file names, such as design."),
    ] = None,
    seed: console.Seed = 0,
    refine_camera: Annotated[
        bool,
        typer.Option("--refine-camera", help="Estimate the cameras' intrinsics as well."),
    ] = False,
    holdout: Annotated[
        int,
        console.number_option("calibrate", "holdout", "N", "Leave N poses out, and predict them."),
    ] = default("calibrate", "holdout"),
    force: Annotated[
        bool,
        typer.Option(
            "--force",
            help="Replace an earlier result; otherwise it is kept, dated.",
            rich_help_panel=console.OUTPUT_GROUP,
        ),
    ] = False,
    as_json: console.Json = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", "-q", help="Say nothing if it is well.", rich_help_panel=console.OUTPUT_GROUP
        ),
    ] = False,
) -> int:
    """Calibrate the machine; write model, numbers and report."""
    import pkmcal

    with console.progress(quiet or as_json) as progress:
        from pkmcal.api.calibrate import CalibrationResult
        from pkmcal.calibration.file_names import CALIBRATION_FOLDER

        loaded = pkmcal.load_session(session, model)
        folder = console.output_folder(
            out, loaded.folder / CALIBRATION_FOLDER, CalibrationResult, force=force
        )
        result = pkmcal.calibrate(
            loaded, method=method, seed=seed, refine_camera=refine_camera, holdout=holdout,
            progress=progress.work,
        )  # fmt: skip
        return finish(result, folder, progress, force=force, as_json=as_json, quiet=quiet)
