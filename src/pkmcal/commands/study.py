"""``pkmcal study``: accuracy of calibrations by simulation, before anything is bought."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, finish
from pkmcal.errors import InputError

STUDY_FOLDER = Path("study")
RUN_ROWS_DESCRIPTION = "one row a run"


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
    ] = 100,
    seed: console.Seed = 0,
    out: Annotated[Path, console.folder("Folder for results and finished batches.")] = STUDY_FOLDER,
    table: Annotated[
        Literal["csv", "parquet"], typer.Option(help="Format of the table of runs.")
    ] = "csv",
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Scheduler of a trusted Dask cluster to use."),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Estimate by simulation how accurate calibrations would be."""
    from importlib.util import find_spec

    from pkmcal.files import check_own_folder, default_output
    from pkmcal.studies.findings import study as simulated
    from pkmcal.studies.store import BATCHES_FOLDER
    from pkmcal.studies.study_report import outcome_of
    from pkmcal.wording import install_step

    if table == "parquet" and find_spec("pyarrow") is None:
        raise InputError(
            "a Parquet table needs pyarrow, which is not installed",
            where="--table",
            next_step=f"{install_step('parquet')}; or leave the option out",
        )
    name = f"study.{table}"
    files = {
        "study.html": PAGE_DESCRIPTION,
        "study.json": NUMBERS_DESCRIPTION,
        name: RUN_ROWS_DESCRIPTION,
    }
    ours = {"study.html", "study.json", "study.csv", "study.parquet", BATCHES_FOLDER}
    if out == STUDY_FOLDER:
        default_output(out)
    over = check_own_folder(out, ours, "a study", "an earlier study")
    try:
        with console.progress(as_json) as progress:
            study = simulated(
                subject, vary or (), runs=runs, seed=seed, out=out, scheduler=scheduler,
                progress=progress,
            )  # fmt: skip
    except KeyboardInterrupt:
        if not as_json:
            console.print_points(
                console.err(),
                [("", f"What is finished lies in {out}; the same command goes on from there.")],
            )
        raise
    return finish(outcome_of(study, table=name), out, files, over=over, as_json=as_json)
