"""``pkmcal validate``: a calibration on data that it did not see."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.outcome import Table
    from pkmcal.validation import Validation

WHAT = {
    "validation.html": "open it in a browser",
    "validation.json": "everything, for programs",
}


def validate(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="The folder that calibrate wrote.")
    ],
    session: Annotated[
        Path,
        typer.Argument(metavar="SESSION", help="A session with photographs that it never saw."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="SESSION/validation unless given."),
    ] = None,
    regions: Annotated[
        int,
        typer.Option("--regions", metavar="N", min=0, help="Leave out N regions in turn as well."),
    ] = 0,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Errors on data that the calibration did not see."""
    from pkmcal.files import check_own_folder
    from pkmcal.session.load import load_session
    from pkmcal.validation import validate as run

    loaded = load_session(session)
    folder = out or loaded.folder / "validation"
    check_own_folder(folder, WHAT, "a validation")
    with console.progress(as_json) as told:
        found = run(calibration, loaded, regions=regions, seed=seed, progress=told)
        told("Writing the report", 0.97)
        save(found, folder)
    if as_json:
        console.print_json(summary(found, folder))
    else:
        tell(console.out(), found, folder)
    return exit_code(found)


def exit_code(found: Validation) -> int:
    """1 where the calibration is not confirmed."""
    return 0 if found.verdict.usable else 1


def save(found: Validation, folder: Path) -> None:
    """Write both files, whole or not at all."""
    from pkmcal.files import json_text, write_folder
    from pkmcal.report.validation_page import validation_html

    texts = {
        "validation.html": validation_html(found),
        "validation.json": json_text(found.document()),
    }
    write_folder(folder, texts)


def summary(found: Validation, folder: Path) -> dict[str, Any]:
    """What the command says, for programs."""
    return {
        "exit_code": exit_code(found),
        **found.document(),
        "files": {name: str(folder / name) for name in WHAT},
    }


def tell(out: Console, found: Validation, folder: Path) -> None:
    """What the command says, for people."""
    from pkmcal.report.validation_page import joints_of, paths_table, regions_table, tables

    verdict = found.verdict
    mark = console.MARKS["good" if verdict.usable else "wrong"]
    console.print_points(out, [(mark, verdict.headline)])
    console.print_points(out, [("  [red]•[/]", reason) for reason in verdict.reasons])
    shown = list(tables(found))
    if found.paths:
        shown.append(paths_table(found.paths))
    if found.regions:
        shown.append(regions_table(found.regions, joints_of(found.session)))
    for one in shown:
        _table(out, one)
    notes = [*found.session.warnings, *verdict.warnings]
    points = [(console.MARKS["doubtful"], note) for note in notes]
    points += [("[cyan]→[/]", advice) for advice in verdict.advice]
    if points:
        out.print()
        console.print_points(out, points)
    out.print()
    console.print_files(out, [(str(folder / name), what) for name, what in WHAT.items()])


def _table(out: Console, table: Table) -> None:
    from rich.table import Table as Rich

    shown = Rich(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for place, heading in enumerate(table.columns):
        shown.add_column(heading, justify="right" if place else "left")
    for row in table.rows:
        shown.add_row(console.escaped(row.name), *row.cells)
    out.print()
    console.print_points(out, [("", table.title)])
    out.print(shown)
