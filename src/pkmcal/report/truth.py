"""Report section on the errors of a simulated session's calibration, whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from math import degrees

from pkmcal.judge.against_truth import AgainstTruth
from pkmcal.outcome import Outcome, Part, Row, Table
from pkmcal.outcome.blocks.log_bar import Magnitude
from pkmcal.wording import amount, percentage


def with_truth(outcome: Outcome, comparison: AgainstTruth) -> Outcome:
    """Outcome of a calibration with the section, and the true error among its magnitudes."""
    part = Part(
        "truth",
        "Against the truth",
        ("The session was simulated. Its truth was read when the result was written.",),
        tables=(truth_table(comparison),),
        notes=(truth_sentence(comparison),),
        menu="Truth",
    )
    bar, error = outcome.comparison, comparison.calibrated.position
    if bar is not None and error > 0:
        true = Magnitude(
            label="True error", value=error * 1e3, text=amount(error, "m"), role="test"
        )
        note = f"{bar.note} True error: distance of the calibrated machine from the simulated one."
        bar = bar.model_copy(update={"magnitudes": (*bar.magnitudes, true), "note": note})
    return replace(outcome, comparison=bar, parts=(part, *outcome.parts))


def truth_table(comparison: AgainstTruth) -> Table:
    """Table of the errors before and after."""
    before, after = comparison.drawing, comparison.calibrated
    rows: list[Row] = []
    for what, old, new, unit in (
        ("joint centres", before.centre * 1e3, after.centre * 1e3, " mm"),
        ("joint offsets", before.offset * 1e3, after.offset * 1e3, " mm"),
        ("platform's position", before.position * 1e3, after.position * 1e3, " mm"),
        ("platform's orientation", degrees(before.orientation), degrees(after.orientation), "°"),
    ):
        times = f"{old / new:.0f} times nearer" if new > 0 else ""
        rows.append(Row(what, (f"{old:.2f}{unit}", f"{new:.3f}{unit}", times)))
    columns = ("Against the truth", "Nominal model", "Calibrated", "Gain")
    return Table("", columns, tuple(rows), brief=False)


def truth_sentence(comparison: AgainstTruth) -> str:
    """Sentence on the share of values within two standard deviations."""
    within, count = comparison.within, comparison.count
    return (
        f"{within} of {count} values ({percentage(within / count)}) lie within two"
        " of their standard deviations of the truth; 95 % should."
    )
