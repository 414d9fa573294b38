"""Tubes whose outlines differ from the nominal model: a sleeve, a ring, a cable along a leg.

In the estimate each side of a tube has an unknown shift at each station, because light shifts
outlines (shading), and each tube a radius with its prior sigma. The shifts have Student's
distribution, so a line that is far off has a small weight and hardly affects the machine. Here
deviations that are too large for shading are tested: a common outward or inward deviation of all
lines of a tube is another radius, a deviation of one line alone is an object beside the tube.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.estimate import Estimate
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM, FalseAlarm, Search
from pkmcal.identify.line_shading import LINE_SHADING
from pkmcal.identify.score import Score
from pkmcal.measurements import Column, Measurements
from pkmcal.measurements.effects import EDGE_SHIFT, lines
from pkmcal.observe.predict import legs_in_camera
from pkmcal.session.load import Session

DISTANCE_SAMPLE_EDGES = 4000
"""Number of edges, spread over all, from which the distances of the lines are computed."""
OF_MEDIAN = 1.25
"""Ratio of the standard deviation of a median to that of a mean, for normal numbers."""
OF_MIDDLE = 1.48
"""Ratio of the standard deviation to the median absolute deviation, for normal numbers."""


class Outline(NamedTuple):
    """A tube's model violation.

    column, score : its column, and its score by its own distribution.
    value, sigma : m, median over the tube's lines, some of which may be partly covered, and its
        standard deviation.
    """

    column: Column
    score: Score
    value: float
    sigma: float


def outlines(
    session: Session,
    measurements: Measurements,
    estimate: Estimate,
    false_alarm: FalseAlarm = SESSION_FALSE_ALARM,
) -> Iterator[Outline]:
    """Tubes with another radius than nominal, then single lines that are off, the most significant
    first.

    Tubes and lines have half of the search's level each.
    """
    from scipy.special import ndtr, stdtr

    keys, number = lines(measurements)
    if len(estimate.line_shift) != len(keys) or not len(keys):
        return
    size = _metres(measurements, estimate, number, len(keys))
    usual = estimate.statistics.shading
    shift, sigma = estimate.line_shift, np.hypot(usual, estimate.line_shift_sigma)
    table, file = session.machine.parameters, session.document["mechanism"]
    grown = estimate.machine.values - table.nominal
    station, leg, tube = keys[:, :3].T
    # radius of each tube: change of the estimated radius plus the shift of each line
    tubes = np.unique(keys[:, 1:3], axis=0)
    edge = float(np.max(estimate.column_sigma(EDGE_SHIFT), initial=0.0))
    results: list[tuple[Score, Integers, float, float]] = []
    for j, t in tubes.tolist():
        mine = np.flatnonzero((leg == j) & (tube == t))
        radius = session.machine.layout.radius[j][t]
        each = grown[radius] + shift[mine] * size[mine]
        if not (each > 0).all() and not (each < 0).all():
            continue  # another radius moves all lines to the same side
        # test of their median, against noise, camera shift and the radius's prior
        value = float(np.median(each))
        own = OF_MEDIAN * np.median(sigma[mine] * size[mine]) / np.sqrt(len(mine))
        scale = float(np.hypot(own, edge * np.median(size[mine])))
        z = float(abs(value) / np.hypot(scale, table.tolerance[radius]))
        chance = float(2 * ndtr(-z))
        score = Score(
            z**2, 1, chance, float(false_alarm.adjusted(Search.OUTLINES, chance, 2 * len(tubes)))
        )
        # reported sigma: at least the scatter of the lines, which may be partly covered
        spread = OF_MEDIAN * OF_MIDDLE * np.median(np.abs(each - value)) / np.sqrt(len(mine))
        results.append((score, mine, value, float(max(scale, spread))))
    thick = sorted(
        (one for one in results if one[0].adjusted < false_alarm.level), key=lambda x: x[0].chance
    )
    # tubes of another radius
    outlined: list[int] = []
    for score, mine, value, scale in thick:
        outlined += mine.tolist()
        j, t = keys[mine[0], 1:3].tolist()
        own, by = _edges_of_lines(measurements, number, mine, size)
        name, facts = f"legs[{j + 1}].tubes[{t + 1}]", _tube(j, t, file=file)
        column = Column("tube.radius", name, "tube radius", edges=by, edge_rows=own, facts=facts)
        yield Outline(column, score, value, scale)
    # single lines of the other tubes, by the distribution of the lines' shading
    z = np.abs(shift) / sigma
    chance = np.where(
        np.isin(np.arange(len(keys)), outlined), 1.0, 2 * stdtr(LINE_SHADING.freedom, -z)
    )
    for k in np.argsort(chance, kind="stable").tolist():
        adjusted = float(false_alarm.adjusted(Search.OUTLINES, chance[k], 2 * len(keys)))
        if adjusted > false_alarm.level:
            break
        score = Score(float(z[k] ** 2), 1, float(chance[k]), adjusted)
        j, t, of = int(leg[k]), int(tube[k]), session.station_names[station[k]]
        own, by = _edges_of_lines(measurements, number, np.array([k]), size)
        name, facts = f"legs[{j + 1}].tubes[{t + 1}], {of}", _tube(j, t, station=of)
        column = Column("tube.edge", name, "tube edge", edges=by, edge_rows=own, facts=facts)
        information = estimate.line_shift_sigma[k]
        yield Outline(column, score, float(shift[k] * size[k]), float(information * size[k]))


def _tube(leg: int, tube: int, **more: str) -> Callable[[Array, Array], dict[str, Any]]:
    """Facts about a tube, numbered from 0."""
    return lambda value, sigma: {
        "leg": leg + 1, "tube": tube + 1, "value": value[0], "sigma": sigma[0], **more
    }  # fmt: skip


def _edges_of_lines(
    measurements: Measurements, number: Integers, mine: Integers, size: Array
) -> tuple[Integers, Array]:
    """Edges (n,) of some lines of a tube, and their derivatives (n, 2, 1) by the tube's excess
    radius, m.

    mine : numbers of the lines. size : metres per pixel on each line.
    """
    own = np.flatnonzero(np.isin(number, mine))
    return own, (-measurements.edges.shift[own] / size[number[own], None])[..., None]


def _metres(measurements: Measurements, estimate: Estimate, number: Integers, count: int) -> Array:
    """Metres per pixel (n,) on each line's tube."""
    edges, state = measurements.edges, estimate.state
    each, first = np.unique(number, return_index=True)
    some = np.union1d(
        first[each >= 0], np.arange(0, len(number), -(-len(number) // DISTANCE_SAMPLE_EDGES))
    )
    some = some[number[some] >= 0]
    rows = edges.configuration[some]
    legs = legs_in_camera(
        estimate.machine,
        state.T_camera_base[edges.station[some]],
        state.T_base_platform[rows],
        measurements.joints[rows],
    )
    at = np.arange(len(some)), edges.leg[some]
    a, u = legs.a[at], legs.u[at]
    away = np.linalg.norm(a - np.sum(a * u, axis=-1, keepdims=True) * u, axis=-1)
    turn = np.linalg.norm(edges.shift[some], axis=-1)
    total = np.bincount(number[some], away * turn, minlength=count)
    return total / np.bincount(number[some], minlength=count)
