"""Plotly traces and layouts in the plane and in space; coordinates in space are drawn in mm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array

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
EYE_BESIDE_CAMERA = 1.2
"""Largest angle between eye and camera, rad, so that a single camera is seen from the side."""
EYE_AT_CORNER = {"x": 1.45, "y": -1.45, "z": 0.8}
PLOTLY_VIEW_ANGLE = np.pi / 4
"""Plotly's vertical field of view in space, rad."""
MAGNITUDE_COLOUR_SCALE = [[0.0, "--band"], [0.6, "--drawing"], [1.0, "--ink"]]
"""Colours of magnitudes, the smallest first."""
WIDE_SPACE_PICTURE, NARROW_SPACE_PICTURE = (1.5, 0.76), (1.0, 0.66)
"""Aspect ratio (width by height) of a plot in space, and the share of it for the data.

Names and numbers stand beside the data, in the same size in a small plot.
"""


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


def _plot_values(values: Iterable[Any]) -> list[Any]:
    """Names unchanged; numbers with five digits, None for those that are not finite."""
    return [
        value if isinstance(value, str) else float(f"{value:.5g}") if math.isfinite(value) else None
        for value in values
    ]


def line(
    name: str, colour: str, width: float, segments: Sequence[Array], **more: Any
) -> dict[str, Any]:
    """Trace of lines in space, each (n, 3), m."""
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "line": {"color": colour, "width": width},
        "hoverinfo": "skip",
        "connectgaps": False,
        **coordinates(segments),
        **more,
    }


def coordinates(segments: Sequence[Array]) -> dict[str, list[float | None]]:
    """Coordinates in mm of lines (n, 3), m, with a gap after each."""
    out: dict[str, list[float | None]] = {"x": [], "y": [], "z": []}
    for points in segments:
        for axis, name in enumerate("xyz"):
            out[name] += [*np.round(points[:, axis] * 1e3, 2).tolist(), None]
    return out


def markers(name: str, points: Array, marker: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Trace of markers at points (n, 3), m."""
    at = np.round(points * 1e3, 2)
    return {
        "type": "scatter3d",
        "mode": "markers",
        "name": name,
        "marker": marker,
        **{axis: at[:, k].tolist() for k, axis in enumerate("xyz")},
        **more,
    }


def coloured(name: str, points: Array, values: Array, unit: str, **more: Any) -> dict[str, Any]:
    """Trace of markers at points (n, 3), m, coloured by values (n,), with a colour bar."""
    style = {
        "size": 4,
        "color": [float(f"{x:.3g}") for x in values.tolist()],
        "colorscale": MAGNITUDE_COLOUR_SCALE,
        "showscale": True,
        "colorbar": {
            "title": {"text": unit, "side": "top"},
            "thickness": 12,
            "outlinewidth": 0,
            "x": 1.0,
            "len": 0.8,
        },
    }
    return markers(name, points, style, **more)


def space_layout(eye: dict[str, float] = EYE_AT_CORNER) -> dict[str, Any]:
    """Layout of a figure in space.

    eye : Plotly's camera position; from a corner by default.
    """
    axis = {**COMMON_AXIS_LAYOUT, "showbackground": False, "tickfont": {"size": 10}, "nticks": 6}
    return {
        **COMMON_PLOT_LAYOUT,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "uirevision": "keep",
        "scene": {
            "aspectmode": "data",
            "dragmode": "turntable",
            "camera": {"eye": eye},
            **{
                f"{name}axis": {**axis, "title": {"text": f"{name} (mm)", "font": {"size": 11}}}
                for name in "xyz"
            },
        },
    }


def path_between_cameras(cameras: Array) -> Array:
    """View direction (3,) from the middle of a machine between two of its cameras.

    No camera then stands in front of the machine.

    cameras : (S, 3) m from the middle.
    """
    around = np.sort(np.arctan2(cameras[:, 1], cameras[:, 0])) if len(cameras) else [-np.pi / 4]
    gaps = np.diff(np.append(around, around[0] + 2 * np.pi))
    angle = float(around[np.argmax(gaps)] + min(gaps.max() / 2, EYE_BESIDE_CAMERA))
    return np.array([0.92 * np.cos(angle), 0.92 * np.sin(angle), 0.4])


def uncropped(data: list[dict[str, Any]], direction: Array) -> dict[str, Any]:
    """Layout of a figure in space, with the view at which all of ``data`` fits.

    direction : (3,) from the data towards the eye.

    ``meta`` holds the view for ``NARROW_SPACE_PICTURE``, which the page uses for plots narrower
    than ``WIDE_SPACE_PICTURE``.
    """
    least, most = (
        np.array([f([v for t in data for v in t[axis] if v is not None]) for axis in "xyz"])
        for f in (np.nanmin, np.nanmax)
    )
    # Plotly's box is a sixteenth larger, and has a geometric mean of its sides of one
    sides = np.where(most > least, (most - least) * 17 / 16, 2.0)
    corners = sides / float(np.prod(sides)) ** (1 / 3) * (list(np.ndindex(2, 2, 2)) - np.array(0.5))
    direction = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], direction) / np.linalg.norm(direction[:2])
    axes = np.stack([right, np.cross(direction, right)], axis=1)

    def camera(width: float, inside: float) -> dict[str, dict[str, float]]:
        # a corner at depth d in front of the eye is in view if it lies within slope * d of the
        # axis; on each axis the extreme corner of either side fixes the distance and the centre
        """Plotly camera for an aspect ratio and the share of the plot that holds the data."""
        slope = inside * np.tan(PLOTLY_VIEW_ANGLE / 2) * np.array([width, 1.0])
        near, across = (corners @ direction)[:, None], corners @ axes / slope
        positive, negative = (near + across).max(axis=0), (near - across).max(axis=0)
        middle = axes @ (slope * (positive - negative) / 2)
        eye = middle + (positive + negative).max() / 2 * direction
        return {
            name: dict(zip("xyz", point.round(3).tolist(), strict=True))
            for name, point in (("eye", eye), ("center", middle))
        }

    layout = space_layout({})
    layout["scene"]["camera"] = camera(*WIDE_SPACE_PICTURE)
    return layout | {
        "meta": {"wide": WIDE_SPACE_PICTURE[0], "narrow": camera(*NARROW_SPACE_PICTURE)}
    }
