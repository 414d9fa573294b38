"""``pkmcal reproduce``: the papers' figures recomputed, beside the printed ones."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.ranges import default

REPRODUCTION_FOLDER = Path("reproduction")


class Paper(StrEnum):
    """Papers that can be reproduced."""

    A = "a"
    B = "b"
    C = "c"


EXAMPLES = """\
pkmcal reproduce
pkmcal reproduce a --runs 1000 --long
pkmcal reproduce b c -o papers --json
"""


def reproduce(
    papers: Annotated[
        list[Paper] | None,
        typer.Argument(metavar="[a|b|c]...", help="Which papers; all unless given."),
    ] = None,
    runs: Annotated[
        int, console.number_option("reproduce", "runs", "N", "Simulated runs.")
    ] = default("reproduce", "runs"),
    seed: console.Seed = 0,
    long: Annotated[
        bool, typer.Option("--long", help="Accuracy by number of poses too; a minute.")
    ] = False,
    images: Annotated[
        bool, typer.Option("--photographs", help="Measure Table 1 on rendered images.")
    ] = False,
    out: Annotated[Path, console.folder("Where the tables go.")] = REPRODUCTION_FOLDER,
    as_json: console.Json = False,
) -> int:
    """Compute the papers' tables and figures again."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.reproduce import ReproductionResult

        given = None if out == REPRODUCTION_FOLDER else out
        folder = console.output_folder(given, REPRODUCTION_FOLDER, ReproductionResult)
        wanted = [paper.value for paper in papers or Paper]
        result = pkmcal.reproduce(
            wanted, runs=runs, seed=seed, long=long, images=images, progress=progress.work
        )
        return finish(result, folder, progress, as_json=as_json)
