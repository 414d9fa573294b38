"""``pkmcal show``: a machine in space, with sliders for its readings."""

from __future__ import annotations

from pathlib import Path

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.options import OUTPUT_GROUP, argument, as_json, command, flag, number, option
from pkmcal.commands.serve import serve

EXAMPLES = """\
pkmcal show gough-stewart
pkmcal show my-machine/mechanism.yaml
pkmcal show out -o machine.html
"""


@command(
    EXAMPLES,
    argument(
        "source", "MACHINE", "Name of a built-in machine, mechanism file, or folder of a session"
        " or calibration.",
    ),
    number("show", "port", "N", "Port to listen on.", usual="a free one"),
    flag("--no-browser", "Print the address without opening a browser."),
    option("-o --out", "HTML", "Write a page instead of serving one.", Path, group=OUTPUT_GROUP),
    as_json(),
)  # fmt: skip
def show(source: str, port: int, no_browser: bool, out: Path | None, as_json: bool) -> int:
    """Show a machine in 3-D, with a slider for each joint reading."""
    from pkmcal.api.show import show as run
    from pkmcal.errors import GeometryError, InputError

    if out is not None and (port or no_browser):
        raise InputError(
            "this option is for a page that is served",
            where="--port" if port else "--no-browser",
            next_step="Leave it out, or leave out -o",
            code="option.not_applicable",
        )
    try:
        view = run(source)
        if out is None:
            from pkmcal.web.machine_page import application

            document = view.served()
            return serve(
                lambda token, port: application(view.machine, document, token, port), port,
                no_browser=no_browser, as_json=as_json,
            )  # fmt: skip
        view.save(out)
    except GeometryError as error:  # the nominal model is the user's file
        raise error.as_input(source) from None
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
