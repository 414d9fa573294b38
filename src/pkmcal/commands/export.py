"""``pkmcal export``: files of a machine for other programs."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.calibration.machine_source import MachineSource
    from pkmcal.exporters.contract import Export


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
            help="c, json, klipper, linuxcnc, mujoco, reprap, ros, sdf, urdf or yaml.",
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
    from pkmcal.calibration.machine_source import load_source
    from pkmcal.exporters.contract import exporter_of, write_export
    from pkmcal.exporters.contract import make_export as run
    from pkmcal.files import default_output

    exporter_of(to)
    source = load_source(calibration, session)
    folder = out or default_output(_default_folder(calibration, to))
    made = run(source, to, force=force)
    write_export(made, folder)
    if as_json:
        console.print_json(summary(made, source, folder))
    else:
        print_export(console.out(), made, source, folder)
    return 0


def _default_folder(calibration: str, to: str) -> Path:
    """Folder beside a calibration's folder, or in the current one for a machine's file or name.

    Links are not followed: they may lead out of the user's folder.
    """
    path = Path(calibration)
    folder = path.parent if path.is_file() and path.suffix == ".json" else path
    if (folder / "calibration.json").is_file():
        return Path(os.path.normpath(folder.absolute())).parent / f"export-{to}"
    return Path(f"export-{to}")


def summary(made: Export, source: MachineSource, folder: Path) -> dict[str, Any]:
    """Document that the command prints for programs."""
    return {
        "exit_code": 0,
        "format": made.exporter.name,
        "machine": source.machine.name,
        "calibrated": source.calibrated,
        "usable": source.usable,
        "headline": source.headline,
        "differences": [
            {"what": d.what, "largest": d.largest, "limit": d.limit, "unit": d.unit}
            for d in made.differences
        ],
        "notes": [{"level": note.level.value, "text": note.text} for note in made.notes],
        "files": {name: str(folder / name) for name in made.files},
        "trial": _trial(made, folder),
    }


def _trial(made: Export, folder: Path) -> str | None:
    """Shell command that tries out the files from the current folder; None if the format has
    none.
    """
    trial = made.exporter.trial
    return f"(cd {shlex.quote(str(folder))} && {trial})" if trial else None


def print_export(out: Console, made: Export, source: MachineSource, folder: Path) -> None:
    """Print the result for people."""
    state = "good" if source.calibrated and source.usable else "doubtful"
    console.print_points(out, [(console.MARK_SIGNS[state], f"{source.origin}: {source.headline}")])
    points = [
        (
            console.MARK_SIGNS["good"],
            f"Read again and compared: {d.what}, {d.largest:.2g} {d.unit} at most.",
        )
        for d in made.differences
    ]
    points += [(console.MARK_SIGNS[note.level.value], note.text) for note in made.notes]
    console.print_points(out, points)
    out.print()
    console.print_files(out, [(str(folder / name), made.exporter.title) for name in made.files])
    if trial := _trial(made, folder):
        out.print()
        # not wrapped, so that it can be copied
        out.print(f"  {trial}", soft_wrap=True, markup=False, highlight=False)
