"""Output of commands: a result written to files, printed for people or programs, and the exit
code.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from pkmcal import terminal
from pkmcal.commands import console

if TYPE_CHECKING:
    from pkmcal.api.result import Result
    from pkmcal.outcome import Outcome

NO_FILES: Mapping[str, str] = MappingProxyType({})


def finish(
    result: Result,
    folder: Path,
    progress: console.CommandProgress,
    *,
    force: bool = False,
    more: Mapping[str, str] = NO_FILES,
    as_json: bool = False,
    quiet: bool = False,
) -> int:
    """Save a result, end the command's progress, print the result, and return the exit code;
    arguments as for `answer`.

    force : replace an earlier result that would be kept.
    """
    progress.writing()
    archive_folder = result.save(folder, force=force)
    progress.close()
    return answer(
        result, folder, more=more, archive_folder=archive_folder, as_json=as_json, quiet=quiet
    )


def answer(
    result: Result,
    folder: Path | None,
    *,
    more: Mapping[str, str] = NO_FILES,
    archive_folder: Path | None = None,
    outcome: Outcome | None = None,
    as_json: bool = False,
    quiet: bool = False,
) -> int:
    """Print a result and the paths of its files, and return the exit code.

    folder : where it was saved, None if it was not. more : further files, descriptions by path.
    archive_folder : folder of the earlier result. outcome : instead of the result's. quiet : print
    nothing for a usable result, and one sentence for another.
    """
    outcome = outcome or result.outcome
    if as_json:
        from pkmcal.api.result import printed_document

        places = {} if folder is None else result.path_document(folder)
        if more:
            places["files"] = {**places.get("files", {}), **{path: path for path in more}}
        earlier = {"kept": str(archive_folder)} if archive_folder else {}
        console.print_json({**places, **printed_document(outcome), **earlier})
    elif not quiet:
        out = terminal.out()
        for one in result.printed_outcomes if outcome is result.outcome else (outcome,):
            terminal.print_outcome(out, one)
        files = {} if folder is None else dict(result.written_files(folder))
        files |= more
        if archive_folder:
            here = Path.cwd()
            inside = archive_folder.is_relative_to(here)
            place = archive_folder.relative_to(here) if inside else archive_folder
            files[str(place)] = "the earlier result, kept"
        if files:
            out.print()
            terminal.print_files(out, files.items())
        if folder is not None and (step := result.next_step(folder)):
            # not wrapped, so that it can be copied
            out.print(f"\n{step}", soft_wrap=True, markup=False, highlight=False)
    elif not outcome.verdict.usable:
        verdict = outcome.verdict
        console.print_error(" ".join([verdict.headline, *verdict.reasons]))
    return outcome.exit_code
