"""``pkmcal diff``: difference of two calibrations or nominal models, and its effect on the tool."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish

DIFFERENCE_PAGE, DIFFERENCE_DOCUMENT = "diff.html", "diff.json"
DIFFERENCE_FILES = {DIFFERENCE_PAGE: PAGE_DESCRIPTION, DIFFERENCE_DOCUMENT: NUMBERS_DESCRIPTION}


def diff(
    a: Annotated[
        str,
        typer.Argument(
            metavar="A", help="A calibration's folder, a mechanism file, or a built-in machine."
        ),
    ],
    b: Annotated[str, typer.Argument(metavar="B", help="Another of the same machine.")],
    out: Annotated[
        Path | None, console.folder("diff beside the calibration B unless given.")
    ] = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Replace an earlier one; otherwise it is kept, dated."),
    ] = False,
    as_json: console.Json = False,
) -> int:
    """Difference of two calibrations or nominal models at the tool."""
    from threadpoolctl import threadpool_limits

    from pkmcal.calibration.archive import keep_earlier
    from pkmcal.files import check_own_folder, default_output, json_text, output_lock
    from pkmcal.judge.difference import difference
    from pkmcal.report.difference import outcome_of

    if out is not None:
        check_own_folder(out, DIFFERENCE_FILES, "a difference")
    with console.progress(as_json) as progress, threadpool_limits(1, "blas"):
        progress("Comparing", 0.1)
        compared = difference(a, b)
    saved = compared.b.saved or compared.a.saved
    folder = out or Path("diff")
    if out is None:
        if saved is not None:
            # Links are not followed: they may lead out of the user's folder.
            beside, here = Path(os.path.normpath(saved.path.absolute())), Path.cwd()
            beside = beside.parent.parent / "diff"
            folder = beside.relative_to(here) if beside.is_relative_to(here) else beside
        check_own_folder(default_output(folder), DIFFERENCE_FILES, "a difference")
    outcome = outcome_of(compared)
    texts = {DIFFERENCE_DOCUMENT: json_text(outcome.document)}
    with output_lock(folder):  # another process may have written there since
        archive_folder = (
            None if force else keep_earlier(folder, texts, DIFFERENCE_DOCUMENT, DIFFERENCE_PAGE)
        )
        return finish(
            outcome, folder, DIFFERENCE_FILES, archive_folder=archive_folder, as_json=as_json
        )
