"""``pkmcal export``: files of a machine for other programs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import argument, as_json, cameras_session, command, flag, option, out

EXAMPLES = """\
pkmcal export out --to c
pkmcal export out --to mujoco -o model
pkmcal export h4 --to urdf --json
"""


@command(
    EXAMPLES,
    argument(
        "calibration", "CALIBRATION|MACHINE", "Folder that calibrate wrote; or mechanism file, or"
        " name of a built-in machine.",
    ),
    option(
        "--to", "FORMAT", "c, hangprinter, json, klipper, linuxcnc, marlin, mujoco, repetier,"
        " reprap, ros, sdf, smoothie, urdf or yaml.",
        required=True,
    ),
    cameras_session(),
    flag("--force", "Export a calibration that should not be used."),
    out("export-FORMAT beside the calibration"),
    as_json(),
)  # fmt: skip
def export(calibration: str, to: str, out: Path | None, as_json: bool, **options: Any) -> int:
    """Write a machine for a controller, a firmware or a simulator."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.files import default_output

        result = pkmcal.export(calibration, to, **options)
        folder = out or default_output(_default_folder(calibration, to))
        return finish(result, folder, progress, as_json=as_json)


def _default_folder(calibration: str, to: str) -> Path:
    """Folder beside a calibration's folder, or in the current one for a machine's file or name.

    Links are not followed: they may lead out of the user's folder.
    """
    path = Path(calibration)
    folder = path.parent if path.is_file() and path.suffix == ".json" else path
    if (folder / "calibration.json").is_file():
        beside = Path(os.path.normpath(folder.absolute())).parent / f"export-{to}"
        return beside if folder.is_absolute() else Path(os.path.relpath(beside))
    return Path(f"export-{to}")
