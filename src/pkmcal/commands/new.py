"""``pkmcal new``: a commented session to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console

WHAT = {
    "session.yaml": "begin here: what to do, step by step",
    "mechanism.yaml": "the drawing of your machine",
    "cameras/front.yaml": "the calibration of your camera",
    "joints.csv": "one row of readings for each configuration",
    "images/front/README.txt": "where the photographs go",
}


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.")],
    as_json: console.Json = False,
) -> int:
    """Write a commented session to fill in."""
    from pkmcal.session.starter import write_session

    names = write_session(folder)
    if as_json:
        console.print_json({"folder": str(folder), "files": names})
        return 0
    out = console.out()
    out.print("A session to fill in:\n", style="bold")
    ordered = sorted(names, key=list(WHAT).index)
    console.print_files(out, [(str(folder / name), WHAT[name]) for name in ordered])
    out.print(f"\nWhat is still missing: pkmcal check {console.escaped(str(folder))}")
    return 0
