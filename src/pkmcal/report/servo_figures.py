"""Plotly figures of a study of servoing; colours are names of the page's CSS variables."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.control.study import Outcome, Study
from pkmcal.geometry.rigid import inverse
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.mechanisms.kinematics import inverse_result

COLOURS = {"true": "--quiet", "identified": "--drawing", "cad": "--good", "hand": "--calibrated"}
SHADES = {"identified": "rgba(0,104,168,.16)", "hand": "rgba(194,72,12,.16)"}
LOOKS = {
    "paper_bgcolor": "--card",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "font": {"color": "--ink", "family": "system-ui, sans-serif", "size": 12},
    "hoverlabel": {"bgcolor": "--card", "font": {"color": "--ink"}},
}
AXIS = {"color": "--muted", "gridcolor": "--rule", "zerolinecolor": "--rule", "linecolor": "--rule"}
FRAMES = 60
"""Pictures of the animation; more only make the page heavy."""
POINTS = 300
"""Points of a curve."""
LEAST = 1e-5
"""Part of the error's start below which a curve tells nothing."""
ALONG = 17
"""Places along an edge that is drawn; edges are curves in a mirror."""


def shares(o: Outcome) -> Array:
    """Norms of the error (R, K) as parts of the start's, of the runs that reached the goal; of all
    where none did.
    """
    return _parts(o, o.runs.error)


def _parts(o: Outcome, values: Array) -> Array:
    rows = o.runs.reached if o.reached else np.ones(len(values), dtype=bool)
    return values[rows] / np.maximum(values[rows, :1], 1e-300)


def _every(samples: int, most: int) -> Integers:
    return np.unique(np.linspace(0, samples - 1, min(samples, most)).round().astype(int))


def _rounded(values: Array, digits: int = 4) -> list[float]:
    return [float(f"{v:.{digits}g}") for v in values]


def curves(s: Study) -> dict[str, Any]:
    """Norm of the error against time, a line and a band for each estimate."""
    data: list[dict[str, Any]] = []
    time = s.outcomes[0].runs.time
    rows = _every(len(time), POINTS)
    for o in s.outcomes:
        values = np.maximum(shares(o)[:, rows], LEAST)
        name = o.estimate.name
        if name in SHADES:
            data += _band(time[rows], values, SHADES[name], name)
    for o in s.outcomes:
        values = np.maximum(np.median(shares(o)[:, rows], axis=0), LEAST)
        data.append(_curve(o, time[rows], values, "%{y:.2g} after %{x:.2f} s"))
    layout = _plane("time, s", "error / error at the start")
    layout["yaxis"] |= {"type": "log", "exponentformat": "power", "dtick": 1}
    return {"data": data, "layout": layout, "config": {}}


def tail(s: Study) -> dict[str, Any]:
    """Distance from the goal, as a part of the way, enlarged near zero."""
    data: list[dict[str, Any]] = []
    time = s.outcomes[0].runs.time
    rows = _every(len(time), POINTS)
    for o in s.outcomes:
        values = 100 * np.median(_parts(o, o.runs.way)[:, rows], axis=0)
        data.append(_curve(o, time[rows], values, "%{y:.2f} % after %{x:.2f} s"))
    layout = _plane("time, s", "% of the way")
    layout["yaxis"] |= {"range": [0, 10]}
    return {"data": data, "layout": layout, "config": {}}


def _curve(o: Outcome, time: Array, values: Array, hover: str) -> dict[str, Any]:
    dash = {"true": "dot", "cad": "dash"}.get(o.estimate.name, "solid")
    return {
        "type": "scatter",
        "mode": "lines",
        "name": o.estimate.title,
        "x": _rounded(time),
        "y": _rounded(values),
        "line": {"color": COLOURS[o.estimate.name], "width": 2.5, "dash": dash},
        "hovertemplate": hover,
    }


def _band(time: Array, values: Array, colour: str, name: str) -> list[dict[str, Any]]:
    both = np.concatenate([time, time[::-1]])
    edge = np.concatenate([values.max(axis=0), values.min(axis=0)[::-1]])
    band = {
        "type": "scatter",
        "mode": "lines",
        "line": {"width": 0},
        "fill": "toself",
        "fillcolor": colour,
        "x": _rounded(both),
        "y": _rounded(edge),
        "hoverinfo": "skip",
        "showlegend": False,
        "name": f"{name}, all runs",
    }
    return [band]


def _plane(x: str, y: str) -> dict[str, Any]:
    return {
        **LOOKS,
        "margin": {"l": 64, "r": 12, "t": 8, "b": 44},
        "legend": {"orientation": "h", "y": 1.12, "x": 0, "bgcolor": "rgba(0,0,0,0)"},
        "xaxis": {**AXIS, "title": {"text": x}},
        "yaxis": {**AXIS, "title": {"text": y}},
    }


# ------------------------------------------------------------------ in space


def _limbs(s: Study, poses: Array) -> tuple[Array, Array]:
    """Ends A and B (n, L, 3) of the true limbs at poses (n, 4, 4), mm."""
    machine = s.eye.true.machine
    layout, theta = machine.layout, machine.values
    readings, internal = inverse_result(layout, theta, poses)
    ends = limb_ends(layout, theta, np.nan_to_num(readings), poses, internal)
    a = np.broadcast_to(ends.a, ends.b.shape)
    return 1e3 * a, 1e3 * ends.b


def _segments(a: Array, b: Array) -> dict[str, list[float | None]]:
    """Coordinates of lines from a to b (L, 3), a gap after each."""
    out: dict[str, list[float | None]] = {}
    for axis, name in enumerate("xyz"):
        out[name] = [
            v
            for p, q in zip(a, b, strict=True)
            for v in (round(float(p[axis]), 1), round(float(q[axis]), 1), None)
        ]
    return out


def _ring(points: Array) -> dict[str, list[float]]:
    """Joints (L, 3) joined in the order that goes around their middle."""
    centred = points - points.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][:2]
    flat = centred @ across.T
    around = np.argsort(np.arctan2(flat[:, 1], flat[:, 0]))
    closed = points[[*around, around[0]]]
    return {name: np.round(closed[:, k], 1).tolist() for k, name in enumerate("xyz")}


def _line3(name: str, colour: str, width: float, **more: Any) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "line": {"color": colour, "width": width},
        "hoverinfo": "skip",
        "connectgaps": False,
        **more,
    }


def _moving(s: Study, pose: Array) -> list[dict[str, Any]]:
    """Coordinates of what moves, one a trace: each leg, then the platform."""
    a, b = (v[0] for v in _limbs(s, pose[None]))
    legs: list[dict[str, Any]] = [
        dict(_segments(a[j : j + 1], b[j : j + 1])) for j in range(len(a))
    ]
    return [*legs, dict(_ring(b))]


def space(s: Study, run: int) -> dict[str, Any]:
    """The machine on its way; what moves comes first, so that frames name it by its place."""
    shown = s.outcome("identified").runs
    start, goal = shown.T_base_platform[run, 0], shown.goals[run]
    seen = set(s.eye.true.legs.tolist())
    *legs, platform = _moving(s, start)
    data = [
        _line3(
            f"leg {j + 1}" + ("" if j in seen else ", not seen"),
            f"--leg{j % 8 + 1}" if j in seen else "--quiet",
            8 if j in seen else 4,
            **leg,
        )
        for j, leg in enumerate(legs)
    ]
    data.append(_line3("platform", "--ink", 6, **platform))
    a, b = (v[0] for v in _limbs(s, goal[None]))
    data.append(_line3("base", "--muted", 3, showlegend=False, **_ring(a)))
    dashed = _line3("goal", "--ink", 2, **_ring(b))
    dashed["line"]["dash"] = "dash"
    data.append(dashed)
    for name, colour in (("identified", "--muted"), ("hand", "--calibrated")):
        o = s.outcome(name)
        poses = o.runs.T_base_platform[run][_every(len(o.runs.time), FRAMES)]
        middle = _limbs(s, poses)[1].mean(axis=1)
        way = {axis: np.round(middle[:, k], 2).tolist() for k, axis in enumerate("xyz")}
        data.append(_line3(f"way, {o.estimate.title.lower()}", colour, 5, **way))
    return {"data": [*data, _eye(s)], "layout": _space_layout(), "config": {"scrollZoom": True}}


def _eye(s: Study) -> dict[str, Any]:
    """Where the camera is."""
    place = np.round(1e3 * inverse(s.eye.true.T_camera_base)[:3, 3], 1).tolist()
    return {
        "type": "scatter3d",
        "mode": "markers+text",
        "name": "camera",
        "text": ["camera"],
        "textposition": "top center",
        "textfont": {"color": "--ink", "size": 12},
        "hoverinfo": "skip",
        "showlegend": False,
        "marker": {"size": 5, "color": "--ink", "symbol": "square"},
        **{axis: [place[k]] for k, axis in enumerate("xyz")},
    }


def frames(s: Study, run: int) -> list[dict[str, Any]]:
    """The pictures of :func:`space`'s animation."""
    runs = s.outcome("identified").runs
    out: list[dict[str, Any]] = []
    for row in _every(int(runs.last[run]) + 1, FRAMES):
        moving = _moving(s, runs.T_base_platform[run, row])
        out.append(
            {
                "name": f"{runs.time[row]:.2f} s",
                "data": [{"type": "scatter3d", **trace} for trace in moving],
                "traces": list(range(len(moving))),
            }
        )
    return out


def _space_layout() -> dict[str, Any]:
    axis = {**AXIS, "showbackground": False, "tickfont": {"size": 10}, "nticks": 6}
    still = {"transition": {"duration": 0}}
    play = {"frame": {"duration": 60, "redraw": True}, "fromcurrent": True, **still}
    pause = {"frame": {"duration": 0, "redraw": False}, "mode": "immediate", **still}
    return {
        **LOOKS,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 70},
        "uirevision": "keep",
        "legend": {"orientation": "v", "y": 1, "x": 0, "bgcolor": "rgba(0,0,0,0)"},
        "scene": {
            "aspectmode": "data",
            "dragmode": "turntable",
            "camera": {"eye": {"x": 1.3, "y": -1.3, "z": 0.7}},
            **{f"{name}axis": {**axis, "title": {"text": f"{name} (mm)"}} for name in "xyz"},
        },
        "updatemenus": [
            {
                "type": "buttons",
                "direction": "left",
                "x": 0,
                "y": 0,
                "xanchor": "left",
                "yanchor": "top",
                "pad": {"t": 14},
                "showactive": False,
                "bgcolor": "--card",
                "bordercolor": "--quiet",
                "buttons": [
                    {"label": "▶ Play", "method": "animate", "args": [None, play]},
                    {"label": "❚❚ Pause", "method": "animate", "args": [[None], pause]},
                ],
            }
        ],
    }


# ------------------------------------------------------------------ in the image


def image(s: Study, run: int) -> dict[str, Any]:
    """Edges at start and goal, the ways of their ends, and the image's frame."""
    width, height = s.eye.camera.image_size
    data = [_frame(width, height)]
    runs = s.outcome("identified").runs
    first, goal = runs.T_base_platform[run, :1], runs.goals[run : run + 1]
    data += _edges(s, first, 1.2, "at the start", "dot")
    data += _edges(s, goal, 2.6, "at the goal", "solid")
    data += _ways(s, run, "identified", "solid")
    data += _ways(s, run, "hand", "dash")
    layout = {
        **LOOKS,
        "margin": {"l": 48, "r": 12, "t": 8, "b": 40},
        "legend": {"orientation": "h", "y": 1.1, "x": 0, "bgcolor": "rgba(0,0,0,0)"},
        "xaxis": {**AXIS, "title": {"text": "pixels"}, "range": [-0.04 * width, 1.04 * width]},
        "yaxis": {
            **AXIS,
            "range": [1.04 * height, -0.04 * height],
            "scaleanchor": "x",
            "scaleratio": 1,
        },
    }
    return {"data": data, "layout": layout, "config": {}}


def _frame(width: int, height: int) -> dict[str, Any]:
    right, bottom = width - 0.5, height - 0.5
    return {
        "type": "scatter",
        "mode": "lines",
        "name": "image",
        "x": [-0.5, right, right, -0.5, -0.5],
        "y": [-0.5, -0.5, bottom, bottom, -0.5],
        "line": {"color": "--muted", "width": 1.5},
        "hoverinfo": "skip",
        "showlegend": False,
    }


def _pixels(s: Study, poses: Array, places: int) -> Array:
    """Pixels (n, E, places, 2) along the edges of the seen legs."""
    machine = s.eye.true.machine
    return s.eye.points(poses, np.nan_to_num(machine.inverse(poses)), places).pixel


def _edges(s: Study, pose: Array, width: float, name: str, dash: str) -> list[dict[str, Any]]:
    pixels = _pixels(s, pose, ALONG)[0]
    return [
        {
            "type": "scatter",
            "mode": "lines",
            "name": f"edges {name}",
            "legendgroup": name,
            "showlegend": e == 0,
            "line": {"color": f"--leg{int(leg) % 8 + 1}", "width": width, "dash": dash},
            "hoverinfo": "skip",
            "x": _pixel_list(pixels[e, :, 0]),
            "y": _pixel_list(pixels[e, :, 1]),
        }
        for e, leg in enumerate(s.eye.tubes.leg)
    ]


def _ways(s: Study, run: int, name: str, dash: str) -> list[dict[str, Any]]:
    """Ways of both ends of each leg's first edge."""
    o = s.outcome(name)
    poses = o.runs.T_base_platform[run][_every(len(o.runs.time), FRAMES)]
    pixels = _pixels(s, poses, 3)
    data: list[dict[str, Any]] = []
    for e in range(0, len(s.eye.tubes.leg), 2):
        ways = [pixels[:, e, 0], pixels[:, e, -1]]
        gap: list[float | None] = [None]
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "name": f"way, {o.estimate.title.lower()}",
                "legendgroup": f"way {name}",
                "showlegend": e == 0,
                "line": {"color": COLOURS[name], "width": 1.6, "dash": dash},
                "hoverinfo": "skip",
                "x": [*_pixel_list(ways[0][:, 0]), *gap, *_pixel_list(ways[1][:, 0])],
                "y": [*_pixel_list(ways[0][:, 1]), *gap, *_pixel_list(ways[1][:, 1])],
            }
        )
    return data


def _pixel_list(values: Array) -> list[float | None]:
    return [round(float(v), 1) if np.isfinite(v) else None for v in values]
