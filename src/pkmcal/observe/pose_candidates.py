"""Candidate poses of a camera without a prior: positions all round the machine, all turns.

A central camera measures rays. From a position, the moving parts of the machine cover a part of the
sphere about the camera: its middle gives the line of sight, its angular width the distance. Both
are measured in images of several configurations without knowing what moves there. So four of the
six unknowns are enumerated, positions on a sphere about the machine and turns about the line of
sight, and two nearly follow. A camera amid the legs is the same case, with a small sphere.

Predictions and images are compared on a chart: angles from the middle of the moving parts, in units
of their width. A turn of the camera is a turn of the chart and a wrong line of sight a shift of it,
for any lens or mirror, so a million candidates are looked up in a table of ten thousand cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers, evenly
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import dot, pose, rotation
from pkmcal.observe.distance_tables import (
    EDGE_DIRECTIONS,
    DistanceTables,
    bin_neighbours,
    direction_of,
    write_distances,
)
from pkmcal.observe.predict import LegsInCamera, TubeList, visible_stretch

CAMERA_DIRECTIONS = 642
"""Directions from the machine to the camera: 8 degrees apart."""
SIGHT_LINE_TURNS = 24
"""Turns about the line of sight: 15 degrees apart."""
NEAREST_DISTANCE_TRIED, FURTHEST_DISTANCE_TRIED = 0.05, 30.0
"""Distances of candidates from the machine's middle, in sizes of the machine."""
DISTANCES_TRIED = 28
SPREAD_POINTS = 160
"""Points of the legs, in all configurations, by which their angular extent is computed."""
WIDER_THAN_LEGS = (0.9, 1.2, 1.6)
"""Ratios of the width of all moving parts to that of the legs: shadows and cables move too."""
CHART_HALF_CELLS = 40
"""Cells of the chart from its middle to its border."""
CHART_HALF_WIDTHS = 3.0
"""Widths of the moving parts from the chart's middle to its border."""
CHART_DISTANCE_CUT = 10
"""Cells at which distances on the chart are cut off."""
CHART_BORDER_CELLS = CHART_DISTANCE_CUT
"""Cells about the chart without edges."""
SIGHT_LINE_SHIFTS = np.stack(np.meshgrid(*[np.arange(-8, 9, 4)] * 2), axis=-1).reshape(-1, 2)
"""Cells by which the line of sight may be off."""
CHORD_ENDS_ALONG_LEG = np.array([0.05, 0.35, 0.65, 0.95])
"""Positions along the visible part of a leg between which its chords are."""
LONGEST_CHORD = CHART_HALF_WIDTHS * CHART_HALF_CELLS
"""Largest weight of a chord, in cells: from near by, a leg fills the sphere."""


class AngularExtent(NamedTuple):
    """Moving parts on the sphere about the camera: unit middle (..., 3), width (...) in rad."""

    middle: Array
    width: Array


def global_candidates(
    camera: Camera,
    tubes: TubeList,
    radius: Array,
    legs: LegsInCamera,
    tables: DistanceTables,
    photographs: Integers,
    keep: int,
) -> Array:
    """The best candidate poses T_camera_base (keep, 4, 4), best first, without a prior.

    legs : of all configurations in the base frame, (K, L). radius : (E,) m of the tubes. tables :
    of the same K images, of which ``photographs`` (indices) are compared.
    """
    in_view = _direction_spread(camera, tables)
    frame = frame_of(in_view.middle)
    places, spread = _places(tubes, radius, legs, float(in_view.width))
    chart = _chart_tables(camera, tables, photographs, frame, float(in_view.width))
    scores = _scores(chart, places, spread, tubes, legs, photographs, float(in_view.width))
    best = np.argpartition(scores.ravel(), keep)[:keep]
    best = best[np.argsort(scores.ravel()[best])]
    place, turn, shift = np.unravel_index(best, scores.shape)
    # the camera looks `off` away from the middle of what it sees, and is turned about that line
    off = SIGHT_LINE_SHIFTS[shift] * (CHART_HALF_WIDTHS / CHART_HALF_CELLS * float(in_view.width))
    zero = np.zeros(len(best))
    tilt = rotation(np.stack([-off[:, 1], off[:, 0], zero], axis=-1))
    roll = rotation(np.stack([zero, zero, 2 * np.pi / SIGHT_LINE_TURNS * turn], axis=-1))
    rot = frame.T @ tilt @ roll @ frame_of(spread.middle[place])
    return pose(rot, -(rot @ places[place][..., None])[..., 0])


def _direction_spread(camera: Camera, tables: DistanceTables) -> AngularExtent:
    """Angular extent of the moving parts in the images."""
    y, x = np.nonzero(tables.moving)
    corner = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    pixel = (np.stack([x, y], axis=-1)[:, None] + corner + 0.5) * tables.scale - 0.5
    rays = camera.ray(pixel)
    ok = np.isfinite(rays).all(axis=(1, 2))
    rays, share = rays[ok], tables.moving[y[ok], x[ok]]
    area = np.cross(rays[:, 1] - rays[:, 0], rays[:, 2] - rays[:, 0])
    weight = share * np.sqrt(dot(area, area))
    return _spread(weight @ rays[:, 0], weight.sum())


def _spread(total: Array, weight: Array) -> AngularExtent:
    """Angular extent of unit rays with the weighted sum (..., 3) and the sum of weights (...)."""
    mean = total / np.maximum(weight, 1e-300)[..., None]
    length = np.sqrt(dot(mean, mean))
    middle = np.where(length[..., None] > 0, mean, [0.0, 0.0, 1.0])  # nothing moves: anywhere
    middle = middle / np.sqrt(dot(middle, middle))[..., None]
    return AngularExtent(middle, np.arccos(np.clip(length, 0.0, 1 - 1e-9)))


def _places(
    tubes: TubeList, radius: Array, legs: LegsInCamera, width: float
) -> tuple[Array, AngularExtent]:
    """Positions (P, 3) in the base frame from which the moving parts are about as wide as in the
    images, and their extent from there.
    """
    one = np.flatnonzero(tubes.side == 0)
    a, b, u = (v[:, tubes.leg] for v in (legs.a, legs.b, legs.u))
    first, last = visible_stretch(a, b, tubes)
    a, u, first, last = a[:, one], u[:, one], first[one], last[:, one]
    length = np.maximum(last - first, 0.0)
    quarter = (np.arange(4) + 0.5) / 4
    point = (
        a[:, :, None] + (first[:, None] + length[..., None] * quarter)[..., None] * u[:, :, None]
    )
    # a place is seen to move as far as it leaves where it was covered before
    away = point - np.median(point, axis=0)
    wide = 2 * radius[one][:, None]
    moves = np.minimum(np.sqrt(dot(away, away)) / wide, 1.0)
    if not moves.any():
        moves = np.ones_like(moves)  # one configuration: what has edges stands for what moves
    weight = (moves * wide * length[..., None]).ravel()
    point = point.reshape(-1, 3)
    centre = weight @ point / weight.sum()
    size = np.sqrt(weight @ dot(point - centre, point - centre) / weight.sum())
    few = evenly(len(point), SPREAD_POINTS)
    point, weight = point[few], weight[few]
    direction = sphere(CAMERA_DIRECTIONS)
    distance = size * np.geomspace(NEAREST_DISTANCE_TRIED, FURTHEST_DISTANCE_TRIED, DISTANCES_TRIED)
    place = centre + direction[:, None] * distance[:, None]
    # one component after the other, and no ray by itself: there are a million of them
    square = sum((point[:, k] - place[..., k, None]) ** 2 for k in range(3))
    near = weight / square
    share = near / np.sqrt(square)
    total = share @ point - share.sum(axis=-1)[..., None] * place
    spread = _spread(total, near.sum(axis=-1))
    nearest = [
        np.abs(np.log(spread.width) - np.log(width / wider)).argmin(axis=1)
        for wider in WIDER_THAN_LEGS
    ]
    at = (
        np.concatenate([np.arange(CAMERA_DIRECTIONS)] * len(WIDER_THAN_LEGS)),
        np.concatenate(nearest),
    )
    return place[at], AngularExtent(spread.middle[at], spread.width[at])


def sphere(count: int) -> Array:
    """Unit directions (count, 3), evenly over the sphere: Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1)


def frame_of(middle: Array) -> Array:
    """Rotations (..., 3, 3) to frames with unit vectors (..., 3) as their z axes."""
    other = np.where(np.abs(middle[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    x = np.cross(other, middle)
    x /= np.sqrt(dot(x, x))[..., None]
    return np.stack([x, np.cross(middle, x), middle], axis=-2)


def _on_chart(rays: Array, width: float) -> Array:
    """Cells (..., 2), from the chart's middle, of unit rays (..., 3) in its frame."""
    away = np.sqrt(rays[..., 0] ** 2 + rays[..., 1] ** 2)
    angle = np.arctan2(away, rays[..., 2])
    cells = CHART_HALF_CELLS / CHART_HALF_WIDTHS / width
    return rays[..., :2] * (angle / np.maximum(away, 1e-12) * cells)[..., None]


def _chart_tables(
    camera: Camera, tables: DistanceTables, photographs: Integers, frame: Array, width: float
) -> Integers:
    """Distance tables (K, EDGE_DIRECTIONS, n, n) uint8 of some images on the chart."""
    n = 2 * CHART_HALF_CELLS + 1
    out = np.empty((len(photographs), EDGE_DIRECTIONS, n, n), dtype=np.float32)
    for row, k in enumerate(photographs):
        edges = tables.edges[k]
        along = np.stack([-edges.normal[:, 1], edges.normal[:, 0]], axis=-1) / 2
        ends = edges.pixel[:, None] + np.stack([-along, along], axis=1)
        rays = camera.ray((ends + 0.5) * tables.scale - 0.5)
        cell = _on_chart(rays[np.isfinite(rays).all(axis=(1, 2))] @ frame.T, width)
        chord = cell[:, 1] - cell[:, 0]
        number = direction_of(np.stack([-chord[:, 1], chord[:, 0]], axis=-1))
        middle = np.rint(cell.mean(axis=1)).astype(int) + CHART_HALF_CELLS
        inside = ((middle >= 0) & (middle < n)).all(axis=1)
        place, number = middle[inside] @ (1, n), number[inside]
        for direction, table in enumerate(out[row]):
            write_distances(place[bin_neighbours(direction, EDGE_DIRECTIONS).take(number)], table)
    return np.rint(np.minimum(out, CHART_DISTANCE_CUT)).astype(np.uint8)


def _scores(
    chart: Integers,
    places: Array,
    spread: AngularExtent,
    tubes: TubeList,
    legs: LegsInCamera,
    photographs: Integers,
    width: float,
) -> Array:
    """Mean distances (P, SIGHT_LINE_TURNS, SIGHT_LINE_SHIFTS), in cells, of all legs' chords from
    image edges of their direction.
    """
    leg = np.unique(tubes.leg)
    a, b, u = (v[photographs][:, leg] for v in (legs.a, legs.b, legs.u))
    low = np.array([tubes.start[tubes.leg == j].min() for j in leg])
    high = np.array([tubes.stop[tubes.leg == j].max() for j in leg])
    high = np.minimum(high, np.sqrt(dot(b - a, b - a)))
    along = low[:, None] + (high - low)[..., None] * CHORD_ENDS_ALONG_LEG
    point = (a[:, :, None] + along[..., None] * u[:, :, None]).reshape(-1, 3)
    ray = point - places[:, None]
    ray /= np.sqrt(dot(ray, ray))[..., None]
    cell = _on_chart(ray @ frame_of(spread.middle).mT, width)
    cell = cell.reshape(len(places), -1, len(CHORD_ENDS_ALONG_LEG), 2)
    chord = np.diff(cell, axis=-2).reshape(len(places), -1, 2)
    middle = ((cell[..., 1:, :] + cell[..., :-1, :]) / 2).reshape(len(places), -1, 2)
    # one component after the other: NumPy is slow along an axis of two
    x, y = (np.ascontiguousarray(middle[..., k]) for k in (0, 1))
    direction = (np.arctan2(chord[..., 1], chord[..., 0]) / np.pi + 0.5) * EDGE_DIRECTIONS
    weight = np.minimum(np.sqrt(dot(chord, chord)), LONGEST_CHORD)
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)[:, None]
    table = np.repeat(np.arange(len(chart)), chord.shape[1] // len(chart)) * EDGE_DIRECTIONS
    # beyond the chart nothing is near; what lies further still is taken to its border
    shifted, n = _shifted(chart), chart.shape[-1] + 2 * CHART_BORDER_CELLS
    limit = n // 2 - np.abs(SIGHT_LINE_SHIFTS).max() - 1
    out = np.empty((len(places), SIGHT_LINE_TURNS, len(SIGHT_LINE_SHIFTS)), dtype=np.float32)
    for turn in range(SIGHT_LINE_TURNS):
        angle = 2 * np.pi / SIGHT_LINE_TURNS * turn
        cos, sin = np.cos(angle), np.sin(angle)
        column, row = (
            np.rint(np.clip(v, -limit, limit)).astype(np.intp) + n // 2
            for v in (cos * x - sin * y, sin * x + cos * y)
        )
        number = (
            np.floor(direction + 2 * EDGE_DIRECTIONS / SIGHT_LINE_TURNS * turn).astype(np.intp)
            % EDGE_DIRECTIONS
        )
        cells = ((table + number) * n + row) * n + column
        out[:, turn] = (weight @ shifted.take(cells, axis=0))[:, 0]
    return out


def _shifted(chart: Integers) -> Array:
    """Distances (cells, SIGHT_LINE_SHIFTS) for every line of sight at each cell of charts (K,
    EDGE_DIRECTIONS, n, n) with a border: values that are looked up together are adjacent.
    """
    border = (CHART_BORDER_CELLS, CHART_BORDER_CELLS)
    around = ((0, 0), (0, 0), border, border)
    flat = np.pad(chart, around, constant_values=CHART_DISTANCE_CUT).astype(np.float32).ravel()
    step = (
        SIGHT_LINE_SHIFTS[:, 1] * (chart.shape[-1] + 2 * CHART_BORDER_CELLS)
        + SIGHT_LINE_SHIFTS[:, 0]
    )
    # nothing is looked up so near the corners that a step leaves the tables
    return flat.take(np.arange(flat.size)[:, None] + step, mode="clip")
