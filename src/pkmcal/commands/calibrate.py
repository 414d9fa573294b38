"""``pkmcal calibrate``: calibration of a session's machine, written to files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import PAGE_DESCRIPTION, answer, write_outcome

CALIBRATION_FILES = {
    "report.html": PAGE_DESCRIPTION,
    "mechanism.yaml": "the calibrated machine",
    "calibration.json": "everything, with covariances",
}


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
    ] = 0,
    force: Annotated[
        bool,
        typer.Option("--force", help="Replace an earlier result; otherwise it is kept, dated."),
    ] = False,
    rrd: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a recording for rerun's viewer as well."),
    ] = None,
    as_json: console.Json = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Say nothing if it is well.")
    ] = False,
) -> int:
    """Calibrate the machine; write model, numbers and report."""
    from pkmcal.calibration.archive import keep_earlier
    from pkmcal.calibration.calibrate import calibrate_session as run
    from pkmcal.calibration.results import check_output
    from pkmcal.files import default_output, output_lock
    from pkmcal.report.calibration import outcome_of
    from pkmcal.report.rrd import check_rrd, write_rrd
    from pkmcal.session.load import load_session

    if rrd is not None:
        check_rrd(rrd)

    loaded = load_session(session, model)
    folder = out or default_output(loaded.folder / "calibration")
    check_output(folder, force=force)
    with console.progress(quiet or as_json) as progress:
        calibration = run(
            loaded,
            method=method,
            seed=seed,
            refine_camera=refine_camera,
            holdout=holdout,
            progress=progress,
        )
        progress("Writing the report", 0.97)
        outcome = outcome_of(calibration)
        with output_lock(folder):  # another process may have written there since the first check
            over = check_output(folder, force=force)
            archive_folder = None if force else keep_earlier(folder, outcome.texts)
            write_outcome(outcome, folder, CALIBRATION_FILES, over)
        files = dict(CALIBRATION_FILES)
        if rrd is not None:
            write_rrd(calibration, rrd)
            files[str(rrd.absolute())] = "rerun opens it"
    return answer(
        outcome, folder, files, archive_folder=archive_folder, as_json=as_json, quiet=quiet
    )
