"""``pkmcal simulate``: a simulated session with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import answer
from pkmcal.commands.options import argument, as_json, choice, command, flag, number, option, seed
from pkmcal.ranges import GOOD_ENCODER_SIGMA, Light, Style

EXAMPLES = """\
pkmcal simulate session
pkmcal simulate session --machine h4 --board --size 640x480
pkmcal simulate session --plan plan --joint-noise "3 um" --noise 2
"""


IMAGES, BOARD = "Images", "Board"


@command(
    EXAMPLES,
    argument("folder", "DIR", "New or empty folder.", Path),
    option(
        "--machine mechanism", "MACHINE", "Name of a built-in machine, or mechanism file."
        " [default: gough-stewart]", default="gough-stewart", earlier="--mechanism",
    ),
    number("simulate", "stations", "N", "Number of stations."),
    number("simulate", "configurations", "N", "Configurations for each station."),
    flag("--shared", "All stations observe the same configurations."),
    number("simulate", "repeats", "N", "Images of each configuration."),
    flag("--handheld", "Hand-held camera: each image has its own pose."),
    number(
        "simulate", "tolerance", "X", "Standard deviation of the true geometry, in prior sigmas."
    ),
    number(
        "simulate", "joint_noise", "M", "Sigma of a joint reading.",
        usual=f"the plan's, or {GOOD_ENCODER_SIGMA:g}",
    ),
    number(
        "simulate", "warming", "K", "Warming of the machine over the session; its"
        " temperatures are then in joints.csv."
    ),
    number(
        "simulate", "force", "N", "Mean force on each reading, N, of cranks and spools N m; forces"
        " are then in joints.csv, and stretch legs whose file states how far they yield."
    ),
    option(
        "--plan", "PLAN", "Folder of a plan: its machine, stations, what they observe, and"
        " configurations.", Path,
    ),
    seed("simulate"),
    option("--camera", "FILE", "Camera file, instead of --size.", Path, group=IMAGES),
    option("--size", "WxH", "Image size, px. [default: 800x600]", group=IMAGES),
    number("simulate", "noise", "GREY", "Sigma of a pixel, grey levels.", group=IMAGES),
    number("simulate", "blur", "PX", "Sigma of the lens's blur.", group=IMAGES),
    choice("finish", Style, "Surface of the legs; metal is polished.", group=IMAGES),
    choice("light", Light, "Light: soft from all sides, or hard.", group=IMAGES),
    flag("--as-built", "Add motors, collars and cables to the legs.", group=IMAGES),
    flag("--board", "Add a board on the base that all stations observe.", group=BOARD),
    flag("--on-platform", "Add the board on the platform instead.", group=BOARD),
    as_json(),
)  # fmt: skip
def simulate(
    folder: Path, mechanism: str, camera: Path | None, size: str | None, as_json: bool,
    **options: Any,
) -> int:  # fmt: skip
    """Simulate a session with images and known truth."""
    import pkmcal

    eye = camera or (None if size is None else console.parsed_size(size))
    with console.progress(as_json) as progress:
        result = pkmcal.simulate(folder, mechanism, camera=eye, progress=progress.report, **options)
    return answer(result, folder, as_json=as_json)
