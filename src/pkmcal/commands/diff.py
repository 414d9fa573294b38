"""``pkmcal diff``: two calibrations, or drawings, and what the difference does to the tool."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS, PAGE, finish

FILES = {"diff.html": PAGE, "diff.json": NUMBERS}


def diff(
    a: Annotated[
        str,
        typer.Argument(
            metavar="A", help="A calibration's folder, a mechanism file, or a built-in machine."
        ),
    ],
    b: Annotated[str, typer.Argument(metavar="B", help="Another of the same machine.")],
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Where the page goes.")
    ] = Path("diff"),
    as_json: console.Json = False,
) -> int:
    """Two calibrations or drawings, and what differs at the tool."""
    from threadpoolctl import threadpool_limits

    from pkmcal.files import check_own_folder
    from pkmcal.judge.difference import difference
    from pkmcal.report.difference import outcome_of

    check_own_folder(out, FILES, "a difference")
    with console.progress(as_json) as told, threadpool_limits(1, "blas"):
        told("Comparing", 0.1)
        found = difference(a, b)
    return finish(outcome_of(found), out, FILES, as_json=as_json)
