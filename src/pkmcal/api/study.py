"""``pkmcal.study``: accuracy of calibrations by simulation, before anything is bought."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from pkmcal.api.result import NUMBERS_DESCRIPTION, PAGE_DESCRIPTION, FolderResult
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Outcome
from pkmcal.outcome.progress import Progress, whole
from pkmcal.papers.paper_a import study_subject
from pkmcal.ranges import check_number, default
from pkmcal.studies.cluster import on_cluster
from pkmcal.studies.engine import run_all
from pkmcal.studies.findings import SweepResult, findings_of
from pkmcal.studies.store import BATCHES_FOLDER, Store
from pkmcal.studies.study_report import outcome_of
from pkmcal.studies.sweep import STUDIED_PAPER, Value, cells_of, parsed, subject_of
from pkmcal.studies.tasks import Runner

RUN_ROWS_DESCRIPTION = "one row a run"


@dataclass(frozen=True, repr=False, eq=False)
class StudyResult(SweepResult, FolderResult):
    """Study with its files: ``found``, ``gains``."""

    own_files = MappingProxyType(
        {
            "study.html": PAGE_DESCRIPTION,
            "study.json": NUMBERS_DESCRIPTION,
            "study.csv": RUN_ROWS_DESCRIPTION,
            BATCHES_FOLDER: "the finished batches",
        }
    )
    kind = ("a study", "an earlier study")

    @property
    def file_list(self) -> Mapping[str, str]:
        """Page, document, and the table of runs."""
        names = ("study.html", "study.json", "study.csv")
        return {name: self.own_files[name] for name in names}

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict, tables and sections of the page, and the table of runs."""
        return outcome_of(self)


def study(
    subject: Machine | Path | str,
    vary: Mapping[str, Value | Sequence[Value]] | Sequence[str] = (),
    *,
    runs: int = default("study", "runs"),
    seed: int = 0,
    out: Path | str | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> StudyResult:
    """Predict the accuracy of calibrations by repeated simulation, without writing results.

    Parameters
    ----------
    subject :
        A session's folder, a machine, a mechanism file, a built-in machine, or ``a``: [A] 4.3.
    vary :
        One value or several by name, or texts ``NAME=V1,V2``; every combination is simulated.
    runs :
        Simulated calibrations of each combination, at least 2.
    seed :
        Seed for all random numbers.
    out :
        A folder for finished batches, from which an interrupted study continues.
    scheduler :
        The address of a Dask cluster; the local cores are used without one.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    StudyResult
        ``found``, one entry for each combination; ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        The subject cannot be studied, ``out`` holds another study, or another process works there.

    """
    if isinstance(vary, Mapping):
        each = {name: np.atleast_1d(values) for name, values in vary.items()}
        vary = [f"{name}={','.join(map(str, values))}" for name, values in each.items()]
    elif isinstance(vary, str):
        vary = [vary]
    check_number("study", "runs", runs)
    check_number("study", "seed", seed)
    runner: Runner | None = None if scheduler is None else on_cluster(scheduler)
    if str(subject) == STUDIED_PAPER:
        studied = study_subject()
    else:
        studied = subject_of(subject if isinstance(subject, Machine) else str(subject))
    varied = parsed(studied, vary)
    cells = cells_of(studied, varied)
    settings = [cell.setting for cell in cells]
    title = " ".join([studied.name if isinstance(subject, Machine) else str(subject), *vary])
    names = [studied.in_words(cell.values) for cell in cells]
    opened = nullcontext() if out is None else Store.opened(Path(out), title, settings, seed)
    with opened as store, whole(progress, "Simulating") as report:
        results = run_all(settings, runs, seed, report, runner, store, names)
    found = tuple(findings_of(cell, result) for cell, result in zip(cells, results, strict=True))
    return StudyResult(studied, varied, tuple(cells), tuple(results), found, runs, seed)
