"""Report section on heights above a bed: each before and after the calibration."""

from __future__ import annotations

import numpy as np

from pkmcal.calibration.heights import ProbedHeights
from pkmcal.outcome import Part, Row, Table
from pkmcal.outcome.blocks.base import configuration_key
from pkmcal.outcome.blocks.plot import Plot, Point, panels, rounded
from pkmcal.outcome.finding import Level
from pkmcal.report.bed import bed_map
from pkmcal.session.load import Session
from pkmcal.session.poses import PoseTable
from pkmcal.wording import amount, count, listed, number

WORST_IN_TERMINAL = 3
"""Heights that the terminal names."""


def section(session: Session, heights: ProbedHeights) -> Part | None:
    """Section with a row for each height; None without heights."""
    if not len(heights):
        return None
    used = heights.used
    before, after = (
        float(np.sqrt(np.nanmean(values[used] ** 2))) for values in (heights.before, heights.after)
    )
    rejected = "" if used.all() else f" {count(int(np.sum(~used)), 'height')} rejected."
    summary = (
        f"{count(int(used.sum()), 'height')}: {amount(before, 'm')} off by the nominal model,"
        f" {amount(after, 'm')} by the calibrated machine (root mean square).{rejected}"
    )
    worst = listed([_worst(session, heights, int(k)) for k in heights.by_size[:WORST_IN_TERMINAL]])
    noise = " ".join(_noise(table) for table in session.trackers if table.kind == "heights")
    return Part(
        "heights",
        "Heights",
        (noise,),
        terminal_text=(f"{summary} Worst: {worst}.",),
        blocks=panels(*_maps(session, heights)),
        tables=(_table(session, heights),),
    )


def _worst(session: Session, heights: ProbedHeights, k: int) -> str:
    """A height in words: where it is, its errors and its standard deviation."""
    x, y, before, after, sigma = _in_mm(heights, k)
    state = "" if heights.used[k] else ", rejected"
    return (
        f"{session.configurations[heights.configuration[k]]} at x {number(x, 0)}, y {number(y, 0)}"
        f" mm ({number(before, 3, signed=True)} → {number(after, 3, signed=True)} ±"
        f" {number(sigma, 3)} mm{state})"
    )


def _noise(table: PoseTable) -> str:
    """Sentence on the standard deviation of a probe's heights, and where it is from."""
    sigma = amount(table.position or 0.0, "m")
    origin = (
        f"pkmcal's default; {table.target.own_sigma}"
        if table.by_default
        else f"as session.yaml states for {table.name}"
    )
    return f"Standard deviation of a height in {table.label}: {sigma}, {origin}."


def _in_mm(heights: ProbedHeights, k: int) -> list[float]:
    """x, y, error before and after, and its standard deviation, mm."""
    every = (heights.x, heights.y, heights.before, heights.after, heights.sigma)
    return [1e3 * float(values[k]) for values in every]


def _maps(session: Session, heights: ProbedHeights) -> list[Plot]:
    """Maps of the errors over the bed, before and after, on one scale of colours."""
    errors = {"Before": heights.before, "After": heights.after}
    most = 1e3 * float(np.nanmax(np.abs([heights.before, heights.after]), initial=1e-9))  # not zero
    out: list[Plot] = []
    for title, values in errors.items():
        points: list[Point] = []
        for k in np.flatnonzero(np.isfinite(values)).tolist():
            name, value = session.configurations[heights.configuration[k]], 1e3 * float(values[k])
            points.append(
                Point(
                    x=rounded(1e3 * float(heights.x[k])),
                    y=rounded(1e3 * float(heights.y[k])),
                    value=rounded(value),
                    tip=f"{name}: {number(value, 3, signed=True)} mm",
                    key=configuration_key(name),
                )
            )
        out.append(bed_map(f"heights-{title.lower()}", title, points, ("error, mm", most)))
    return out


def _table(session: Session, heights: ProbedHeights) -> Table:
    """Table of all heights, the largest error in standard deviations first."""
    rows: list[Row] = []
    for place, k in enumerate(heights.by_size.tolist()):
        name = session.configurations[heights.configuration[k]]
        x, y, before, after, sigma = _in_mm(heights, k)
        state = "rejected" if not heights.used[k] else "worst" if not place else "used"
        cells = (
            number(x, 1),
            number(y, 1),
            number(before, 3, signed=True),
            number(after, 3, signed=True),
            number(sigma, 3),
            number(after / sigma, 1, signed=True),
            state,
        )
        mark = None if heights.used[k] else Level.DOUBTFUL
        rows.append(Row(name, cells, mark=mark, key=configuration_key(name)))
    return Table(
        "Every height before and after",
        ("Configuration", "x, mm", "y, mm", "Before, mm", "After, mm", "σ, mm", "In σ", "Use"),
        tuple(rows),
        "Predicted by the readings less measured. Before: by the nominal model, its mean taken off"
        " (and its tilt, unless the bed is level by session.yaml). After: by the calibrated"
        " machine. σ: standard deviation of such an error by the noise of the probe and the"
        " readings.",
        brief=False,
        words=(7,),
    )
