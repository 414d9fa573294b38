"""Localization of one image alone, without a prior: hypotheses of its camera pose.

Positions all round the machine, at distances from which it fills the image or a third of it, turns
about the line of sight and shifts in the image are enumerated, and scored by the middles of the
tubes on a chart of tube-like pairs of edges (:mod:`pkmcal.observe.tubes`). The best few thousand
are refined as those of a station (:mod:`pkmcal.observe.pose_likelihood`), on tables with three
times as many directions; the best of these again at two and four times the resolution, where
texture has far less likelihood and the machine more.

The second best shows how sure the best is: in an image full of edges a wrong match is rarely alone,
and a machine of equal parts looks much the same from several sides. Errors of the nominal model are
correlated along a leg, so each half of a leg counts as one measurement of that comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import angle_between, dot, inverse, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.distance_tables import WORKING_WIDTH, distance_tables
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.pose_candidates import CAMERA_DIRECTIONS, SIGHT_LINE_TURNS, frame_of, sphere
from pkmcal.observe.pose_likelihood import (
    StationView,
    distinct_silhouettes,
    log_likelihood_of,
    refine_lm,
    refine_ml,
)
from pkmcal.observe.predict import edge_points, legs_in_camera, visible_stretch
from pkmcal.observe.tubes import MAP_CELL_SIZE, PAIR_DIRECTIONS, TubeChart, tube_chart

PICTURE_SHARES_FILLED = (0.3, 1.5)
"""Share of the image that the machine fills: from a third, to where its ends are outside."""
WIDEST_HALF_ANGLE = 1.2
"""Largest half angle (rad) that the machine subtends."""
NEXT_DISTANCE_FACTOR = 1.18
"""Factor from one distance to the next: half of that moves a leg's end by half its width."""
CHART_SHARE_OFF_MIDDLE = 0.2
"""Largest offset of the machine from the chart's middle, to each side, as a share of its size."""
CHART_STRIDE_CELLS = 2
"""Cells of the chart from one shift in the image to the next."""
PICTURE_PLACES_A_TURN = 2
"""Shifts in the image that are retained for each position and turn of the camera."""
HYPOTHESES_THAT_DESCEND = 2000
"""Hypotheses that are refined: in a cluttered laboratory the right one is among the first 1000."""
HYPOTHESES_ON_COARSE, HYPOTHESES_ON_FINER = 400, 120
"""Hypotheses that go on after the first refinements, and to the finer image."""
MANY_DIRECTIONS = 24
"""Directions of the tables: each includes its neighbours, so edges within 11 degrees count."""
FINEST_TABLES = 4 * WORKING_WIDTH, MANY_DIRECTIONS
"""Width (px) and directions of the tables on which pose hypotheses are compared."""
HYPOTHESES_ON_FINEST = 40
"""Hypotheses that go on to the finest image, besides the symmetric poses of the first two."""
SAME_PLACE_TURN = np.radians(20.0)
"""Turn within which two poses are one: symmetric poses differ by 60 degrees at least."""
MACHINE_FOLDS = (2, 3, 4, 6)
"""Equal parts that a machine may have."""
JOINT_ON_JOINT_DISTANCE = 0.2
"""Distance, in radii of the base, within which joints coincide under a turn: parts of a machine are
never equal, but nearly enough to be exchanged in an image."""
NEAR_ROUNDS, NEAR_STARTS, NEAR_THAT_GO_ON = 3, 32, 8
"""Rounds, starts in each, and retained starts of the search for the likeliest pose near another."""
NEAR_TURN, NEAR_SHIFT = np.radians(5.0), np.array([0.005, 0.005, 0.03])
"""Spread of the starts: turns about the machine (rad), and shifts in units of the camera's
distance. Legs move by their own width then, by which the first search may be off."""
PLACES_IN_A_BATCH = 214
"""Positions that are evaluated together: some ten megabytes."""


class PoseHypotheses(NamedTuple):
    """Hypotheses of an image's camera pose, the likeliest first.

    T_camera_base : (H, 4, 4), none near the first. log_likelihood_ratio : (H,) as of
    :mod:`pkmcal.observe.pose_likelihood`. unit : log-likelihood that counts as one measurement.
    """

    T_camera_base: Array
    log_likelihood_ratio: Array
    unit: float

    @property
    def rival_probability(self) -> float:
        """Posterior probability of the second pose against the first."""
        second = float(self.log_likelihood_ratio[1]) if len(self.log_likelihood_ratio) > 1 else 0.0
        return 1 / (
            1 + float(np.exp(min((self.log_likelihood_ratio[0] - second) / self.unit, 500.0)))
        )


def localize_image(view: StationView, image: Integers) -> PoseHypotheses:
    """Pose hypotheses of one image without a prior; view : of this image alone."""
    one = np.zeros(1, dtype=int)
    coarse = replace(view, tables=distance_tables([image], WORKING_WIDTH, MANY_DIRECTIONS))
    fine = replace(view, tables=distance_tables([image], 2 * WORKING_WIDTH, MANY_DIRECTIONS))
    hypotheses = _hypotheses(view, tube_chart(image, view.camera))
    hypotheses = refine_lm(coarse, hypotheses, one, 2, (16, 14, 12, 10))
    hypotheses = _most(coarse, hypotheses, 4, HYPOTHESES_ON_COARSE)
    hypotheses = refine_lm(coarse, hypotheses, one, 4, (8, 7, 6, 5, 5))
    hypotheses = _most(coarse, hypotheses, 5, HYPOTHESES_ON_FINER)
    hypotheses, log_likelihood_ratio = refine_ml(fine, hypotheses, one, 8, 6)
    hypotheses = hypotheses[np.argsort(-log_likelihood_ratio)]
    hypotheses = hypotheses[distinct_silhouettes(fine, hypotheses, one)][:HYPOTHESES_ON_FINEST]
    return weighed_places(
        view, image, np.concatenate([hypotheses, symmetric_poses(view, hypotheses[:2])])
    )


def weighed_places(view: StationView, image: Integers, values: Array) -> PoseHypotheses:
    """Distinct poses out of (H, 4, 4), refined on the finest tables."""
    one = np.zeros(1, dtype=int)
    view = replace(view, tables=distance_tables([image], *FINEST_TABLES))
    values, log_likelihood_ratio = refine_ml(view, values, one, 16, 6)
    order = np.argsort(-log_likelihood_ratio)
    order = order[log_likelihood_ratio[order] > 0]
    if not len(order):
        order = np.array([int(np.argmax(log_likelihood_ratio))])
    order = order[distinct(view, values[order])]
    return PoseHypotheses(
        values[order], log_likelihood_ratio[order], _unit(view, values[order[:1]])
    )


def distinct(view: StationView, values: Array) -> Integers:
    """Indices of poses (H, 4, 4), best first, that are not the same pose as a better one."""
    retained_rows = np.array(distinct_silhouettes(view, values, np.zeros(1, dtype=int)))
    # near the first lies the same place, less well settled
    return retained_rows[
        (angle_between(values[retained_rows], values[0]) >= SAME_PLACE_TURN) | (retained_rows == 0)
    ]


def finest_view(
    machine: Machine, photograph: Photographs, joints: Array, poses: Array
) -> StationView:
    """The view with the finest tables of one image; joints, poses : of all configurations."""
    tables = distance_tables([photograph.images[0]], *FINEST_TABLES)
    return StationView(machine, photograph.camera, photograph.configuration, joints, poses, tables)


def refine_local(view: StationView, T_camera_base: Array, scatter: float) -> tuple[Array, float]:
    """The likeliest pose near one (4, 4), and its log-likelihood ratio: a pose by the nominal model
    may match the wrong side of some legs.

    scatter : largest scatter of edges, reduced px, as in :func:`refine_ml`.
    """
    rng, one = np.random.default_rng(0), np.zeros(1, dtype=int)
    ends = view.machine.ends_at(view.joints, view.poses)
    middle = np.concatenate([ends.a[0], ends.b[0]]).mean(axis=0)
    best, most = T_camera_base, -np.inf
    for _ in range(NEAR_ROUNDS):
        turn = rotation(rng.normal(size=(NEAR_STARTS, 3)) * NEAR_TURN)
        turn[0] = np.eye(3)
        starts = best @ pose(turn, middle - turn @ middle)
        away = np.sqrt(dot(starts[0, :3, 3], starts[0, :3, 3]))
        starts[1:, :3, 3] += away * rng.normal(size=(NEAR_STARTS - 1, 3)) * NEAR_SHIFT
        starts, log_likelihood_ratio = refine_ml(view, starts, one, 8, 6)
        starts = starts[np.argsort(-log_likelihood_ratio)[:NEAR_THAT_GO_ON]]
        starts, log_likelihood_ratio = refine_ml(view, starts, one, 16, 10, scatter)
        k = int(np.argmax(log_likelihood_ratio))
        if log_likelihood_ratio[k] > most:
            best, most = starts[k], float(log_likelihood_ratio[k])
    return best, most


def _unit(view: StationView, values: Array) -> float:
    """Reduced pixels of silhouette that count as one measurement: those of half a leg."""
    edges = edge_points(
        view.machine, view.camera, legs_in_camera(view.machine, values[0], view.poses, view.joints),
        view.tubes, 2,
    )  # fmt: skip
    chord = edges.pixel[0, :, 1] - edges.pixel[0, :, 0]
    length = np.nan_to_num(2 * np.hypot(chord[:, 0], chord[:, 1]) / view.tables.scale)
    return float(length.sum()) / (2 * len(np.unique(view.tubes.leg)))


def _most(view: StationView, values: Array, samples: int, count: int) -> Array:
    log_likelihood_ratio = log_likelihood_of(view, values, np.zeros(1, dtype=int), samples).sum(
        axis=-1
    )
    return values[np.argsort(-log_likelihood_ratio)[:count]]


class _Tubes(NamedTuple):
    """T tubes of the machine in the image's configuration, base frame.

    ends : (T, 3, 3) first, middle and last visible point. radius : (T,). centre : (3,) of all.
    size : m, from the centre to the furthest point.
    """

    ends: Array
    radius: Array
    centre: Array
    size: float


def _hypotheses(view: StationView, chart: TubeChart) -> Array:
    """Poses T_camera_base (HYPOTHESES_THAT_DESCEND, 4, 4), best first."""
    tubes = _tubes(view)
    width, height = chart.size
    half = min(width, height) / 2 / chart.scale
    near, far = (
        tubes.size / np.sin(min(half * fill, WIDEST_HALF_ANGLE))
        for fill in reversed(PICTURE_SHARES_FILLED)
    )
    count = int(np.ceil(np.log(far / near) / np.log(NEXT_DISTANCE_FACTOR))) + 1
    distance = np.geomspace(near, far, count)
    direction = sphere(CAMERA_DIRECTIONS)
    rotation_to = frame_of(-direction)
    # what is looked up: each place in the picture is a shift of the maps
    reach = [int(CHART_SHARE_OFF_MIDDLE * n / MAP_CELL_SIZE) for n in chart.size]
    steps = [np.arange(-cells, cells + 1, CHART_STRIDE_CELLS) for cells in reach]
    windows = _windows(chart.surprisal, steps)
    values: list[Array] = []
    shifts: list[Integers] = []
    for away in distance:
        point = tubes.ends - (tubes.centre + direction * away)[:, None, None]
        in_view = np.einsum("pij,ptnj->ptni", rotation_to, point)
        for turn in range(SIGHT_LINE_TURNS):
            score = _scores(
                in_view, tubes.radius, 2 * np.pi * turn / SIGHT_LINE_TURNS, chart, windows
            )
            for _ in range(PICTURE_PLACES_A_TURN):
                best = score.argmax(axis=-1)[:, None]
                shifts += [best]
                values += [np.take_along_axis(score, best, axis=-1)]
                np.put_along_axis(score, best, -np.inf, axis=-1)
    # (distance * turn * PICTURE_PLACES_A_TURN, place)
    value, best = (np.concatenate(part, axis=-1).T for part in (values, shifts))
    order = np.argsort(-value.ravel())[:HYPOTHESES_THAT_DESCEND]
    row, place = np.unravel_index(order, value.shape)
    step, shift = row // PICTURE_PLACES_A_TURN, best[row, place]
    dx, dy = steps[0][shift % len(steps[0])], steps[1][shift // len(steps[0])]
    x, y = (d * MAP_CELL_SIZE / chart.scale for d in (dx, dy))
    zero = np.zeros(len(order))
    tilt = rotation(np.stack([-y, x, zero], axis=-1))
    roll = rotation(
        np.stack([zero, zero, 2 * np.pi / SIGHT_LINE_TURNS * (step % SIGHT_LINE_TURNS)], axis=-1)
    )
    rot = tilt @ roll @ rotation_to[place]
    stand = tubes.centre + direction[place] * distance[step // SIGHT_LINE_TURNS][:, None]
    return pose(rot, -(rot @ stand[..., None])[..., 0])


def _tubes(view: StationView) -> _Tubes:
    tubes = view.tubes
    legs = legs_in_camera(view.machine, np.eye(4), view.poses[:1], view.joints[:1])
    one = np.flatnonzero(tubes.side == 0)
    a, b, u = (v[0][tubes.leg] for v in (legs.a, legs.b, legs.u))
    first, last = visible_stretch(a, b, tubes)
    place = first[:, None] + np.maximum(last - first, 0.0)[:, None] * [0.0, 0.5, 1.0]
    ends = (a[:, None] + place[..., None] * u[:, None])[one]
    corner = ends.reshape(-1, 3)
    centre = (corner.min(axis=0) + corner.max(axis=0)) / 2
    size = float(np.sqrt(dot(corner - centre, corner - centre).max()))
    return _Tubes(ends, view.machine.values[tubes.radius[one]], centre, size)


def _windows(surprisal: Integers, steps: Sequence[Integers]) -> Integers:
    """A view of the maps in which [width, direction, y, x] is a window of shifts, (Sy, Sx); y, x
    count from the corner of the padded chart.
    """
    border = _border(surprisal)
    padded = np.pad(surprisal, ((0, 0), (0, 0), (border, border), (border, border)))
    nx, ny = (len(s) for s in steps)
    shape = (
        *surprisal.shape[:2],
        padded.shape[2] - CHART_STRIDE_CELLS * ny,
        padded.shape[3] - CHART_STRIDE_CELLS * nx,
    )
    stride = padded.strides
    return np.lib.stride_tricks.as_strided(
        padded,
        (*shape, ny, nx),
        (*stride, CHART_STRIDE_CELLS * stride[2], CHART_STRIDE_CELLS * stride[3]),
        writeable=False,
    )


def _border(surprisal: Integers) -> int:
    """Cells of padding about the maps, without tubes."""
    return max(surprisal.shape[2:])


def _scores(
    visibility: Array, radius: Array, turn: float, chart: TubeChart, windows: Integers
) -> Array:
    """Mean surprisal (P, shifts) of the tubes' middles, weighted by the tubes' lengths.

    visibility : (P, T, 3, 3) first, middle and last points from each position, camera frame.
    """
    beside = np.hypot(visibility[..., 0], visibility[..., 1])
    angle = np.arctan2(beside, visibility[..., 2])
    cell = visibility[..., :2] * (chart.scale * angle / np.maximum(beside, 1e-12))[..., None]
    cell = cell @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    chord = cell[:, :, 2] - cell[:, :, 0]
    normal = np.arctan2(chord[..., 0], -chord[..., 1])
    number = np.rint(normal % np.pi * (PAIR_DIRECTIONS / np.pi)).astype(np.intp) % PAIR_DIRECTIONS
    width = 2 * radius * chart.scale / np.sqrt(dot(visibility[:, :, 1], visibility[:, :, 1]))
    weight = np.hypot(chord[..., 0], chord[..., 1])
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    at = np.floor((cell[:, :, 1] + chart.middle) / MAP_CELL_SIZE).astype(np.intp)
    shifts = windows.shape[-2:]
    first = _border(chart.surprisal) - CHART_STRIDE_CELLS * (np.array(shifts[::-1]) // 2)
    at = np.clip(at + first, 0, np.array(windows.shape[3:1:-1]) - 1)
    which = chart.width_number(width)
    out = np.empty((len(visibility), shifts[0] * shifts[1]), dtype=np.float32)
    for k in range(0, len(visibility), PLACES_IN_A_BATCH):
        part = slice(k, k + PLACES_IN_A_BATCH)
        worth = windows[which[part], number[part], at[part, :, 1], at[part, :, 0]]
        worth = worth.reshape(*worth.shape[:2], -1).astype(np.float32)
        out[part] = np.matmul(weight[part, None], worth)[:, 0]
    return out


def symmetric_poses(view: StationView, values: Array) -> Array:
    """Poses (H, 4, 4) of the machine turned about its own axis onto itself, all such turns of each
    pose: a machine of equal parts looks much the same.
    """
    machine = view.machine
    base = machine.base_centers()
    middle = base.mean(axis=0)
    axis = np.linalg.svd(base - middle)[2][2]  # across the plane in which they lie, nearly
    near = JOINT_ON_JOINT_DISTANCE * np.sqrt(dot(base - middle, base - middle).max())
    turns: list[Array] = []
    for angle in 2 * np.pi * np.unique([k / n for n in MACHINE_FOLDS for k in range(1, n)]):
        turn = rotation(angle * axis)
        shifted = (base - middle) @ turn.T + middle
        apart = np.sqrt(dot(shifted[:, None] - base, shifted[:, None] - base))
        if apart.min(axis=1).max() < near:
            turns.append(pose(turn, middle - turn @ middle))
    about = np.array(turns).reshape(-1, 4, 4)
    return (values[:, None] @ inverse(about)).reshape(-1, 4, 4)
