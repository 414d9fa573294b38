"""Plotly figures of studies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pkmcal.outcome import AXIS, LOOKS

TICKS = [0.01, 0.03, 0.1, 0.3, 1, 3]


def bars(name: str, x: Sequence[str], y: Sequence[float], unit: str, **marker: Any) -> Any:
    """One method's bars."""
    return {
        "type": "bar",
        "name": name,
        "x": list(x),
        "y": list(y),
        "marker": marker,
        "hovertemplate": f"%{{x}}: %{{y:.3f}} {unit}",
    }


def series(
    name: str, x: Sequence[Any], y: Sequence[float], colour: str, mode: str, **more: Any
) -> dict[str, Any]:
    """A line, marks, or both. more : of Plotly's scatter trace, over what stands here."""
    return {
        "type": "scatter",
        "mode": mode,
        "name": name,
        "x": list(x),
        "y": [round(v, 4) for v in y],
        "line": {"color": colour, "width": 1.5},
        "marker": {"color": colour, "size": 8},
        **more,
    }


def log_log(
    data: Sequence[dict[str, Any]], x: Sequence[float], x_title: str, y_title: str
) -> dict[str, Any]:
    """Series against x, both axes logarithmic."""
    axis = {**AXIS, "type": "log", "fixedrange": True}
    layout = {
        **LOOKS,
        "margin": {"l": 64, "r": 12, "t": 8, "b": 48},
        "legend": {"x": 1, "xanchor": "right", "y": 1, "bgcolor": "rgba(0,0,0,0)"},
        "xaxis": {**axis, "tickvals": list(x), "title": {"text": x_title}},
        "yaxis": {**axis, "tickvals": TICKS, "title": {"text": y_title}},
    }
    return {"data": list(data), "layout": layout, "config": {}}
