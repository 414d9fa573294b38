"""``pkmcal.check``: checks of a session before it is calibrated."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

from pkmcal.api.result import FolderResult, page_and_numbers
from pkmcal.checks.check import check_session
from pkmcal.checks.pictures import picture_names, with_pictures, write_pictures
from pkmcal.checks.results import SessionCheck
from pkmcal.checks.sentences import outcome_of
from pkmcal.files import check_own_folder, given_path
from pkmcal.judge.repeatability import RepeatStudy, study_repeats
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, part, whole
from pkmcal.ranges import check_number


@dataclass(frozen=True, repr=False, eq=False)
class CheckResult(FolderResult, SessionCheck):
    """Check of a session, with its files: ``stations``, ``joints``, ``forecast``, ``advice``.

    repeat : whether repeated images were studied as well. repeats : their study; None without one,
    or if the session cannot be calibrated.
    """

    repeat: bool = False
    repeats: RepeatStudy | None = None

    own_files = page_and_numbers("check")
    kind = ("a check", None)

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page."""
        own = {one.name: getattr(self, one.name) for one in fields(SessionCheck)}
        outcome = outcome_of(SessionCheck(**own), self.repeats)
        if not self.repeat:
            return outcome
        repeats = self.repeats and self.repeats.as_dict()
        return replace(outcome, document={**outcome.document, "repeats": repeats})

    def contents(self) -> dict[str, str | bytes]:
        """Page and document; the page shows the nominal model over the images."""
        if not self.look:
            return super().contents()
        parts = (*self.outcome.parts, with_pictures(self.look))
        return self.contents_of(replace(self.outcome, parts=parts), self.file_list)

    def save_pictures(self, folder: Path | str) -> bool:
        """Write the nominal model over each image as PNG; False if there is nothing to draw.

        Raises InputError where the folder holds anything but pictures of an earlier check.
        """
        if not self.look:
            return False
        names = picture_names(self.look).values()
        check_own_folder(Path(folder), names, "pictures of a check", "an earlier check's")
        write_pictures(self.look, Path(folder))
        return True


def check(
    session: Path | str,
    *,
    repeat: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> CheckResult:
    """Check a session for faults before it is calibrated, without writing files.

    Mistakes in the session are findings of the result, and raise no error.

    Parameters
    ----------
    session :
        The session's folder.
    repeat :
        Measure the scatter of repeated images as well, which calibrates the session.
    seed :
        Seed of the localization.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    CheckResult
        ``findings``, ``stations``, ``joints``, ``forecast``, ``advice``, ``exit_code`` (0 good, 1
        less accurate than it could be, 2 cannot be calibrated), ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        With ``repeat``, the session has no repeated images.

    """
    check_number("check", "seed", seed)
    session = given_path(session, "a session's folder")
    study = None
    with whole(progress, "Reading the session") as report:
        own = part(report, 0, 0.4 if repeat else 1)
        value = check_session(session, seed=seed, repeat=repeat, progress=own)
        if repeat and value.exit_code < 2:
            study = study_repeats(session, seed=seed, progress=part(report, 0.4, 1))
    return CheckResult.of(value, repeat=repeat, repeats=study)
