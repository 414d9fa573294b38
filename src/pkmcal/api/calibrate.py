"""``pkmcal.calibrate`` and ``pkmcal.load_result``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from pkmcal.calibration.calibrate import Calibration
from pkmcal.calibration.calibrate import calibrate_session as run
from pkmcal.calibration.saved_calibration import SavedCalibration, load
from pkmcal.report.calibration import save
from pkmcal.report.rrd import write_rrd
from pkmcal.session.load import Session


@dataclass(frozen=True, repr=False)
class CalibrationResult(Calibration):
    """A calibration that can be saved: ``summary()``, ``parameters``, ``machine``, ``verdict``,
    ``tool_error(poses)``, ``plot_residuals()``, ``plot_parameters()``, ``plot_tool()``,
    ``save(folder)`` and ``record(path)``. Covariances and residuals are in ``estimate``.
    """

    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write what ``pkmcal calibrate`` writes: report.html, mechanism.yaml, calibration.json.

        folder : a new or empty one, or one of an earlier calibration, which is kept in a dated
            folder beside it unless ``force`` replaces it.
        Returns that folder, None where nothing was kept. Raises InputError where the folder holds
        anything else, or cannot be written.
        """
        return save(self, folder, force=force)

    def record(self, path: Path | str) -> None:
        """Write a recording, NAME.rrd, of photographs, edges, poses and the result, which rerun's
        viewer plays (``rerun NAME.rrd``).

        Needs ``pip install '.[rerun]'``. Raises InputError without it, or where the file
        cannot be written or a photograph not be read any more.
        """
        write_rrd(self, path)


def calibrate(
    session: Session | Path | str,
    *,
    method: Literal["bundle", "four-step", "linear", "inverse-kinematic"] = "bundle",
    seed: int = 0,
    refine_camera: bool = False,
    holdout: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> CalibrationResult:
    """Calibrate the machine of a session; nothing is written.

    Parameters
    ----------
    session :
        Its folder, or one that :func:`pkmcal.load_session` has loaded.
    method :
        ``bundle``, the joint estimate, or a paper's own for comparison: ``four-step`` ([A]),
        ``linear`` ([B]), ``inverse-kinematic`` ([C]).
    seed :
        Of the random search for the stations' poses.
    refine_camera :
        Estimate the cameras' intrinsics as well, from their calibration's covariance on.
    holdout :
        Poses, spread over the workspace, to leave out and to judge the result by; configurations
        with the same readings are of one pose.
    progress :
        Called with the step in words and the share that is done, 0 to 1.

    Returns
    -------
    CalibrationResult
        ``result.summary()``, ``result.parameters``, ``result.machine``, ``result.verdict.usable``,
        ``result.tool_error(poses)``, ``result.save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The session or an argument is at fault; it says where and what to do.
    pkmcal.errors.ResultError
        Nothing can be said from these data.

    """
    value = run(
        session,
        method=method,
        seed=seed,
        refine_camera=refine_camera,
        holdout=holdout,
        progress=progress,
    )
    # a result that is held should not hold its photographs, too
    retained = replace(value, photographs={})
    return CalibrationResult(**{one.name: getattr(retained, one.name) for one in fields(retained)})


def load_result(source: Path | str) -> SavedCalibration:
    """Read a calibration that ``pkmcal calibrate``, or ``result.save``, has written.

    Parameters
    ----------
    source :
        Its folder, or the calibration.json in it.

    Returns
    -------
    SavedCalibration
        ``summary()``, ``parameters``, ``machine``, ``tool_error(poses)`` and the plots, as of
        :func:`pkmcal.calibrate`.

    Raises
    ------
    pkmcal.errors.InputError
        The file is missing, is no calibration, or was changed by hand.

    """
    return load(source)
