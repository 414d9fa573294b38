"""Geometry before and after calibration, as in [B] Fig. 7: joint centres at home, errors enlarged.

Two plane views as SVG, and one in space as a Plotly figure in millimetres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pkmcal.arrays import Array, enlargement
from pkmcal.errors import PkmcalError
from pkmcal.geometry.outlines import ring
from pkmcal.geometry.rigid import apply
from pkmcal.identify.centres import Centres
from pkmcal.identify.estimate import Estimate
from pkmcal.outcome import Part, Plot
from pkmcal.pages import page
from pkmcal.pages.charts import CHART_WIDTH
from pkmcal.pages.plots import line, markers, space_layout
from pkmcal.session.load import Session
from pkmcal.wording import brief, number

ELLIPSE_SIGMAS = 2.0
"""Standard deviations of ellipses and ellipsoids."""
ENLARGED_ERROR_SHARE = 0.22
"""Length of large errors after enlargement, in radii of the machine."""
PLANE_VIEW_MARGIN = 30.0
LABELS_MERGED_WITHIN = 9.0
"""Distance, in SVG units, below which two labels become one."""
ELLIPSOID_RING_POINTS = 25
"""Points of an ellipsoid's ring."""


@dataclass(frozen=True)
class Joint:
    """Joint centre at home, base frame, m.

    leg : from 1.
    nominal model, displaced : (3,) by the nominal model, and with the enlarged error.
    spread : (3, 3) enlarged covariance.
    arm : (2, k, 3) nominal and enlarged; points from where a motor holds the arm to a base joint;
        a platform joint has only itself.
    """

    leg: int
    side: str
    nominal: Array
    displaced: Array
    spread: Array
    tip: str
    arm: Array


@dataclass(frozen=True)
class BeforeAfter:
    """All joint centres, of base, then of platform.

    factor : enlargement of errors.
    spread_factor : enlargement of ellipses, which would be hidden by the markers if it were that
        of errors.
    """

    factor: float
    spread_factor: float
    joints: tuple[Joint, ...]

    def of_side(self, side: str) -> tuple[Joint, ...]:
        """Joints of base or platform, by leg."""
        return tuple(joint for joint in self.joints if joint.side == side)


@dataclass(frozen=True)
class JointMark:
    """Joint in a plane view, SVG units.

    ellipse : half axes rx and ry, and angle in degrees.
    """

    leg: int
    side: str
    nominal: tuple[float, float]
    displaced: tuple[float, float]
    ellipse: tuple[float, float, float]
    tip: str


@dataclass(frozen=True)
class Projection:
    """Scene in one direction.

    limbs : of the nominal model, each from its arm to the platform.
    grid : (horizontal?, position, text).
    labels : (x, y, text).
    """

    title: str
    alt: str
    width: float
    height: float
    axes: tuple[str, str]
    marks: tuple[JointMark, ...]
    limbs: tuple[tuple[tuple[float, float], ...], ...]
    grid: tuple[tuple[bool, float, str], ...]
    labels: tuple[tuple[float, float, str], ...]


def section(
    session: Session,
    estimate: Estimate,
    centres: tuple[Centres, ...],
) -> Part:
    """Section of the report."""
    scene = scene_of(session, estimate, centres)
    return Part(
        "geometry",
        "Geometry before and after",
        (page.filled_template("geometry.html.j2", scene=scene),),
        plots=(
            Plot(
                "space",
                "In space",
                "Drag to turn, wheel or pinch to come nearer.",
                "The machine in three dimensions: joint centres by the nominal model and as"
                " calibrated. The two plane views show the same.",
                figure_of(scene),
                height=420,
            ),
        ),
        html=page.filled_template("views.html.j2", views=plane_projections(scene)),
        menu="Geometry",
    )


def scene_of(session: Session, estimate: Estimate, centres: tuple[Centres, ...]) -> BeforeAfter:
    """Joint centres at home, errors enlarged by a round factor."""
    try:
        home = session.machine.home()
    except PkmcalError:  # no home in the nominal model: use the first pose with data
        home = estimate.state.T_base_platform[int(np.argmax(estimate.configurations))]
    # errors are enlarged to a fixed share of the machine's radius
    placed = {"base": np.eye(4), "platform": home}
    size = float(np.ptp(np.concatenate([c.nominal for c in centres]), axis=0).max()) / 2
    change = np.concatenate([np.linalg.norm(c.change, axis=-1) for c in centres])
    sigma = np.concatenate([c.sigma for c in centres])
    factor = enlargement(change, ENLARGED_ERROR_SHARE * size)
    spread_factor = enlargement(ELLIPSE_SIGMAS * sigma, ENLARGED_ERROR_SHARE / 3 * size)
    joints: list[Joint] = []
    before, after = (m.arms_at(m.middle_readings()) for m in (session.machine, estimate.machine))
    for side in centres:
        T = placed[side.side]
        nominal = apply(T, side.nominal)
        enlarged = nominal + factor * (apply(T, side.calibrated) - nominal)
        spread = spread_factor**2 * T[:3, :3] @ side.blocks @ T[:3, :3].T
        for j in range(len(nominal)):
            dx, dy, dz = (number(float(v) * 1e3, 3, signed=True) for v in side.change[j])
            tip = (
                f"Leg {j + 1}, {side.side}: {dx}, {dy}, {dz} mm from the nominal model (x, y, z); "
                f"σ {brief(float(side.sigma[j]) * 1e3)} mm"
            )
            arm = np.stack([nominal[j], enlarged[j]])[:, None]
            if side.side == "base":
                old = apply(side.T_calibrated_nominal, before[j])
                arm = np.stack([old, old + factor * (after[j] - old)])
            joints.append(Joint(j + 1, side.side, nominal[j], enlarged[j], spread[j], tip, arm))
    return BeforeAfter(factor, spread_factor, tuple(joints))


def plane_projections(scene: BeforeAfter) -> tuple[Projection, Projection]:
    """Views from above, and from the side in which the base joints are best separated."""
    base = np.array([joint.nominal for joint in scene.of_side("base")])
    gaps = [np.diff(np.sort(base[:, axis])).min() for axis in (0, 1)]
    across = int(np.argmax(gaps))
    return (
        _view(scene, "From above", (0, 1)),
        _view(scene, "From the side", (across, 2)),
    )


def _view(scene: BeforeAfter, title: str, axes: tuple[int, int]) -> Projection:
    """Projection of the scene onto two axes, the second one upwards."""
    pick = list(axes)
    nominal = np.array([joint.nominal[pick] for joint in scene.joints])
    displaced = np.array([joint.displaced[pick] for joint in scene.joints])
    arms = [joint.arm[0][:, pick] for joint in scene.joints]
    # scale and limits, so that all points fit into the width of a chart
    corners = np.concatenate([nominal, displaced, *arms])
    low, high = corners.min(axis=0), corners.max(axis=0)
    scale = (CHART_WIDTH - 2 * PLANE_VIEW_MARGIN) / (high - low).max()
    width, height = CHART_WIDTH, float((high - low)[1] * scale + 2 * PLANE_VIEW_MARGIN)
    left = (width - float((high - low)[0]) * scale) / 2

    def place(point: Array) -> tuple[float, float]:
        """SVG coordinates of a point (2,), m."""
        x, y = (point - low) * scale
        return round(left + float(x), 1), round(height - PLANE_VIEW_MARGIN - float(y), 1)

    names = ("x", "y", "z")
    marks = tuple(
        JointMark(
            j.leg, j.side, place(d), place(s), _ellipse(j.spread[np.ix_(pick, pick)], scale), j.tip
        )
        for j, d, s in zip(scene.joints, nominal, displaced, strict=True)
    )
    half = len(marks) // 2  # base joints come first, then the platform's
    return Projection(
        title=title,
        alt=f"{title}: joint centres by the nominal model and as calibrated, errors enlarged "
        f"{scene.factor:g} times",
        width=width,
        height=height,
        axes=(names[axes[0]], names[axes[1]]),
        marks=marks,
        limbs=tuple(
            (*map(place, arm), end.nominal)
            for arm, end in zip(arms[:half], marks[half:], strict=True)
        ),
        grid=_grid(low, high, place),
        labels=_labels(marks, (width / 2, height / 2)),
    )


def _ellipse(spread: Array, scale: float) -> tuple[float, float, float]:
    """Half axes (SVG units) and angle (degrees, y downwards) of the ``ELLIPSE_SIGMAS`` ellipse."""
    values, vectors = np.linalg.eigh(spread)
    ry, rx = ELLIPSE_SIGMAS * scale * np.sqrt(np.maximum(values, 0))
    angle = -np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
    return round(float(rx), 2), round(float(ry), 2), round(float(angle), 1)


def _grid(
    low: Array, high: Array, place: Callable[[Array], tuple[float, float]]
) -> tuple[tuple[bool, float, str], ...]:
    """Grid lines every 100 mm, or a multiple, with their coordinate."""
    step = 0.1 * max(1, round(float((high - low).max()) / 0.6))
    lines: list[tuple[bool, float, str]] = []
    for axis, level in ((0, False), (1, True)):
        first, last = math.ceil(low[axis] / step - 0.3), math.floor(high[axis] / step + 0.3)
        for k in range(first, last + 1):
            point = low.copy()
            point[axis] = k * step
            lines.append((level, place(point)[axis], number(k * step * 1e3, 0)))
    return tuple(lines)


def _labels(
    marks: tuple[JointMark, ...], centre: tuple[float, float]
) -> tuple[tuple[float, float, str], ...]:
    """Leg numbers beside their marks, away from the centre.

    Numbers that would overlap share a label.
    """
    placed: list[tuple[float, float, list[int]]] = []
    for mark in marks:
        dx, dy = mark.nominal[0] - centre[0], mark.nominal[1] - centre[1]
        away = max(math.hypot(dx, dy), 1e-6)
        x, y = mark.nominal[0] + 13 * dx / away, mark.nominal[1] + 13 * dy / away
        near = [p for p in placed if math.hypot(p[0] - x, p[1] - y) < LABELS_MERGED_WITHIN]
        if near and mark.leg not in near[0][2]:
            near[0][2].append(mark.leg)
        elif not near:
            placed.append((x, y, [mark.leg]))
    return tuple(
        (round(x, 1), round(y + 4, 1), " ".join(str(n) for n in legs)) for x, y, legs in placed
    )


# ------------------------------------------------------------------ in space


def figure_of(scene: BeforeAfter) -> dict[str, Any]:
    """Traces, layout and configuration for ``Plotly.newPlot``."""
    base, platform = scene.of_side("base"), scene.of_side("platform")
    legs = list(zip(base, platform, strict=True))
    data = [
        line("Nominal model", "--drawing", 4, [np.stack([*a.arm[0], b.nominal]) for a, b in legs]),
        line(
            f"Calibrated, × {scene.factor:g}",
            "--calibrated",
            4,
            [np.stack([*a.arm[1], b.displaced]) for a, b in legs],
        ),
        *(
            line(
                f"{side[0].side} outline",
                "--quiet",
                2,
                [ring(np.array([joint.nominal for joint in side]))],
                showlegend=False,
            )
            for side in (base, platform)
        ),
        line("Change", "--ink", 6, [np.stack([j.nominal, j.displaced]) for j in scene.joints]),
        _ellipsoids(scene),
        _centres(base, platform),
    ]
    layout = space_layout()
    layout["scene"]["camera"]["center"] = {"x": 0, "y": 0, "z": -0.14}
    layout["legend"] = {"orientation": "h", "y": 0, "x": 0, "bgcolor": "rgba(0,0,0,0)"}
    return {"data": data, "layout": layout, "config": {"scrollZoom": True}}


def _ellipsoids(scene: BeforeAfter) -> dict[str, Any]:
    """Three rings of each centre's ellipsoid, in its principal planes."""
    angle = np.linspace(0, 2 * np.pi, ELLIPSOID_RING_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    segments: list[Array] = []
    for joint in scene.joints:
        values, axes = np.linalg.eigh(joint.spread)
        half = axes * (ELLIPSE_SIGMAS * np.sqrt(np.maximum(values, 0)))
        segments += [
            joint.displaced + circle @ half[:, list(p)].T for p in ((0, 1), (0, 2), (1, 2))
        ]
    return line(f"{ELLIPSE_SIGMAS:g}σ, × {scene.spread_factor:g}", "--calibrated", 2, segments)


def _centres(base: tuple[Joint, ...], platform: tuple[Joint, ...]) -> dict[str, Any]:
    """Markers of the nominal centres with leg numbers and tooltips."""
    joints = (*base, *platform)
    style = {
        "size": 5,
        "color": "--drawing",
        "symbol": ["square"] * len(base) + ["circle"] * len(platform),
    }
    return markers(
        "Joint centres, nominal model",
        np.array([joint.nominal for joint in joints]),
        style,
        mode="markers+text",
        showlegend=False,
        text=[str(joint.leg) for joint in joints],
        textposition="top center",
        textfont={"color": "--ink", "size": 13},
        hovertext=[joint.tip.replace("; ", "<br>") for joint in joints],
        hoverinfo="text",
    )
