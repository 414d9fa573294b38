"""``pkmcal reproduce``: the papers' figures computed again, beside what the papers print."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.outcome import Table
    from pkmcal.report.reproduction import Reproduction

MARKED = {True: "good", False: "wrong"}
WHAT = {".html": "open it in a browser", ".json": "everything, for programs"}
STYLES = {"paper": "yellow", "prototype": "dim", "ours": ""}


class Paper(StrEnum):
    """A paper that can be reproduced; its figures are in pkmcal.reproduce.paper_x."""

    A = "a"
    C = "c"


def reproduce(
    papers: Annotated[
        list[Paper] | None,
        typer.Argument(metavar="[a|c]...", help="Which papers; all unless given."),
    ] = None,
    runs: Annotated[
        int, typer.Option(metavar="N", min=2, max=100_000, help="Simulated runs.")
    ] = 100,
    seed: console.Seed = 0,
    long: Annotated[
        bool, typer.Option("--long", help="Accuracy by number of poses too; a minute.")
    ] = False,
    photographs: Annotated[
        bool, typer.Option("--photographs", help="Measure Table 1 on rendered photographs.")
    ] = False,
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="DIR", help="Where the pages go.")
    ] = Path("reproduction"),
    as_json: console.Json = False,
) -> int:
    """Compute the papers' tables and figures again."""
    from pkmcal.files import check_own_folder
    from pkmcal.reproduce import Options
    from pkmcal.reproduce import reproduce as computed

    ours = {f"paper-{paper.value}{ending}" for paper in Paper for ending in WHAT}
    check_own_folder(out, ours, "reproductions", "earlier reproductions")
    wanted = list(dict.fromkeys(papers or list(Paper)))
    with console.progress(as_json) as told:
        options = Options(runs, seed, long, photographs, told)
        found = [computed(paper.value, options) for paper in wanted]
    files = save(found, out)
    code = 0 if all(one.passed for one in found) else 1
    if as_json:
        documents = {one.letter: one.document() for one in found}
        console.print_json({"papers": documents, "files": files, "exit_code": code})
        return code
    terminal = console.out()
    for one in found:
        tell(terminal, one)
    console.print_files(terminal, [(path, WHAT[Path(path).suffix]) for path in files])
    return code


def save(found: list[Reproduction], folder: Path) -> list[str]:
    """Write a page and a JSON file a paper; returns their paths."""
    from pkmcal.files import json_text, write_folder
    from pkmcal.report.reproduction import reproduction_html

    texts: dict[str, str] = {}
    for one in found:
        texts[f"paper-{one.letter}.html"] = reproduction_html(one)
        texts[f"paper-{one.letter}.json"] = json_text(one.document())
    write_folder(folder, texts)
    return [str(folder / name) for name in texts]


def tell(out: Console, found: Reproduction) -> None:
    """Headline, tables, remarks and expectations."""
    mark = console.MARKS[MARKED[found.passed]]
    out.print(found.cited, style="dim", markup=False)
    out.print()
    console.print_points(out, [(mark, found.headline)])
    for part in found.parts:
        for table in part.tables:
            if table.brief:
                _tell_table(out, table)
    out.print()
    console.print_points(out, [(console.MARKS["note"], text) for text in found.remarks])
    out.print()
    points = [(console.MARKS[MARKED[c.passed]], c.sentence) for c in found.checks]
    console.print_points(out, points)
    out.print()


def _tell_table(out: Console, table: Table) -> None:
    from rich.table import Table as RichTable

    shown = RichTable(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for place, column in enumerate(table.columns):
        shown.add_column(column, justify="right" if place else "left", no_wrap=True)
    for row in table.rows:
        cells = (console.escaped(text) for text in (row.name, *row.cells))
        shown.add_row(*cells, style=STYLES[row.source])
    out.print()
    out.print(table.title, style="bold", markup=False)
    out.print(shown)
