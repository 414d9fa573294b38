"""``pkmcal check``: checks of a session before it is calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import answer, finish

OVERLAYS_DESCRIPTION = "the nominal model over each image"

EXAMPLES = """\
pkmcal check my-machine
pkmcal check my-machine -o check
pkmcal check my-machine --pictures drawn --repeat
"""


def check(
    session: console.SessionFolder,
    out: Annotated[Path | None, console.folder("Write a page with images there.")] = None,
    pictures: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write the nominal model over each image, as PNG.",
            rich_help_panel=console.OUTPUT_GROUP,
        ),
    ] = None,
    repeat: Annotated[
        bool,
        typer.Option("--repeat", help="Measure the accuracy by repeated images as well."),
    ] = False,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Find what is wrong with a session before any work is spent."""
    import pkmcal
    from pkmcal.errors import InputError

    with console.progress(as_json) as progress:
        from pkmcal.api.check import CheckResult
        from pkmcal.files import check_writable, resolved

        if out is not None:
            CheckResult.check_folder(out)
        if pictures is not None:
            check_writable(pictures)
            if out is not None and resolved(pictures) == resolved(out):
                raise InputError(
                    "the page and the pictures need folders of their own",
                    where="--pictures",
                    found=str(pictures),
                    next_step=f"Name another folder, such as {out}-pictures",
                )
        result = pkmcal.check(session, repeat=repeat, seed=seed, progress=progress.work)
        more: dict[str, str] = {}
        if pictures is not None:
            progress.report("Drawing", console.WORK_SHARE)
            if result.save_pictures(pictures):
                more[str(pictures)] = OVERLAYS_DESCRIPTION
        if out is not None:
            return finish(result, out, progress, more=more, as_json=as_json)
    return answer(result, None, more=more, as_json=as_json)
