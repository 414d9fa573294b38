"""Plots of the parameters: their changes with their deviations, and their correlations."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.parameter_estimates import ParameterEstimates
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import leg_key
from pkmcal.outcome.blocks.plot import (
    BandMark,
    CellsMark,
    ColourScale,
    DotsMark,
    Panels,
    Plot,
    PlotAxis,
    Point,
    RuleMark,
    Tick,
    category_axis,
    leg_colour,
    linear_axis,
    linear_ticks,
    panels,
    rounded,
)
from pkmcal.outcome.blocks.text import Listing
from pkmcal.report.parameters import correlations
from pkmcal.wording import DISPLAY_UNITS, amount, number, split_name, with_unit

MOST_CORRELATIONS = 250
"""Most parameters in the plot of correlations; with more a cell would be below three pixels."""
LEAST_CORRELATION = 0.05
"""Correlation below which a cell is left empty: its colour would not be seen."""
STRONG_CORRELATION = 0.8
"""Correlation above which a pair is listed."""
MOST_PAIRS = 24
INTERVAL_SIGMAS = 2.0
"""Standard deviations on either side of a parameter's change."""
HOW_TOGETHER = (
    "Orange: when one is larger than stated, so is the other; blue: the other is smaller. Only"
    " their sum, or difference, is as sure as the small deviations of other values suggest. In the"
    " frames that the parameters refer to; what a frame or the file holds is left out, and of"
    " values that are tied one stands for all."
)


# ------------------------------------------------------------------ changes


def changes(estimates: ParameterEstimates) -> tuple[Panels, ...]:
    """Change of each estimated parameter in its tolerances, with its standard deviations: one plot
    for each leg, all on the same scale.

    Parameters that the gauge or the file fixes are left out, as those without a tolerance.
    """
    table, rows = estimates.table, list[tuple[int | None, Point]]()
    for k, one in enumerate(estimates):
        tolerance = float(table.tolerance[k])
        if one.decided_by in ("frame", "fixed") or not tolerance > 0:
            continue
        leg, _ = split_name(one.name)
        change, reach = one.change / tolerance, INTERVAL_SIGMAS * one.sigma / tolerance
        by_data = one.decided_by == "data"
        tip = (
            f"{table.in_words(one.name) if leg else one.name}:"
            f" {number(change, 2, signed=True)} ± {number(reach, 2)} tolerances of"
            f" {_with_unit(tolerance, one.unit)}"
            + ("" if by_data else "; the nominal model decides more than the data")
        )
        point = Point(
            x=rounded(change),
            y=table.labels[k],
            low=rounded(change - reach),
            high=rounded(change + reach),
            tip=tip,
            key=leg_key(leg),
            colour=leg_colour(leg) if by_data else "quiet",
        )
        rows.append((leg, point))
    ends = [end for _, point in rows for end in (point.low, point.high) if end is not None]
    axis = linear_axis("change ± 2σ, in tolerances", (*ends, -1.0, 1.0))
    groups = groupby(rows, key=lambda row: row[0])
    return panels(*(_leg_changes(leg, [p for _, p in group], axis) for leg, group in groups))


def _leg_changes(leg: int | None, points: list[Point], axis: PlotAxis) -> Plot:
    """Changes of one leg's parameters, or of those of no leg."""
    title = f"Leg {leg}" if leg else "Machine"
    return Plot(
        name=f"changes-{leg or 'machine'}",
        title=title,
        caption="",
        alt=f"{title}: change of {len(points)} parameters from the nominal model, with two standard"
        " deviations, in tolerances; the table below has the numbers",
        x=axis,
        y=category_axis(str(point.y) for point in points),
        marks=(
            BandMark(name="", axis="x", low=-1.0, high=1.0),
            RuleMark(name="", axis="x", at=0.0, colour="quiet"),
            DotsMark(name="", colour=leg_colour(leg), points=tuple(points)),
        ),
    )


def _with_unit(value: float, unit: str) -> str:
    """Tolerance in the displayed unit; that of a ratio or a direction as a number."""
    return amount(value, unit) if unit in DISPLAY_UNITS else with_unit(f"{value:.2g}", "")


# ------------------------------------------------------------------ correlations


def correlations_part(estimate: Estimate) -> Part | None:
    """Section on correlations; None for fewer than two free parameters, or too many to be drawn."""
    table = estimate.machine.parameters
    free, rho, pairs = correlations(estimate)
    if not 1 < len(free) <= MOST_CORRELATIONS:
        return None
    names = [table.in_words(table.names[k]) for k in free]
    off = np.abs(rho) * pairs
    a, b = np.unravel_index(np.argmax(off), off.shape)
    strong = np.count_nonzero(off > STRONG_CORRELATION)
    text = (
        f"Of {np.count_nonzero(pairs)} pairs, {strong} have a correlation of"
        f" more than {STRONG_CORRELATION:g}; the closest are {names[a]} and {names[b]},"
        f" {number(rho[a, b], 2, signed=True)}."
    )
    if np.count_nonzero(pairs) < len(free) * (len(free) - 1) // 2:
        text += " Components of one axis, which its length binds, are not counted."
    order = np.argsort(-off, axis=None, kind="stable")[: min(strong, MOST_PAIRS)]
    closest = [np.unravel_index(k, off.shape) for k in order]
    listing = Listing(
        title=f"The closest {len(closest)} pairs" if len(closest) > 1 else "The closest pair",
        items=tuple(
            f"{names[i]} and {names[j]}: {number(rho[i, j], 2, signed=True)}" for i, j in closest
        ),
        folded=True,
    )
    legs = [split_name(table.names[k])[0] for k in free]
    return Part(
        "correlations",
        "What is known together",
        (f"{text} {HOW_TOGETHER}",),
        blocks=(correlation_plot(rho, names, legs), *((listing,) if closest else ())),
        menu="Correlations",
    )


def correlation_plot(rho: Array, names: list[str], legs: list[int | None]) -> Plot:
    """Cells of all pairs (n, n), in blocks by leg."""
    n = len(names)
    blocks = [(leg, len(list(group))) for leg, group in groupby(legs)]
    ends = np.cumsum([size for _, size in blocks]).tolist()
    ticks = tuple(
        Tick(at=end - size / 2, label=f"leg {leg}" if leg else "machine")
        for (leg, size), end in zip(blocks, ends, strict=True)
    )
    values = tuple(
        tuple(round(v, 2) if abs(v) >= LEAST_CORRELATION else None for v in row)
        for row in rho.tolist()
    )
    borders = [
        RuleMark(name="", axis=axis, at=end, colour="quiet")
        for end in ends[:-1]
        for axis in ("x", "y")
    ]
    return Plot(
        name="correlations",
        title="Correlations of the parameters",
        caption="",
        alt=f"A square of {n} by {n} cells in blocks by leg, coloured by the correlation of two"
        " parameters each; the closest pairs are listed below.",
        x=PlotAxis(label="", scale="linear", limits=(0, n), ticks=ticks),
        y=PlotAxis(label="", scale="linear", limits=(n, 0), ticks=ticks),
        marks=(
            CellsMark(x=(0, n), y=(0, n), values=values, columns=tuple(names), rows=tuple(names)),
            *borders,
        ),
        colours=ColourScale(
            label="correlation", limits=(-1, 1), ticks=linear_ticks(-1, 1), diverging=True
        ),
        equal=True,
    )
