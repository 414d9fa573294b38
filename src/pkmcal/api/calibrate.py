"""``pkmcal.calibrate`` and ``pkmcal.load_result``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

from pkmcal.api.result import PAGE_DESCRIPTION, FolderResult
from pkmcal.calibration.calibrate import Calibration, calibrate_session, check_options
from pkmcal.calibration.results import check_output
from pkmcal.calibration.saved_calibration import SavedCalibration, load
from pkmcal.errors import InputError
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.ranges import CalibrationMethod, default
from pkmcal.report.calibration import outcome_of, save
from pkmcal.session.load import Session, load_session


@dataclass(frozen=True, repr=False, eq=False)
class CalibrationResult(Calibration, FolderResult):
    """Calibration with its files.

    ``summary()``, ``parameters``, ``machine``, ``verdict``, ``tool_error(poses)``,
    ``plot_residuals()``, ``plot_parameters()``, ``plot_tool()``, ``save(folder)``, ``show()``.
    Covariances and residuals are in ``estimate``.
    """

    own_files = MappingProxyType(
        {
            "report.html": PAGE_DESCRIPTION,
            "mechanism.yaml": "the calibrated machine",
            "calibration.json": "everything, with covariances",
        }
    )
    kind = ("a calibration", None)

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, cards and sections of the report, and the texts of the files."""
        return outcome_of(self)

    def _repr_html_(self) -> str:
        """The report in a frame; a calibration that was loaded has a table instead."""
        return FolderResult._repr_html_(self) or ""

    @classmethod
    def check_folder(cls, folder: Path | str, *, force: bool = False) -> list[str]:
        """Names of an earlier calibration's files in a folder; InputError for anything else."""
        return check_output(folder, force=force)

    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write the files of ``pkmcal calibrate``: report.html, mechanism.yaml, calibration.json.

        folder : a new or empty one, or one of an earlier calibration, which is kept in a dated
        folder beside it unless ``force`` replaces it. Returns that dated folder, None if nothing
        was kept. Raises InputError if the folder holds anything else, or cannot be written.
        """
        return save(self, folder, force=force, outcome=self.outcome)


def calibrate(
    session: Session | Path | str,
    *,
    method: CalibrationMethod = "bundle",
    seed: int = 0,
    model: str | None = None,
    refine_camera: bool = False,
    holdout: int = default("calibrate", "holdout"),
    progress: Progress | None = None,
) -> CalibrationResult:
    """Calibrate the machine of a session, without writing files.

    Parameters
    ----------
    session :
        A session's folder, or a session loaded by :func:`pkmcal.load_session`.
    method :
        ``bundle``, the joint estimate, or a paper's method for comparison: ``four-step`` ([A]),
        ``linear`` ([B]), ``inverse-kinematic`` ([C]).
    seed :
        Seed of the random search for the stations' poses.
    model :
        One of the models that the mechanism file names, of a session's folder; by default the
        file's own.
    refine_camera :
        Estimate the cameras' intrinsics as well, with their calibration's covariance as prior.
    holdout :
        Number of poses, spread over the workspace, that are not used and on which the result is
        tested; configurations with the same readings are one pose.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    CalibrationResult
        ``result.summary()``, ``result.parameters``, ``result.machine``, ``result.verdict.usable``,
        ``result.tool_error(poses)``, ``result.save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The session or an argument is invalid; the error has the place and the next step.
    pkmcal.errors.ResultError
        These data do not allow a result.

    """
    check_options(method, seed, holdout)
    with whole(progress, "Reading the session") as report:
        if not isinstance(session, Session):
            session = load_session(session, model)
        elif model is not None:
            raise InputError(
                "the model of a loaded session is chosen when it is loaded",
                where="model",
                found=model,
                next_step=f"Load it with pkmcal.load_session(folder, {model!r})",
                code="option.not_applicable",
            )
        calibration = calibrate_session(
            session,
            method=method,
            seed=seed,
            refine_camera=refine_camera,
            holdout=holdout,
            progress=report,
        )
    # release the images, which a long-lived result need not keep in memory
    return CalibrationResult.of(replace(calibration, images={}))


def load_result(source: Path | str) -> SavedCalibration:
    """Read a calibration written by ``pkmcal calibrate`` or ``result.save``.

    Parameters
    ----------
    source :
        A calibration's folder, or the calibration.json in it.

    Returns
    -------
    SavedCalibration
        ``summary()``, ``parameters``, ``machine``, ``tool_error(poses)`` and the plots, as in
        the result of :func:`pkmcal.calibrate`.

    Raises
    ------
    pkmcal.errors.InputError
        The file is missing, is not a calibration, or was edited by hand.

    """
    return load(source)
