"""Small charts as frozen views, which the template ``charts.html.j2`` renders as SVG.

Coordinates are SVG units in a box ``CHART_WIDTH`` wide, so that text keeps its size on a phone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from pkmcal.arrays import Array
from pkmcal.pages import page
from pkmcal.wording import count, number

if TYPE_CHECKING:
    from markupsafe import Markup

CHART_WIDTH = 360.0
CHART_ROW_HEIGHT = 18.0
LABEL_LETTER_WIDTH = 6.0
"""Approximate width of a letter of a row's label."""
LONGEST_ROW_LABEL = 22
"""Letters of a row's label that are shown."""
CUT_OFF_LENGTH_FACTOR = 3.0
"""Length of the longest whisker that a chart shows in full, in median lengths."""
NORMAL_90 = 1.6449
"""90 % of a normal distribution lie within this many standard deviations."""


@dataclass(frozen=True)
class Spread:
    """Row of a box plot: middle half as a bar, central 90 % as a line, median as a mark.

    tip : tooltip.
    leg : number from 1, which gives the colour; None for no leg.
    quantiles : at 5, 25, 50, 75 and 95 %.
    lead : link to the data of the row.
    """

    label: str
    tip: str
    leg: int | None
    quantiles: tuple[float, float, float, float, float]
    lead: str = ""

    @property
    def name(self) -> str:
        """Label, shortened to the space that it has."""
        return (
            self.label
            if len(self.label) <= LONGEST_ROW_LABEL
            else self.label[: LONGEST_ROW_LABEL - 1] + "…"
        )


@dataclass(frozen=True)
class RowChart:
    """Box plots below each other on a common scale.

    alt : description for readers who cannot see the chart.
    band : half-width of the expected central 90 %, None for none.
    note : small print beside the title.
    """

    width: ClassVar[float] = CHART_WIDTH
    row: ClassVar[float] = CHART_ROW_HEIGHT

    title: str
    unit: str
    alt: str
    boxes: tuple[Spread, ...]
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    band: float | None
    note: str = ""

    @property
    def left(self) -> float:
        """Left edge of the frame, beside the longest label."""
        return 12 + LABEL_LETTER_WIDTH * min(
            max(len(b.label) for b in self.boxes), LONGEST_ROW_LABEL
        )

    @property
    def height(self) -> float:
        """Height of the chart with ticks and unit."""
        return CHART_ROW_HEIGHT * len(self.boxes) + 40

    def x(self, value: float) -> float:
        """Horizontal position of a value, clipped to the frame."""
        share = (min(max(value, self.low), self.high) - self.low) / (self.high - self.low)
        return self.left + share * (CHART_WIDTH - self.left - 12)


@dataclass(frozen=True)
class UprightBar:
    """Bar of a bar chart.

    tip : tooltip.
    expected : interval to compare the value with, None for none.
    lead : link to the data of the bar.
    """

    label: str
    tip: str
    value: float
    expected: tuple[float, float] | None = None
    quiet: bool = False
    lead: str = ""


@dataclass(frozen=True)
class BarChart:
    """Vertical bars that start at zero.

    unit : text that names both axes.
    labels : positions, in bars, with their text.
    curve : points (position in bars, value) of a line to compare the bars with.
    note : small print beside the title.
    """

    width: ClassVar[float] = CHART_WIDTH

    title: str
    unit: str
    alt: str
    bars: tuple[UprightBar, ...]
    high: float
    ticks: tuple[tuple[float, str], ...]
    labels: tuple[tuple[float, str], ...]
    curve: tuple[tuple[float, float], ...] = ()
    height: float = 200.0
    note: str = ""

    @property
    def left(self) -> float:
        """Left edge of the bars, beside the longest tick label."""
        return 12 + 6.5 * max([4, *(len(text) for _, text in self.ticks)])

    @property
    def step(self) -> float:
        """Width of a bar with its gap."""
        return (CHART_WIDTH - self.left - 8) / max(len(self.bars), 1)

    def x(self, bar: float) -> float:
        """Position of the left side of a bar, counted from 0."""
        return self.left + bar * self.step

    def y(self, value: float) -> float:
        """Vertical position of a value, clipped to the frame."""
        share = min(max(value, 0.0), self.high) / self.high
        return self.height - 36 - share * (self.height - 46)

    @property
    def path(self) -> str:
        """Curve as SVG path data."""
        points = [f"{self.x(b):.1f},{self.y(v):.1f}" for b, v in self.curve]
        return "M" + "L".join(points) if points else ""


def ticks_between(low: float, high: float, about: int = 5) -> tuple[tuple[float, str], ...]:
    """Round values between two limits, with their text."""
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return tuple((k * step, number(k * step, places)) for k in range(first, last + 1))


def box(
    label: str, values: Array, unit: str, places: int, leg: int | None = None, lead: str = ""
) -> Spread | None:
    """Box plot row of the finite values, None without any; the tooltip lists its quantiles."""
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    q = np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95))
    tip = (
        f"{label}: median {number(q[2], places, signed=True)} {unit}, middle half "
        f"{number(q[1], places, signed=True)} to {number(q[3], places, signed=True)}, "
        f"nine tenths {number(q[0], places, signed=True)} to {number(q[4], places, signed=True)}; "
        f"{count(values.size, 'value')}"
    )
    q05, q25, q50, q75, q95 = (float(v) for v in q)
    return Spread(label, tip, leg, (q05, q25, q50, q75, q95), lead)


def row_chart(
    title: str,
    unit: str,
    boxes: Sequence[Spread | None],
    band: float | None,
    alt: str,
    note: str = "",
) -> RowChart | None:
    """Chart symmetric about zero that holds the boxes and the band; None without boxes.

    Whiskers much longer than the median one end at the border, so that a single bad group does not
    flatten all others.
    """
    rows = tuple(box for box in boxes if box)
    if not rows:
        return None
    reaches = [max(abs(b.quantiles[0]), abs(b.quantiles[4])) for b in rows]
    reach = min(max(reaches), CUT_OFF_LENGTH_FACTOR * float(np.median(reaches)))
    high = 1.08 * max(reach, (band or 0.0) * 1.3, 1e-12)
    ticks = ticks_between(-high, high)
    return RowChart(title, unit, alt, rows, -high, high, ticks, band, note)


def bar_chart(
    title: str,
    unit: str,
    bars: list[UprightBar],
    labels: tuple[tuple[float, str], ...],
    alt: str,
    curve: tuple[tuple[float, float], ...] = (),
    note: str = "",
) -> BarChart | None:
    """Bars on a scale that holds them, their expected intervals and the curve; None for no bars."""
    if not bars:
        return None
    tops = [bar.value for bar in bars] + [v for _, v in curve]
    tops += [bar.expected[1] for bar in bars if bar.expected]
    high = 1.06 * max(*tops, 1e-12)
    ticks = ticks_between(0.0, high, 4)
    return BarChart(title, unit, alt, tuple(bars), high, ticks, labels, curve, note=note)


def six_labels(bars: list[UprightBar]) -> tuple[tuple[float, str], ...]:
    """Labels of at most six bars at equal distances."""
    every = max(1, -(-len(bars) // 6))
    return tuple((k + 0.5, bars[k].label) for k in range(0, len(bars), every))


def ends_and_middle(bars: list[UprightBar]) -> tuple[tuple[float, str], ...]:
    """Labels of the first, the middle and the last bar."""
    last = len(bars) - 1
    return tuple((k + 0.5, bars[k].label) for k in sorted({0, last // 2, last}) if bars)


def panels(*charts: BarChart | RowChart | None, remarks: tuple[str, ...] = ()) -> Markup | str:
    """Charts beside each other below their remarks, as HTML; empty without charts."""
    present = [chart for chart in charts if chart]
    return (
        page.filled_template("panels.html.j2", charts=present, remarks=remarks) if present else ""
    )
