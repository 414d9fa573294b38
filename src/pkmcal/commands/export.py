"""``pkmcal export``: files of a machine for other programs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import finish

EXAMPLES = """\
pkmcal export out --to c
pkmcal export out --to mujoco -o model
pkmcal export h4 --to ros --json
"""


def export(
    calibration: Annotated[
        str,
        typer.Argument(
            metavar="CALIBRATION",
            help="The folder that calibrate wrote; or a mechanism file, or a built-in machine.",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            metavar="FORMAT",
            help="c, json, klipper, linuxcnc, marlin, mujoco, repetier, reprap, ros, sdf, smoothie,"
            " urdf or yaml.",
        ),
    ],
    out: Annotated[Path | None, console.folder("export-FORMAT unless given.")] = None,
    session: console.CamerasOf = None,
    force: Annotated[
        bool, typer.Option("--force", help="Export a calibration that was refused.")
    ] = False,
    as_json: console.Json = False,
) -> int:
    """Write the machine for a controller, a firmware or a simulator."""
    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.files import default_output

        result = pkmcal.export(calibration, to, session=session, force=force)
        folder = out or default_output(_default_folder(calibration, to))
        return finish(result, folder, progress, as_json=as_json)


def _default_folder(calibration: str, to: str) -> Path:
    """Folder beside a calibration's folder, or in the current one for a machine's file or name.

    Links are not followed: they may lead out of the user's folder.
    """
    path = Path(calibration)
    folder = path.parent if path.is_file() and path.suffix == ".json" else path
    if (folder / "calibration.json").is_file():
        return Path(os.path.normpath(folder.absolute())).parent / f"export-{to}"
    return Path(f"export-{to}")
