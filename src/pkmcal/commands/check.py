"""``pkmcal check``: what is wrong with a session, before any work is spent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from pkmcal.commands import console
from pkmcal.commands.finish import answer


def check(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session's folder.")],
    repeat: Annotated[
        bool,
        typer.Option("--repeat", help="Measure the accuracy by repeated photographs as well."),
    ] = False,
    seed: console.Seed = 0,
    as_json: console.Json = False,
) -> int:
    """Find what is wrong with a session before any work is spent."""
    from pkmcal.check.check import check_session, outcome_of

    study = None
    with console.progress() as told:
        found = check_session(session, seed=seed, progress=told)
        if repeat and found.exit_code < 2:
            from pkmcal.check.repeats import study_repeats

            study = study_repeats(session, seed=seed, progress=told)
    outcome = outcome_of(found, study)
    if repeat:
        repeats = study and study.as_dict()
        outcome = replace(outcome, document={**outcome.document, "repeats": repeats})
    return answer(outcome, session, {}, as_json=as_json)
