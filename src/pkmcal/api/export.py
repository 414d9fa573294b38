"""``pkmcal.export``: files of a machine for other programs."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pkmcal.api.result import Result
from pkmcal.calibration.machine_source import MachineSource, load_source
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.exporters.contract import Export, exporter_of, make_export, write_export
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Outcome, Part, Row, Table, Verdict
from pkmcal.outcome.finding import Level, note
from pkmcal.wording import brief, decimals, number, percent


@dataclass(frozen=True, repr=False)
class ExportResult(Result, Export):
    """Files for another program: ``files``, ``differences`` from the machine, ``notes``, and
    ``values`` under the program's own names.

    source : the machine and its calibration.
    """

    source: MachineSource

    @cached_property
    def outcome(self) -> Outcome:
        """The calibration's verdict, the differences from the machine, and remarks on the use."""
        source = self.source
        compared = tuple(
            note("export.compared", d.what, largest=d.largest, limit=d.limit, unit=d.unit)
            for d in self.differences
        )
        return Outcome(
            command="export",
            title=f"{source.machine.name} as {self.exporter.title}",
            verdict=Verdict(True, f"{source.origin}: {source.headline}"),
            partial=not (source.calibrated and source.usable),
            parts=self._parts(),
            findings=(*compared, *self.notes),
            document=self._document(),
        )

    def _parts(self) -> tuple[Part, ...]:
        """Table of the values with their standard deviations, where these are known."""
        rows: list[Row] = []
        for one in self.values:
            if one.sigma is not None:
                sigma = brief(one.sigma) if one.sigma else "exact"
                share = "" if one.data_share is None else percent(one.data_share)
                cells = (number(one.value, decimals(one.sigma)), sigma, one.unit, share)
                rows.append(Row(one.name, cells, mark=Level.DOUBTFUL if one.by_nominal else None))
        if not rows:
            return ()
        columns = ("Name", "Value", "σ", "Unit", "By the data")
        return (Part("values", "Values", tables=(Table("", columns, tuple(rows), words=(3,)),)),)

    def _document(self) -> dict[str, Any]:
        """Document for programs, without paths."""
        return {
            "format": self.exporter.name,
            "machine": self.source.machine.name,
            "calibrated": self.source.calibrated,
            "usable": self.source.usable,
            "headline": self.source.headline,
            "differences": [
                {"what": d.what, "largest": d.largest, "limit": d.limit, "unit": d.unit}
                for d in self.differences
            ],
            "values": [one._asdict() for one in self.values],
            "notes": [{"level": one.level.value, "text": one.text} for one in self.notes],
        }

    @property
    def file_list(self) -> Mapping[str, str]:
        """The files of the format."""
        return dict.fromkeys(self.files, self.exporter.title)

    def contents(self) -> dict[str, str | bytes]:
        """Texts of the files by name."""
        return dict(self.files)

    def save(self, folder: Path | str, *, force: bool = False) -> None:
        """Write the files, all or none, into a new or empty folder, or over an earlier export.

        Raises InputError if the folder holds anything else, or cannot be written.
        """
        del force
        write_export(self, Path(folder))

    def path_document(self, folder: Path) -> dict[str, Any]:
        """Paths of the files, and the shell command that tries them out, None without one."""
        return {**super().path_document(folder), "trial": self.next_step(folder).strip() or None}

    def next_step(self, folder: Path) -> str:
        """Shell command that tries out the files from the current folder."""
        trial = self.exporter.trial
        return f"  (cd {shlex.quote(str(folder))} && {trial})" if trial else ""


def export(
    calibration: SavedCalibration | Machine | Path | str,
    to: str,
    *,
    session: Path | str | None = None,
    force: bool = False,
) -> ExportResult:
    """Make a machine's files for a controller, a firmware or a simulator, without writing them.

    Parameters
    ----------
    calibration :
        A calibration's folder, a calibration loaded by :func:`pkmcal.load_result`, a machine, a
        mechanism file, or the name of a built-in machine.
    to :
        Name of the format: ``c``, ``hangprinter``, ``json``, ``klipper``, ``linuxcnc``, ``marlin``,
        ``mujoco``, ``repetier``, ``reprap``, ``ros``, ``smoothie``, ``sdf``, ``urdf``, ``yaml``.
    session :
        The calibration's session, for its cameras, where it is not found around the folder.
    force :
        Export a calibration that was refused; the files state that.

    Returns
    -------
    ExportResult
        ``files``, ``differences``, ``notes``, ``values``, ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        There is no such format, calibration or machine, or the format cannot express the machine.
    pkmcal.errors.ResultError
        The calibration was refused.

    """
    exporter_of(to)
    source = load_source(calibration, None if session is None else Path(session))
    return ExportResult.of(make_export(source, to, force=force), source=source)
