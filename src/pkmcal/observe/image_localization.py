"""The machine in one photograph alone, of which nothing is known: the places that it could show.

Places all round the machine, at distances from which it fills the picture or a third of it, turns
about the line of sight and places in the picture are tried, by the middles of the tubes on a chart
of what could be tubes (:mod:`pkmcal.observe.tubes`). The best few thousand descend as those of a
station do (:mod:`pkmcal.observe.pose_likelihood`), on tables that tell three times as many
directions apart; the best of these again on twice and four times as fine a picture, where texture
yields far less evidence and the machine more.

How surely the best is the machine, the second best tells: what is not the machine in a picture full
of edges is rarely alone, and a machine of equal parts looks much the same from several sides. What
the drawing has wrong moves all edges of a leg together, so each half of a leg counts as one
measurement of that comparison.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import dot, inverse, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.distance_tables import WORKING_WIDTH, distance_tables
from pkmcal.observe.image_batches import Photographs
from pkmcal.observe.pose_candidates import (
    CAMERA_DIRECTIONS,
    SIGHT_LINE_TURNS,
    frame_of,
    same_pose,
    sphere,
)
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
"""Share of the picture that the machine fills: from a third, to where its ends lie outside."""
WIDEST_HALF_ANGLE = 1.2
"""Half the angle (rad) under which it is seen at most."""
NEXT_DISTANCE_FACTOR = 1.18
"""Factor from one distance to the next: half of that moves a leg's end by half its width."""
CHART_SHARE_OFF_MIDDLE = 0.2
"""Share of the chart's size by which the machine may lie off its middle, to each side."""
CHART_STRIDE_CELLS = 2
"""Cells of the chart from one place in the picture to the next."""
PICTURE_PLACES_A_TURN = 2
"""Places in the picture that are kept for each place and turn of the camera."""
HYPOTHESES_THAT_DESCEND = 2000
"""Hypotheses that descend: in a cluttered laboratory the machine's is among the first thousand."""
HYPOTHESES_ON_COARSE, HYPOTHESES_ON_FINER = 400, 120
"""How many go on after the first descents, and to the finer picture."""
MANY_DIRECTIONS = 24
"""Directions of the tables: each takes its neighbours in, so edges within 11 degrees count."""
FINEST_TABLES = 4 * WORKING_WIDTH, MANY_DIRECTIONS
"""Width (px) and directions of the tables on which places are weighed."""
HYPOTHESES_ON_FINEST = 40
"""How many go on to the finest picture, and beside them the look-alikes of the first two."""
MACHINE_FOLDS = (2, 3, 4, 6)
"""Equal parts that a machine may have."""
JOINT_ON_JOINT_DISTANCE = 0.2
"""Distance, in the base's radius, within which joints fall on joints: no two machines' parts are so
equal that they could be exchanged, and yet from a photograph they could."""
NEAR_ROUNDS, NEAR_STARTS, NEAR_THAT_GO_ON = 3, 32, 8
"""How often, and from how many places at once, the likeliest place near one is looked for; how many
of these are settled closely."""
NEAR_TURN, NEAR_SHIFT = np.radians(5.0), np.array([0.005, 0.005, 0.03])
"""How far these are turned about the machine (rad), and shifted, in the camera's distance: legs
move by their own width then, by which the search that found the place may be off."""
PLACES_IN_A_BATCH = 214
"""Places that are looked up together: some ten megabytes."""


class PoseHypotheses(NamedTuple):
    """Places that a photograph could show, the one with the most evidence first.

    T_camera_base : (H, 4, 4), none near the first. log_likelihood_ratio : (H,) as
    :mod:`pkmcal.observe.pose_likelihood` has it. unit : evidence that counts as one measurement.
    """

    T_camera_base: Array
    log_likelihood_ratio: Array
    unit: float

    @property
    def rival_probability(self) -> float:
        """Probability that the second is the machine's place and not the first."""
        second = float(self.log_likelihood_ratio[1]) if len(self.log_likelihood_ratio) > 1 else 0.0
        return 1 / (
            1 + float(np.exp(min((self.log_likelihood_ratio[0] - second) / self.unit, 500.0)))
        )


def localize_image(view: StationView, image: Integers) -> PoseHypotheses:
    """The likeliest places of the camera of one photograph; view : of it alone."""
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
    """Places (H, 4, 4) settled on the finest tables, those that are not the same place."""
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
    """Of places (H, 4, 4), best first, those that are not the same place as a better one."""
    retained_rows = np.array(distinct_silhouettes(view, values, np.zeros(1, dtype=int)))
    # near the first lies the same place, less well settled
    return retained_rows[~same_pose(values[retained_rows], values[0]) | (retained_rows == 0)]


def finest_view(
    machine: Machine, photograph: Photographs, joints: Array, poses: Array
) -> StationView:
    """What places of one photograph are weighed on; joints, poses : of all configurations."""
    tables = distance_tables([photograph.images[0]], *FINEST_TABLES)
    return StationView(machine, photograph.camera, photograph.configuration, joints, poses, tables)


def refine_local(view: StationView, T_camera_base: Array, scatter: float) -> tuple[Array, float]:
    """The place with the most evidence near one (4, 4), and its evidence: where a drawing has put
    the camera, it may hold on to the wrong side of some legs.

    scatter : as :func:`refine_ml` takes it.
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
    """Reduced pixels of silhouette that count as one measurement: half a leg's."""
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
    """Tubes of the machine in the photograph's configuration, T of them, base frame.

    ends : (T, 3, 3) first, middle and last point that can be seen. radius : (T,). centre : (3,) of
    all. size : m, from there to the furthest.
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
    """The maps so that [width, direction, y, x] is a whole window of shifts, (Sy, Sx); y, x count
    from the chart's corner less what :func:`_border` says.
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
    """Cells put about the maps, on which nothing is a tube."""
    return max(surprisal.shape[2:])


def _scores(
    visibility: Array, radius: Array, turn: float, chart: TubeChart, windows: Integers
) -> Array:
    """Mean worth (P, shifts) of the tubes' middles; visibility : (P, T, 3, 3) first, middle and
    last points from each place. Long tubes count more.
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
    """Places (H, 4, 4) with the machine turned about its own axis onto itself, all such turns of
    each: a machine of equal parts looks much the same from there.
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
