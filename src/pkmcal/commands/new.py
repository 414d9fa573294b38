"""``pkmcal new``: a commented session to fill in."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from pkmcal.session.starter import Seen

WHAT = {
    "session.yaml": "begin here: what to do, step by step",
    "mechanism.yaml": "the drawing of your machine",
    "cameras/front.yaml": "the calibration of your camera",
    "board.yaml": "the board on the platform",
    "joints.csv": "one row of readings for each configuration",
}
PHOTOGRAPHS = "where the photographs go"


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.")],
    machine: Annotated[
        str | None, typer.Option(metavar="MACHINE", help="A built-in machine, or a drawing's file.")
    ] = None,
    board: Annotated[bool, typer.Option("--board", help="A board on it is seen.")] = False,
    legs: Annotated[
        bool, typer.Option("--legs", help="The legs are seen; the usual where they can be.")
    ] = False,
    places: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, max=20, help="Places that the camera stands in. [1]"),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Write a commented session to fill in."""
    from pkmcal.session.starter import write_session

    seen: Seen | None = "both" if board and legs else "board" if board else "legs" if legs else None
    plain = machine is None and seen is None and places is None
    if plain and not as_json and on_terminal():
        machine, seen, places = _asked()
    names = write_session(folder, machine, seen, places or 1)
    if as_json:
        console.print_json({"folder": str(folder), "files": names})
        return 0
    out = console.out()
    out.print("A session to fill in:\n", style="bold")
    known = [name for name in WHAT if name in names]
    others = sorted(set(names) - set(known))
    rows = [(name, WHAT[name]) for name in known] + [(name, PHOTOGRAPHS) for name in others]
    console.print_files(out, [(str(folder / name), what) for name, what in rows])
    out.print(f"\nWhat is still missing: pkmcal check {console.escaped(str(folder))}")
    return 0


def on_terminal() -> bool:
    """Whether somebody is there to answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _asked() -> tuple[str | None, Seen | None, int]:
    """What somebody at a terminal wants: the machine, what is seen of it, from how many places."""
    from rich.prompt import IntPrompt, Prompt

    from pkmcal.mechanisms import catalogue, load_mechanism

    names = sorted(catalogue())
    console.out().print(f"Built-in machines: {', '.join(names)}.")
    machine = Prompt.ask(
        "Which one is most like yours",
        choices=names, show_choices=False, default="gough-stewart",
    )  # fmt: skip
    drawn = load_mechanism(machine)
    seen: Seen | None = None
    if any(leg.tubes for leg in drawn.document.legs):
        answer = Prompt.ask(
            "What does the camera see of it",
            choices=["legs", "board", "both"], default="legs",
        )  # fmt: skip
        seen = "both" if answer == "both" else "board" if answer == "board" else "legs"
    elif drawn.redundancy > 0:
        console.out().print("Its readings alone tell its geometry: no camera is needed.")
        return machine, None, 1
    else:
        console.out().print("Its drawing has no visible cylinders, so a board is seen.")
    usual = 1 if seen is None or seen == "board" else 2
    places = IntPrompt.ask("In how many places does the camera stand", default=usual)
    return machine, seen, min(max(places, 1), 20)
