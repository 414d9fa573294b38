"""``pkmcal calibrate``: from a session to a calibrated machine on disk."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pkmcal.commands import console

if TYPE_CHECKING:
    from rich.console import Console

    from pkmcal.calibration.calibrate import Calibration


class Method(StrEnum):
    """How to identify."""

    BUNDLE = "bundle"
    FOUR_STEP = "four-step"
    LINEAR = "linear"
    INVERSE_KINEMATIC = "inverse-kinematic"


Model = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="A model that the mechanism file names, such as design."),
]

WHAT = {
    "report.html": "open it in a browser",
    "mechanism.yaml": "the calibrated machine",
    "calibration.json": "everything, with covariances",
}


def calibrate(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session's folder.")],
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="DIR", help="SESSION/calibration unless given."),
    ] = None,
    method: Annotated[
        Method,
        typer.Option(
            metavar="NAME",
            help="bundle, or the papers' own: four-step, linear, inverse-kinematic.",
        ),
    ] = Method.BUNDLE,
    model: Model = None,
    seed: console.Seed = 0,
    refine_camera: Annotated[
        bool,
        typer.Option("--refine-camera", help="Estimate the cameras' intrinsics as well."),
    ] = False,
    holdout: Annotated[
        int,
        typer.Option(metavar="N", min=0, help="Leave N configurations out, and predict them."),
    ] = 0,
    as_json: console.Json = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Say nothing if it is well.")
    ] = False,
) -> int:
    """Calibrate the machine; write model, numbers and report."""
    from pkmcal.calibration.calibrate import calibrate as run
    from pkmcal.calibration.results import check_output
    from pkmcal.report.calibration import save
    from pkmcal.session.load import load_session

    loaded = load_session(session, model)
    folder = out or loaded.folder / "calibration"
    check_output(folder)
    with console.progress(quiet) as told:
        calibration = run(
            loaded,
            method=method.value,
            seed=seed,
            refine_camera=refine_camera,
            holdout=holdout,
            progress=told,
        )
        told("Writing the report", 0.97)
        save(calibration, folder)
    if as_json:
        console.print_json(summary(calibration, folder))
    elif not quiet:
        tell(console.out(), calibration, folder)
    elif not calibration.verdict.usable:
        verdict = calibration.verdict
        console.print_error(" ".join([verdict.headline, *verdict.reasons]))
    return exit_code(calibration)


def exit_code(calibration: Calibration) -> int:
    """1 where the result should not be used."""
    return 0 if calibration.verdict.usable else 1


def summary(calibration: Calibration, folder: Path) -> dict[str, Any]:
    """What the command says, for programs."""
    from dataclasses import asdict

    from pkmcal.commands.figures import figures_of
    from pkmcal.validate.figures import holdout_document

    return {
        "exit_code": exit_code(calibration),
        "verdict": asdict(calibration.verdict),
        "figures": figures_of(calibration).as_dict(),
        "session_warnings": calibration.session.warnings,
        "files": {name: str(folder / name) for name in WHAT},
        "holdout": holdout_document(calibration.holdout, calibration.session.configurations)
        if calibration.holdout
        else None,
        "timings": calibration.timings,
    }


def tell(out: Console, calibration: Calibration, folder: Path) -> None:
    """What the command says, for people."""
    from pkmcal.commands.figures import figures_of

    verdict = calibration.verdict
    mark = console.MARKS["good" if verdict.usable else "wrong"]
    console.print_points(out, [(mark, verdict.headline)])
    console.print_points(out, [("  [red]•[/]", reason) for reason in verdict.reasons])
    out.print()
    cards = figures_of(calibration).headlines()
    widest = max(len(card.question) for card in cards)
    for card in cards:
        values = ", ".join(_joined(*value) for value in card.values)
        out.print(f"  {card.question:{widest}}  [bold]{values}[/]", soft_wrap=True)
    if calibration.holdout:
        from pkmcal.report.validation_page import holdout_sentence, joints_of

        out.print()
        said = holdout_sentence(calibration.holdout, joints_of(calibration.session))
        console.print_points(out, [("", said)])
    notes = [*calibration.session.warnings, *verdict.warnings]
    points = [(console.MARKS["doubtful"], note) for note in notes]
    points += [("[cyan]→[/]", advice) for advice in verdict.advice]
    if points:
        out.print()
        console.print_points(out, points)
    out.print()
    if not verdict.usable:
        out.print("Written all the same, to find out why:", style="yellow")
    console.print_files(out, [(str(folder / name), what) for name, what in WHAT.items()])


def _joined(value: str, unit: str) -> str:
    return value + unit if unit == "°" else f"{value} {unit}"
