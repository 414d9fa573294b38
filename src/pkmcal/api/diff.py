"""``pkmcal.diff``: the difference of two machines, and its effect on the tool."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeGuard

from threadpoolctl import threadpool_limits

from pkmcal.api.result import FolderResult, page_and_numbers
from pkmcal.calibration.archive import keep_earlier
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.cameras.contract import Camera
from pkmcal.cameras.files import is_camera_file
from pkmcal.errors import InputError
from pkmcal.files import json_text, output_lock
from pkmcal.judge.camera_difference import CameraDifference, camera_difference
from pkmcal.judge.difference import MachineDifference, difference
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.report.camera_difference import outcome_of as camera_outcome
from pkmcal.report.difference import outcome_of


class DifferenceFiles(FolderResult, ABC):
    """Files of a difference; those of an earlier one are kept beside them."""

    own_files = page_and_numbers("diff")
    kind = ("a difference", None)

    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write the files; as :meth:`pkmcal.api.result.Result.save`."""
        folder, (page, document) = Path(folder), self.own_files
        self.check_folder(folder)
        texts = {document: json_text(self.outcome.document)}
        with output_lock(folder):  # another process may have written there since
            archive_folder = None if force else keep_earlier(folder, texts, document, page)
            super().save(folder)
        return archive_folder


@dataclass(frozen=True, repr=False, eq=False)
class DiffResult(DifferenceFiles, MachineDifference):
    """Difference of two machines with its files: ``change``, ``centres``, ``tool``, ``verdict``."""

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        return outcome_of(self)


@dataclass(frozen=True, repr=False, eq=False)
class CameraDiffResult(DifferenceFiles, CameraDifference):
    """Difference of two cameras with its files: ``difference``, ``sigma``, ``chance``."""

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        return camera_outcome(self)


def diff(
    a: SavedCalibration | Machine | Camera | Path | str,
    b: SavedCalibration | Machine | Camera | Path | str,
    *,
    progress: Progress | None = None,
) -> DiffResult | CameraDiffResult:
    """Compare two calibrations or nominal models of one machine, or two cameras, without writing
    files.

    Parameters
    ----------
    a, b :
        Calibrations or their folders, machines, mechanism files, or names of built-in machines; or
        cameras or their files.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    DiffResult
        ``change`` (b minus a), ``chance``, ``centres``, ``tool``, ``verdict``, ``summary()``,
        ``save(folder)``.
    CameraDiffResult
        ``difference`` (rows, columns, 2) px, B's pixel minus A's after the best rotation,
        ``sigma``, ``chance``, ``verdict``, of two cameras.

    Raises
    ------
    pkmcal.errors.InputError
        They are not of the same machine, or not cameras of images of one size.

    """
    with threadpool_limits(1, "blas"), whole(progress, "Comparing"):
        if _is_camera(a) and _is_camera(b):
            return CameraDiffResult.of(camera_difference(a, b))
        if isinstance(a, Camera) or isinstance(b, Camera) or _is_camera(a) or _is_camera(b):
            raise InputError(
                "one of the two is a camera",
                found=f"{a} and {b}",
                expected="two cameras' files, or two calibrations or mechanism files",
                code="difference.kinds",
            )
        return DiffResult.of(difference(a, b))


def _is_camera(side: object) -> TypeGuard[Camera | Path | str]:
    return isinstance(side, Camera) or (isinstance(side, Path | str) and is_camera_file(side))
