"""``pkmcal study``: accuracy of calibrations by simulation, before anything is bought."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.finish import finish
from pkmcal.commands.options import argument, as_json, command, number, option, out, seed
from pkmcal.studies.varied import DESIGN_NAMES_VARIED, PAPER_NAMES_VARIED

STUDY_FOLDER = Path("study")

EXAMPLES = """\
pkmcal study gough-stewart
pkmcal study h4 --vary configurations=4,15 --vary edge_noise=0.1,0.3
pkmcal study my-machine --vary stations=1,2,3 --runs 200 -o study
"""

FURTHER_HELP = """\
Names of --vary, for a machine or a session:
{}
Names of --vary, for the machine of paper A:
{}
""".format(
    *(
        "\n".join(
            f"  {name:<15} {varied.cell_text}{', ' if varied.unit else ''}{varied.unit}"
            for name, varied in names.items()
        )
        for names in (DESIGN_NAMES_VARIED, PAPER_NAMES_VARIED)
    )
)


@command(
    EXAMPLES,
    argument(
        "subject", "SUBJECT", "Session's folder, mechanism file, name of a built-in machine, or a"
        " for the machine of paper A, section 4.3.",
    ),
    option(
        "--vary", "NAME=V1,V2", "Values to combine with all others; one value sets it. Names are"
        " listed below. [repeatable; default: nothing varies]", multiple=True,
    ),
    number("study", "runs", "N", "Simulations for each combination."),
    seed("study"),
    option("--scheduler", "ADDRESS", "Dask scheduler of a trusted cluster, such as tcp://host:8786."
        " [default: this computer's cores]"),
    out("study", "Folder for the results and the finished batches."),
    as_json(),
    more=FURTHER_HELP,
)  # fmt: skip
def study(
    subject: str, vary: tuple[str, ...], out: Path | None, as_json: bool, **options: Any
) -> int:
    """Predict the accuracy of calibrations by repeated simulation."""
    import pkmcal

    try:
        with console.progress(as_json) as progress:
            from pkmcal.api.study import StudyResult

            # in the usual folder's place may stand a link of a stranger's session, named or not
            given = None if out == STUDY_FOLDER else out
            folder = console.output_folder(given, STUDY_FOLDER, StudyResult)
            result = pkmcal.study(subject, vary, out=folder, progress=progress.work, **options)
            return finish(result, folder, progress, as_json=as_json)
    except KeyboardInterrupt:
        if not as_json:
            place = out or STUDY_FOLDER
            done = f"Finished batches are in {place}; run the same command to continue."
            terminal.print_points(terminal.err(), [("", done)])
        raise
