"""Calibrated machine in space with its cameras, tubes, and a slider through the measured poses.

A Plotly figure, true to scale, in millimetres. Moving traces come first, so that the animation's
frames refer to them by index.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.cameras.frustum import frustum
from pkmcal.geometry.outlines import ring
from pkmcal.geometry.rigid import inverse
from pkmcal.identify.estimate import Estimate
from pkmcal.mechanisms import Machine
from pkmcal.outcome import Plot
from pkmcal.pages.page import N_COLOURS
from pkmcal.pages.plots import line, markers, path_between_cameras, uncropped
from pkmcal.report.links import Links
from pkmcal.session.load import Session
from pkmcal.wording import count

MOST_SLIDER_POSES = 90
"""Poses of the slider; more would make the page large and the slider too fine for a finger."""
TUBE_RING_CORNERS = 10
"""Corners of a drawn tube's cross-section."""
FRUSTUM_DEPTH_SHARE, LEAST_FRUSTUM_DEPTH = 0.18, 0.1
"""Depth of a camera's frustum, in distances between camera and machine, and least depth.

The least depth is in sizes of the machine.
"""
MOST_CAMERAS_NAMED = 12
"""Most cameras that have their names beside them."""


class PosedLimbs(NamedTuple):
    """Legs in K poses, base frame, m.

    a, b : (K, L, 3) ends on base and platform.
    arms : arrays (K, k, 3), points from the carrier to each leg's end a.
    """

    a: Array
    b: Array
    arms: tuple[Array, ...]


def posed_limbs(machine: Machine, joints: Array, T_base_platform: Array) -> PosedLimbs:
    """Legs at readings (K, m) and poses (K, 4, 4)."""
    ends = machine.ends_at(joints, T_base_platform)
    arms, shape = machine.arms_at(joints), (len(joints), machine.n_legs, 3)
    a, b = (np.broadcast_to(x, shape) for x in (ends.a, ends.b))
    return PosedLimbs(a, b, tuple(np.broadcast_to(x, (len(joints), *x.shape[-2:])) for x in arms))


def plot(
    session: Session,
    estimate: Estimate,
    links: Links,
    places: tuple[Array, Integers],
    most: int = MOST_SLIDER_POSES,
) -> Plot | None:
    """Figure with at most ``most`` poses; None if no pose was estimated.

    places : measured targets (N, 3), base frame, m, and their configurations (N,).
    """
    used = np.flatnonzero(estimate.configurations)
    if not len(used):
        return None
    # poses of the slider, evenly chosen
    some = used[np.unique(np.linspace(0, len(used) - 1, min(len(used), most)).astype(int))]
    machine, state = estimate.machine, estimate.state
    limbs = posed_limbs(machine, session.joints[some], state.T_base_platform[some])
    names = [session.configurations[k] for k in some]
    cameras = np.array([inverse(T)[:3, 3] for T in state.T_camera_base[: len(session.stations)]])
    frames = _frames(machine, limbs, names)
    still = _static_traces(session, estimate, limbs, links, places)
    data = [*_moving_traces(machine, frames[0]["data"]), *still]
    layout = _layout(limbs, cameras.reshape(-1, 3), data, names)
    fewer = f" of {len(used)}, evenly chosen" if len(some) < len(used) else ""
    return Plot(
        "photographed",
        "In space, true to scale",
        f"Drag to turn, wheel or pinch to come nearer. The slider takes the machine through"
        f" {count(len(some), 'pose')}{fewer}; a click on a pose's point leads to its image.",
        "The calibrated machine in three dimensions with its tubes, its cameras' fields of view,"
        " and the poses that were measured; the table has the cameras' places.",
        {"data": data, "layout": layout, "config": {"scrollZoom": True}},
        height=560,
        frames=frames,
    )


# ------------------------------------------------------------------ moving traces


def _frames(machine: Machine, limbs: PosedLimbs, names: list[str]) -> tuple[dict[str, Any], ...]:
    """Frame of each pose: the legs' tubes, their axes, their arms, and the platform."""
    tubes = [_cylinders(machine, limbs, j) for j in range(machine.n_legs)]
    out: list[dict[str, Any]] = []
    for k, name in enumerate(names):
        legs = [np.stack([limbs.a[k, j], limbs.b[k, j]]) for j in range(machine.n_legs)]
        arms = [arm[k] for arm in limbs.arms if arm.shape[-2] > 1]
        lines = [_gapped(legs), _gapped(arms), _gapped([ring(limbs.b[k])])]
        moving = [{"type": "mesh3d", **_axes(points[k])} for points in tubes]
        moving += [{"type": "scatter3d", **_axes(points)} for points in lines]
        out.append({"name": name, "data": moving, "traces": list(range(len(moving)))})
    return tuple(out)


def _moving_traces(machine: Machine, first: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Traces of the first frame, with their styles."""
    out: list[dict[str, Any]] = []
    lines = (("axes of the legs", "--muted", 3), ("arms", "--ink", 7), ("platform", "--ink", 5))
    for n, trace in enumerate(first):
        if n < machine.n_legs:
            many = len(trace["x"]) // (2 * TUBE_RING_CORNERS)
            faces = _faces(many)
            out.append(
                {
                    **trace,
                    "name": f"leg {n + 1}",
                    "color": f"--leg{n % N_COLOURS + 1}",
                    **{letter: faces[:, c] for c, letter in enumerate("ijk")},
                    "flatshading": False,
                    "lighting": {"ambient": 0.65, "diffuse": 0.5, "specular": 0.1},
                    "hoverinfo": "name",
                    "showlegend": False,
                }
            )
        else:
            name, colour, width = lines[n - machine.n_legs]
            style = line(name, colour, width, (), showlegend=False)
            out.append({**style, **trace})
    return out


def _cylinders(machine: Machine, limbs: PosedLimbs, leg: int) -> Array:
    """Rings of a leg's tubes in all poses, (K, 2 n TUBE_RING_CORNERS, 3) m.

    Tubes beyond the leg's end have length 0.
    """
    a, b = limbs.a[:, leg], limbs.b[:, leg]
    length = np.linalg.norm(b - a, axis=-1)
    u = (b - a) / length[:, None]
    other = np.eye(3)[np.argmin(np.abs(u), axis=-1)]
    # v and w span the cross-section
    v = np.cross(u, other)
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    w = np.cross(u, v)
    angle = 2 * np.pi * np.arange(TUBE_RING_CORNERS) / TUBE_RING_CORNERS
    across = np.cos(angle)[:, None] * v[:, None] + np.sin(angle)[:, None] * w[:, None]
    rings: list[Array] = []
    radii = machine.values[machine.layout.radius[leg]]
    for tube, radius in zip(machine.document.legs[leg].tubes, radii, strict=True):
        for end in (tube.start, tube.stop):
            along = np.minimum(end, length)[:, None] * u
            rings.append((a + along)[:, None] + radius * across)
    none = np.zeros((len(a), 0, 3))
    return np.concatenate([none, *rings], axis=1)


def _faces(tubes: int) -> Integers:
    """Triangles (n, 3) between the two rings of each tube."""
    corner = np.arange(TUBE_RING_CORNERS)
    following = (corner + 1) % TUBE_RING_CORNERS
    sides = np.concatenate(
        [
            np.column_stack([corner, following, corner + TUBE_RING_CORNERS]),
            np.column_stack([following, following + TUBE_RING_CORNERS, corner + TUBE_RING_CORNERS]),
        ]
    )
    return (sides + 2 * TUBE_RING_CORNERS * np.arange(tubes)[:, None, None]).reshape(-1, 3)


# ------------------------------------------------------------------ static traces


def _static_traces(
    session: Session,
    estimate: Estimate,
    limbs: PosedLimbs,
    links: Links,
    places: tuple[Array, Integers],
) -> list[dict[str, Any]]:
    """Traces of base, cameras, poses, and targets measured by trackers or boards."""
    carried = np.stack([arm[0, 0] for arm in limbs.arms])
    out = [line("base", "--muted", 4, [ring(carried)], showlegend=False)]
    # frustums reach towards the machine, and stay visible close to it
    ends = np.concatenate([limbs.a[0], limbs.b[0]])
    middle, least = ends.mean(axis=0), LEAST_FRUSTUM_DEPTH * float(np.ptp(ends, axis=0).max())
    eyes = [inverse(T) for T in estimate.state.T_camera_base[: len(session.stations)]]
    if eyes:
        lines = [
            part
            for station, T in zip(session.stations, eyes, strict=True)
            for depth in [
                max(FRUSTUM_DEPTH_SHARE * float(np.linalg.norm(T[:3, 3] - middle)), least)
            ]
            for part in frustum(station.camera, T, depth)
        ]
        out.append(line("cameras", "--ink", 3, lines))
        names = [station.name for station in session.stations]
        out.append(
            markers(
                "camera",
                np.stack([T[:3, 3] for T in eyes]),
                {"size": 4, "color": "--ink", "symbol": "square"},
                mode="markers+text" if len(eyes) <= MOST_CAMERAS_NAMED else "markers",
                text=names,
                textposition="top center",
                textfont={"color": "--ink", "size": 12},
                hoverinfo="text",
                hovertext=[f"camera of {name}" for name in names],
                showlegend=False,
            )
        )
    used = np.flatnonzero(estimate.configurations)
    style = {"size": 3, "color": "--calibrated"}
    out.append(_poses("measured poses", estimate.state.T_base_platform[used, :3, 3], used, style,
                      session, links))  # fmt: skip
    if len(places[0]):
        style = {"size": 2.5, "color": "--drawing", "symbol": "diamond"}
        out.append(_poses("measured targets", *places, style, session, links))
    return out


def _poses(
    name: str,
    points: Array,
    configuration: Integers,
    style: dict[str, Any],
    session: Session,
    links: Links,
) -> dict[str, Any]:
    """Markers at points (N, 3), each linked to its configuration's image."""
    return markers(
        name,
        points,
        style,
        hoverinfo="text",
        hovertext=[f"configuration {session.configurations[k]}" for k in configuration],
        customdata=[links.to_configuration(int(k)) for k in configuration],
    )


# ------------------------------------------------------------------ layout


def _layout(
    limbs: PosedLimbs, cameras: Array, data: list[dict[str, Any]], names: list[str]
) -> dict[str, Any]:
    """Layout seen from between the cameras (S, 3), m, with all data in view."""
    middle = np.concatenate([limbs.a[0], limbs.b[0]]).mean(axis=0)
    layout = uncropped(data, path_between_cameras(cameras - middle))
    layout["legend"] = {"orientation": "h", "y": 1, "x": 0, "bgcolor": "rgba(0,0,0,0)"}
    layout["margin"]["b"] = 78
    if len(names) > 1:
        layout["sliders"] = [_slider(names)]
    return layout


def _slider(names: list[str]) -> dict[str, Any]:
    """Slider with a step for each pose."""
    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": True},
             "transition": {"duration": 0}}  # fmt: skip
    return {
        "active": 0,
        "x": 0.02,
        "len": 0.96,
        "y": 0,
        "pad": {"t": 8, "b": 4},
        "currentvalue": {"prefix": "configuration ", "font": {"color": "--ink", "size": 13}},
        "font": {"color": "--muted", "size": 10},
        "bgcolor": "--rule",
        "bordercolor": "--quiet",
        "activebgcolor": "--quiet",
        "tickcolor": "--quiet",
        "ticklen": 4,
        "minorticklen": 2,
        "steps": [{"label": name, "method": "animate", "args": [[name], still]} for name in names],
    }


def _gapped(segments: list[Array]) -> Array:
    """Lines (n, 3) in one array (m, 3), separated by NaN."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([np.zeros((0, 3)), *(x for s in segments for x in (s, gap))])


def _axes(points: Array) -> dict[str, Array]:
    """Coordinates of points (n, 3), m, in mm with one decimal."""
    rounded = np.round(points * 1e3, 1)
    return {axis: rounded[:, c] for c, axis in enumerate("xyz")}
