"""Small SVG drawings for the documentation's pictures: a frame with axes, lines, dots, bars."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from pkmcal.arrays import Array
from pkmcal.calibration.plots import CALIBRATED_COLOUR, NOMINAL_COLOUR
from pkmcal.outcome.blocks.plot import linear_ticks

INK, MUTED, RULE = "#1a1e24", "#58626d", "#dde2e7"
NOMINAL, CALIBRATED, GOOD = NOMINAL_COLOUR, CALIBRATED_COLOUR, "#00664b"

Point = tuple[float, float]


def text(at: Point, words: str, colour: str = INK, anchor: str = "start", **more: object) -> str:
    """Words at a place; ``more`` are further attributes, underscores for hyphens."""
    extra = "".join(f' {key.replace("_", "-")}="{value}"' for key, value in more.items())
    return (
        f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" fill="{colour}" text-anchor="{anchor}"{extra}>'
        f"{escape(words)}</text>"
    )


def line(
    points: Iterable[Sequence[float]],
    colour: str,
    width: float = 1.5,
    dash: str = "",
    head: bool = False,
) -> str:
    """A polyline; ``head`` puts an arrow at its end."""
    path = "M" + "L".join(f"{p[0]:.2f},{p[1]:.2f}" for p in points)
    extra = f' stroke-dasharray="{dash}"' if dash else ""
    extra += f' marker-end="url(#head{colour.removeprefix("#")})"' if head else ""
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="{width}"{extra}/>'


def dot(at: Sequence[float], colour: str, radius: float = 3.0, fill: str | None = None) -> str:
    """A filled circle, or a ring where ``fill`` is another colour."""
    return (
        f'<circle cx="{at[0]:.2f}" cy="{at[1]:.2f}" r="{radius}" fill="{fill or colour}"'
        f' stroke="{colour}" stroke-width="1.5"/>'
    )


def arrow_heads(*colours: str) -> str:
    """Definitions that ``line(..., head=True)`` refers to."""
    heads = "".join(
        f'<marker id="head{c.removeprefix("#")}" viewBox="0 0 10 10" refX="9" refY="5"'
        f' markerWidth="9" markerHeight="9" markerUnits="userSpaceOnUse" orient="auto">'
        f'<path d="M0,1L10,5L0,9z" fill="{c}"/></marker>'
        for c in colours
    )
    return f"<defs>{heads}</defs>"


def svg(width: float, height: float, *parts: str) -> str:
    """A drawing of a size in CSS pixels."""
    return (
        f'<svg width="{width:g}" height="{height:g}" viewBox="0 0 {width:g} {height:g}"'
        f' font-family="Liberation Sans, Arial, sans-serif" font-size="13">{"".join(parts)}</svg>'
    )


@dataclass
class Plot:
    """A frame with axes; drawing methods take data coordinates and collect SVG parts.

    x, y : (low, high). labels : under and left of the frame. ticks : whether y has numbers.
    """

    x: Point
    y: Point
    labels: tuple[str, str]
    size: Point = (420.0, 300.0)
    title: str = ""
    ticks: bool = True
    parts: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.left, self.top = 58.0, 30.0
        self.right, self.bottom = self.size[0] - 12, self.size[1] - 44
        self.parts += [text((self.left, 18), self.title, font_weight="bold")] if self.title else []
        self._axes()

    def at(self, x: float, y: float) -> Point:
        """Data to drawing coordinates."""
        u = (x - self.x[0]) / (self.x[1] - self.x[0])
        v = (y - self.y[0]) / (self.y[1] - self.y[0])
        return (
            self.left + u * (self.right - self.left),
            self.bottom - v * (self.bottom - self.top),
        )

    def curve(self, x: Array, y: Array, colour: str, width: float = 2.0, dash: str = "") -> None:
        """A line through points (n,), cut off at the frame's top and bottom."""
        inside = np.clip(y, *self.y)
        points = [self.at(*p) for p in zip(x.tolist(), inside.tolist(), strict=True)]
        self.parts.append(line(points, colour, width, dash))

    def dots(self, x: Array, y: Array, colour: str, radius: float = 3.2) -> None:
        """Filled circles at points (n,)."""
        self.parts += [
            dot(self.at(*p), colour, radius) for p in zip(x.tolist(), y.tolist(), strict=True)
        ]

    def upright(self, x: float, colour: str, dash: str = "") -> None:
        """A vertical line over the frame's height."""
        self.parts.append(line([self.at(x, self.y[0]), self.at(x, self.y[1])], colour, 2, dash))

    def histogram(self, values: Array, borders: Array, colour: str, opacity: float = 0.55) -> None:
        """Bars of the values' density; what lies beyond the borders is left out."""
        share = np.histogram(values, borders)[0] / values.size / np.diff(borders)
        for low, high, value in zip(borders[:-1], borders[1:], share, strict=True):
            (x0, y0), (x1, y1) = self.at(float(low), float(value)), self.at(float(high), self.y[0])
            self.parts.append(
                f'<rect x="{x0 + 0.5:.2f}" y="{y0:.2f}" width="{x1 - x0 - 1:.2f}"'
                f' height="{max(y1 - y0, 0):.2f}" fill="{colour}" fill-opacity="{opacity}"/>'
            )

    def words(self, x: float, y: float, words: str, colour: str = INK) -> None:
        """Words at data coordinates."""
        self.parts.append(text(self.at(x, y), words, colour))

    def svg(self) -> str:
        """The finished plot."""
        return svg(*self.size, *self.parts)

    def _axes(self) -> None:
        for tick in linear_ticks(*self.x):
            place = self.at(tick.at, self.y[0])
            self.parts.append(line([place, (place[0], self.top)], RULE, 1))
            self.parts.append(text((place[0], place[1] + 17), tick.label, MUTED, "middle"))
        for tick in linear_ticks(*self.y) if self.ticks else ():
            place = self.at(self.x[0], tick.at)
            self.parts.append(line([place, (self.right, place[1])], RULE, 1))
            self.parts.append(text((place[0] - 7, place[1] + 4), tick.label, MUTED, "end"))
        middle = (self.left + self.right) / 2
        self.parts.append(text((middle, self.size[1] - 8), self.labels[0], MUTED, "middle"))
        half = (self.top + self.bottom) / 2
        turn = f"rotate(-90 14 {half:.1f})"
        self.parts.append(text((14, half), self.labels[1], MUTED, "middle", transform=turn))
