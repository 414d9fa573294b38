"""Plots that several reports have: box plots below each other, and bars by configuration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array
from pkmcal.outcome.blocks.base import Key
from pkmcal.outcome.blocks.plot import (
    BandMark,
    BarsMark,
    Box,
    BoxesMark,
    Colour,
    Mark,
    Plot,
    Point,
    RuleMark,
    category_axis,
    linear_axis,
    quantiles,
)
from pkmcal.wording import count, number

CUT_OFF_LENGTH_FACTOR = 3.0
"""Length of the longest whisker that a plot shows in full, in median lengths."""
NORMAL_90 = 1.6449
"""90 % of a normal distribution lie within this many standard deviations."""


def box(
    label: str, values: Array, unit: str, places: int, colour: Colour = "quiet", key: Key = ""
) -> Box | None:
    """Box plot row of the finite values, None without any; the tooltip lists its quantiles."""
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    q05, q25, q50, q75, q95 = (
        number(float(q), places, signed=True)
        for q in np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95))
    )
    tip = (
        f"{label}: median {q50} {unit}, middle half {q25} to {q75}, nine tenths {q05} to {q95};"
        f" {count(values.size, 'value')}"
    )
    return Box(at=label, quantiles=quantiles(values.tolist()), tip=tip, key=key, colour=colour)


def row_plot(
    name: str,
    title: str,
    unit: str,
    rows: Sequence[Box | None],
    alt: str,
    band: float | None = None,
    caption: str = "",
) -> Plot | None:
    """Box plots on a scale that is symmetric about zero; None without any.

    Whiskers much longer than the median one end at the border, so that a single bad group does not
    flatten all others.

    band : half-width of the expected central 90 %, None for none.
    """
    boxes = tuple(row for row in rows if row)
    if not boxes:
        return None
    reaches = [max(abs(row.quantiles[0]), abs(row.quantiles[4])) for row in boxes]
    reach = min(max(reaches), CUT_OFF_LENGTH_FACTOR * float(np.median(reaches)))
    reach = max(reach, 1.3 * (band or 0.0), 1e-12)
    shaded = (BandMark(name="", axis="x", low=-band, high=band),) if band else ()
    return Plot(
        name=name,
        title=title,
        caption=caption,
        alt=alt,
        x=linear_axis(unit, (-reach, reach)),
        y=category_axis(row.at for row in boxes),
        marks=(
            *shaded, RuleMark(name="", axis="x", at=0.0, colour="quiet"), BoxesMark(boxes=boxes),
        ),
    )  # fmt: skip


def bar_plot(
    name: str,
    title: str,
    x: str,
    y: str,
    bars: Sequence[Point],
    alt: str,
    *,
    more: Sequence[Mark] = (),
    high: float = 0.0,
    series: str = "",
    caption: str = "",
) -> Plot | None:
    """Bars of categories on a scale that begins at zero and holds them; None without any.

    x, y : labels of the axes.
    more : marks over the bars.
    high : value that the scale holds as well.
    series : name of the bars in the legend.
    """
    if not bars:
        return None
    values = [value for bar in bars for value in (bar.y, bar.high) if isinstance(value, float)]
    return Plot(
        name=name,
        title=title,
        caption=caption,
        alt=alt,
        x=category_axis((str(bar.x) for bar in bars), x),
        y=linear_axis(y, (*values, high), zero=True),
        marks=(BarsMark(name=series, colour="calibrated", points=tuple(bars)), *more),
    )
