"""``pkmcal new``: template of a session with comments."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.finish import finish

EXAMPLES = """\
pkmcal new my-machine
pkmcal new my-machine --machine h4 --board
pkmcal new my-printer --printer printer.cfg
"""


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.")],
    machine: Annotated[
        str | None,
        typer.Option(metavar="MACHINE", help="A built-in machine, or a nominal model's file."),
    ] = None,
    board: Annotated[bool, typer.Option("--board", help="A board on it is seen.")] = False,
    legs: Annotated[
        bool, typer.Option("--legs", help="The legs are seen; the usual where they can be.")
    ] = False,
    places: Annotated[
        int | None,
        console.number_option("new", "places", "N", "Places that the camera stands in; 1."),
    ] = None,
    printer: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A delta printer's printer.cfg, config.g, Configuration.h, or what M503 or M205"
            " printed: its nominal model and heights.",
        ),
    ] = None,
    probed: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="What the printer said while it probed its bed."),
    ] = None,
    firmware: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="The printer's firmware, if its file does not show it: klipper, marlin, repetier,"
            " reprap or smoothie.",
        ),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Write a commented session to fill in."""
    import pkmcal
    from pkmcal.api.new import NewResult

    NewResult.check_folder(folder)
    plain = not (machine or board or legs or places or printer or probed or firmware)
    if plain and not as_json and on_terminal():
        machine, board, legs, places = _dialogue()
    with console.progress(as_json) as progress:
        result = pkmcal.new(
            machine,
            board=board,
            legs=legs,
            places=places,
            printer=printer,
            probed=probed,
            firmware=firmware,
        )
        return finish(result, folder, progress, as_json=as_json)


def on_terminal() -> bool:
    """Whether a user can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _dialogue() -> tuple[str, bool, bool, int]:
    """Machine, whether a board and the legs are observed, and number of stations, by a dialogue."""
    from rich.prompt import IntPrompt, Prompt

    from pkmcal.mechanisms import catalogue, load_mechanism

    names = sorted(catalogue())
    terminal.out().print(f"Built-in machines: {', '.join(names)}.")
    machine = Prompt.ask(
        "Which one is most like yours",
        choices=names, show_choices=False, default="gough-stewart",
    )  # fmt: skip
    nominal = load_mechanism(machine)
    what = ""
    if any(leg.tubes for leg in nominal.document.legs):
        what = Prompt.ask(
            "What does the camera see of it",
            choices=["legs", "board", "both"], default="legs",
        )  # fmt: skip
    elif nominal.redundancy > 0:
        terminal.out().print("Its readings alone tell its geometry: no camera is needed.")
        return machine, False, False, 1
    else:
        terminal.out().print("Its nominal model has no visible cylinders, so a board is seen.")
    usual = 1 if what in ("", "board") else 2
    places = IntPrompt.ask("In how many places does the camera stand", default=usual)
    return machine, what in ("board", "both"), what in ("legs", "both"), min(max(places, 1), 20)
