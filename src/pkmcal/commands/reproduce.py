"""``pkmcal reproduce``: the papers' figures recomputed, beside the printed ones."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console

REPRODUCTION_FOLDER = Path("reproduction")


class Paper(StrEnum):
    """Papers that can be reproduced."""

    A = "a"
    B = "b"
    C = "c"


def reproduce(
    papers: Annotated[
        list[Paper] | None,
        typer.Argument(metavar="[a|b|c]...", help="Which papers; all unless given."),
    ] = None,
    runs: Annotated[int, console.number_option("reproduce", "runs", "N", "Simulated runs.")] = 100,
    seed: console.Seed = 0,
    long: Annotated[
        bool, typer.Option("--long", help="Accuracy by number of poses too; a minute.")
    ] = False,
    images: Annotated[
        bool, typer.Option("--photographs", help="Measure Table 1 on rendered images.")
    ] = False,
    out: Annotated[Path, console.folder("Where the pages go.")] = REPRODUCTION_FOLDER,
    as_json: console.Json = False,
) -> int:
    """Compute the papers' tables and figures again."""
    from pkmcal.commands.finish import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, answer, contents
    from pkmcal.files import check_own_folder, default_output, write_folder
    from pkmcal.studies.reproduction import Options
    from pkmcal.studies.reproduction import reproduce_paper as computed

    files = {
        paper.value: {
            f"paper-{paper.value}.html": PAGE_DESCRIPTION,
            f"paper-{paper.value}.json": NUMBERS_DESCRIPTION,
        }
        for paper in Paper
    }
    ours = {name for names in files.values() for name in names}
    if out == REPRODUCTION_FOLDER:
        default_output(out)
    check_own_folder(out, ours, "reproductions", "earlier reproductions")
    wanted = [paper.value for paper in dict.fromkeys(papers or list(Paper))]
    with console.progress(as_json) as progress:
        options = Options(runs, seed, long, images, progress)
        outcomes = {paper: computed(paper, options) for paper in wanted}
    texts = {
        name: text
        for paper, outcome in outcomes.items()
        for name, text in contents(outcome, files[paper]).items()
    }
    write_folder(out, texts)
    if not as_json:
        return max(answer(outcome, out, files[paper]) for paper, outcome in outcomes.items())
    code = max(outcome.exit_code for outcome in outcomes.values())
    documents = {paper: outcome.document for paper, outcome in outcomes.items()}
    written = [str(out / name) for name in texts]
    console.print_json({"papers": documents, "files": written, "exit_code": code})
    return code
