"""``pkmcal study``: accuracy of calibrations by simulation, before anything is bought."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.ranges import default
from pkmcal.studies.varied import DESIGN_NAMES_VARIED, PAPER_NAMES_VARIED

STUDY_FOLDER = Path("study")

EXAMPLES = """\
pkmcal study gough-stewart
pkmcal study h4 --vary configurations=4,15 --vary edge_noise=0.1,0.3
pkmcal study my-machine --vary stations=1,2,3 --runs 200 -o study
"""

FURTHER_HELP = """\
Names of --vary, of a machine or a session:
{}
Names of --vary, of a:
{}
""".format(
    *(
        "\n".join(
            f"  {name:<15} {varied.cell_text}{', ' if varied.unit else ''}{varied.unit}"
            for name, varied in names.items()
        )
        for names in (DESIGN_NAMES_VARIED, PAPER_NAMES_VARIED)
    )
)


def study(
    subject: Annotated[
        str,
        typer.Argument(
            metavar="SUBJECT",
            help="A session's folder, a mechanism file, a built-in machine, or a: [A] 4.3.",
        ),
    ],
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=V1,V2", help="Values to try, every combination; one value sets it."
        ),
    ] = None,
    runs: Annotated[
        int,
        console.number_option("study", "runs", "N", "Simulations of each combination."),
    ] = default("study", "runs"),
    seed: console.Seed = 0,
    out: Annotated[Path, console.folder("Folder for results and finished batches.")] = STUDY_FOLDER,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Scheduler of a trusted Dask cluster to use."),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Estimate by simulation how accurate calibrations would be."""
    import pkmcal

    try:
        with console.progress(as_json) as progress:
            from pkmcal.api.study import StudyResult

            given = None if out == STUDY_FOLDER else out
            folder = console.output_folder(given, STUDY_FOLDER, StudyResult)
            result = pkmcal.study(
                subject, vary or (), runs=runs, seed=seed, out=folder, scheduler=scheduler,
                progress=progress.work,
            )  # fmt: skip
            return finish(result, folder, progress, as_json=as_json)
    except KeyboardInterrupt:
        if not as_json:
            terminal.print_points(
                terminal.err(),
                [("", f"What is finished lies in {out}; the same command goes on from there.")],
            )
        raise
