"""``pkmcal plan``: the next configurations to measure, and the poses of the camera."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import (
    argument,
    as_json,
    command,
    flag,
    number,
    option,
    out,
    seed,
)
from pkmcal.errors import InputError
from pkmcal.planning.defaults import PLANNED_IMAGE_SIZE
from pkmcal.ranges import RANGES

EXAMPLES = """\
pkmcal plan my-machine
pkmcal plan gough-stewart -n 20 --places 3
pkmcal plan delta --tracker "20 um" --joint-noise "0.001 deg"
"""


FOR_A_SESSION, FOR_A_MACHINE = "For a SESSION", "For a MACHINE"


@command(
    EXAMPLES,
    argument(
        "subject", "SESSION|MACHINE", "Folder of a session; or name of a built-in machine, or"
        " mechanism file.",
    ),
    number(
        "plan", "configurations", "N", "Configurations for each station.",
        flags="-n --configurations", into="count",
    ),
    number("plan", "places", "N", "Choose N stations as well.",
        usual="the session's, or 1 or 3"),
    flag(
        "--together/--apart", "All stations observe each configuration, or each its own."
        " [default: together with several cameras or a tracker]", default=None,
    ),
    number("plan", "edge_noise", "PX", "Sigma of an edge without images."),
    number("plan", "corner_noise", "PX", "Sigma of a board's corner without images."),
    seed("plan"),
    number(
        "plan", "best_of", "N", "Choose N of the session's stations.", usual="all",
        group=FOR_A_SESSION,
    ),
    option(
        "--after", "CALIBRATION", "Calibration to continue from. [default: the session's]", Path,
        group=FOR_A_SESSION,
    ),
    flag("--from-drawing", "Ignore the session's calibration.", group=FOR_A_SESSION),
    flag(
        "--same-place", "The cameras have not moved since the calibration.", group=FOR_A_SESSION
    ),
    option(
        "--camera", "FILE", "Camera file. [default: a pinhole of --size]", Path,
        group=FOR_A_MACHINE,
    ),
    option(
        "--size", "WxH", "Image size without a camera file, px. [default: {}x{}]".format(
            *PLANNED_IMAGE_SIZE
        ), group=FOR_A_MACHINE,
    ),
    flag("--board", "Observe a board on the platform.", group=FOR_A_MACHINE),
    option(
        "--tracker", "M[,RAD]", "Observe by a tracker or probe with this sigma, such as 20 um or"
        " 20 um,0.005 deg. [default: a camera observes]", group=FOR_A_MACHINE,
    ),
    number(
        "plan", "joint_noise", "M", "Sigma of a joint reading.", group=FOR_A_MACHINE
    ),
    number(
        "plan", "reading_resolution", "M", "Step of the joint readings.", group=FOR_A_MACHINE
    ),
    number(
        "plan", "play", "M", "Play: by how much a drive's positions at one reading differ with the"
        " side from which it comes.", group=FOR_A_MACHINE
    ),
    out("SESSION/plan, or plan"),
    as_json(),
)  # fmt: skip
def plan(
    subject: str, camera: Path | None, size: str | None, tracker: str | None, out: Path | None,
    as_json: bool, **options: Any,
) -> int:  # fmt: skip
    """Choose the configurations that determine a machine best."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.plan import PlanResult
        from pkmcal.session.load import session_folder

        folder = console.output_folder(
            out, (session_folder(subject) or Path()) / "plan", PlanResult
        )
        result = pkmcal.plan(
            subject,
            camera=camera or (None if size is None else console.parsed_size(size)),
            tracker=None if tracker is None else _tracker(tracker),
            progress=progress.work,
            **options,
        )
        return finish(result, folder, progress, as_json=as_json)


def _tracker(text: str) -> tuple[float, float | None]:
    """Noise of a tracker, m and rad, from a text such as 2e-5 or 20 um,0.005 deg."""
    from pkmcal.files.quantities import read_quantity

    parts, allowed = text.split(","), RANGES["plan"]["tracker"]
    with suppress(ValueError, InputError):
        numbers = [
            read_quantity(part, unit) for part, unit in zip(parts, ("m", "rad"), strict=False)
        ]
        for one in numbers:
            allowed.check(one, "--tracker")
        if len(numbers) == len(parts):
            return numbers[0], numbers[1] if len(numbers) == 2 else None
    raise InputError(
        "this tracker noise cannot be used",
        where="--tracker",
        found=text,
        expected="metres, and radians where it measures turns, such as 20 um or 20 um,0.005 deg;"
        f" {allowed.text()} each",
    )
