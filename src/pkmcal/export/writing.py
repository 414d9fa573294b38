"""An export from start to end: refused, made, read again, compared, and then written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pkmcal.errors import InputError, ResultError
from pkmcal.export.contract import Difference, Exporter, exporters
from pkmcal.export.source import Source
from pkmcal.files import check_own_folder, closest, listed, write_folder
from pkmcal.outcome import Finding


@dataclass(frozen=True)
class Export:
    """What was made: texts by file name, how far they are from the machine, and what to know."""

    exporter: Exporter
    files: dict[str, str]
    differences: tuple[Difference, ...]
    notes: tuple[Finding, ...]


def exporter_of(name: str) -> Exporter:
    """A format by its word after ``--to``; InputError lists them."""
    known = exporters()
    if name in known:
        return known[name]
    guess = closest(name, known)
    raise InputError(
        "there is no such format to export to",
        found=name,
        expected=(f"{guess}, or another of " if guess else "") + listed(list(known), 20),
    )


def check_usable(source: Source, force: bool) -> None:
    """Raise ResultError for a calibration that was refused, unless forced."""
    if source.usable or force:
        return
    raise ResultError(
        "this calibration was refused, and is not exported: "
        + " ".join((source.headline, *source.reasons)),
        where=source.origin,
        next_step="Calibrate again; or export it all the same with --force, and its files say so",
    )


def export(source: Source, name: str, *, force: bool = False) -> Export:
    """Make a format's texts, read them again, and compare; nothing is written.

    Raises InputError for a machine that the format cannot express, ResultError for a calibration
    that was refused, and where a text read again is not the machine.
    """
    exporter = exporter_of(name)
    check_usable(source, force)
    files = exporter.files(source)
    differences = tuple(exporter.check(files, source))
    for difference in differences:
        if difference.beyond:
            raise ResultError(
                f"the {name} files, read again, are not the machine ({difference.what});"
                " nothing was written",
                found=f"{difference.largest:.3g} {difference.unit}",
                expected=f"at most {difference.limit:.3g} {difference.unit}",
                next_step="This is a defect of pkmcal: report it, with the mechanism file",
            )
    return Export(exporter, files, differences, tuple(exporter.notes(files, source)))


def write(made: Export, folder: Path) -> None:
    """Write the files, whole or not at all."""
    check_own_folder(folder, made.files, "this export", "an earlier export")
    write_folder(folder, made.files)
