"""``pkmcal diff``: difference of two calibrations or nominal models, and its effect on the tool; or
of two cameras.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import argument, as_json, command, force, out

if TYPE_CHECKING:
    from pkmcal.api.diff import CameraDiffResult, DiffResult

EXAMPLES = """\
pkmcal diff last-year out
pkmcal diff gough-stewart out
pkmcal diff cameras/front.yaml camera/camera.yaml -o diff --json
"""


@command(
    EXAMPLES,
    argument(
        "a",
        "A",
        "Folder of a calibration, mechanism file, or name of a built-in machine; or a"
        " camera's file.",
    ),
    argument("b", "B", "Another of the same machine, or another camera."),
    out("diff beside the calibration B"),
    force(),
    as_json(),
)
def diff(a: str, b: str, out: Path | None, force: bool, as_json: bool) -> int:
    """Compare two calibrations or nominal models at the tool, or two cameras over the image."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.api.diff import DiffResult
        from pkmcal.files import default_output

        if out is not None:
            DiffResult.check_folder(out)
        result = pkmcal.diff(a, b, progress=progress.work)
        folder = out or default_output(_default_folder(result))
        return finish(result, folder, progress, force=force, as_json=as_json)


def _default_folder(result: DiffResult | CameraDiffResult) -> Path:
    """The folder diff beside the calibration B, or else A, or in the current folder."""
    saved = [getattr(side, "saved", None) for side in (result.b, result.a)]
    saved = saved[0] or saved[1]
    if saved is None:
        return Path("diff")
    # Links are not followed: they may lead out of the user's folder.
    folder = Path(os.path.normpath(saved.path.absolute())).parent.parent / "diff"
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
