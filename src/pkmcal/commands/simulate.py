"""``pkmcal simulate``: a simulated session with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import answer
from pkmcal.ranges import default

EXAMPLES = """\
pkmcal simulate session
pkmcal simulate session --mechanism h4 --board --size 640x480
pkmcal simulate session --plan plan --joint-noise "3 um" --noise 2
"""


def simulate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.")],
    mechanism: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="A built-in machine, or a mechanism file.")
    ] = "gough-stewart",
    camera: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="A camera file, instead of --size.", rich_help_panel="Images"
        ),
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Pixels of an image.", rich_help_panel="Images")
    ] = "800x600",
    stations: Annotated[
        int, console.number_option("simulate", "stations", "N", "Places of the camera.")
    ] = default("simulate", "stations"),
    configurations: Annotated[
        int,
        console.number_option("simulate", "configurations", "N", "Images from each place."),
    ] = default("simulate", "configurations"),
    shared: Annotated[
        bool, typer.Option("--shared", help="The same configurations from all places.")
    ] = False,
    repeats: Annotated[
        int, console.number_option("simulate", "repeats", "N", "Images of each configuration.")
    ] = default("simulate", "repeats"),
    tolerance: Annotated[
        float,
        console.number_option(
            "simulate", "tolerance", "X", "True values' deviation, in tolerances."
        ),
    ] = default("simulate", "tolerance"),
    joint_noise: Annotated[
        float,
        console.number_option("simulate", "joint_noise", "M", "Noise of a reading, m or rad."),
    ] = default("simulate", "joint_noise"),
    noise: Annotated[
        float,
        console.number_option(
            "simulate", "noise", "GREY", "Noise of a pixel, grey levels.", group="Images"
        ),
    ] = default("simulate", "noise"),
    blur: Annotated[
        float,
        console.number_option(
            "simulate", "blur", "PX", "Blur of the lens, pixels.", group="Images"
        ),
    ] = default("simulate", "blur"),
    board: Annotated[
        bool,
        typer.Option(
            "--board",
            help="A board on the base, which joins the stations.",
            rich_help_panel="Board",
        ),
    ] = False,
    on_platform: Annotated[
        bool,
        typer.Option(
            "--on-platform", help="The board on the platform instead.", rich_help_panel="Board"
        ),
    ] = False,
    finish: Annotated[
        Literal["mixed", "matte", "dark", "metal"],
        typer.Option(help="Surface of the legs; metal is polished.", rich_help_panel="Images"),
    ] = "mixed",
    light: Annotated[
        Literal["usual", "soft", "hard"],
        typer.Option(help="From all sides, or hard.", rich_help_panel="Images"),
    ] = "usual",
    as_built: Annotated[
        bool,
        typer.Option(
            "--as-built", help="Motors, rings and cables on the legs.", rich_help_panel="Images"
        ),
    ] = False,
    handheld: Annotated[
        bool,
        typer.Option(
            "--handheld", help="Each image from its own place, --repeats of a configuration."
        ),
    ] = False,
    plan: Annotated[
        Path | None,
        typer.Option(metavar="PLAN", help="What pkmcal plan asked for, with its machine."),
    ] = None,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Simulate a session with images and known truth."""
    import pkmcal

    eye = camera or console.parsed_size(size)
    with console.progress(as_json) as progress:
        result = pkmcal.simulate(
            folder, mechanism, camera=eye, board=board, on_platform=on_platform, noise=noise,
            blur=blur, plan=plan, seed=seed, progress=progress.report, stations=stations,
            configurations=configurations, shared=shared, repeats=repeats, tolerance=tolerance,
            joint_noise=joint_noise, finish=finish, light=light, as_built=as_built,
            handheld=handheld,
        )  # fmt: skip
    return answer(result, folder, as_json=as_json)
