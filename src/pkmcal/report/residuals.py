"""Report section on residuals of edges and readings, by leg, station and configuration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import dot
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import EdgeSet
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.observe.overlays import EDGE_SIDE_NAMES
from pkmcal.observe.predict import legs_in_camera
from pkmcal.outcome import Part
from pkmcal.pages import charts
from pkmcal.report.links import Links
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import count, joined, named, number

GROUP_STANDS_OUT_FACTOR = 1.5
"""Ratio of a group's residuals to the median group's above which a sentence reports it."""
SHADED_MEAN_SHIFT = 0.05
"""Mean outward shift, px, above which a sentence reports it.

Shading moves edges by this and more.
"""
SIGMAS_IN_WORDS = "standard deviations"
HISTOGRAM_HALF_SPAN = 5.0
"""Standard deviations that the histogram spans on either side."""
RESIDUALS_READING_TEXT = (
    "Measured against predicted, in standard deviations. Bars hold the middle half of the values,"
    " lines nine tenths; the grey band is where nine tenths belong if noise is all that is left."
    " Longer lines mean that something other than the stated noise is at work; a box off zero,"
    " that it always pulls the same way."
)


def section(
    session: Session,
    edges: EdgeSet,
    estimate: Estimate,
    shifts: Array,
    links: Links,
    poses: charts.RowChart | None = None,
) -> Part:
    """Section with charts, below sentences on groups that stand out.

    shifts : (N,) px, of :func:`outward_shift`.
    links : to the images on the page.
    poses : chart of the poses' residuals, None without poses.
    """
    panels = charts.panels(
        by_leg(session, edges, estimate, links),
        _edge_boxes("station", session.station_names, edges.station, edges, estimate, links),
        _joints(session, estimate, links),
        poses,
        histogram(estimate.edge_residuals),
        _configurations(session, edges, estimate, links),
        _outward(edges, shifts, links),
        remarks=remarks(session, edges, estimate, shifts),
    )
    return Part("residuals", "Residuals", (RESIDUALS_READING_TEXT,), html=panels)


def outward_shift(edges: EdgeSet, estimate: Estimate, joints: Array, camera: Integers) -> Array:
    """Measured minus predicted position of each edge, px outward from the leg, (N,).

    The camera's estimated edge shift is subtracted. The two components of a normal's residual are
    fitted by one shift along ``edges.shift``, weighted by their covariance; NaN where a leg passes
    through the camera.

    joints : (K, m) readings.
    camera : (S,) index of each station's camera.
    """
    if not len(edges):
        return np.zeros(0)
    machine, state = estimate.machine, estimate.state
    k, j = edges.configuration, edges.leg
    legs = legs_in_camera(
        machine, state.T_camera_base[edges.station], state.T_base_platform[k], joints[k]
    )
    rows = np.arange(len(edges))
    radius = machine.radii_of(edges.leg, edges.tube)
    # measured minus predicted normal in the tangent basis of the measured one
    normal = edge_normal_jacobians(legs.a[rows, j], legs.b[rows, j], radius, edges.side).n
    error = -np.einsum("nij,ni->nj", edges.basis, normal)
    error -= edges.shift * state.columns[EDGE_SHIFT][camera[edges.station]][:, None]
    weighted = np.linalg.solve(edges.covariance, edges.shift[..., None])[..., 0]
    return dot(weighted, error) / dot(weighted, edges.shift)


def weighted_edge_rms(white: Array, weights: Array) -> float:
    """Weighted root mean square of residuals (n, 2), weights (n,).

    NaN if the weights sum to zero.
    """
    total = 2 * float(np.sum(weights))
    return float(np.sqrt(np.sum(weights[:, None] * white**2) / total)) if total else float("nan")


def by_leg(
    session: Session, edges: EdgeSet, estimate: Estimate, links: Links
) -> charts.RowChart | None:
    """Box plots of the edges' residuals by leg, in the legs' colours."""
    legs = [f"leg {j + 1}" for j in range(session.machine.n_legs)]
    return _edge_boxes("leg", legs, edges.leg, edges, estimate, links)


def _edge_boxes(
    by: str,
    names: Sequence[str],
    group: Integers,
    edges: EdgeSet,
    estimate: Estimate,
    links: Links,
) -> charts.RowChart | None:
    """Box plot of both residual components for each group with edges.

    Each row links to the image of its largest residual.
    """
    white = estimate.edge_residuals
    boxes: list[charts.Spread | None] = []
    for g, name in enumerate(names):
        mine = group == g
        size = np.linalg.norm(white[mine], axis=1)
        lead = links.to_largest(edges.station[mine], edges.configuration[mine], size)
        boxes.append(charts.box(name, white[mine], "σ", 2, g + 1 if by == "leg" else None, lead))
    alt = f"Boxes of the whitened edge residuals by {by}"
    return charts.row_chart(f"Edges, by {by}", SIGMAS_IN_WORDS, boxes, charts.NORMAL_90, alt)


def _configurations(
    session: Session, edges: EdgeSet, estimate: Estimate, links: Links
) -> charts.BarChart | None:
    """Root mean square of each configuration's edges, with the interval expected of noise alone."""
    bars: list[charts.UprightBar] = []
    for k, name in enumerate(session.configurations):
        mine = edges.configuration == k
        weights = estimate.edge_weights[mine]
        level = weighted_edge_rms(estimate.edge_residuals[mine], weights)
        if not np.isfinite(level):
            continue
        of = f" over {count(len(weights), 'edge')}"
        lead = links.to_configuration(k)
        bars.append(level_bar(name, level, 2 * float(weights.sum()), of, lead))
    title, unit = "Edges, by configuration", f"configurations; root mean square, {SIGMAS_IN_WORDS}"
    alt = "Bars of the residuals by configuration"
    return charts.bar_chart(title, unit, bars, charts.six_labels(bars), alt)


def level_bar(name: str, level: float, n: float, of: str = "", lead: str = "") -> charts.UprightBar:
    """Bar of a configuration's root mean square, in standard deviations, over n numbers.

    With the interval that n numbers of pure noise have.
    """
    low, high = expected_rms(n)
    tip = (
        f"configuration {name}: {number(level, 2)} σ{of}, {number(low, 2)} to {number(high, 2)}"
        " expected of noise alone"
    )
    return charts.UprightBar(name, tip, level, (low, high), level <= high, lead)


def expected_rms(n: float) -> tuple[float, float]:
    """95 % interval of the root mean square of n standard normal numbers."""
    from scipy.special import chdtri

    low, high = np.sqrt(chdtri(n, [0.975, 0.025]) / n)
    return float(low), float(high)


def histogram(white: Array) -> charts.BarChart | None:
    """Histogram of all residuals with the normal density; the outermost bars include all beyond."""
    values = white[np.isfinite(white)]
    if not values.size:
        return None
    borders = np.arange(-HISTOGRAM_HALF_SPAN, HISTOGRAM_HALF_SPAN + 0.25, 0.5)
    counts = np.histogram(np.clip(values, -HISTOGRAM_HALF_SPAN, HISTOGRAM_HALF_SPAN), borders)[0]
    bars: list[charts.UprightBar] = []
    for low, high, n in zip(borders[:-1], borders[1:], counts.tolist(), strict=True):
        where = f"{number(low, 1)} to {number(high, 1)} σ"
        if low == -HISTOGRAM_HALF_SPAN or high == HISTOGRAM_HALF_SPAN:
            where += " or beyond"
        bars.append(
            charts.UprightBar(where, f"{where}: {count(n, 'residual')}", float(n), None, True)
        )
    x = np.linspace(-HISTOGRAM_HALF_SPAN, HISTOGRAM_HALF_SPAN, 81)
    density = np.exp(-x * x / 2) / np.sqrt(2 * np.pi) * values.size * 0.5
    curve = tuple(zip(((x + HISTOGRAM_HALF_SPAN) * 2).tolist(), density.tolist(), strict=True))
    labels = tuple(
        ((v + HISTOGRAM_HALF_SPAN) * 2, number(v, 0)) for v in (-4.0, -2.0, 0.0, 2.0, 4.0)
    )
    alt = "Histogram of the residuals with the normal density over it"
    return charts.bar_chart(
        "All edge residuals", f"{SIGMAS_IN_WORDS}; number of residuals", bars, labels, alt, curve
    )


def _outward(edges: EdgeSet, shifts: Array, links: Links) -> charts.RowChart | None:
    """Box plots of outward shifts by leg, tube and side, which show shading and wrong radii."""
    boxes = [
        charts.box(
            f"leg {j + 1}, tube {t + 1}, {EDGE_SIDE_NAMES[s]}", shifts[mine], "px", 3, j + 1, lead
        )
        for (j, t, s), mine in _edge_kinds(edges)
        for lead in [
            links.to_largest(edges.station[mine], edges.configuration[mine], np.abs(shifts[mine]))
        ]
    ]
    alt = "Boxes of the outward shift in pixels by leg, tube and side"
    title = "Edges too far out (+) or in (−), by leg, tube and side"
    note = "looking along the leg from base to platform"
    return charts.row_chart(title, "pixels", boxes, None, alt, note)


def _edge_kinds(edges: EdgeSet) -> list[tuple[tuple[int, int, int], Booleans]]:
    """Leg, tube and side of the edges, each with a mask (N,) of its edges."""
    kinds = np.stack([edges.leg, edges.tube, edges.side], axis=-1)
    return [
        ((int(j), int(t), int(s)), (kinds == (j, t, s)).all(axis=-1))
        for j, t, s in np.unique(kinds, axis=0)
    ]


def _joints(session: Session, estimate: Estimate, links: Links) -> charts.RowChart | None:
    """Box plots of the readings' residuals by joint, linked to the image of the largest."""
    motor = session.machine.layout.actuated
    used = np.flatnonzero(estimate.configurations)
    white = estimate.joint_residuals[used]
    shifted = [np.flatnonzero(motor == column).tolist() for column in range(white.shape[1])]
    worst = used[np.abs(white).argmax(axis=0)] if len(white) else np.zeros(len(shifted), dtype=int)
    boxes = [
        charts.box(
            named(legs), white[:, column], "σ", 2, legs[0] + 1, links.to_configuration(int(k))
        )
        for column, (legs, k) in enumerate(zip(shifted, worst, strict=True))
    ]
    alt = "Boxes of the readings' residuals by joint"
    # readings that determine the poses have small residuals whatever their noise; the degrees of
    # freedom show that
    s = estimate.statistics
    note = f"{count(s.n_joints, 'reading')}, {count(s.dof_joints, 'degree')} of freedom"
    return charts.row_chart(
        "Joint readings, by leg", SIGMAS_IN_WORDS, boxes, charts.NORMAL_90, alt, note
    )


def remarks(session: Session, edges: EdgeSet, estimate: Estimate, shifts: Array) -> tuple[str, ...]:
    """Sentences on groups that stand out."""
    stations = [f"station {name}" for name in session.station_names]
    configurations = [f"configuration {name}" for name in session.configurations]
    legs = [f"leg {j + 1}" for j in range(session.machine.n_legs)]
    out: list[str] = []
    for names, group in ((legs, edges.leg), (stations, edges.station)):
        out += _outstanding(names, group, estimate)
    if not out:  # a bad station would raise every configuration that it observed
        out += _outstanding(configurations, edges.configuration, estimate)
    shaded = _shaded(edges, estimate, shifts)
    if shaded:
        out.append(
            f"Edges that lie off in the same way in every image, {joined(shaded)}: shading, a "
            "surface that is not round, or a neighbour taken for the edge."
        )
    if scatter := estimate.statistics.look_scatter:
        out.append(
            "Which border is a leg's depends on where it is searched: from machines as likely as"
            f" this one, results scatter by {number(scatter, 1)} of the deviations that noise gives"
            " them, and these contain it."
        )
    return tuple(out)


def _outstanding(names: list[str], group: Integers, estimate: Estimate) -> list[str]:
    """Sentences on groups whose weighted residuals are far above those of the median group."""
    white, weights = estimate.edge_residuals, estimate.edge_weights
    level = {
        g: weighted_edge_rms(white[group == g], weights[group == g])
        for g in np.unique(group).tolist()
    }
    level = {g: value for g, value in level.items() if np.isfinite(value)}
    if len(level) < 3:
        return []
    middle = float(np.median(list(level.values())))
    outstanding = [g for g, value in level.items() if value > GROUP_STANDS_OUT_FACTOR * middle]
    outstanding = sorted(outstanding, key=lambda g: -level[g])[:4]
    return [
        f"The residuals of {names[g]} are {number(level[g] / middle, 1)} times those of the "
        "middle one: check its images first."
        for g in outstanding
    ]


def _shaded(edges: EdgeSet, estimate: Estimate, shifts: Array) -> list[str]:
    """Edges with a large and significant mean shift, in words, the largest first."""
    shaded: list[tuple[float, str]] = []
    for (leg, tube, side), mine in _edge_kinds(edges):
        finite_shifts = shifts[
            mine & (estimate.edge_weights >= INLIER_WEIGHT) & np.isfinite(shifts)
        ]
        if len(finite_shifts) < 4:
            continue
        mean, error = finite_shifts.mean(), finite_shifts.std(ddof=1) / np.sqrt(len(finite_shifts))
        if abs(mean) > max(SHADED_MEAN_SHIFT, 3 * error):
            where = f"leg {leg + 1} tube {tube + 1} {EDGE_SIDE_NAMES[side]}"
            shaded.append((abs(mean), f"{where} by {number(mean, 2, signed=True)} px"))
    return [text for _, text in sorted(shaded, reverse=True)[:4]]
