"""Blocks of plots in the plane: axes, and marks on them.

Python computes what is drawn, with ticks, limits and texts of tooltips; the viewer chooses pixels.
``linear_axis``, ``log_axis`` and ``category_axis`` make axes for values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from pkmcal.files import Schema
from pkmcal.outcome.blocks.base import Key, Text
from pkmcal.wording import number

Colour = Literal[
    "nominal", "calibrated", "quiet", "ink", "good", "warn", "bad",
    "leg-1", "leg-2", "leg-3", "leg-4", "leg-5", "leg-6", "leg-7", "leg-8",
]  # fmt: skip
"""Colour by its meaning; the viewer has its values in the light and the dark theme."""
Position = float | Text
"""Position on an axis: a number, or the name of a category."""

LEAST_TICKS = 4
"""Least number of labels on a linear axis."""
LEAST_LOG_TICKS = 3
"""Least number of labels on a logarithmic axis."""
MOST_DECADES = 8
"""Decades above which not every power of ten has a label."""
AXIS_MARGIN = 0.04
"""Free part of an axis beyond its values, at each end."""
LEAST_SPAN = 1e-6
"""Span of values, in the largest one, below which they count as equal."""
LEAST_LOG_MARGIN = 0.01
"""Least free part of a logarithmic axis, in decades."""
PLOT_DIGITS = 6
"""Significant digits of values in a plot."""


LEG_COLOURS: tuple[Colour, ...] = tuple(
    colour for colour in get_args(Colour) if colour.startswith("leg-")
)
"""Colours of the legs; machines with more legs repeat them."""


def leg_colour(leg: int | None) -> Colour:
    """Colour of a leg, from 1; quiet for no leg."""
    return LEG_COLOURS[(leg - 1) % len(LEG_COLOURS)] if leg else "quiet"


# ------------------------------------------------------------------ axes


class Tick(Schema):
    """Label of an axis at a value."""

    at: float
    label: Text


class PlotAxis(Schema):
    """Axis of a plot.

    label : quantity and unit, such as "rms, mm"; may be empty.
    scale : of numbers, or one place for each of ``categories``.
    limits : values at the ends of an axis of numbers; the first may be the larger one.
    ticks : labels of an axis of numbers.
    """

    label: Text
    scale: Literal["linear", "log", "categories"]
    limits: tuple[float, float] | None = None
    ticks: tuple[Tick, ...] = ()
    categories: tuple[Text, ...] = ()


def linear_axis(label: str, values: Iterable[float], *, zero: bool = False) -> PlotAxis:
    """Axis that holds all finite values.

    zero : the axis begins, or ends, at zero if the values have one sign.
    """
    low, high = _ends(values, (0.0,) if zero else ())
    size, span = max(abs(low), abs(high)), high - low
    margin = AXIS_MARGIN * (span if span > LEAST_SPAN * size else size or 1.0)
    low = low if zero and low == 0 else low - margin
    high = high if zero and high == 0 else high + margin
    if low == high:  # nothing but zeros
        high = 1.0
    return PlotAxis(label=label, scale="linear", limits=(low, high), ticks=linear_ticks(low, high))


def log_axis(label: str, values: Iterable[float]) -> PlotAxis:
    """Logarithmic axis that holds all finite positive values."""
    low, high = (math.log10(v or 1.0) for v in _ends(v for v in values if v > 0))
    margin = max(AXIS_MARGIN * (high - low), LEAST_LOG_MARGIN)
    low, high = 10 ** (low - margin), 10 ** (high + margin)
    return PlotAxis(label=label, scale="log", limits=(low, high), ticks=log_ticks(low, high))


def category_axis(names: Iterable[str], label: str = "") -> PlotAxis:
    """Axis with a place for each name."""
    return PlotAxis(label=label, scale="categories", categories=tuple(names))


def _ends(values: Iterable[float], more: tuple[float, ...] = ()) -> tuple[float, float]:
    """Smallest and largest finite value; 0 and 1 without any."""
    finite = [float(v) for v in (*values, *more) if math.isfinite(v)]
    return (min(finite), max(finite)) if finite else (0.0, 1.0)


def linear_ticks(low: float, high: float) -> tuple[Tick, ...]:
    """Labels at the multiples of the largest round step of which LEAST_TICKS lie on the axis."""
    power = math.floor(math.log10(high - low))
    for decade, factor in product((power, power - 1, power - 2), (5, 2, 1)):
        step = factor * 10.0**decade
        ticks = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
        if len(ticks) >= LEAST_TICKS:
            places = max(0, -decade)
            return tuple(Tick(at=k * step, label=number(k * step, places)) for k in ticks)
    raise ValueError(f"no ticks between {low} and {high}")


def log_ticks(low: float, high: float) -> tuple[Tick, ...]:
    """Labels at powers of ten; between them, too, where these are fewer than
    ``LEAST_LOG_TICKS``, and at equal steps where the axis is shorter than that.
    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    every = -(-len(decades) // MOST_DECADES)
    for factors in ((1,), (1, 3), (1, 2, 5)):
        values = [m * 10.0**k for k in decades if k % every == 0 for m in factors]
        values = [v for v in values if low <= v <= high]
        if len(values) >= LEAST_LOG_TICKS:
            return tuple(Tick(at=v, label=_power_text(v)) for v in values)
    return linear_ticks(low, high)


def _power_text(value: float) -> str:
    """Round number in full between 0.001 and 10 000, others as ``10⁻⁶`` and ``3·10⁻⁶``."""
    if 0.999e-3 < value < 10_001:
        return f"{value:g}"
    exponent = math.floor(math.log10(value) + 1e-9)
    factor = round(value / 10.0**exponent)
    power = "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return power if factor == 1 else f"{factor}·{power}"


# ------------------------------------------------------------------ marks


class Point(Schema):
    """Point of a mark.

    low, high : ends of an interval along the axis of the values, which is y unless y has
        categories: a standard deviation's bar, or the range that is expected.
    tip : tooltip.
    key : what the point belongs to; empty for nothing.
    colour : null for the mark's.
    value : for the plot's colour scale.
    """

    x: Position
    y: Position
    low: float | None = None
    high: float | None = None
    tip: Text = ""
    key: Key = ""
    colour: Colour | None = None
    value: float | None = None


class LineMark(Schema):
    """Polyline; a null breaks it. name : in the legend; empty for no entry."""

    mark: Literal["line"] = "line"
    name: Text
    colour: Colour
    points: tuple[tuple[Position, float | None], ...]
    dashed: bool = False
    key: Key = ""


class DotsMark(Schema):
    """Dots, with intervals as lines through them."""

    mark: Literal["dots"] = "dots"
    name: Text
    colour: Colour
    points: tuple[Point, ...]
    symbol: Literal["circle", "cross"] = "circle"
    radius: float = 4


class BarsMark(Schema):
    """Bars from zero, with intervals as lines over them.

    width : of a bar on an axis of numbers; 0 on one of categories, whose bars fill their place.
        Bars of several marks stand side by side on an axis of categories.
    """

    mark: Literal["bars"] = "bars"
    name: Text
    colour: Colour
    points: tuple[Point, ...]
    width: float = 0


class Box(Schema):
    """Distribution in one row: quantiles at 5, 25, 50, 75 and 95 %, those in the middle as a bar.

    at : category of the y axis.
    """

    at: Text
    quantiles: tuple[float, float, float, float, float]
    tip: Text
    key: Key = ""
    colour: Colour = "quiet"


class BoxesMark(Schema):
    """Box plots, one in each row."""

    mark: Literal["boxes"] = "boxes"
    boxes: tuple[Box, ...]


class BandMark(Schema):
    """Shaded range of an axis, over the whole of the other one."""

    mark: Literal["band"] = "band"
    name: Text
    axis: Literal["x", "y"]
    low: float
    high: float


class RuleMark(Schema):
    """Straight line at a value of an axis, over the whole of the other one."""

    mark: Literal["rule"] = "rule"
    name: Text
    axis: Literal["x", "y"]
    at: float
    colour: Colour = "ink"


class CellsMark(Schema):
    """Rectangle of cells of equal size, coloured by the plot's colour scale.

    x, y : values of the axes at its left and right, and at its top and bottom.
    values : of each row, from the top; null for an empty cell.
    columns, rows : names for the tooltips.
    """

    mark: Literal["cells"] = "cells"
    x: tuple[float, float]
    y: tuple[float, float]
    values: tuple[tuple[float | None, ...], ...]
    columns: tuple[Text, ...]
    rows: tuple[Text, ...]


Mark = Annotated[
    LineMark | DotsMark | BarsMark | BoxesMark | BandMark | RuleMark | CellsMark,
    Field(discriminator="mark"),
]


class ColourScale(Schema):
    """Colours of values, with its legend.

    diverging : two colours on either side of the middle of ``limits``; otherwise one, the larger
        the more ink.
    """

    label: Text
    limits: tuple[float, float]
    ticks: tuple[Tick, ...]
    diverging: bool = False


class Plot(Schema):
    """Plot in the plane.

    caption : how to read it.
    alt : description for readers who cannot see it.
    marks : from back to front.
    equal : same scale on both axes.
    """

    kind: Literal["plot"] = "plot"
    name: str
    title: Text
    caption: Text
    alt: Text
    x: PlotAxis
    y: PlotAxis
    marks: tuple[Mark, ...]
    colours: ColourScale | None = None
    equal: bool = False


class Panels(Schema):
    """Plots side by side where there is room."""

    kind: Literal["panels"] = "panels"
    plots: tuple[Plot, ...]


def panels(*plots: Plot | None) -> tuple[Panels, ...]:
    """Block with the plots that there are; none without any."""
    present = tuple(plot for plot in plots if plot)
    return (Panels(plots=present),) if present else ()


def line_points(
    x: Iterable[float | str], y: Iterable[float]
) -> tuple[tuple[Position, float | None], ...]:
    """Points of a line: numbers with ``PLOT_DIGITS`` digits, gaps at values that are not finite."""
    return tuple(
        (a if isinstance(a, str) else rounded(a), rounded(b) if math.isfinite(b) else None)
        for a, b in zip(x, y, strict=True)
    )


def rounded(value: float) -> float:
    """Number with ``PLOT_DIGITS`` significant digits."""
    return float(f"{value:.{PLOT_DIGITS}g}")


def quantiles(values: Sequence[float]) -> tuple[float, float, float, float, float]:
    """Quantiles of a :class:`Box`."""
    q05, q25, q50, q75, q95 = (
        rounded(q) for q in np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95)).tolist()
    )
    return q05, q25, q50, q75, q95
