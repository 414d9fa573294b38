"""How well the model explains the edges and the readings, by leg, station and configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import dot
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet
from pkmcal.mechanisms import Machine
from pkmcal.observe.predict import legs_in_camera
from pkmcal.report.charts import (
    NORMAL_90,
    BarChart,
    RowChart,
    Spread,
    UprightBar,
    bar_chart,
    box,
    row_chart,
)
from pkmcal.session.load import Session
from pkmcal.wording import count, joined, named, number

KEPT = 0.5
"""Robust weight below which an edge counts as put aside; pictures draw it dashed."""
STANDS_OUT = 1.5
"""A group whose residuals are this many times the middle group's is worth a sentence."""
SHADED = 0.05
"""Mean outward shift (px) from which a sentence is due: shading moves edges by this and more."""
SIGMAS = "standard deviations"
HISTOGRAM = 5.0
"""Standard deviations that the histogram spans to either side."""
SIDES = ("right", "left")
"""The two edges of a leg as a picture shows them, looking along the leg from A to B."""


@dataclass(frozen=True)
class Residuals:
    """The section's charts, and sentences about what stands out in them."""

    by_leg: RowChart | None
    by_station: RowChart | None
    by_configuration: BarChart | None
    histogram: BarChart | None
    outward: RowChart | None
    joints: RowChart | None
    remarks: tuple[str, ...]


def residual_charts(
    session: Session, edges: EdgeSet, estimate: Estimate, shifts: Array
) -> Residuals:
    """All charts of the section. shifts : (N,) px, of :func:`outward_shift`."""
    white = estimate.edge_residuals
    stations = [s.name for s in session.stations]
    legs = [f"leg {j + 1}" for j in range(session.machine.n_legs)]
    return Residuals(
        by_leg=_edge_boxes("leg", _groups(legs, edges.leg, white, True)),
        by_station=_edge_boxes("station", _groups(stations, edges.station, white)),
        by_configuration=_configurations(session, edges, estimate),
        histogram=_histogram(white),
        outward=_outward(edges, shifts),
        joints=_joints(session, estimate),
        remarks=_remarks(session, edges, estimate, shifts),
    )


def camera_numbers(session: Session) -> Integers:
    """Number of each station's camera file, in order of first use, (S,)."""
    files = [station.camera_file for station in session.stations]
    order = list(dict.fromkeys(files))
    return np.array([order.index(name) for name in files], dtype=int)


def outward_shift(edges: EdgeSet, estimate: Estimate, joints: Array, camera: Integers) -> Array:
    """Measured minus predicted place of each edge, px outward from the leg, (N,).

    joints : (K, m) readings. camera : (S,) number of each station's camera.
    The camera's constant shift is taken out. The two numbers of a residual normal are fitted by
    one shift along ``edges.shift``, weighted by their covariance; NaN where a leg passes through
    the camera.
    """
    machine, state = estimate.machine, estimate.state
    k, j = edges.configuration, edges.leg
    legs = legs_in_camera(
        machine, state.T_camera_base[edges.station], state.T_base_platform[k], joints[k]
    )
    each = np.arange(len(edges))
    radius = machine.values[radius_positions(machine, edges)]
    normal = edge_normal_jacobians(legs.a[each, j], legs.b[each, j], radius, edges.side).n
    error = -np.einsum("nij,ni->nj", edges.basis, normal)
    error -= edges.shift * state.edge_shift[camera[edges.station]][:, None]
    weighted = np.linalg.solve(edges.covariance, edges.shift[..., None])[..., 0]
    return dot(weighted, error) / dot(weighted, edges.shift)


def radius_positions(machine: Machine, edges: EdgeSet) -> Integers:
    """Where each edge's radius stands among the machine's parameters, (N,)."""
    pairs = zip(edges.leg.tolist(), edges.tube.tolist(), strict=True)
    return np.array([machine.layout.radius[j][t] for j, t in pairs], dtype=int)


def rms(white: Array, weights: Array) -> float:
    """Root mean square of residuals (n, 2) with the edges' weights (n,); NaN without any."""
    total = 2 * float(np.sum(weights))
    return float(np.sqrt(np.sum(weights[:, None] * white**2) / total)) if total else float("nan")


def _edge_boxes(by: str, boxes: list[Spread]) -> RowChart | None:
    alt = f"Boxes of the whitened edge residuals by {by}"
    return row_chart(f"Edges, by {by}", SIGMAS, boxes, NORMAL_90, alt)


def _groups(names: list[str], group: Integers, white: Array, legs: bool = False) -> list[Spread]:
    """A box for each group that has edges; both numbers of a residual count."""
    found = [
        box(name, white[group == g], "σ", 2, g + 1 if legs else None)
        for g, name in enumerate(names)
    ]
    return [b for b in found if b]


def _configurations(session: Session, edges: EdgeSet, estimate: Estimate) -> BarChart | None:
    """Root mean square of each configuration's edges, with the range that noise alone gives."""
    bars: list[UprightBar] = []
    for k, name in enumerate(session.configurations):
        mine = edges.configuration == k
        weights = estimate.edge_weights[mine]
        level = rms(estimate.edge_residuals[mine], weights)
        if not np.isfinite(level):
            continue
        low, high = expected_rms(2 * float(weights.sum()))
        tip = (
            f"configuration {name}: {number(level, 2)} σ over {count(len(weights), 'edge')}, "
            f"{number(low, 2)} to {number(high, 2)} expected of noise alone"
        )
        bars.append(UprightBar(name, tip, level, (low, high), level <= high))
    every = max(1, -(-len(bars) // 6))
    labels = tuple((i + 0.5, bars[i].label) for i in range(0, len(bars), every))
    title, unit = "Edges, by configuration", "root mean square, standard deviations"
    return bar_chart(title, unit, bars, labels, "Bars of the residuals by configuration")


def expected_rms(n: float) -> tuple[float, float]:
    """Where the root mean square of n standard normal numbers lies 19 times in 20."""
    from scipy.special import chdtri

    low, high = np.sqrt(chdtri(n, [0.975, 0.025]) / n)
    return float(low), float(high)


def _histogram(white: Array) -> BarChart | None:
    """Counts of all residuals beside the normal density; the outermost bars hold the rest."""
    values = white[np.isfinite(white)]
    if not values.size:
        return None
    borders = np.arange(-HISTOGRAM, HISTOGRAM + 0.25, 0.5)
    counts = np.histogram(np.clip(values, -HISTOGRAM, HISTOGRAM), borders)[0]
    bars: list[UprightBar] = []
    for low, high, n in zip(borders[:-1], borders[1:], counts.tolist(), strict=True):
        where = f"{number(low, 1)} to {number(high, 1)} σ"
        if low == -HISTOGRAM or high == HISTOGRAM:
            where += " or beyond"
        bars.append(UprightBar(where, f"{where}: {count(n, 'residual')}", float(n), None, True))
    x = np.linspace(-HISTOGRAM, HISTOGRAM, 81)
    density = np.exp(-x * x / 2) / np.sqrt(2 * np.pi) * values.size * 0.5
    curve = tuple(zip(((x + HISTOGRAM) * 2).tolist(), density.tolist(), strict=True))
    labels = tuple(((v + HISTOGRAM) * 2, number(v, 0)) for v in (-4.0, -2.0, 0.0, 2.0, 4.0))
    alt = "Histogram of the residuals with the normal density over it"
    return bar_chart("All edge residuals", SIGMAS, bars, labels, alt, curve)


def _outward(edges: EdgeSet, shifts: Array) -> RowChart | None:
    """Outward shift of every leg's edges: shading and wrong radii show here."""
    boxes: list[Spread | None] = []
    for leg, tube, side in _edge_kinds(edges):
        values = shifts[_is_kind(edges, leg, tube, side)]
        name = f"leg {leg + 1}, tube {tube + 1}, {SIDES[side]}"
        boxes.append(box(name, values, "px", 3, leg + 1))
    alt = "Boxes of the outward shift in pixels by leg, tube and side"
    title = "Edges too far out (+) or in (−), by leg, tube and side"
    note = "looking along the leg from base to platform"
    return row_chart(title, "pixels", [b for b in boxes if b], None, alt, note)


def _edge_kinds(edges: EdgeSet) -> list[tuple[int, int, int]]:
    kinds = np.stack([edges.leg, edges.tube, edges.side], axis=-1)
    return [(int(j), int(t), int(s)) for j, t, s in np.unique(kinds, axis=0)]


def _is_kind(edges: EdgeSet, leg: int, tube: int, side: int) -> Booleans:
    return (edges.leg == leg) & (edges.tube == tube) & (edges.side == side)


def _joints(session: Session, estimate: Estimate) -> RowChart | None:
    """Residuals of the readings by joint."""
    motor = session.machine.layout.actuated
    white = estimate.joint_residuals[estimate.configurations]
    moved = [np.flatnonzero(motor == column).tolist() for column in range(white.shape[1])]
    boxes = [
        box(named(legs), white[:, column], "σ", 2, legs[0] + 1) for column, legs in enumerate(moved)
    ]
    alt = "Boxes of the readings' residuals by joint"
    return row_chart("Joint readings, by leg", SIGMAS, [b for b in boxes if b], NORMAL_90, alt)


def _remarks(
    session: Session, edges: EdgeSet, estimate: Estimate, shifts: Array
) -> tuple[str, ...]:
    """Sentences about groups that stand out."""
    stations = [f"station {s.name}" for s in session.stations]
    configurations = [f"configuration {name}" for name in session.configurations]
    legs = [f"leg {j + 1}" for j in range(session.machine.n_legs)]
    out: list[str] = []
    for names, group in ((legs, edges.leg), (stations, edges.station)):
        out += _outstanding(names, group, estimate)
    if not out:  # a bad station would name every configuration that it saw
        out += _outstanding(configurations, edges.configuration, estimate)
    shaded = _shaded(edges, estimate, shifts)
    if shaded:
        out.append(
            f"Edges that lie off in the same way in every photograph, {joined(shaded)}: shading, a "
            "surface that is not round, or a neighbour taken for the edge."
        )
    return tuple(out)


def _outstanding(names: list[str], group: Integers, estimate: Estimate) -> list[str]:
    """Groups whose residuals are far above the middle group's, edges put aside not counted."""
    white, weights = estimate.edge_residuals, estimate.edge_weights
    level = {g: rms(white[group == g], weights[group == g]) for g in np.unique(group).tolist()}
    level = {g: value for g, value in level.items() if np.isfinite(value)}
    if len(level) < 3:
        return []
    middle = float(np.median(list(level.values())))
    found = [g for g, value in level.items() if value > STANDS_OUT * middle]
    found = sorted(found, key=lambda g: -level[g])[:4]
    return [
        f"The residuals of {names[g]} are {number(level[g] / middle, 1)} times those of the "
        "middle one: look at its pictures first."
        for g in found
    ]


def _shaded(edges: EdgeSet, estimate: Estimate, shifts: Array) -> list[str]:
    """Legs' edges whose mean shift is large and sure, the largest first, in words."""
    found: list[tuple[float, str]] = []
    for leg, tube, side in _edge_kinds(edges):
        keep = _is_kind(edges, leg, tube, side) & (estimate.edge_weights >= KEPT)
        values = shifts[keep & np.isfinite(shifts)]
        if len(values) < 4:
            continue
        mean, error = values.mean(), values.std(ddof=1) / np.sqrt(len(values))
        if abs(mean) > max(SHADED, 3 * error):
            where = f"leg {leg + 1} tube {tube + 1} {SIDES[side]}"
            found.append((abs(mean), f"{where} by {number(mean, 2, signed=True)} px"))
    return [text for _, text in sorted(found, reverse=True)[:4]]
