"""``pkmcal.validate``: errors of a calibration on data that it did not see."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pkmcal.api.result import FolderResult, page_and_numbers
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.judge.validate import Validation, validate_calibration
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.ranges import default
from pkmcal.report.validation import outcome_of
from pkmcal.session.load import Session


@dataclass(frozen=True, repr=False, eq=False)
class ValidationResult(FolderResult, Validation):
    """Validation with its files: ``judged``, ``regions``, ``paths``, ``verdict``."""

    own_files = page_and_numbers("validation")
    kind = ("a validation", None)

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        return outcome_of(self)


def validate(
    calibration: SavedCalibration | Path | str,
    session: Session | Path | str,
    *,
    regions: int = default("validate", "regions"),
    seed: int = 0,
    progress: Progress | None = None,
) -> ValidationResult:
    """Measure a calibration's errors on a session that it did not use, without writing files.

    Parameters
    ----------
    calibration :
        A calibration's folder, or a calibration loaded by :func:`pkmcal.load_result`.
    session :
        A session with data that the calibration did not use, or its folder.
    regions :
        Number of regions of the session's workspace that are held out in addition, one after the
        other, from a calibration on the rest; the session may then be the calibration's own.
    seed :
        Seed of the localization.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    ValidationResult
        ``verdict``, ``judged``, ``regions``, ``paths``, ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The two do not belong together, or the session has no new data.

    """
    with whole(progress, "Reading the calibration") as report:
        value = validate_calibration(
            calibration, session, regions=regions, seed=seed, progress=report
        )
    return ValidationResult.of(value)
