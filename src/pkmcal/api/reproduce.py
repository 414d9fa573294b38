"""``pkmcal.reproduce``: the papers' figures recomputed, beside the printed ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, get_args

from pkmcal.api.result import NUMBERS_DESCRIPTION, FolderResult
from pkmcal.errors import InputError
from pkmcal.files import write_folder
from pkmcal.outcome import Outcome, Verdict
from pkmcal.outcome.progress import Progress, part, whole
from pkmcal.papers.reproduction import Options, reproduce_paper
from pkmcal.ranges import Paper, check_number, default
from pkmcal.wording import count, listed

PAPERS: tuple[str, ...] = get_args(Paper)


def table_and_numbers(paper: str) -> Mapping[str, str]:
    """Files of a paper, with their descriptions."""
    return {f"paper-{paper}.md": "the table", f"paper-{paper}.json": NUMBERS_DESCRIPTION}


@dataclass(frozen=True, repr=False)
class ReproductionResult(FolderResult):
    """Reproductions of papers. outcomes : by the paper's letter."""

    outcomes: Mapping[str, Outcome]

    own_files: ClassVar[Mapping[str, str]] = MappingProxyType(
        {name: what for paper in PAPERS for name, what in table_and_numbers(paper).items()}
    )
    kind: ClassVar[tuple[str, str | None]] = ("reproductions", "earlier reproductions")

    @cached_property
    def outcome(self) -> Outcome:
        """Verdict on all papers, and their documents."""
        verdicts = [one.verdict for one in self.outcomes.values()]
        good = sum(verdict.usable for verdict in verdicts)
        several = f"{good} of {count(len(verdicts), 'paper')} pass every check."
        return Outcome(
            command="reproduce",
            title="Reproduction of papers",
            verdict=Verdict(
                usable=good == len(verdicts),
                headline=verdicts[0].headline if len(verdicts) == 1 else several,
                findings=tuple(one for verdict in verdicts for one in verdict.findings),
            ),
            findings=tuple(one for each in self.outcomes.values() for one in each.findings),
            document={"papers": {paper: one.document for paper, one in self.outcomes.items()}},
        )

    @property
    def printed_outcomes(self) -> Sequence[Outcome]:
        """The outcome of each paper."""
        return tuple(self.outcomes.values())

    @property
    def file_list(self) -> Mapping[str, str]:
        """The table and the document of each paper."""
        return {n: what for paper in self.outcomes for n, what in table_and_numbers(paper).items()}

    def contents(self) -> dict[str, str | bytes]:
        """Tables and documents by name."""
        return {
            name: text
            for paper, outcome in self.outcomes.items()
            for name, text in self.contents_of(outcome, table_and_numbers(paper)).items()
        }

    def save(self, folder: Path | str, *, force: bool = False) -> None:
        """Write the files; those of other papers stay. As :meth:`pkmcal.api.result.Result.save`."""
        self.check_folder(folder, force=force)
        write_folder(Path(folder), self.contents())

    def path_document(self, folder: Path) -> dict[str, Any]:
        """Paths of the files."""
        return {"files": [str(folder / name) for name in self.file_list]}


def reproduce(
    papers: str | Sequence[str] = PAPERS,
    *,
    runs: int = default("reproduce", "runs"),
    seed: int = 0,
    long: bool = False,
    images: bool = False,
    progress: Progress | None = None,
) -> ReproductionResult:
    """Recompute the tables and figures of papers [A], [B] and [C], without writing files.

    Parameters
    ----------
    papers :
        Letters of the papers: ``a``, ``b``, ``c``.
    runs :
        Number of simulated runs.
    seed :
        Seed for all random numbers.
    long :
        Compute the accuracy by the number of poses as well, which takes a minute.
    images :
        Measure Table 1 of [A] on rendered images as well.
    progress :
        Called with a text and the share done, 0 to 1.

    Returns
    -------
    ReproductionResult
        ``outcomes`` by paper, ``summary()``, ``save(folder)``.

    Raises
    ------
    pkmcal.errors.InputError
        There is no such paper, or a number is out of its range.

    """
    check_number("reproduce", "runs", runs)
    check_number("reproduce", "seed", seed)
    wanted = list(dict.fromkeys(papers))
    if unknown := [paper for paper in wanted if paper not in PAPERS]:
        raise InputError(
            "there is no such paper", where="papers", found=unknown[0], expected=listed(PAPERS)
        )
    outcomes: dict[str, Outcome] = {}
    with whole(progress, "Simulating") as report:
        for number, paper in enumerate(wanted):
            own = part(report, number / len(wanted), (number + 1) / len(wanted))
            outcomes[paper] = reproduce_paper(paper, Options(runs, seed, long, images, own))
    return ReproductionResult(outcomes)
