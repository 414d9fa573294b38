"""``pkmcal reproduce``: the papers' figures recomputed, beside the printed ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import click

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import argument, as_json, command, flag, number, out, seed
from pkmcal.ranges import Paper

EXAMPLES = """\
pkmcal reproduce
pkmcal reproduce a --runs 1000 --long
pkmcal reproduce b c -o papers --json
"""


@command(
    EXAMPLES,
    argument(
        "papers", "[a|b|c]...", "Papers. [default: all]", click.Choice(get_args(Paper)), nargs=-1
    ),
    number("reproduce", "runs", "N", "Simulated runs."),
    seed("reproduce"),
    flag("--long", "Add the accuracy by number of configurations; takes a minute."),
    flag("--photographs images", "Measure paper A's Table 1 on rendered images."),
    out("reproduction", "Folder for the tables."),
    as_json(),
)  # fmt: skip
def reproduce(papers: tuple[str, ...], out: Path | None, as_json: bool, **options: Any) -> int:
    """Recompute the tables and figures of papers A, B and C."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.reproduce import PAPERS, ReproductionResult

        folder = console.output_folder(out, Path("reproduction"), ReproductionResult)
        result = pkmcal.reproduce(papers or PAPERS, progress=progress.work, **options)
        return finish(result, folder, progress, as_json=as_json)
