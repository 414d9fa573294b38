"""``pkmcal demo``: a simulated session, its calibration, and the comparison with the truth."""

from __future__ import annotations

from pathlib import Path

from pkmcal import terminal
from pkmcal.commands import console
from pkmcal.commands.finish import answer
from pkmcal.commands.options import as_json, command, flag, out
from pkmcal.errors import InputError
from pkmcal.outcome.progress import part

DEMO_FOLDER = Path("pkmcal-demo")
DEMO_SESSION_NAME, DEMO_CALIBRATION_NAME = "session", "calibration"
FAST_SIZE = (480, 360)
FAST_CONFIGURATIONS = 4
SIMULATING_SHARE = 0.85
"""Share of rendering in the progress of the work."""

EXAMPLES = """\
pkmcal demo
pkmcal demo --fast --no-open
pkmcal demo -o my-demo --json
"""


@command(
    EXAMPLES,
    flag("--fast", "Use fewer and smaller images."),
    flag("--no-open", "Do not open the report in a browser."),
    out("pkmcal-demo"),
    as_json(),
)
def demo(fast: bool, no_open: bool, out: Path | None, as_json: bool) -> int:
    """Simulate a session, calibrate it, and compare with the truth."""
    from dataclasses import asdict, replace
    from datetime import datetime

    import pkmcal

    with console.progress(as_json) as progress:
        from pkmcal.calibration.file_names import CALIBRATION_REPORT_FILE
        from pkmcal.files import default_output, write_text
        from pkmcal.judge.against_truth import compare_with_truth
        from pkmcal.placement.default_camera import camera_of_size, default_camera
        from pkmcal.report.truth import truth_sentence, truth_table, with_truth
        from pkmcal.simulation.demo import DEMO_MECHANISM, DEMO_SEED, DEMO_SETTINGS
        from pkmcal.web.report_page import report_page

        place = out or default_output(DEMO_FOLDER)
        session, folder = place / DEMO_SESSION_NAME, place / DEMO_CALIBRATION_NAME
        _make_room(place)
        simulated = pkmcal.simulate(
            session,
            DEMO_MECHANISM,
            camera=camera_of_size(FAST_SIZE) if fast else default_camera(),
            stations=DEMO_SETTINGS.stations,
            configurations=FAST_CONFIGURATIONS if fast else DEMO_SETTINGS.configurations,
            seed=DEMO_SEED,
            progress=part(progress.work, 0, SIMULATING_SHARE),
        )
        result = pkmcal.calibrate(simulated, progress=part(progress.work, SIMULATING_SHARE, 1))
        progress.writing()
        result.save(folder)
    # The truth is read only now, when the result is written; the report gets a section on it.
    comparison = compare_with_truth(result, session)
    report = with_truth(result.outcome, comparison)
    write_text(folder / CALIBRATION_REPORT_FILE, report_page(report, datetime.now()))
    outcome = replace(
        report,
        subject=f"A {result.machine.name} that deviates from its nominal model, in"
        f" {simulated.images_taken} simulated images: {session}",
        summary={
            **(result.outcome.summary or {}),
            "session": session,
            "comparison": asdict(comparison),
        },
    )
    code = answer(result, folder, outcome=outcome, as_json=as_json)
    if not as_json:
        console_out = terminal.out()
        terminal.print_table(console_out, truth_table(comparison))
        console_out.print()
        terminal.print_points(console_out, [("[cyan]→[/]", truth_sentence(comparison))])
        if not no_open and console.can_show():
            import webbrowser

            from pkmcal.files import resolved

            webbrowser.open(resolved(folder / CALIBRATION_REPORT_FILE).as_uri())
    return code


def _make_room(out: Path) -> None:
    """Remove an earlier demonstration; raise InputError if the folder holds anything else."""
    from pkmcal.files import entries, remove_folder

    standing = entries(out)
    if not standing:
        return
    ours = {DEMO_SESSION_NAME, DEMO_CALIBRATION_NAME}
    if not (out / DEMO_SESSION_NAME / "truth.json").is_file() or set(standing) - ours:
        raise InputError(
            "the folder for the demonstration holds something else",
            where=str(out),
            found=", ".join(standing[:3]),
            expected="a new or empty folder, or an earlier demonstration to replace",
            next_step="Name another folder with -o",
            code="output.foreign_files",
        )
    for name in standing:  # the session last, because it identifies the folder as a demonstration
        remove_folder(out / name)
