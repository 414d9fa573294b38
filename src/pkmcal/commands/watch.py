"""``pkmcal watch``: is a machine still as calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.watch import Watch

WHAT = {"watch.html": "open it in a browser", "watch.json": "everything, for programs"}


def watch(
    calibration: Annotated[
        Path, typer.Argument(metavar="CALIBRATION", help="The folder that calibrate wrote.")
    ],
    session: Annotated[
        Path,
        typer.Argument(metavar="SESSION", help="New photographs with readings, a few are enough."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="SESSION/watch unless given."),
    ] = None,
    alpha: Annotated[
        float,
        typer.Option("--alpha", metavar="P", help="Share of false alarms."),
    ] = 0.01,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Is the machine still as calibrated? Tests each leg."""
    from pkmcal.files import check_own_folder
    from pkmcal.session.load import load_session
    from pkmcal.watch import check_alpha
    from pkmcal.watch import watch as run

    check_alpha(alpha)
    loaded = load_session(session)
    folder = out or loaded.folder / "watch"
    check_own_folder(folder, WHAT, "what watch writes", "an earlier look")
    with console.progress(as_json) as told:
        found = run(calibration, loaded, alpha=alpha, seed=seed, progress=told)
        told("Writing the report", 0.97)
        save(found, folder)
    if as_json:
        console.print_json(summary(found, folder))
    else:
        tell(console.out(), found, folder)
    return exit_code(found)


def exit_code(found: Watch) -> int:
    """1 where the machine changed, or where that cannot be told."""
    return 0 if found.verdict.usable else 1


def save(found: Watch, folder: Path) -> None:
    """Write both files, whole or not at all."""
    from pkmcal.files import json_text, write_folder
    from pkmcal.report.watch_page import watch_html

    texts = {"watch.html": watch_html(found), "watch.json": json_text(found.document())}
    write_folder(folder, texts)


def summary(found: Watch, folder: Path) -> dict[str, Any]:
    """What the command says, for programs."""
    return {
        "exit_code": exit_code(found),
        **found.document(),
        "files": {name: str(folder / name) for name in WHAT},
    }


def tell(out: Console, found: Watch, folder: Path) -> None:
    """What the command says, for people."""
    from rich.table import Table

    from pkmcal.report.watch_page import legs_table

    verdict = found.verdict
    mark = console.MARKS[
        "good" if verdict.usable else "wrong" if found.judged.changed else "doubtful"
    ]
    console.print_points(out, [(mark, verdict.headline)])
    console.print_points(out, [("  [red]•[/]", reason) for reason in verdict.reasons])
    table = legs_table(found, brief=True)
    shown = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for place, heading in enumerate(table.columns):
        shown.add_column(heading, justify="right" if place else "left")
    for row in table.rows:
        shown.add_row(console.escaped(row.name), *row.cells)
    out.print()
    out.print(shown)
    notes = [*found.session.warnings, *verdict.warnings]
    points = [(console.MARKS["doubtful"], note) for note in notes]
    points += [("[cyan]→[/]", advice) for advice in verdict.advice]
    if points:
        out.print()
        console.print_points(out, points)
    out.print()
    console.print_files(out, [(str(folder / name), what) for name, what in WHAT.items()])
