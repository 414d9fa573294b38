"""Report section `residuals` on residuals of edges and readings, by leg, station and
configuration; those over the image are :mod:`pkmcal.report.field`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import edge_normal_jacobians
from pkmcal.geometry.rigid import dot
from pkmcal.identify.estimate import Estimate
from pkmcal.levels import NOISE_EXCESS, OUTLIER_SIGMAS
from pkmcal.measurements import EdgeSet
from pkmcal.measurements.edges import SHADING_SIGMA
from pkmcal.measurements.effects import EDGE_SHIFT
from pkmcal.observe.overlays import EDGE_SIDE_NAMES
from pkmcal.observe.predict import legs_in_camera
from pkmcal.outcome import Part
from pkmcal.outcome.blocks.base import Key, configuration_key, leg_key, station_key
from pkmcal.outcome.blocks.plot import (
    BandMark,
    BarsMark,
    Box,
    Colour,
    LineMark,
    Plot,
    Point,
    leg_colour,
    line_points,
    linear_axis,
    panels,
    rounded,
)
from pkmcal.outcome.blocks.text import Listing
from pkmcal.report.charts import NORMAL_90, bar_plot, box, row_plot
from pkmcal.session.load import Session
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import count, joined, named, number

SIGMAS_IN_WORDS = "standard deviations"
HISTOGRAM_HALF_SPAN = 5.0
"""Standard deviations that the histogram spans on either side."""
HISTOGRAM_BAR_WIDTH = 0.5
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
    poses: Plot | None = None,
) -> Part:
    """Section with plots, below sentences on groups that stand out.

    shifts : (N,) px, of :func:`outward_shift`.
    poses : plot of the poses' residuals, None without poses.
    """
    sentences = remarks(session, edges, estimate, shifts)
    boxes = [
        _edge_box(session, name, edges.station == s, edges, estimate, "quiet", station_key(name))
        for s, name in enumerate(session.station_names)
    ]
    plots = panels(
        by_leg(session, edges, estimate),
        _edge_plot("station", boxes),
        _joints(session, estimate),
        poses,
        histogram(estimate.edge_residuals),
        _configurations(session, edges, estimate),
        _outward(session, edges, shifts),
    )
    listing = (Listing(title="", items=sentences),) if sentences else ()
    return Part("residuals", "Residuals", (RESIDUALS_READING_TEXT,), blocks=(*listing, *plots))


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


def by_leg(session: Session, edges: EdgeSet, estimate: Estimate) -> Plot | None:
    """Box plots of the edges' residuals by leg, in the legs' colours."""
    boxes = [
        _edge_box(
            session,
            f"leg {j + 1}",
            edges.leg == j,
            edges,
            estimate,
            leg_colour(j + 1),
            leg_key(j + 1),
        )
        for j in range(session.machine.n_legs)
    ]
    return _edge_plot("leg", boxes)


def _edge_box(
    session: Session,
    name: str,
    mine: Booleans,
    edges: EdgeSet,
    estimate: Estimate,
    colour: Colour,
    key: Key,
) -> Box | None:
    """Box plot of both residual components of the edges in a mask (N,).

    The tooltip names the image of the largest residual.
    """
    white = estimate.edge_residuals[mine]
    row = box(name, white, "σ", 2, colour, key)
    return row and _with_image(session, edges, mine, np.linalg.norm(white, axis=1), row)


def _with_image(session: Session, edges: EdgeSet, mine: Booleans, sizes: Array, row: Box) -> Box:
    """Box whose tooltip names the image of the largest of the sizes (n,); NaN counts least."""
    k = np.flatnonzero(mine)[int(np.argmax(np.nan_to_num(sizes, nan=-np.inf)))]
    station, configuration = edges.station[k], edges.configuration[k]
    image = f"{session.station_names[station]}/{session.configurations[configuration]}"
    return row.model_copy(update={"tip": f"{row.tip}; the largest in {image}"})


def _edge_plot(by: str, boxes: Sequence[Box | None]) -> Plot | None:
    """Box plots of whitened residuals of edges, grouped by something."""
    return row_plot(
        f"edges-by-{by}",
        f"Edges, by {by}",
        SIGMAS_IN_WORDS,
        boxes,
        f"Boxes of the whitened edge residuals by {by}",
        NORMAL_90,
    )


def _configurations(session: Session, edges: EdgeSet, estimate: Estimate) -> Plot | None:
    """Root mean square of each configuration's edges, with the interval expected of noise alone."""
    bars: list[Point] = []
    for k, name in enumerate(session.configurations):
        mine = edges.configuration == k
        weights = estimate.edge_weights[mine]
        level = weighted_edge_rms(estimate.edge_residuals[mine], weights)
        if np.isfinite(level):
            of = f" over {count(len(weights), 'edge')}"
            bars.append(level_bar(name, level, 2 * float(weights.sum()), of))
    return level_plot("edges-by-configuration", "Edges, by configuration", bars)


def level_plot(name: str, title: str, bars: Sequence[Point]) -> Plot | None:
    """Plot of :func:`level_bar` of configurations; None without any.

    An interval that all of them have is a band behind them.
    """
    alt = f"{title}: bars of the residuals' root mean squares"
    label = f"root mean square, {SIGMAS_IN_WORDS}"
    intervals = {
        (bar.low, bar.high) for bar in bars if bar.low is not None and bar.high is not None
    }
    if len(intervals) != 1:
        caption = "Lines: expected of noise alone, 95 %."
        return bar_plot(name, title, "configurations", label, bars, alt, caption=caption)
    low, high = intervals.pop()
    plain = [bar.model_copy(update={"low": None, "high": None}) for bar in bars]
    caption = "Shaded: expected of noise alone, 95 %."
    plot = bar_plot(name, title, "configurations", label, plain, alt, high=high, caption=caption)
    band = BandMark(name="", axis="y", low=low, high=high)
    return plot and plot.model_copy(update={"marks": (band, *plot.marks)})


def level_bar(name: str, level: float, n: float, of: str = "") -> Point:
    """Bar of a configuration's root mean square, in standard deviations, over n numbers.

    With the interval that n numbers of pure noise have.
    """
    low, high = expected_rms(n)
    tip = (
        f"configuration {name}: {number(level, 2)} σ{of}, {number(low, 2)} to {number(high, 2)}"
        " expected of noise alone"
    )
    return Point(
        x=name,
        y=rounded(level),
        low=rounded(low),
        high=rounded(high),
        tip=tip,
        key=configuration_key(name),
        colour="quiet" if level <= high else None,
    )


def expected_rms(n: float) -> tuple[float, float]:
    """95 % interval of the root mean square of n standard normal numbers."""
    from scipy.special import chdtri

    low, high = np.sqrt(chdtri(n, [0.975, 0.025]) / n)
    return float(low), float(high)


def histogram(white: Array) -> Plot | None:
    """Histogram of all residuals with the normal density; the outermost bars include all beyond."""
    values = white[np.isfinite(white)]
    if not values.size:
        return None
    end, width = HISTOGRAM_HALF_SPAN, HISTOGRAM_BAR_WIDTH
    borders = np.arange(-end, end + width / 2, width)
    counts = np.histogram(np.clip(values, -end, end), borders)[0]
    bars: list[Point] = []
    for low, high, n in zip(borders[:-1], borders[1:], counts.tolist(), strict=True):
        where = f"{number(low, 1)} to {number(high, 1)} σ"
        if low == -end or high == end:
            where += " or beyond"
        middle = float(low + width / 2)
        bars.append(Point(x=middle, y=float(n), tip=f"{where}: {count(n, 'residual')}"))
    x = np.linspace(-end, end, 81)
    density = np.exp(-x * x / 2) / np.sqrt(2 * np.pi) * values.size * width
    return Plot(
        name="histogram",
        title="All edge residuals",
        caption="",
        alt="Histogram of the residuals with the normal density over it",
        x=linear_axis(SIGMAS_IN_WORDS, (-end, end)),
        y=linear_axis("number of residuals", (*counts.tolist(), density.max()), zero=True),
        marks=(
            BarsMark(name="residuals", colour="quiet", points=tuple(bars), width=width),
            LineMark(
                name="normal distribution", colour="ink",
                points=line_points(x.tolist(), density.tolist()),
            ),
        ),
    )  # fmt: skip


def _outward(session: Session, edges: EdgeSet, shifts: Array) -> Plot | None:
    """Box plots of outward shifts by leg, tube and side, which show shading and wrong radii."""
    boxes: list[Box | None] = []
    for (j, t, s), mine in _edge_kinds(edges):
        label = f"leg {j + 1}, tube {t + 1}, {EDGE_SIDE_NAMES[s]}"
        row = box(label, shifts[mine], "px", 3, leg_colour(j + 1), leg_key(j + 1))
        boxes.append(row and _with_image(session, edges, mine, np.abs(shifts[mine]), row))
    return row_plot(
        "outward",
        "Edges too far out (+) or in (−), by leg, tube and side",
        "pixels",
        boxes,
        "Boxes of the outward shift in pixels by leg, tube and side",
        caption="Looking along the leg from base to platform.",
    )


def _edge_kinds(edges: EdgeSet) -> list[tuple[tuple[int, int, int], Booleans]]:
    """Leg, tube and side of the edges, each with a mask (N,) of its edges."""
    kinds = np.stack([edges.leg, edges.tube, edges.side], axis=-1)
    return [
        ((int(j), int(t), int(s)), (kinds == (j, t, s)).all(axis=-1))
        for j, t, s in np.unique(kinds, axis=0)
    ]


def _joints(session: Session, estimate: Estimate) -> Plot | None:
    """Box plots of the readings' residuals by joint; tooltips name the worst configurations."""
    motor = session.machine.layout.actuated
    used = np.flatnonzero(estimate.configurations)
    white = estimate.joint_residuals[used]
    boxes: list[Box | None] = []
    for column in range(white.shape[1]):
        legs = np.flatnonzero(motor == column).tolist()
        leg = legs[0] + 1
        row = box(named(legs), white[:, column], "σ", 2, leg_colour(leg), leg_key(leg))
        if row:
            worst = session.configurations[used[int(np.argmax(np.abs(white[:, column])))]]
            row = row.model_copy(update={"tip": f"{row.tip}; the largest in {worst}"})
        boxes.append(row)
    # readings that determine the poses have small residuals whatever their noise; the degrees of
    # freedom show that
    s = estimate.statistics
    caption = f"{count(s.n_joints, 'reading')}, {count(s.dof_joints, 'degree')} of freedom."
    return row_plot(
        "joints",
        "Joint readings, by leg",
        SIGMAS_IN_WORDS,
        boxes,
        "Boxes of the readings' residuals by joint",
        NORMAL_90,
        caption,
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
    outstanding = [g for g, value in level.items() if value > NOISE_EXCESS * middle]
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
        if abs(mean) > OUTLIER_SIGMAS * np.hypot(SHADING_SIGMA, error):
            where = f"leg {leg + 1} tube {tube + 1} {EDGE_SIDE_NAMES[side]}"
            shaded.append((abs(mean), f"{where} by {number(mean, 2, signed=True)} px"))
    return [text for _, text in sorted(shaded, reverse=True)[:4]]
