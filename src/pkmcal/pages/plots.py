"""Plots in the plane and in space, as the page's Plotly draws them: their looks, and what stands in
space, where lengths are millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import apply

TRANSPARENT_COLOUR = "rgba(0,0,0,0)"
COMMON_PLOT_LAYOUT: dict[str, Any] = {
    "paper_bgcolor": "--card",
    "plot_bgcolor": TRANSPARENT_COLOUR,
    "font": {"color": "--ink", "family": "system-ui, sans-serif", "size": 12},
    "hoverlabel": {"bgcolor": "--card", "font": {"color": "--ink"}},
}
"""What the layouts of all plots have in common."""
COMMON_AXIS_LAYOUT: dict[str, Any] = {
    "color": "--muted",
    "gridcolor": "--rule",
    "zerolinecolor": "--rule",
    "linecolor": "--rule",
}
"""And their axes."""
EYE_BESIDE_CAMERA = 1.2
"""rad that the eye stands beside a camera at most, so that a single one looks across."""
EYE_AT_CORNER = {"x": 1.45, "y": -1.45, "z": 0.8}
PLOTLY_VIEW_ANGLE = np.pi / 4
"""From below to above in a picture in space, rad: Plotly's."""
MAGNITUDE_COLOUR_SCALE = [[0.0, "--band"], [0.6, "--drawing"], [1.0, "--ink"]]
"""Of magnitudes, the least first."""
WIDE_SPACE_PICTURE, NARROW_SPACE_PICTURE = (1.5, 0.76), (1.0, 0.66)
"""Widths of pictures in space, in heights, and the part of each that what is drawn may take: names
and numbers stand beside it, of the same size in a small picture."""
FRUSTUM_POINTS_A_SIDE = 6
"""Points of each side of a picture's border that a frustum is drawn through."""


def plane(x: str, y: str) -> dict[str, Any]:
    """Layout of a plot of y against x, which are named by the axes' titles; the legend above."""
    return {
        **COMMON_PLOT_LAYOUT,
        "margin": {"l": 64, "r": 12, "t": 8, "b": 44},
        # see-through, for the highest tick's number stands half behind it
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
    """A line, marks or both in the plane, with gaps where a value is none; more : of Plotly's
    trace, over what stands here.
    """
    return {
        "type": "scatter",
        "mode": mode,
        "name": name,
        "x": _drawn(x),
        "y": _drawn(y),
        "line": {"color": colour, "width": 1.5},
        "marker": {"color": colour, "size": 8},
        **more,
    }


def bars(name: str, x: Iterable[Any], y: Iterable[float], **marker: Any) -> dict[str, Any]:
    """A trace of bars that look like marker."""
    return {
        "type": "bar",
        "name": name,
        "x": _drawn(x),
        "y": _drawn(y),
        "marker": marker,
        "hovertemplate": "%{x}: %{y:.3g}",
    }


def _drawn(values: Iterable[Any]) -> list[Any]:
    """Names, or numbers with five digits and None for those that are not finite."""
    return [
        value if isinstance(value, str) else float(f"{value:.5g}") if math.isfinite(value) else None
        for value in values
    ]


def line(
    name: str, colour: str, width: float, segments: Sequence[Array], **more: Any
) -> dict[str, Any]:
    """A trace of lines in space, each (n, 3), m."""
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
    """Coordinates (mm) of lines (n, 3), a gap after each."""
    out: dict[str, list[float | None]] = {"x": [], "y": [], "z": []}
    for points in segments:
        for axis, name in enumerate("xyz"):
            out[name] += [*np.round(points[:, axis] * 1e3, 2).tolist(), None]
    return out


def markers(name: str, points: Array, marker: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A trace of marks at points (n, 3), m."""
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
    """A trace of marks at points (n, 3), m, in the colours of values (n,), with their scale."""
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


def ring(points: Array) -> Array:
    """A body's joints (L, 3) in the order that goes around their middle, closed (L + 1, 3)."""
    centred = points - points.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][:2]
    around = np.argsort(np.arctan2(*(centred @ across.T).T))
    return points[[*around, around[0]]]


def space_layout(eye: dict[str, float] = EYE_AT_CORNER) -> dict[str, Any]:
    """The layout of a figure in space, seen from ``eye``, a corner unless told."""
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
    """The way (3,) from which a machine and its cameras, at (S, 3) m from its middle, are looked
    at: between two cameras, so that none stands before it.
    """
    around = np.sort(np.arctan2(cameras[:, 1], cameras[:, 0])) if len(cameras) else [-np.pi / 4]
    gaps = np.diff(np.append(around, around[0] + 2 * np.pi))
    angle = float(around[np.argmax(gaps)] + min(gaps.max() / 2, EYE_BESIDE_CAMERA))
    return np.array([0.92 * np.cos(angle), 0.92 * np.sin(angle), 0.4])


def uncropped(data: list[dict[str, Any]], direction: Array) -> dict[str, Any]:
    """The layout of a figure in space that is seen with all of ``data`` in the picture.

    direction : (3,) from what is drawn towards the eye. In ``meta`` stands how
    ``NARROW_SPACE_PICTURE`` pictures are looked at; the page takes it where they are narrower than
    ``WIDE_SPACE_PICTURE``.
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
        # a corner at depth d before the eye is inside where it lies within slope d of the middle,
        # so on each axis the corners on either side decide how far away, and what the middle is
        slope = inside * np.tan(PLOTLY_VIEW_ANGLE / 2) * np.array([width, 1.0])
        near, across = (corners @ direction)[:, None], corners @ axes / slope
        one, other = (near + across).max(axis=0), (near - across).max(axis=0)
        middle = axes @ (slope * (one - other) / 2)
        eye = middle + (one + other).max() / 2 * direction
        return {
            name: dict(zip("xyz", point.round(3).tolist(), strict=True))
            for name, point in (("eye", eye), ("center", middle))
        }

    layout = space_layout({})
    layout["scene"]["camera"] = camera(*WIDE_SPACE_PICTURE)
    return layout | {
        "meta": {"wide": WIDE_SPACE_PICTURE[0], "narrow": camera(*NARROW_SPACE_PICTURE)}
    }


def frustum(camera: Camera, T_base_camera: Array, depth: float) -> list[Array]:
    """Lines (n, 3), m, base frame: the picture's border at some depth, and the rays to its corners.

    Where the lens or mirror sees nothing at the border, its field's, as far as it goes; of a field
    that is wider than a plane can hold, at a distance instead of a depth.
    """
    right, bottom = camera.image_size[0] - 0.5, camera.image_size[1] - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    at = np.arange(4 * FRUSTUM_POINTS_A_SIDE + 1) / FRUSTUM_POINTS_A_SIDE
    border = np.stack([np.interp(at, np.arange(5), corners[:, c]) for c in (0, 1)], axis=-1)
    centre = (border.max(axis=0) + border.min(axis=0)) / 2
    share = np.linspace(1, 0, 41)[:, None, None]
    rays = camera.ray(centre + share * (border - centre))
    first = np.argmax(np.isfinite(rays).all(axis=-1), axis=0)
    rays = rays[first, np.arange(len(border))]
    if not np.isfinite(rays).all():
        return []
    deep = rays[:, 2].min()
    points = rays * depth / (rays[:, 2:] if deep > 0.3 else 1.0)
    in_view = apply(T_base_camera, points)
    eye = T_base_camera[:3, 3]
    return [in_view, *(np.stack([eye, in_view[k * FRUSTUM_POINTS_A_SIDE]]) for k in range(4))]
