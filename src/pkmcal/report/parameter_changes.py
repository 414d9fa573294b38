"""Plots of the parameters' changes from the nominal model, with their standard deviations."""

from __future__ import annotations

from itertools import groupby

from pkmcal.identify.parameter_estimates import ParameterEstimates
from pkmcal.outcome.blocks.base import leg_key
from pkmcal.outcome.blocks.plot import (
    BandMark,
    DotsMark,
    Panels,
    Plot,
    PlotAxis,
    Point,
    RuleMark,
    category_axis,
    leg_colour,
    linear_axis,
    panels,
    rounded,
)
from pkmcal.wording import DISPLAY_UNITS, amount, number, split_name

INTERVAL_SIGMAS = 2.0
"""Standard deviations on either side of a parameter's change."""


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
    return amount(value, unit) if unit in DISPLAY_UNITS else f"{value:.2g}"
