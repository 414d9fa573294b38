"""``pkmcal diff``: difference of two calibrations or nominal models, and its effect on the tool."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish

if TYPE_CHECKING:
    from pkmcal.api.diff import DiffResult

EXAMPLES = """\
pkmcal diff last-year out
pkmcal diff gough-stewart out
pkmcal diff a/mechanism.yaml b/mechanism.yaml -o diff --json
"""


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
        typer.Option(
            "--force",
            help="Replace an earlier one; otherwise it is kept, dated.",
            rich_help_panel=console.OUTPUT_GROUP,
        ),
    ] = False,
    as_json: console.Json = False,
) -> int:
    """Difference of two calibrations or nominal models at the tool."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.diff import DiffResult
        from pkmcal.files import default_output

        if out is not None:
            DiffResult.check_folder(out)
        result = pkmcal.diff(a, b, progress=progress.work)
        folder = out or default_output(_default_folder(result))
        return finish(result, folder, progress, force=force, as_json=as_json)


def _default_folder(result: DiffResult) -> Path:
    """The folder diff beside the calibration B, or else A, or in the current folder."""
    saved = result.b.saved or result.a.saved
    if saved is None:
        return Path("diff")
    # Links are not followed: they may lead out of the user's folder.
    folder = Path(os.path.normpath(saved.path.absolute())).parent.parent / "diff"
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
