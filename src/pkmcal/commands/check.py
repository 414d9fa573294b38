"""``pkmcal check``: checks of a session before it is calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import answer, finish
from pkmcal.commands.options import OUTPUT_GROUP, as_json, command, flag, option, seed, session

OVERLAYS_DESCRIPTION = "the nominal model over each image"

EXAMPLES = """\
pkmcal check my-machine
pkmcal check my-machine -o check
pkmcal check my-machine --pictures drawn --seed 1
"""


@command(
    EXAMPLES,
    session(),
    flag("--repeat", "Estimate the accuracy from repeated images as well."),
    seed("check"),
    option(
        "-o --out", "DIR", "Folder for a page with the images. [default: none is written]", Path,
        group=OUTPUT_GROUP,
    ),
    option(
        "--pictures", "DIR", "Folder for the images with the nominal model overlaid, as PNG."
        " [default: none are written]", Path,
        group=OUTPUT_GROUP,
    ),
    as_json(),
)  # fmt: skip
def check(
    session: Path, out: Path | None, pictures: Path | None, as_json: bool, **options: Any
) -> int:
    """Check a session for faults before it is calibrated."""
    import pkmcal
    from pkmcal.errors import InputError

    with console.progress(as_json) as progress:
        from pkmcal.api.check import CheckResult
        from pkmcal.files import check_writable, resolved

        if out is not None:
            CheckResult.check_folder(out)
        if pictures is not None:
            check_writable(pictures)
            if out is not None and resolved(pictures) == resolved(out):
                raise InputError(
                    "the page and the pictures need folders of their own",
                    where="--pictures",
                    found=str(pictures),
                    next_step=f"Name another folder, such as {out}-pictures",
                )
        result = pkmcal.check(session, progress=progress.work, **options)
        more: dict[str, str] = {}
        if pictures is not None:
            progress.report("Drawing", console.WORK_SHARE)
            if result.save_pictures(pictures):
                more[str(pictures)] = OVERLAYS_DESCRIPTION
        if out is not None:
            return finish(result, out, progress, more=more, as_json=as_json)
    return answer(result, None, more=more, as_json=as_json)
