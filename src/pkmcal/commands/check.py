"""``pkmcal check``: checks of a session before it is calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, answer, write_outcome

CHECK_FILES = {"check.html": PAGE_DESCRIPTION, "check.json": NUMBERS_DESCRIPTION}
OVERLAYS_DESCRIPTION = "the nominal model over each image"


def check(
    session: console.SessionFolder,
    out: Annotated[Path | None, console.folder("Write a page with images there.")] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write the nominal model over each image, as PNG."),
    ] = None,
    repeat: Annotated[
        bool,
        typer.Option("--repeat", help="Measure the accuracy by repeated images as well."),
    ] = False,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Find what is wrong with a session before any work is spent."""
    from pkmcal.checks.check import check_session
    from pkmcal.checks.sentences import outcome_of
    from pkmcal.files import check_own_folder, check_writable

    if out is not None:
        check_own_folder(out, CHECK_FILES, "a check")
    if pictures is not None:
        check_writable(pictures)
    study = None
    with console.progress(as_json) as progress:
        check = check_session(session, seed=seed, progress=progress)
        if repeat and check.exit_code < 2:
            from pkmcal.judge.repeatability import study_repeats

            study = study_repeats(session, seed=seed, progress=progress)
        outcome = outcome_of(check, study)
        if repeat:
            repeats = study and study.as_dict()
            outcome = replace(outcome, document={**outcome.document, "repeats": repeats})
        files: dict[str, str] = {}
        if pictures is not None and check.look:
            from pkmcal.checks.pictures import picture_names, write_pictures

            progress("Drawing", 0.95)
            names = picture_names(check.look).values()
            check_own_folder(pictures, names, "pictures of a check", "an earlier check's")
            write_pictures(check.look, pictures)
            files[str(pictures)] = OVERLAYS_DESCRIPTION
        if out is not None:
            if check.look:
                from pkmcal.checks.pictures import with_pictures

                progress("Writing the page", 0.97)
                outcome = replace(outcome, parts=(*outcome.parts, with_pictures(check.look)))
            write_outcome(outcome, out, CHECK_FILES)
            files |= {str(out / name): what for name, what in CHECK_FILES.items()}
    return answer(outcome, Path(), files, as_json=as_json)
