"""Plotly traces and layouts in the plane."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

TRANSPARENT_COLOUR = "rgba(0,0,0,0)"
COMMON_PLOT_LAYOUT: dict[str, Any] = {
    "paper_bgcolor": "--card",
    "plot_bgcolor": TRANSPARENT_COLOUR,
    "font": {"color": "--ink", "family": "system-ui, sans-serif", "size": 12},
    "hoverlabel": {"bgcolor": "--card", "font": {"color": "--ink"}},
}
"""Layout entries common to all plots."""
COMMON_AXIS_LAYOUT: dict[str, Any] = {
    "color": "--muted",
    "gridcolor": "--rule",
    "zerolinecolor": "--rule",
    "linecolor": "--rule",
}
"""Layout entries common to all axes."""


def plane(x: str, y: str) -> dict[str, Any]:
    """Layout of a plot of y against x, with the axes' titles; the legend is above."""
    return {
        **COMMON_PLOT_LAYOUT,
        "margin": {"l": 64, "r": 12, "t": 8, "b": 44},
        # transparent: half of the highest tick's number lies behind it
        "legend": {
            "orientation": "h",
            "x": 0,
            "y": 1.0,
            "yanchor": "bottom",
            "bgcolor": TRANSPARENT_COLOUR,
        },
        "xaxis": {**COMMON_AXIS_LAYOUT, "title": {"text": x}},
        "yaxis": {**COMMON_AXIS_LAYOUT, "title": {"text": y}},
    }


def trace(
    name: str,
    x: Iterable[Any],
    y: Iterable[float],
    colour: str,
    mode: str = "lines+markers",
    **more: Any,
) -> dict[str, Any]:
    """Line, markers or both in the plane, with gaps at values that are not finite.

    more : further entries of Plotly's trace, which take precedence.
    """
    return {
        "type": "scatter",
        "mode": mode,
        "name": name,
        "x": _plot_values(x),
        "y": _plot_values(y),
        "line": {"color": colour, "width": 1.5},
        "marker": {"color": colour, "size": 8},
        **more,
    }


def bars(name: str, x: Iterable[Any], y: Iterable[float], **marker: Any) -> dict[str, Any]:
    """Trace of bars.

    marker : entries of Plotly's marker.
    """
    return {
        "type": "bar",
        "name": name,
        "x": _plot_values(x),
        "y": _plot_values(y),
        "marker": marker,
        "hovertemplate": "%{x}: %{y:.3g}",
    }


def _plot_values(values: Iterable[Any]) -> list[Any]:
    """Names unchanged; numbers with five digits, None for those that are not finite."""
    return [
        value if isinstance(value, str) else float(f"{value:.5g}") if math.isfinite(value) else None
        for value in values
    ]
