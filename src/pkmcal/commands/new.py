"""``pkmcal new``: template of a session with comments."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from pkmcal.starter import ObservedChoice

SESSION_FILE_DESCRIPTIONS = {
    "session.yaml": "begin here: what to do, step by step",
    "mechanism.yaml": "the nominal model of your machine",
    "cameras/front.yaml": "the calibration of your camera",
    "board.yaml": "the board on the platform",
    "joints.csv": "one row of readings for each configuration",
}
FELT_FILE_DESCRIPTIONS = {
    "session.yaml": "how good the probe is: see whether it is yours",
    "mechanism.yaml": "the printer by its firmware: see whether its tolerances are right",
    "joints.csv": "the carriages when the bed was felt",
    "poses.csv": "the tool's height above the bed there",
}
"""Descriptions of the files of a complete session of a printer."""
IMAGES_DESCRIPTION = "where the images go"


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
            help="A delta printer's printer.cfg, or config.g with M665: its nominal model"
            " and heights.",
        ),
    ] = None,
    probed: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="What the printer said while it probed its bed."),
    ] = None,
    as_json: console.Json = False,
) -> int:
    """Write a commented session to fill in."""
    from pkmcal.starter import write_session

    if printer is not None or probed is not None:
        others = {"--machine": machine, "--legs": legs, "--probed": probed if board else None}
        return _new_printer_session(folder, printer, probed, board, places or 1, others, as_json)
    what: ObservedChoice | None = (
        "both" if board and legs else "board" if board else "legs" if legs else None
    )
    plain = machine is None and what is None and places is None
    if plain and not as_json and on_terminal():
        machine, what, places = _dialogue()
    names = write_session(folder, machine, what, places or 1)
    return _print_session(folder, names, as_json)


def _new_printer_session(
    folder: Path,
    printer: Path | None,
    probed: Path | None,
    board: bool,
    places: int,
    others: Mapping[str, object],
    as_json: bool,
) -> int:
    """Write a printer's session. others : options given in addition, which exclude
    ``--printer``.
    """
    from pkmcal.errors import InputError
    from pkmcal.printers.session import write_printer_session

    if printer is None:
        raise InputError(
            "points of a bed are read with the printer's own values",
            where="--probed",
            expected="--printer FILE besides: its printer.cfg, or its config.g with M665",
        )
    if extra := [name for name, given in others.items() if given]:
        raise InputError(
            "a printer's session is of its heights, or with --board of a board on its tool",
            where="--printer",
            found=" and ".join(extra) + " besides",
            expected="neither --machine nor --legs, and --probed or --board",
        )
    names = write_printer_session(folder, printer, probed, "board" if board else None, places)
    return _print_session(folder, names, as_json, done=not board, of_printer=True)


def _print_session(
    folder: Path,
    names: Sequence[str],
    as_json: bool,
    done: bool = False,
    of_printer: bool = False,
) -> int:
    """Print the files written. done : nothing is missing in the session. of_printer : its nominal
    model is from a firmware's file.
    """
    if as_json:
        console.print_json({"folder": str(folder), "files": names})
        return 0
    out = console.out()
    out.print("A session:\n" if done else "A session to fill in:\n", style="bold")
    printer_files = (
        {"mechanism.yaml": FELT_FILE_DESCRIPTIONS["mechanism.yaml"]} if of_printer else {}
    )
    what = {**SESSION_FILE_DESCRIPTIONS, **(FELT_FILE_DESCRIPTIONS if done else printer_files)}
    described = [name for name in what if name in names]
    others = sorted(set(names) - set(described))
    rows = [(name, what[name]) for name in described] + [
        (name, IMAGES_DESCRIPTION) for name in others
    ]
    console.print_files(out, [(str(folder / name), what) for name, what in rows])
    place = console.escaped(str(folder))
    out.print(
        f"\nNext: pkmcal calibrate {place}"
        if done
        else f"\nWhat is still missing: pkmcal check {place}"
    )
    return 0


def on_terminal() -> bool:
    """Whether a user can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _dialogue() -> tuple[str | None, ObservedChoice | None, int]:
    """Machine, observed parts and number of stations, by a dialogue."""
    from rich.prompt import IntPrompt, Prompt

    from pkmcal.mechanisms import catalogue, load_mechanism

    names = sorted(catalogue())
    console.out().print(f"Built-in machines: {', '.join(names)}.")
    machine = Prompt.ask(
        "Which one is most like yours",
        choices=names, show_choices=False, default="gough-stewart",
    )  # fmt: skip
    nominal = load_mechanism(machine)
    what: ObservedChoice | None = None
    if any(leg.tubes for leg in nominal.document.legs):
        answer = Prompt.ask(
            "What does the camera see of it",
            choices=["legs", "board", "both"], default="legs",
        )  # fmt: skip
        what = "both" if answer == "both" else "board" if answer == "board" else "legs"
    elif nominal.redundancy > 0:
        console.out().print("Its readings alone tell its geometry: no camera is needed.")
        return machine, None, 1
    else:
        console.out().print("Its nominal model has no visible cylinders, so a board is seen.")
    usual = 1 if what is None or what == "board" else 2
    places = IntPrompt.ask("In how many places does the camera stand", default=usual)
    return machine, what, min(max(places, 1), 20)
