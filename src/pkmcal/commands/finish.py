"""Output of commands: the outcome written to files, printed for people or programs, and the exit
code.

``files`` maps the names of the files, in the order in which they are listed, to descriptions.
``NAME.html`` is the outcome's page and ``NAME.json`` its document, unless the outcome holds a text
of that name.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pkmcal.commands import console
from pkmcal.wording import with_unit

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.outcome import Outcome

PAGE_DESCRIPTION = "open it in a browser"
NUMBERS_DESCRIPTION = "everything, for programs"


def finish(
    outcome: Outcome,
    folder: Path,
    files: Mapping[str, str],
    *,
    over: Collection[str] = (),
    archive_folder: Path | None = None,
    as_json: bool = False,
) -> int:
    """Write the files, print the outcome, and return the exit code.

    over : files of an earlier result, which are removed. archive_folder : folder of its copy.
    """
    with console.progress(as_json) as progress:
        progress("Writing the report", 0.97)
        write_outcome(outcome, folder, files, over)
    return answer(outcome, folder, files, archive_folder=archive_folder, as_json=as_json)


def write_outcome(
    outcome: Outcome, folder: Path, files: Mapping[str, str], over: Collection[str] = ()
) -> None:
    """Write all files atomically."""
    from pkmcal.files import write_folder

    write_folder(folder, contents(outcome, files), over)


def answer(
    outcome: Outcome,
    folder: Path,
    files: Mapping[str, str],
    *,
    archive_folder: Path | None = None,
    as_json: bool = False,
    quiet: bool = False,
) -> int:
    """Print the outcome and the paths of its files, and return the exit code.

    quiet : print nothing for a usable result, and one sentence for another.
    """
    if as_json:
        earlier = {"kept": str(archive_folder)} if archive_folder else {}
        console.print_json({**printed(outcome, folder, files), **earlier})
    elif not quiet:
        out = console.out()
        print_outcome(out, outcome)
        if files:
            out.print()
            written = [(str(folder / name), what) for name, what in files.items()]
            if archive_folder:
                here = Path.cwd()
                place = (
                    archive_folder.relative_to(here)
                    if archive_folder.is_relative_to(here)
                    else archive_folder
                )
                written.append((str(place), "the earlier result, kept"))
            console.print_files(out, written)
    elif not outcome.verdict.usable:
        verdict = outcome.verdict
        console.print_error(" ".join([verdict.headline, *verdict.reasons]))
    return outcome.exit_code


def contents(outcome: Outcome, files: Mapping[str, str]) -> dict[str, str | bytes]:
    """Content of each file."""
    from pkmcal.files import json_text
    from pkmcal.pages.page import page_html

    texts, made = dict(outcome.texts), datetime.now()
    for name in files:
        if name in texts:
            continue
        page = name.endswith(".html")
        texts[name] = page_html(outcome, made) if page else json_text(outcome.document)
    return texts


def printed(outcome: Outcome, folder: Path, files: Mapping[str, str]) -> dict[str, Any]:
    """Single JSON object that a command prints."""
    return {
        "exit_code": outcome.exit_code,
        **({"files": {name: str(folder / name) for name in files}} if files else {}),
        **(outcome.document if outcome.summary is None else outcome.summary),
    }


def print_outcome(out: Console, outcome: Outcome) -> None:
    """Print an outcome for people: verdict, figures, tables, findings and checks."""
    verdict, findings = outcome.verdict, outcome.findings
    if outcome.subject:
        console.print_points(out, [("", outcome.subject)])
        out.print()
    console.print_points(out, [(console.MARK_SIGNS[outcome.mark], verdict.headline)])
    console.print_points(out, [("  [red]•[/]", reason) for reason in verdict.reasons])
    brief = any(table.brief for part in outcome.parts for table in part.tables)
    if outcome.figures and not brief:
        out.print()
        widest = max(len(card.question) for card in outcome.figures)
        for card in outcome.figures:
            values = ", ".join(with_unit(value, unit) for value, unit in card.values)
            out.print(f"  {card.question:{widest}}  [bold]{values}[/]", soft_wrap=True)
    for part in outcome.parts:
        for table in part.tables:
            if table.brief:
                console.print_table(out, table)
        if part.terminal_text:
            out.print()
            console.print_points(out, [("", text) for text in part.terminal_text])
    checks = [check for part in outcome.parts for check in part.checks]
    for points in (
        [
            *((console.MARK_SIGNS[finding.level], finding.text) for finding in findings),
            *((console.MARK_SIGNS["doubtful"], text) for text in verdict.warnings),
            *(("[cyan]→[/]", text) for text in verdict.advice),
        ],
        [(console.MARK_SIGNS["good" if c.passed else "wrong"], c.sentence) for c in checks],
    ):
        if points:
            out.print()
            console.print_points(out, points)
    if outcome.closing:
        out.print()
        out.print(outcome.closing, style="yellow", markup=False)
