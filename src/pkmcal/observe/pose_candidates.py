"""Candidate poses of a camera without a prior: positions all round the machine, all orientations.

Seen from a position, the moving parts of the machine spread over a part of the sphere around the
camera. The middle of that part determines the direction in which the camera must look, its width
the distance. Both are observed in images of several configurations, without knowing which pixels
belong to the machine. Of six unknowns, four are therefore sampled, on a grid of positions around
the machine and of rotations about the line of sight, and two nearly follow. A camera among the legs
is the same case with a small sphere.

Comparisons are made on a chart of angles from the middle of the moving region, in units of its
width. A rotation of the camera is a rotation of the chart and an error of the line of sight a
shift, for any lens or mirror, so a million hypotheses are evaluated by look-ups in a table of some
ten thousand cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import angle_between, dot, pose, rotation
from pkmcal.observe.distance_tables import (
    DISTANCE_TABLE_OPTIONS,
    DistanceTables,
    bin_neighbours,
    direction_of,
    write_distances,
)
from pkmcal.observe.predict import LegsInCamera, TubeList, visible_stretch


@dataclass(frozen=True)
class CandidateOptions:
    """Constants of the grid of camera poses, and of the chart on which they are compared."""

    # number of directions from the machine to the camera: 8 degrees apart
    directions: int = 642
    # number of rotations about the line of sight: 15 degrees apart
    turns: int = 24
    # smallest and largest distance from the middle of the machine, relative to its size
    distance_range: tuple[float, float] = (0.05, 30.0)
    # number of distances between these, in geometric progression (ratio 1.27)
    distances: int = 28
    # number of points of the legs, over all configurations, from which the angular extent is
    # computed
    spread_points: int = 160
    # ratios of the width of the moving region to that of the legs that are tried: shadows and
    # cables move too
    wider: tuple[float, ...] = (0.9, 1.2, 1.6)
    # cells from the middle of the chart to its border
    half_cells: int = 40
    # widths of the moving region from the middle of the chart to its border
    half_widths: float = 3.0
    # largest distance on the chart, cells; also the padding around the chart, which has no edge
    distance_cut: int = 10
    # largest error of the line of sight that is tried, cells: a fifth of the chart
    shift_reach: int = 8
    # spacing of these errors, cells
    shift_step: int = 4
    # ends of the chords along the visible part of a leg, as shares of its length
    chord_ends: tuple[float, ...] = (0.05, 0.35, 0.65, 0.95)
    # number of edge directions on the chart
    edge_directions: int = DISTANCE_TABLE_OPTIONS.directions

    @cached_property
    def shifts(self) -> Integers:
        """Errors of the line of sight that are tried, (n, 2) cells."""
        steps = np.arange(-self.shift_reach, self.shift_reach + 1, self.shift_step)
        return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)

    @property
    def longest_chord(self) -> float:
        """Largest weight of a chord, cells: close to the camera, a leg fills the sphere."""
        return self.half_widths * self.half_cells


CANDIDATE_OPTIONS = CandidateOptions()

SAME_POSE_TURN = np.radians(20.0)
"""Turn within which two pose candidates are one: those of a machine of equal parts are turned by 60
degrees at least."""


def same_pose(one: Array, other: Array) -> Booleans:
    """Whether pose candidates (..., 4, 4) are the same pose, more or less well refined; (...)."""
    return angle_between(one, other) < SAME_POSE_TURN


class AngularExtent(NamedTuple):
    """Middle, unit vectors (..., 3), and width (...), rad, of what moves, on the sphere around the
    camera.
    """

    middle: Array
    width: Array


def global_candidates(
    camera: Camera,
    tubes: TubeList,
    radius: Array,
    legs: LegsInCamera,
    tables: DistanceTables,
    images: Integers,
    keep: int,
    options: CandidateOptions = CANDIDATE_OPTIONS,
) -> Array:
    """Likeliest poses T_camera_base (keep, 4, 4) without a prior, best first.

    radius : (E,) m of the tubes of each edge.
    legs : (K, L) in the base frame, of all configurations.
    tables : of the same K images.
    images : numbers of the images that are scored.
    """
    # angular extent of the moving region: solid angle of each pixel, times the share of images in
    # which it moves
    y, x = np.nonzero(tables.moving)
    corner = np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    pixel = (np.stack([x, y], axis=-1)[:, None] + corner + 0.5) * tables.scale - 0.5
    rays = camera.ray(pixel)
    ok = np.isfinite(rays).all(axis=(1, 2))
    rays, share = rays[ok], tables.moving[y[ok], x[ok]]
    area = np.cross(rays[:, 1] - rays[:, 0], rays[:, 2] - rays[:, 0])
    weight = share * np.sqrt(dot(area, area))
    in_view = _spread(weight @ rays[:, 0], weight.sum())
    frame = frame_of(in_view.middle)
    places, spread = _places(tubes, radius, legs, float(in_view.width), options)
    chart = _chart_tables(camera, tables, images, frame, float(in_view.width), options)
    scores = _scores(chart, places, spread, tubes, legs, images, float(in_view.width), options)
    best = np.argpartition(scores.ravel(), keep)[:keep]
    best = best[np.argsort(scores.ravel()[best])]
    place, turn, shift = np.unravel_index(best, scores.shape)
    # shift of the line of sight and rotation about it, applied to the frame in which the camera
    # looks at the middle of the legs
    off = options.shifts[shift] * (options.half_widths / options.half_cells * float(in_view.width))
    zero = np.zeros(len(best))
    tilt = rotation(np.stack([-off[:, 1], off[:, 0], zero], axis=-1))
    roll = rotation(np.stack([zero, zero, 2 * np.pi / options.turns * turn], axis=-1))
    rot = frame.T @ tilt @ roll @ frame_of(spread.middle[place])
    return pose(rot, -(rot @ places[place][..., None])[..., 0])


def _spread(total: Array, weight: Array) -> AngularExtent:
    """Mean direction and width of unit rays from their weighted sum (..., 3) and sum of weights
    (...).

    The width is the angle whose cosine is the length of the mean.
    """
    mean = total / np.maximum(weight, 1e-300)[..., None]
    length = np.sqrt(dot(mean, mean))
    middle = np.where(length[..., None] > 0, mean, [0.0, 0.0, 1.0])  # nothing moves: any direction
    middle = middle / np.sqrt(dot(middle, middle))[..., None]
    return AngularExtent(middle, np.arccos(np.clip(length, 0.0, 1 - 1e-9)))


def _places(
    tubes: TubeList, radius: Array, legs: LegsInCamera, width: float, options: CandidateOptions
) -> tuple[Array, AngularExtent]:
    """Camera positions (P, 3), base frame, from which the legs have about the observed width.

    For each direction and each ratio of widths, the distance with the best width; with the
    extent of the legs seen from each position.
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
    # a point counts as moving by the share of the tube's width that it leaves uncovered
    away = point - np.median(point, axis=0)
    wide = 2 * radius[one][:, None]
    moves = np.minimum(np.sqrt(dot(away, away)) / wide, 1.0)
    if not moves.any():
        moves = np.ones_like(moves)  # one configuration: all edges count as moving
    weight = (moves * wide * length[..., None]).ravel()
    point = point.reshape(-1, 3)
    centre = weight @ point / weight.sum()
    size = np.sqrt(weight @ dot(point - centre, point - centre) / weight.sum())
    # extent from each position, weighted by the solid angle of the points
    few = evenly(len(point), options.spread_points)
    point, weight = point[few], weight[few]
    direction = sphere(options.directions)
    distance = size * np.geomspace(*options.distance_range, options.distances)
    place = centre + direction[:, None] * distance[:, None]
    # component by component, because an array of a million rays would be slow
    square = sum((point[:, k] - place[..., k, None]) ** 2 for k in range(3))
    near = weight / square
    share = near / np.sqrt(square)
    total = share @ point - share.sum(axis=-1)[..., None] * place
    spread = _spread(total, near.sum(axis=-1))
    # for each direction and ratio, the distance at which the width fits best
    nearest = [
        np.abs(np.log(spread.width) - np.log(width / wider)).argmin(axis=1)
        for wider in options.wider
    ]
    at = (
        np.concatenate([np.arange(options.directions)] * len(options.wider)),
        np.concatenate(nearest),
    )
    return place[at], AngularExtent(spread.middle[at], spread.width[at])


def sphere(count: int) -> Array:
    """Unit directions (count, 3) evenly distributed on the sphere, a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=-1)


def frame_of(middle: Array) -> Array:
    """Rotations (..., 3, 3) from the frame of unit vectors (..., 3) to a frame with these as its z
    axis.
    """
    other = np.where(np.abs(middle[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    x = np.cross(other, middle)
    x /= np.sqrt(dot(x, x))[..., None]
    return np.stack([x, np.cross(middle, x), middle], axis=-2)


def _on_chart(rays: Array, width: float, options: CandidateOptions) -> Array:
    """Chart cells (..., 2), relative to the middle, of unit rays (..., 3) in the chart's frame."""
    away = np.sqrt(rays[..., 0] ** 2 + rays[..., 1] ** 2)
    angle = np.arctan2(away, rays[..., 2])
    cells = options.half_cells / options.half_widths / width
    return rays[..., :2] * (angle / np.maximum(away, 1e-12) * cells)[..., None]


def _chart_tables(
    camera: Camera,
    tables: DistanceTables,
    images: Integers,
    frame: Array,
    width: float,
    options: CandidateOptions,
) -> Integers:
    """Distance tables (K, directions, n, n) uint8 on the chart, in cells, of some images."""
    n = 2 * options.half_cells + 1
    out = np.empty((len(images), options.edge_directions, n, n), dtype=np.float32)
    for row, k in enumerate(images):
        edges = tables.edges[k]
        # each edge point as a chord of one reduced pixel, which gives its direction on the chart
        along = np.stack([-edges.normal[:, 1], edges.normal[:, 0]], axis=-1) / 2
        ends = edges.pixel[:, None] + np.stack([-along, along], axis=1)
        rays = camera.ray((ends + 0.5) * tables.scale - 0.5)
        cell = _on_chart(rays[np.isfinite(rays).all(axis=(1, 2))] @ frame.T, width, options)
        chord = cell[:, 1] - cell[:, 0]
        number = direction_of(
            np.stack([-chord[:, 1], chord[:, 0]], axis=-1), options.edge_directions
        )
        middle = np.rint(cell.mean(axis=1)).astype(int) + options.half_cells
        inside = ((middle >= 0) & (middle < n)).all(axis=1)
        place, number = middle[inside] @ (1, n), number[inside]
        for direction, table in enumerate(out[row]):
            write_distances(
                place[bin_neighbours(direction, options.edge_directions).take(number)], table
            )
    return np.rint(np.minimum(out, options.distance_cut)).astype(np.uint8)


def _scores(
    chart: Integers,
    places: Array,
    spread: AngularExtent,
    tubes: TubeList,
    legs: LegsInCamera,
    images: Integers,
    width: float,
    options: CandidateOptions,
) -> Array:
    """Mean distance (P, turns, shifts), in cells, of the legs' chords to
    edges of the same direction, weighted by the chords' lengths.
    """
    leg = np.unique(tubes.leg)
    a, b, u = (v[images][:, leg] for v in (legs.a, legs.b, legs.u))
    # chords along the visible part of each leg, on the chart
    low = np.array([tubes.start[tubes.leg == j].min() for j in leg])
    high = np.array([tubes.stop[tubes.leg == j].max() for j in leg])
    high = np.minimum(high, np.sqrt(dot(b - a, b - a)))
    along = low[:, None] + (high - low)[..., None] * options.chord_ends
    point = (a[:, :, None] + along[..., None] * u[:, :, None]).reshape(-1, 3)
    ray = point - places[:, None]
    ray /= np.sqrt(dot(ray, ray))[..., None]
    cell = _on_chart(ray @ frame_of(spread.middle).mT, width, options)
    cell = cell.reshape(len(places), -1, len(options.chord_ends), 2)
    chord = np.diff(cell, axis=-2).reshape(len(places), -1, 2)
    middle = ((cell[..., 1:, :] + cell[..., :-1, :]) / 2).reshape(len(places), -1, 2)
    # component by component: NumPy is slow along an axis of two
    x, y = (np.ascontiguousarray(middle[..., k]) for k in (0, 1))
    direction = (np.arctan2(chord[..., 1], chord[..., 0]) / np.pi + 0.5) * options.edge_directions
    weight = np.minimum(np.sqrt(dot(chord, chord)), options.longest_chord)
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)[:, None]
    table = np.repeat(np.arange(len(chart)), chord.shape[1] // len(chart)) * options.edge_directions
    # beyond the chart there are no edges; chords further away are moved to its border
    shifted, n = _shifted(chart, options), chart.shape[-1] + 2 * options.distance_cut
    limit = n // 2 - np.abs(options.shifts).max() - 1
    out = np.empty((len(places), options.turns, len(options.shifts)), dtype=np.float32)
    for turn in range(options.turns):
        # rotate the chords and look up all shifts of each
        angle = 2 * np.pi / options.turns * turn
        cos, sin = np.cos(angle), np.sin(angle)
        column, row = (
            np.rint(np.clip(v, -limit, limit)).astype(np.intp) + n // 2
            for v in (cos * x - sin * y, sin * x + cos * y)
        )
        number = (
            np.floor(direction + 2 * options.edge_directions / options.turns * turn).astype(np.intp)
            % options.edge_directions
        )
        cells = ((table + number) * n + row) * n + column
        out[:, turn] = (weight @ shifted.take(cells, axis=0))[:, 0]
    return out


def _shifted(chart: Integers, options: CandidateOptions) -> Array:
    """Distances (cells, shifts) at each cell of padded charts (K, directions, n, n), for
    every shift of the line of sight.

    Values that are looked up together are adjacent in memory.
    """
    border = (options.distance_cut, options.distance_cut)
    around = ((0, 0), (0, 0), border, border)
    flat = np.pad(chart, around, constant_values=options.distance_cut).astype(np.float32).ravel()
    step = (
        options.shifts[:, 1] * (chart.shape[-1] + 2 * options.distance_cut) + options.shifts[:, 0]
    )
    # no cell near enough to the corners to leave the tables is ever looked up
    return flat.take(np.arange(flat.size)[:, None] + step, mode="clip")
