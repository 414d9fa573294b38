"""``pkmcal.diff``: the difference of two machines, and its effect on the tool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from threadpoolctl import threadpool_limits

from pkmcal.api.result import FolderResult, page_and_numbers
from pkmcal.calibration.archive import keep_earlier
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.files import json_text, output_lock
from pkmcal.judge.difference import MachineDifference, difference
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.report.difference import outcome_of


@dataclass(frozen=True, repr=False, eq=False)
class DiffResult(FolderResult, MachineDifference):
    """Difference of two machines with its files: ``change``, ``centres``, ``tool``, ``verdict``."""

    own_files = page_and_numbers("diff")
    kind = ("a difference", None)

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        return outcome_of(self)

    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write the files; as :meth:`pkmcal.api.result.Result.save`."""
        folder, (page, document) = Path(folder), self.own_files
        self.check_folder(folder)
        texts = {document: json_text(self.outcome.document)}
        with output_lock(folder):  # another process may have written there since
            archive_folder = None if force else keep_earlier(folder, texts, document, page)
            super().save(folder)
        return archive_folder


def diff(
    a: SavedCalibration | Machine | Path | str,
    b: SavedCalibration | Machine | Path | str,
    *,
    progress: Progress | None = None,
) -> DiffResult:
    """Compare two calibrations or nominal models of one machine, without writing files.

    Parameters
    ----------
    a, b :
        Calibrations or their folders, machines, mechanism files, or names of built-in machines.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    DiffResult
        ``change`` (b minus a), ``chance``, ``centres``, ``tool``, ``verdict``, ``summary()``,
        ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        They are not of the same machine.

    """
    with threadpool_limits(1, "blas"), whole(progress, "Comparing"):
        return DiffResult.of(difference(a, b))
