"""``pkmcal.watch``: whether a machine has changed since its calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from pkmcal.api.result import FolderResult, page_and_numbers
from pkmcal.calibration.saved_calibration import SavedCalibration
from pkmcal.files import write_folder
from pkmcal.judge.watch import Watch, watch_machine
from pkmcal.judge.watch_runs import earlier_runs
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.ranges import default
from pkmcal.report.watch import outcome_of
from pkmcal.session.load import Session


@dataclass(frozen=True, repr=False, eq=False)
class WatchResult(FolderResult, Watch):
    """Tests of a calibrated machine, with their files: ``judged``, ``verdict``.

    Saved over an earlier test, a result continues its run chart.
    """

    own_files = page_and_numbers("watch")
    kind = ("what watch writes", "an earlier test of the machine")

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        return outcome_of(self)

    @classmethod
    def check_folder(cls, folder: Path | str, *, force: bool = False) -> list[str]:
        """Names of an earlier test's files in a folder; see :class:`FolderResult`.

        Raises InputError for an earlier test whose run chart cannot be continued, too.
        """
        names = super().check_folder(folder, force=force)
        earlier_runs(folder)
        return names

    def save(self, folder: Path | str, *, force: bool = False) -> Path | None:
        """Write the command's files; the run chart continues that of a test in this folder."""
        over = self.check_folder(folder, force=force)
        whole_history = replace(self, earlier=earlier_runs(folder))
        write_folder(Path(folder), whole_history.contents(), over)
        return None


def watch(
    calibration: SavedCalibration | Path | str,
    session: Session | Path | str,
    *,
    alpha: float = default("watch", "alpha"),
    same_place: Sequence[str] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> WatchResult:
    """Test whether a machine is still as calibrated, without writing files.

    Parameters
    ----------
    calibration :
        A calibration's folder, or a calibration loaded by :func:`pkmcal.load_result`.
    session :
        New images or poses with their readings, or the folder of this session; five are enough.
    alpha :
        Probability of an alarm for a machine that has not changed.
    same_place :
        Names of stations whose cameras have not been touched since the calibration.
    seed :
        Seed of the localization.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    WatchResult
        ``verdict``, ``judged``, ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The two do not belong together, or the session has no new data.

    """
    with whole(progress, "Reading the calibration") as report:
        value = watch_machine(
            calibration, session, alpha=alpha, seed=seed, same_place=same_place, progress=report
        )
    return WatchResult.of(value)
