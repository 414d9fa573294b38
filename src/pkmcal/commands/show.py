"""``pkmcal show``: a machine in space, with sliders for its readings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.serve import serve

EXAMPLES = """\
pkmcal show gough-stewart
pkmcal show my-machine/mechanism.yaml
pkmcal show out -o machine.html
"""


def show(
    machine: Annotated[
        str,
        typer.Argument(
            metavar="MACHINE",
            help="A built-in machine, a mechanism file, a session or a calibration.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="HTML",
            help="Write a page instead of serving one.",
            rich_help_panel=console.OUTPUT_GROUP,
        ),
    ] = None,
    port: Annotated[
        int, console.number_option("show", "port", "N", "A free one unless given.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address, and open nothing.")
    ] = False,
    as_json: console.Json = False,
) -> int:
    """Show a machine in space, with sliders for its readings."""
    from pkmcal.api.show import show as run
    from pkmcal.errors import GeometryError, InputError

    if out is not None and (port or no_browser):
        raise InputError(
            "this option is for a page that is served",
            where="--port" if port else "--no-browser",
            next_step="Leave it out, or leave out -o",
        )
    try:
        view = run(machine)
        if out is None:
            from pkmcal.web.machine_page import application

            document = view.served()
            return serve(
                lambda token, port: application(view.machine, document, token, port), port,
                no_browser=no_browser, as_json=as_json,
            )  # fmt: skip
        view.save(out)
    except GeometryError as error:  # the nominal model is the user's file
        raise error.as_input(machine) from None
    if as_json:
        console.print_json({"exit_code": 0, "file": str(out)})
    else:
        terminal.print_points(
            terminal.out(),
            [
                (
                    terminal.MARK_SIGNS["good"],
                    f"{view.machine.name} is in {out}: open it in a browser.",
                )
            ],
        )
    return 0
