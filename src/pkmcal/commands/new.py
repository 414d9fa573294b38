"""``pkmcal new``: template of a session with comments."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import argument, as_json, command, flag, number, option

EXAMPLES = """\
pkmcal new my-machine
pkmcal new my-machine --machine h4 --board
pkmcal new my-printer --printer printer.cfg
"""
DIMENSIONS_GROUP = "Dimensions of a family (--machine) or of --from"
SPACING = "a fifth of the radius"


def _dimension(name: str, described: str, usual: str = "") -> Any:
    """Option of a length of a family of machines."""
    return number("new", name, "LENGTH", described, usual=usual, group=DIMENSIONS_GROUP)


@command(
    EXAMPLES,
    argument("folder", "DIR", "New or empty folder.", Path),
    option(
        "--machine", "MACHINE", "Name of a built-in machine, mechanism file, or, with dimensions,"
        " hexapod, rotary-hexapod, delta or linear-delta. [default: a dialogue, or gough-stewart]",
    ),
    flag("--legs", "The cameras observe the legs. [default where legs can be observed]"),
    flag("--board", "The cameras observe a board."),
    number("new", "places", "N", "Number of stations.", usual="1"),
    option(
        "--printer", "FILE", "Delta printer's printer.cfg, config.g, Configuration.h, or output of"
        " M503 or M205: source of the nominal model and the probed heights.", Path,
    ),
    option("--probed", "FILE", "Terminal output of the printer's bed probing.", Path),
    option(
        "--part", "FILE", "Distances on a printed part, beside the heights: a YAML file with the"
        " commanded positions of its marks.", Path,
    ),
    option(
        "--firmware", "NAME", "Printer's firmware, if its file does not show it: klipper, marlin,"
        " repetier, reprap or smoothie.",
    ),
    option(
        "--from from_file", "FILE", "MJCF, SDF, or URDF with its file of loops; Klipper's"
        " printer.cfg of a rotary delta or a winch, RepRapFirmware's configuration of a"
        " Hangprinter, or a Maslow 4's calibration log; with --leg, a hexapod's joint centres:"
        " LinuxCNC's HAL file of genhexkins, or a CSV table.",
        Path,
    ),
    option("--unit", "NAME", "Unit of a HAL file's lengths: mm or inch."),
    _dimension("base_radius", "Radius of the circle through the base joints, motors or towers."),
    _dimension("platform_radius", "Radius of the circle through the platform joints."),
    _dimension("leg", "Length of a leg at home, or of a leg's rod."),
    _dimension("arm", "Length of a crank."),
    _dimension("base_spacing", "Distance between the base joints of a pair.", SPACING),
    _dimension("platform_spacing", "Distance between the platform joints of a pair.", SPACING),
    number(
        "new", "arm_angle", "ANGLE", "Direction of a hexapod's level arms, from outwards at their"
        " pair: -90 deg where they face each other.", usual="90 deg", group=DIMENSIONS_GROUP,
    ),
    _dimension("travel", "How far legs change their lengths, or carriages move."),
    _dimension("tube_radius", "Radius of the legs' cylinders."),
    as_json(),
)  # fmt: skip
def new(folder: Path, as_json: bool, **options: Any) -> int:
    """Write a commented session folder to fill in."""
    import pkmcal
    from pkmcal.api.new import NewResult

    NewResult.check_folder(folder)
    if not any(options.values()) and not as_json and on_terminal():
        options = _dialogue()
    with console.progress(as_json) as progress:
        return finish(pkmcal.new(**options), folder, progress, as_json=as_json)


def on_terminal() -> bool:
    """Whether a user can answer."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _dialogue() -> dict[str, Any]:
    """Options by a dialogue: machine, whether a board and the legs are observed, and stations."""
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
            "What does the camera observe",
            choices=["legs", "board", "both"], default="legs",
        )  # fmt: skip
    elif nominal.redundancy > 0:
        terminal.out().print("Its readings alone determine its geometry: no camera is needed.")
        return {"machine": machine}
    else:
        terminal.out().print("Its nominal model has no visible cylinders: a board is observed.")
    usual = 1 if what in ("", "board") else 2
    places = IntPrompt.ask("Number of stations (fixed places of the camera)", default=usual)
    return {
        "machine": machine,
        "board": what in ("board", "both"),
        "legs": what in ("legs", "both"),
        "places": min(max(places, 1), 20),
    }
