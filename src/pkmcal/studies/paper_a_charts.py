"""[A] Fig. 4 and the accuracy by number of poses as Plotly figures; colours are CSS names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.reproduce.paper_a_expected import MEAN_ERRORS
from pkmcal.reproduce.paper_a_study import BOUND, CORRECTED, DRAWING, JOINT, PRINTED

LABELS = {
    DRAWING: "the drawing, before",
    PRINTED: "four steps as printed",
    CORRECTED: "four steps corrected",
    JOINT: "joint estimate",
    BOUND: "Cramér-Rao bound",
}
COLOURS = {PRINTED: "--quiet", CORRECTED: "--drawing", JOINT: "--calibrated", BOUND: "--ink"}
RANGE = (0.005, 5.0)
"""mm that the logarithmic axis of errors holds."""
LOOKS = {
    "paper_bgcolor": "--card",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"color": "--ink", "family": "system-ui, sans-serif", "size": 12},
    "hoverlabel": {"bgcolor": "--card", "font": {"color": "--ink"}},
}
AXIS = {"color": "--muted", "gridcolor": "--rule", "zerolinecolor": "--rule", "linecolor": "--rule"}
TICKS = [0.01, 0.03, 0.1, 0.3, 1, 3]


def figure_4(
    names: tuple[str, ...], values: Array, mean_error: Mapping[str, Array]
) -> dict[str, Any]:
    """True values (30,) as a line, mean errors (30,) of each method as bars below; m."""
    bars = [
        {
            "type": "bar",
            "name": LABELS[method],
            "x": list(names),
            "y": _mm(mean_error[method]),
            "marker": _bar_style(method, colour),
            "hovertemplate": "%{x}: %{y:.3f} mm",
        }
        for method, colour in COLOURS.items()
    ]
    return {
        "data": [*bars, _before(names, mean_error[DRAWING]), _true_values(names, values)],
        "layout": _figure_4_layout(),
        "config": {},
    }


def _before(names: tuple[str, ...], errors: Array) -> dict[str, Any]:
    """The drawing's errors, a dash across each parameter's bars."""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": LABELS[DRAWING],
        "x": list(names),
        "y": _mm(errors),
        "marker": {
            "symbol": "line-ew-open",
            "size": 22,
            "color": "--muted",
            "line": {"width": 2, "color": "--muted"},
        },
        "hovertemplate": "%{x}: %{y:.3f} mm",
    }


def _true_values(names: tuple[str, ...], values: Array) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": "true value",
        "x": list(names),
        "y": _mm(values),
        "yaxis": "y2",
        "line": {"color": "--leg3", "width": 1.5},
        "marker": {"size": 5, "color": "--leg3"},
        "hovertemplate": "%{x}: %{y:.1f} mm",
    }


def _bar_style(method: str, colour: str) -> dict[str, Any]:
    """Filled, but for the bound, which is no estimate."""
    if method != BOUND:
        return {"color": colour}
    return {"color": "rgba(0,0,0,0)", "line": {"color": colour, "width": 1.2}}


def _mm(values: Array) -> list[float]:
    return np.round(1e3 * values, 4).tolist()


def _papers_band() -> tuple[dict[str, Any], dict[str, Any]]:
    """The range of errors that the paper reports: a shape and its label."""
    band = {
        "type": "rect",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "y0": 1e3 * MEAN_ERRORS[0],
        "y1": 1e3 * MEAN_ERRORS[1],
        "fillcolor": "--band",
        "line": {"width": 0},
        "layer": "below",
    }
    said = {
        "xref": "paper",
        "x": 1.0,
        "xanchor": "right",
        "y": float(np.log10(1e3 * MEAN_ERRORS[1])),
        "yanchor": "bottom",
        "text": "grey band: the paper, 0.04 to 1 mm",
        "showarrow": False,
        "font": {"size": 11, "color": "--muted"},
    }
    return band, said


def _figure_4_layout() -> dict[str, Any]:
    low, high = (float(np.log10(v)) for v in RANGE)
    band, said = _papers_band()
    error_axis = {
        **AXIS,
        "type": "log",
        "range": [low, high],
        "domain": [0.0, 0.68],
        "tickvals": TICKS,
        "title": {"text": "mean |error|, mm"},
    }
    value_axis = {**AXIS, "domain": [0.76, 1.0], "title": {"text": "true value, mm"}}
    return {
        **LOOKS,
        "margin": {"l": 64, "r": 8, "t": 34, "b": 46},
        "barmode": "group",
        "bargap": 0.22,
        "bargroupgap": 0,
        "legend": {
            "orientation": "h",
            "y": 1.0,
            "yanchor": "bottom",
            "x": 0,
            "traceorder": "normal",
        },
        "xaxis": {
            **AXIS,
            "tickangle": -60,
            "anchor": "y",
            "showgrid": False,
            "fixedrange": True,
            "range": [-0.7, 29.7],
        },
        "yaxis": {**error_axis, "fixedrange": True},
        "yaxis2": {**value_axis, "fixedrange": True},
        "shapes": [band],
        "annotations": [said],
    }


def by_poses(
    found: Mapping[int, tuple[float, float]],
    bound: Mapping[int, float],
    prototype: Mapping[int, float],
) -> dict[str, Any]:
    """End-effector (mm, with its standard error) by poses a station, on logarithmic axes."""
    poses = sorted(found)
    last = poses[-1]
    ours = {
        "type": "scatter",
        "mode": "lines+markers",
        "name": "joint estimate",
        "x": poses,
        "y": [round(found[n][0], 4) for n in poses],
        "error_y": {"array": [round(2 * found[n][1], 4) for n in poses], "color": "--calibrated"},
        "line": {"color": "--calibrated"},
        "marker": {"color": "--calibrated", "size": 8},
    }
    falling = [bound[last] * (last / n) ** 0.5 for n in poses]
    limit = [bound[n] for n in poses]
    others = [
        _series("Cramér-Rao bound", poses, limit, "--ink", "lines", "dot"),
        _series("as N to the power of −½", poses, falling, "--quiet", "lines", "dash"),
        _series("independent prototype", [*prototype], [*prototype.values()], "--drawing",
                "markers"),
    ]  # fmt: skip
    axis = {**AXIS, "type": "log", "fixedrange": True}
    layout = {
        **LOOKS,
        "margin": {"l": 64, "r": 12, "t": 8, "b": 48},
        "legend": {"x": 1, "xanchor": "right", "y": 1, "bgcolor": "rgba(0,0,0,0)"},
        "xaxis": {**axis, "tickvals": poses, "title": {"text": "poses a station, N"}},
        "yaxis": {**axis, "tickvals": TICKS, "title": {"text": "displacement, mm"}},
    }
    return {"data": [others[0], others[1], ours, others[2]], "layout": layout, "config": {}}


def _series(
    name: str, x: list[int], y: list[float], colour: str, mode: str, dash: str = "solid"
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": mode,
        "name": name,
        "x": x,
        "y": [round(v, 4) for v in y],
        "line": {"color": colour, "dash": dash, "width": 1.5},
        "marker": {"color": colour, "size": 9, "symbol": "diamond-open"},
    }
