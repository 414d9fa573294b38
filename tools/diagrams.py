"""The documentation's drawings, each from the program's own functions and a simulated
session.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from plots import CALIBRATED, GOOD, INK, MUTED, NOMINAL, Plot, arrow_heads, dot, line, svg, text
from scipy.interpolate import CubicSpline

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import apply, inverse, look_at
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.observe import legs, profiles
from pkmcal.observe.image_batches import ImageWindow, Placed, StationImages
from pkmcal.observe.predict import edge_points, legs_in_camera, tubes_of, unobstructed
from pkmcal.simulation import Truth

if TYPE_CHECKING:
    from case import Case

LEGS = ("#c77f00", "#2a94cc", "#008f68", "#bd5f95", "#0a62a6", "#c8500a")
Box = tuple[int, int, int, int]
"""Left, top, width, height, px."""
REACH = 1.4
"""Pixels about the true edge in which the strongest gradient is searched."""


# ------------------------------------------------------------------ frames


def frames(truth: Truth) -> str:
    """The machine with base, platform and camera frames, from outside."""
    eye = look_at(np.array([1.6, -1.25, 1.0]), np.array([0.0, -0.02, 0.2]), np.array([0, 0, 1.0]))
    rgb = (CALIBRATED, GOOD, NOMINAL)

    def on_paper(points: Array) -> Array:
        in_view = apply(eye, np.asarray(points, dtype=float))
        return np.array([455.0, 160.0]) + 950.0 * in_view[..., :2] / in_view[..., 2:]

    def axes(T: Array, name: str, size: float, away: tuple[float, float], anchor: str) -> list[str]:
        ends = on_paper(apply(T, size * np.vstack([np.zeros(3), np.eye(3)])))
        out: list[str] = []
        for tip, letter, colour in zip(ends[1:], "xyz", rgb, strict=True):
            out.append(line([ends[0], tip], colour, 2.4, head=True))
            words = tip + 11 * (tip - ends[0]) / max(float(np.linalg.norm(tip - ends[0])), 1.0)
            out.append(text((words[0], words[1] + 4), letter, colour, "middle"))
        place = ends[0] + np.array(away)
        return [*out, text((place[0], place[1]), name, INK, anchor, font_weight="bold")]

    T = truth.machine.home()
    joints = truth.machine.inverse(T[None])[0]
    ends = limb_ends(truth.machine.layout, truth.machine.values, joints, T)
    a, b = on_paper(np.array(ends.a)), on_paper(np.array(ends.b))
    T_base_camera = inverse(truth.T_camera_base[1])
    origins = on_paper(np.stack([np.zeros(3), T[:3, 3], T_base_camera[:3, 3]]))
    parts = [arrow_heads(*rgb, MUTED), _outline(a), _outline(b)]
    parts += [line(pair, "#8a939c", 3.5) for pair in zip(a, b, strict=True)]
    parts += [dot(p, INK, 3.5) for p in (*a, *b)]
    parts.append(text((a[1, 0] + 10, a[1, 1] + 12), "A₂ (base frame)", INK))
    parts.append(text((b[1, 0] - 10, b[1, 1] + 16), "B₂ (platform frame)", INK, "end"))
    parts.append(line([origins[1], origins[0]], MUTED, 1.2, "5 4"))
    parts.append(line([origins[2], origins[0]], MUTED, 1.2, "5 4"))
    middle = (origins[0] + origins[1]) / 2
    parts.append(text((middle[0] + 6, middle[1] - 8), "T_base_platform", MUTED))
    middle = 0.55 * origins[2] + 0.45 * origins[0]
    parts.append(text((middle[0], middle[1] + 20), "T_camera_base", MUTED, "middle"))
    parts += axes(np.eye(4), "base", 0.12, (-10, 20), "middle")
    parts += axes(T, "platform", 0.1, (12, -24), "start")
    parts += _camera(T_base_camera, on_paper)
    parts += axes(T_base_camera, "camera", 0.1, (-12, 0), "end")
    return svg(720, 415, *parts)


def _outline(points: Array) -> str:
    centre = points.mean(axis=0)
    order = np.argsort(np.arctan2(*(points - centre).T[::-1]))
    return line(points[[*order, order[0]]], "#aab2bb", 1.5)


def _camera(T_base_camera: Array, on_paper: Callable[[Array], Array]) -> list[str]:
    corners = np.array([[-4, -3, 8], [4, -3, 8], [4, 3, 8], [-4, 3, 8]]) * 0.011
    visible = on_paper(apply(T_base_camera, np.vstack([np.zeros(3), corners])))
    sides = [line([visible[0], c], MUTED, 1) for c in visible[1:]]
    return [*sides, line(visible[[1, 2, 3, 4, 1]], MUTED, 1)]


# ------------------------------------------------------------------ edge planes


def edge_planes() -> str:
    """A cut across a leg, u towards the reader: normals of the two edge planes, to scale."""
    scale, centre, radius = 62.0, np.array([6.3, 0.0, 0.0]), 1.5
    above = centre + np.array([0.0, 0.0, 1.0])
    n = edge_normal_jacobians(centre, above, np.array(radius), np.arange(2)).n

    def at(p: Array) -> tuple[float, float]:
        return 130 + scale * float(p[0]), 150 - scale * float(p[1])

    parts = [arrow_heads(CALIBRATED, NOMINAL, INK, MUTED)]
    o, axis = at(np.zeros(3)), at(centre)
    parts.append(dot(axis, INK, radius * scale, "#eef1f4"))
    parts.append(line([o, axis], MUTED, 1.2, "5 4"))
    for side, colour in ((0, CALIBRATED), (1, NOMINAL)):
        touch = centre + radius * n[side]
        parts.append(line([o, at(touch * 1.25)], colour, 1.6))
        parts.append(line([axis, at(touch)], MUTED, 1.2, "5 4"))
        parts.append(line([o, at(1.05 * n[side])], colour, 2.4, head=True))
        foot = 3.2 * touch / np.linalg.norm(touch)
        parts.append(line([at(foot), at(foot + 0.75 * n[side])], colour, 2.4, head=True))
        parts.append(dot(at(touch), colour, 3.5))
        place = at(1.25 * n[side])
        place = (place[0] - 8, place[1] + 5)
        parts.append(text(place, f"n{'₀₁'[side]}", colour, "middle", font_size=16))
    middle = at(centre / 2)
    parts += [
        dot(o, INK, 4), dot(axis, INK, 4),
        text((o[0] - 10, o[1] + 5), "camera's centre", INK, "end"),
        text((axis[0] + 10, axis[1] + 5), "axis, u towards you", INK),
        text((middle[0] + 8, middle[1] - 8), "‖m‖", MUTED, "middle", font_size=15),
        text((axis[0] - 26, axis[1] - 38), "R", MUTED, font_size=15),
        text((o[0] + 84, o[1] - 6), "θ", MUTED, font_size=15),
        text((330, 30), "side 1", NOMINAL, "middle"),
        text((330, 278), "side 0", CALIBRATED, "middle"),
        text((790, 290), "sin θ = R / ‖m‖", MUTED, "end", font_size=15),
    ]  # fmt: skip
    return svg(800, 300, *parts)


# ------------------------------------------------------------------ measurement passes


def measurement_passes(case: Case) -> str:
    """Three panels: a rough pose, the localized station, the result."""
    s, k = 1, 5
    images, session, result = case.images[s], case.session, case.result
    row = int(images.configuration[k])
    image = images.images[k]
    by_hand, recognised = (T[s] for T in case.pose_passes)
    drawn = session.machine.forward(session.joints[row])
    state = result.estimate.state
    views = [
        (session.machine, by_hand, drawn, NOMINAL, "1  pose by hand, the nominal model's machine"),
        (session.machine, recognised, drawn, NOMINAL, "2  localized, still the nominal model"),
        (result.machine, state.T_camera_base[s], state.T_base_platform[row], CALIBRATED,
         "3  after identification"),
    ]  # fmt: skip
    crops = [(150, 80, 480, 410), (215, 150, 152, 130), (215, 150, 152, 130)]
    parts: list[str] = []
    for panel, (view, crop) in enumerate(zip(views, crops, strict=True)):
        machine, T, pose, colour, title = view
        lines = edge_lines(machine, images, T, pose, k)
        frame = (10 + panel * 385, 34, 370, 316)
        parts.append(_panel(image, crop, frame, lines, colour, title, panel))
    return svg(1160, 360, *parts)


def edge_lines(
    machine: Machine, images: StationImages, T_camera_base: Array, pose: Array, k: int
) -> Array:
    """Predicted edges in image k, (E, n, 2) px; NaN where nothing is visible."""
    tubes = tubes_of(machine)
    in_view = legs_in_camera(machine, T_camera_base, pose[None], images.joints[k][None])
    points = edge_points(machine, images.camera, in_view, tubes, 60)
    clear = unobstructed(machine, images.camera, in_view, tubes, points, 0.5)
    return np.where(clear[0][..., None], points.pixel[0], np.nan)


def _panel(
    image: Integers, crop: Box, frame: Box, lines: Array, colour: str, title: str, number: int
) -> str:
    """A part of an image in a frame, with edges over it."""
    x, y, w, h = crop
    left, top, width, height = frame
    # brighter, to distinguish dark sides of legs from the wall
    visible = np.clip(image[y : y + h, x : x + w] * 1.5, 0, 255).astype(np.uint8)
    packed = cv2.imencode(".png", visible)[1]
    data = base64.b64encode(packed.tobytes()).decode("ascii")
    zoom = width / w
    finite = [edge[np.isfinite(edge).all(axis=1)] for edge in lines]
    placed = [(left, top) + (edge - (x, y) + 0.5) * zoom for edge in finite if len(edge) > 1]
    drawn = "".join(line(points.tolist(), colour, 1.6) for points in placed)
    rectangle = f'<rect x="{left}" y="{top}" width="{width}" height="{height}"/>'
    return (
        f'<defs><clipPath id="c{number}">{rectangle}</clipPath></defs>'
        f'<g clip-path="url(#c{number})"><image x="{left}" y="{top}" width="{width}"'
        f' height="{h * zoom:.1f}" preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
        f"{drawn}</g>" + text((left, top - 10), title, INK, font_size=15)
    )


# ------------------------------------------------------------------ profiles


@dataclass(frozen=True)
class Places:
    """Measured profiles about the true edges, N of them.

    grey : (N, samples). half_width : (N,) px. blur : (N,) px. tube : (N,). model_error,
    gradient_error : (N,) px outward of the truth, by the model and the strongest gradient.
    """

    grey: Array
    half_width: Array
    blur: Array
    tube: Integers
    model_error: Array
    gradient_error: Array


def measured_places(case: Case) -> Places:
    """All profiles of the session, taken about the edges that truth predicts."""
    results: list[tuple[Array, ...]] = []
    truth = case.truth
    for p in case.images:
        poses = truth.T_camera_base[p.station], truth.T_base_platform[p.configuration]
        window = ImageWindow.of([Placed(p, *poses)])
        prediction = legs._predicted_edges(window, truth.machine, legs.EDGE_OPTIONS)
        blur = {p.station: profiles.estimate_blur(prediction.across)}
        dull, _ = profiles.without_highlights(prediction.across, blur)
        curves = profiles.residual_curves(dull, blur)
        chances = profiles.shift_log_likelihoods(dull, curves)
        about = legs._leg_lines(
            chances, prediction.places.along, prediction.full, prediction.tubes, legs.EDGE_OPTIONS
        )
        at = profiles.locate(dull, curves, about)
        tube = prediction.tubes.tube[np.nonzero(prediction.full)[1]]
        steep = strongest_gradient(prediction.across.grey)
        blurs = np.full(len(tube), blur[p.station])
        columns = (
            prediction.across.grey, prediction.across.half_width, blurs, tube, at.position, steep,
        )  # fmt: skip
        results.append(tuple(c[at.valid] for c in columns))
    return Places(*(np.concatenate(c) for c in zip(*results, strict=True)))


def strongest_gradient(grey: Array) -> Array:
    """Where profiles (N, samples) change fastest within REACH of their middle, (N,) px."""
    fine = np.arange(-REACH, REACH + 0.005, 0.01)
    slope = np.abs(CubicSpline(profiles.PROFILE_OPTIONS.profile_offsets, grey.T)(fine, 1))
    return fine[np.argmax(slope, axis=0)]


def two_profiles(places: Places) -> str:
    """The profile whose gradient errs as the median one's does, and one of the worst tenth."""
    off = np.abs(places.gradient_error)
    usual = np.abs(places.model_error) < 0.15
    chosen = [
        int(np.argmin(np.where(usual, np.abs(off - np.quantile(off, q)), np.inf)))
        for q in (0.5, 0.92)
    ]
    titles = ("The strongest gradient errs as usual", "… and as in the worst tenth")
    plots = [_one_profile(places, n, title) for n, title in zip(chosen, titles, strict=True)]
    return _beside(*plots)


def _one_profile(places: Places, n: int, title: str) -> Plot:
    grey, at = places.grey[n], profiles.PROFILE_OPTIONS.profile_offsets
    place, model = profiles._blurred_model(
        round(float(places.blur[n]), 3),
        float(places.half_width[n]),
        profiles.PROFILE_OPTIONS,
    )
    shift = float(places.model_error[n])
    rows = np.stack([np.interp(at - shift, place, c) for c in model.T], axis=-1)
    levels = np.linalg.lstsq(rows, grey, rcond=None)[0]
    fine = np.linspace(-3, 3, 241)
    fit = np.stack([np.interp(fine - shift, place, c) for c in model.T], axis=-1) @ levels
    low, high = float(min(grey.min(), fit.min())), float(max(grey.max(), fit.max()))
    room = 0.12 * (high - low)
    plot = Plot(
        (-3.2, 3.2), (low - room, high + 4.4 * room), ("px outward of the true edge", "grey level"),
        (430, 320), title,
    )  # fmt: skip
    plot.curve(fine, fit, CALIBRATED, 2.2)
    plot.dots(at, grey, INK, 2.6)
    steep = float(places.gradient_error[n])
    for row, (x, words, colour, dash) in enumerate(
        (
            (0.0, "true edge", GOOD, ""),
            (shift, f"profile model {shift:+.2f} px", CALIBRATED, "5 4"),
            (steep, f"strongest gradient {steep:+.2f} px", NOMINAL, "5 4"),
        )
    ):
        plot.upright(x, colour, dash)
        plot.words(0.1, high + (3.3 - 0.9 * row) * room, words, colour)
    return plot


def position_errors(places: Places) -> str:
    """Histograms of both errors, cylinder and rod of the legs."""
    borders = np.arange(-1.45, 1.46, 0.1)
    plots: list[Plot] = []
    for tube, title in ((0, "Cylinders (tube 1)"), (1, "Rods (tube 2)")):
        label = "error of a position, px outward"
        plot = Plot((-1.5, 1.5), (0, 6.0), (label, "density"), (430, 320), title)
        mine = places.tube == tube
        plot.histogram(places.gradient_error[mine], borders, NOMINAL)
        plot.histogram(places.model_error[mine], borders, CALIBRATED)
        plot.words(0.4, 5.3, "strongest gradient", NOMINAL)
        plot.words(0.4, 4.85, "profile model", CALIBRATED)
        plots.append(plot)
    return _beside(*plots)


def repeats(edges: Array, images: Array) -> str:
    """Histograms of errors over standard deviations, beside the normal density."""
    x = np.linspace(-5, 5, 201)
    normal = np.exp(-x * x / 2) / np.sqrt(2 * np.pi)
    plots: list[Plot] = []
    borders = np.arange(-5, 5.1, 0.5)
    high = max(np.histogram(v, borders, density=True)[0].max() for v in (edges, images))
    top = float(np.ceil(10 * high)) / 10
    for values, title in (
        (edges, "Edges simulated with their stated noise"),
        (images, "Rendered images, whole program"),
    ):
        label = "error of a centre's coordinate, in its σ"
        plot = Plot((-5, 5), (0, top), (label, "density"), (430, 320), title)
        plot.histogram(values, borders, MUTED)
        plot.curve(x, normal, INK, 1.6)
        plot.words(1.7, 0.9 * top, f"rms {np.sqrt(np.mean(values**2)):.2f}", INK)
        plots.append(plot)
    return _beside(*plots)


def _beside(*plots: Plot) -> str:
    drawn = "".join(plot.svg() for plot in plots)
    return f'<div style="display: flex; gap: 10px; padding: 5px">{drawn}</div>'
