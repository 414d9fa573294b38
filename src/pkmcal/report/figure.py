"""The scene as a Plotly figure: plain data, drawn by the page's script.

Colours are names of the page's CSS variables; the script puts in the values of the light or the
dark theme. Lengths are millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.report.scene import ELLIPSE, Joint, Scene

RING = 25
"""Points of an ellipsoid's ring."""


def figure_of(
    scene: Scene, places: tuple[Array, Integers] | None = None, names: Sequence[str] = ()
) -> dict[str, Any]:
    """Traces, layout and configuration for ``Plotly.newPlot``.

    places : of measured targets (N, 3), base frame, and their configurations, by their names.
    """
    base, platform = scene.of_side("base"), scene.of_side("platform")
    return {
        "data": [
            _limbs(
                "Drawing", "--drawing", [(a.drawing, b.drawing) for a, b in _pairs(base, platform)]
            ),
            _limbs(
                f"Calibrated, × {scene.factor:g}",
                "--calibrated",
                [(a.shown, b.shown) for a, b in _pairs(base, platform)],
            ),
            _outline(base),
            _outline(platform),
            _vectors(scene.joints),
            _rings(scene),
            _centres(base, platform),
            *(_places(*places, names) if places is not None and len(places[0]) else ()),
        ],
        "layout": _layout(),
        "config": {"scrollZoom": True},
    }


def _pairs(base: tuple[Joint, ...], platform: tuple[Joint, ...]) -> list[tuple[Joint, Joint]]:
    return list(zip(base, platform, strict=True))


def _lines(segments: list[Array]) -> dict[str, list[float | None]]:
    """Coordinates (mm) of several lines (n, 3), a gap after each."""
    out: dict[str, list[float | None]] = {"x": [], "y": [], "z": []}
    for points in segments:
        for axis, name in enumerate("xyz"):
            out[name] += [*np.round(points[:, axis] * 1e3, 2).tolist(), None]
    return out


def _line(
    name: str, colour: str, width: float, segments: list[Array], **more: Any
) -> dict[str, Any]:
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "line": {"color": colour, "width": width},
        "hoverinfo": "skip",
        "connectgaps": False,
        **_lines(segments),
        **more,
    }


def _limbs(name: str, colour: str, ends: list[tuple[Array, Array]]) -> dict[str, Any]:
    return _line(name, colour, 4, [np.stack(pair) for pair in ends])


def _outline(joints: tuple[Joint, ...]) -> dict[str, Any]:
    """The body's joints in the order that goes around it."""
    points = np.array([joint.drawing for joint in joints])
    centred = points - points.mean(axis=0)
    around = np.argsort(np.arctan2(centred[:, 1], centred[:, 0]))
    closed = points[[*around, around[0]]]
    return _line(f"{joints[0].side} outline", "--quiet", 2, [closed], showlegend=False)


def _vectors(joints: tuple[Joint, ...]) -> dict[str, Any]:
    segments = [np.stack([joint.drawing, joint.shown]) for joint in joints]
    return _line("Change", "--ink", 6, segments)


def _rings(scene: Scene) -> dict[str, Any]:
    """Three rings of every centre's ellipsoid, along its principal planes."""
    angle = np.linspace(0, 2 * np.pi, RING)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    segments: list[Array] = []
    for joint in scene.joints:
        values, axes = np.linalg.eigh(joint.spread)
        half = axes * (ELLIPSE * np.sqrt(np.maximum(values, 0)))
        segments += [joint.shown + circle @ half[:, list(p)].T for p in ((0, 1), (0, 2), (1, 2))]
    return _line(f"{ELLIPSE:g}σ, × {scene.spread_factor:g}", "--calibrated", 2, segments)


def _centres(base: tuple[Joint, ...], platform: tuple[Joint, ...]) -> dict[str, Any]:
    """Markers of the drawing's centres with leg numbers and tooltips."""
    joints = (*base, *platform)
    points = np.round(np.array([joint.drawing for joint in joints]) * 1e3, 2)
    return {
        "type": "scatter3d",
        "mode": "markers+text",
        "name": "Joint centres, drawing",
        "showlegend": False,
        "x": points[:, 0].tolist(),
        "y": points[:, 1].tolist(),
        "z": points[:, 2].tolist(),
        "text": [str(joint.leg) for joint in joints],
        "textposition": "top center",
        "textfont": {"color": "--ink", "size": 13},
        "hovertext": [joint.tip.replace("; ", "<br>") for joint in joints],
        "hoverinfo": "text",
        "marker": {
            "size": 5,
            "color": "--drawing",
            "symbol": ["square"] * len(base) + ["circle"] * len(platform),
        },
    }


def _places(points: Array, configuration: Integers, names: Sequence[str]) -> list[dict[str, Any]]:
    """Markers where measured targets were."""
    at = np.round(points * 1e3, 2)
    marker = {
        "type": "scatter3d",
        "mode": "markers",
        "name": "Measured poses",
        "hovertext": [f"configuration {names[k]}" for k in configuration],
        "hoverinfo": "text",
        "marker": {"size": 2.5, "color": "--quiet", "symbol": "diamond"},
        **{axis: at[:, k].tolist() for k, axis in enumerate("xyz")},
    }
    return [marker]


def _layout() -> dict[str, Any]:
    axis = {
        "color": "--muted",
        "gridcolor": "--rule",
        "zerolinecolor": "--rule",
        "showbackground": False,
        "tickfont": {"size": 10},
        "nticks": 6,
    }
    return {
        "paper_bgcolor": "--card",
        "font": {"color": "--ink", "family": "system-ui, sans-serif", "size": 12},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "uirevision": "keep",
        "legend": {"orientation": "h", "y": 0, "x": 0, "bgcolor": "rgba(0,0,0,0)"},
        "hoverlabel": {"bgcolor": "--card", "font": {"color": "--ink"}},
        "scene": {
            "aspectmode": "data",
            "dragmode": "turntable",
            "camera": {
                "eye": {"x": 1.45, "y": -1.45, "z": 0.8},
                "center": {"x": 0, "y": 0, "z": -0.14},
            },
            **{f"{name}axis": {**axis, "title": {"text": f"{name} (mm)"}} for name in "xyz"},
        },
    }
