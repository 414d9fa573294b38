"""Report section on the correlations of the parameters: a plot of all, and a list of pairs."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.estimate import Estimate
from pkmcal.levels import INSEPARABLE_CORRELATION
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.plot import (
    CellsMark,
    ColourScale,
    Plot,
    PlotAxis,
    RuleMark,
    Tick,
    linear_ticks,
)
from pkmcal.outcome.blocks.text import Listing
from pkmcal.report.parameters import correlations
from pkmcal.wording import number, split_name

MOST_CORRELATIONS = 250
"""Most parameters in the plot of correlations; with more a cell would be below three pixels."""
LEAST_CORRELATION = 0.05
"""Correlation below which a cell is left empty: its colour would not be seen."""
MOST_PAIRS = 24
HOW_TOGETHER = (
    "Orange: when one is larger than stated, so is the other; blue: the other is smaller. Only"
    " their sum, or difference, is as sure as the small deviations of other values suggest. In the"
    " frames that the parameters refer to; what a frame or the file holds is left out, and of"
    " values that are tied one stands for all."
)


def section(estimate: Estimate) -> Part | None:
    """Section on correlations; None for fewer than two free parameters, or too many to be drawn."""
    table = estimate.machine.parameters
    free, rho, pairs = correlations(estimate)
    if not 1 < len(free) <= MOST_CORRELATIONS or not pairs.any():
        return None
    names = [table.in_words(table.names[k]) for k in free]
    off = np.abs(rho) * pairs
    a, b = np.unravel_index(np.argmax(off), off.shape)
    strong = np.count_nonzero(off > INSEPARABLE_CORRELATION)
    text = (
        f"Of {np.count_nonzero(pairs)} pairs, {strong} have a correlation of"
        f" more than {INSEPARABLE_CORRELATION:.2f}; the closest are {names[a]} and {names[b]},"
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
        "Correlations",
        (f"{text} {HOW_TOGETHER}",),
        blocks=(correlation_plot(rho, names, legs), *((listing,) if closest else ())),
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
