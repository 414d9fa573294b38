"""Camera localization from a single image without a prior.

Coarse poses: camera directions all round the machine, distances at which it fills a third of the
image to more than all of it, rotations about the optical axis, and positions in the image. They are
scored by the centres of the tubes on a chart of possible tubes (:mod:`pkmcal.observe.tubes`). The
best few thousand descend as in the localization of a station
(:mod:`pkmcal.observe.pose_likelihood`), on tables with three times as many edge directions. The
best of these are refined on tables of twice and four times the resolution, where texture
contributes much less log likelihood and the machine more.

The log-likelihood ratio to the second best hypothesis measures the certainty of the best: clutter
rarely produces a single match, and a machine of equal parts looks nearly the same from several
sides. An error of the nominal model moves all edges of a leg together, so in this comparison each
half of a leg counts as one measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import angle_between, apply, dot, inverse, pose, rotation
from pkmcal.levels import NEARLY_ALL
from pkmcal.mechanisms import Machine
from pkmcal.observe.distance_tables import (
    DISTANCE_TABLE_OPTIONS,
    DistanceTableOptions,
    DistanceTables,
    distance_tables,
)
from pkmcal.observe.image_batches import StationImages
from pkmcal.observe.legs import EDGE_OPTIONS
from pkmcal.observe.pose_candidates import (
    CANDIDATE_OPTIONS,
    CandidateOptions,
    frame_of,
    same_pose,
    sphere,
)
from pkmcal.observe.pose_likelihood import (
    StationView,
    distances_under,
    distinct_silhouettes,
    mixture_of,
    refine_lm,
    refine_ml,
)
from pkmcal.observe.predict import edge_points, legs_in_camera, visible_stretch
from pkmcal.observe.tubes import TUBE_CHART_OPTIONS, TubeChart, TubeChartOptions, tube_chart


@dataclass(frozen=True)
class ImageLocalizationOptions:
    """Constants of the localization of a single image."""

    # smallest and largest share of the image that the machine fills: from a third, to ends outside
    # the image
    filled: tuple[float, float] = (0.3, 1.5)
    # largest half angle subtended by the machine, rad
    widest: float = 1.2
    # ratio of successive distances: half a step moves the end of a leg by half its width
    distance_ratio: float = 1.18
    # largest offset of the machine from the middle of the chart, to each side, as a share of the
    # chart's size
    off_middle: float = 0.2
    # chart cells between successive positions in the image
    stride: int = 2
    # number of image positions retained for each camera position and rotation
    positions: int = 2
    # number of hypotheses of the chart that are compared by their silhouettes. Of 18 simulated
    # images (gough-stewart and 3-rps, three seeds each) the same four are localized with it and
    # with 16000, none at a wrong pose, and three of them with 4000 (measured); on a photograph with
    # two of six legs hidden the correct one is among the first eight thousand
    charted: int = 8000
    # number of hypotheses that are refined
    refined: int = 2000
    # number of hypotheses retained after the first descent
    on_coarse: int = 400
    # number of hypotheses for the tables of double resolution
    on_finer: int = 120
    # number of hypotheses on the finest tables, besides the symmetric poses of the first two
    on_finest: int = 40
    # number of poses of a line that are refined
    on_line: int = 6
    # reaches of the steps of the first descent, reduced pixels, falling from the distance at which
    # an edge is attracted
    first_reaches: tuple[float, ...] = (16, 14, 12, 10)
    # reaches of the second descent
    next_reaches: tuple[float, ...] = (8, 7, 6, 5, 5)
    # number of edge directions of the tables: with the neighbours included, edges within 11
    # degrees count
    directions: int = 24
    # orders of rotational symmetry that are tried
    folds: tuple[int, ...] = (2, 3, 4, 6)
    # largest distance between a rotated joint and its counterpart in a symmetric pose, relative to
    # the radius of the base. No real parts are exactly interchangeable, but in an image they look
    # so: a leg as long as that radius is turned by the 11 degrees within which edges count (0.2)
    joint_distance: float = 0.2
    # rounds of the search near a pose; refine_local ends with the first that gains nothing
    near_rounds: int = 3
    # starts in each round
    near_starts: int = 32
    # starts that are refined to the end
    near_refined: int = 8
    # standard deviation of the starts' rotation about the machine, rad. Legs then move by their
    # own width, the possible error of the first search
    near_turn: float = np.radians(5.0)
    # standard deviations of the starts' shift in the camera's axes, relative to its distance
    near_shift: tuple[float, float, float] = (0.005, 0.005, 0.03)
    # number of camera positions scored together, so that intermediate results stay in the
    # processor's cache (numerical: no effect on results)
    batch: int = 64
    # distance tables, of which width and number of directions are changed
    tables: DistanceTableOptions = DISTANCE_TABLE_OPTIONS
    # chart of possible tubes
    chart: TubeChartOptions = TUBE_CHART_OPTIONS
    # grid of camera directions and of rotations about the line of sight
    candidates: CandidateOptions = CANDIDATE_OPTIONS

    def tables_at(self, resolution: int) -> DistanceTableOptions:
        """Options of distance tables with a multiple of the usual resolution."""
        width = resolution * self.tables.width
        return replace(self.tables, width=width, directions=self.directions)

    def wider(self, factor: int) -> ImageLocalizationOptions:
        """Options with a multiple of the number of hypotheses."""
        names = ("refined", "on_coarse", "on_finer", "on_finest")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


IMAGE_LOCALIZATION_OPTIONS = ImageLocalizationOptions()


class PoseHypotheses(NamedTuple):
    """Candidate poses of an image, by decreasing log-likelihood ratio.

    T_camera_base : (H, 4, 4), of distinct silhouettes.
    log_likelihood_ratio : (H,) against chance, as in :mod:`pkmcal.observe.pose_likelihood`.
    unit : log-likelihood ratio that counts as one independent measurement.
    """

    T_camera_base: Array
    log_likelihood_ratio: Array
    unit: float

    def select(self, rows: Integers | Booleans) -> PoseHypotheses:
        """Some of the hypotheses, in the same order."""
        return PoseHypotheses(self.T_camera_base[rows], self.log_likelihood_ratio[rows], self.unit)

    def weighed(self, log_likelihood: Array) -> PoseHypotheses:
        """The hypotheses with independent evidence (H,), nats, best first."""
        total = self.log_likelihood_ratio + self.unit * log_likelihood
        order = np.argsort(-total, kind="stable")
        return PoseHypotheses(self.T_camera_base[order], total[order], self.unit)

    @property
    def probabilities(self) -> Array:
        """Probability (H,) of each hypothesis, given that it or the first one is correct."""
        nats = (self.log_likelihood_ratio[0] - self.log_likelihood_ratio) / self.unit
        return 1 / (1 + np.exp(np.minimum(nats, 500.0)))

    @property
    def rival_probability(self) -> float:
        """Probability that the second hypothesis is the correct one, given that one of the first
        two is.

        Without a second hypothesis, the comparison is with chance.
        """
        if len(self.log_likelihood_ratio) > 1:
            return float(self.probabilities[1])
        return 1 / (1 + float(np.exp(min(self.log_likelihood_ratio[0] / self.unit, 500.0))))


def localize_image(
    view: StationView,
    image: Integers,
    options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS,
) -> PoseHypotheses:
    """Pose hypotheses of the camera of one image, best first, none near the first.

    view : of this image alone.
    """
    one = np.zeros(1, dtype=int)
    coarse = replace(view, tables=distance_tables([image], options.tables_at(1)))
    fine = replace(view, tables=distance_tables([image], options.tables_at(2)))
    # chart of tubes, then robust descents on tables of the usual resolution
    hypotheses = _hypotheses(view, tube_chart(image, view.camera, options.chart), options)
    hypotheses = _most(coarse, hypotheses, 3, options.refined)
    hypotheses = refine_lm(coarse, hypotheses, one, 2, options.first_reaches)
    hypotheses = _most(coarse, hypotheses, 4, options.on_coarse)
    hypotheses = refine_lm(coarse, hypotheses, one, 4, options.next_reaches)
    hypotheses = _most(coarse, hypotheses, 5, options.on_finer)
    # maximum likelihood at twice the resolution
    hypotheses, _ = refine_ml(fine, hypotheses, one, 8, 6)
    hypotheses = _most(fine, hypotheses, 8, options.on_finer)
    hypotheses = hypotheses[distinct_silhouettes(fine, hypotheses, one)][: options.on_finest]
    # and, with the symmetric poses of the best two, at four times
    weighed = weighed_poses(
        view,
        image,
        np.concatenate([hypotheses, symmetric_poses(view, hypotheses[:2], options)]),
        options=options,
    )
    return weighed.select(distinct(view, weighed.T_camera_base))


def weighed_poses(
    view: StationView,
    image: Integers,
    values: Array,
    options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS,
) -> PoseHypotheses:
    """Hypotheses from poses (H, 4, 4) refined on the finest tables, equal silhouettes removed.

    Poses no likelier than chance are removed too, unless none remains; then the best one is
    returned.
    """
    one = np.zeros(1, dtype=int)
    view = replace(view, tables=distance_tables([image], options.tables_at(4)))
    values, _ = refine_ml(view, values, one, 16, 6)
    log_likelihood_ratio = _log_likelihood(view, values, 16)
    order = np.argsort(-log_likelihood_ratio)
    order = order[log_likelihood_ratio[order] > 0]
    if not len(order):
        order = np.array([int(np.argmax(log_likelihood_ratio))])
    order = order[distinct_silhouettes(view, values[order], one)]
    # unit of log likelihood: the mean length of half a leg's silhouette
    edges = edge_points(
        view.machine,
        view.camera,
        legs_in_camera(view.machine, values[order[0]], view.poses, view.joints),
        view.tubes,
        2,
    )
    chord = edges.pixel[0, :, 1] - edges.pixel[0, :, 0]
    length = np.nan_to_num(2 * np.hypot(chord[:, 0], chord[:, 1]) / view.tables.scale)
    unit = float(length.sum()) / (2 * len(np.unique(view.tubes.leg)))
    return PoseHypotheses(values[order], log_likelihood_ratio[order], unit)


def distinct(view: StationView, values: Array) -> Integers:
    """Indices of the poses (H, 4, 4), best first, that are not the same as a better one, nor near
    the first.
    """
    rows = np.array(distinct_silhouettes(view, values, np.zeros(1, dtype=int)))
    # poses near the first are the same pose, refined less well
    return rows[~same_pose(values[rows], values[0]) | (rows == 0)]


def finest_tables(image: StationImages) -> DistanceTables:
    """Distance tables of one image, at the largest resolution that is used."""
    return distance_tables([image.images[0]], IMAGE_LOCALIZATION_OPTIONS.tables_at(4))


def finest_view(
    machine: Machine,
    image: StationImages,
    joints: Array,
    poses: Array,
    tables: DistanceTables | None = None,
) -> StationView:
    """View of one image with the finest tables.

    joints, poses : of all configurations of the session; the latter are T_base_platform.
    tables : of the image, computed if None.
    """
    tables = tables or finest_tables(image)
    return StationView(machine, image.camera, image.configuration, joints, poses, tables)


def refine_local(view: StationView, T_camera_base: Array, scatter: float) -> tuple[Array, Array]:
    """Likeliest poses near others (n, 4, 4), and their log-likelihood ratios (n,).

    After a localization with the nominal model, some legs may be matched to the wrong side of a
    tube; random starts around a pose find the correct match.

    scatter : as the parameter ``widest`` of :func:`refine_ml`.
    """
    options, one = IMAGE_LOCALIZATION_OPTIONS, np.zeros(1, dtype=int)
    rngs = [np.random.default_rng(0) for _ in T_camera_base]
    best, most = T_camera_base.copy(), np.full(len(T_camera_base), -np.inf)
    gains = np.arange(len(best))  # poses that the last round has improved
    for _ in range(options.near_rounds):
        if not gains.size:
            break
        # starts about each pose, side by side; the likeliest of each are refined to the end
        starts = np.concatenate([_starts_near(view, best[k], rngs[k], options) for k in gains])
        starts, value = refine_ml(view, starts, one, 8, 6)
        starts, _ = _likeliest(starts, value, len(gains), options.near_refined)
        starts, value = refine_ml(view, starts, one, 16, 10, scatter)
        starts, value = _likeliest(starts, value, len(gains), 1)
        better = value >= most[gains] + view.options.least_gain
        gains = gains[better]
        best[gains], most[gains] = starts[better], value[better]
    return best, most


def _likeliest(poses: Array, likelihood: Array, count: int, keep: int) -> tuple[Array, Array]:
    """The ``keep`` likeliest of each of ``count`` equal groups of poses (H, 4, 4), one group after
    the other, and their likelihoods.
    """
    by_group = likelihood.reshape(count, -1)
    order = np.argsort(-by_group, axis=1, kind="stable")[:, :keep]
    rows = (order + by_group.shape[1] * np.arange(count)[:, None]).ravel()
    return poses[rows], likelihood[rows]


def localize_along(
    view: StationView,
    T_camera_base: Array,
    scatter: float,
    options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS,
) -> Array:
    """Likeliest pose near each of N lines of poses (N, D, 4, 4), such as a camera's at unknown
    distance in a given direction; equal ones once, (n, 4, 4).

    view : with the finest tables. scatter : as of :func:`refine_local`.
    """
    one, count, poses = np.zeros(1, dtype=int), len(T_camera_base), T_camera_base.reshape(-1, 4, 4)
    if not count:
        return poses
    starts, _ = _likeliest(poses, _log_likelihood(view, poses, 8), count, options.on_line)
    starts, likelihood = refine_ml(view, starts, one, 8, 6)
    starts, likelihood = _likeliest(starts, likelihood, count, 1)
    starts = starts[np.argsort(-likelihood, kind="stable")]
    return refine_local(view, starts[distinct_silhouettes(view, starts, one)], scatter)[0]


def localize_near(
    view: StationView,
    image: Integers,
    T_camera_base: Array,
    options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS,
    seed: int = 0,
) -> PoseHypotheses:
    """Pose hypotheses of the camera of one image near a pose (4, 4), best first.

    view : of this image alone. seed : of the poses around it at which the search begins.
    """
    one = np.zeros(1, dtype=int)
    coarse = replace(view, tables=distance_tables([image], options.tables_at(1)))
    starts = _starts_near(view, T_camera_base, np.random.default_rng(seed), options)
    settled = refine_lm(coarse, starts, one, 4, options.next_reaches)
    return weighed_poses(view, image, np.concatenate([starts, settled]), options)


def with_neighbours(
    view: StationView,
    image: Integers,
    T_camera_base: Array,
    log_prior: Callable[[Array], Array],
    options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS,
) -> PoseHypotheses:
    """Pose hypotheses of the camera of one image from poses (H, 4, 4), best first, with the rivals
    beside the best one, by several searches near it.

    Without these searches, a local maximum of the likelihood beside the correct pose would have no
    rival.

    log_prior : log prior (H,), nats, of poses (H, 4, 4).
    """

    def weighed(poses: Array) -> PoseHypotheses:
        hypotheses = weighed_poses(view, image, poses, options)
        return hypotheses.weighed(log_prior(hypotheses.T_camera_base))

    hypotheses = weighed(T_camera_base)
    for seed in range(1, options.near_rounds + 1):
        near = localize_near(view, image, hypotheses.T_camera_base[0], options, seed)
        hypotheses = weighed(np.concatenate([hypotheses.T_camera_base, near.T_camera_base]))
    return hypotheses


def log_prior_by_hand(
    view: StationView,
    T_camera_base: Array,
    other: Array,
    sigma: float,
    options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS,
) -> Array:
    """Log prior (H,), nats, of poses ``other`` (H, 4, 4) after a person has set one (4, 4), against
    that of poses anywhere.

    Nearly all poses set by hand are right, up to the numbers of the legs of a machine of equal
    parts. The rest tell nothing.

    sigma : of a hand, rad: of each rotation about the machine's middle, and of the direction to it;
        and of the distance, relative.
    """
    set_by_hand = T_camera_base[None]
    equal = np.concatenate([set_by_hand, symmetric_poses(view, set_by_hand, options)])
    middle = _machine_middle(view)
    equal_middle, other_middle = apply(equal, middle), apply(other, middle)
    shift = (other_middle[:, None] - equal_middle) / np.linalg.norm(equal_middle, axis=-1)[:, None]
    turn = angle_between(other[:, None], equal)
    square = (turn**2 + dot(shift, shift)) / sigma**2
    near = np.exp(-square / 2).sum(axis=1) / len(equal) / (np.sqrt(2 * np.pi) * sigma) ** 6
    # all rotations, and the directions and distances of the search without a prior
    last = np.array(view.camera.image_size) - 1
    rays = view.camera.ray(last / 2 + last / 2 * np.array([[[-1, 0], [1, 0]], [[0, -1], [0, 1]]]))
    view_angles = np.nan_to_num(np.arccos(dot(rays[:, 0], rays[:, 1])), nan=np.pi)
    width, height = 2 * options.off_middle * view_angles
    everywhere = 8 * np.pi**2 * width * height * np.log(options.filled[1] / options.filled[0])
    return np.log(NEARLY_ALL * near * everywhere + 1 - NEARLY_ALL)


def _starts_near(
    view: StationView,
    T_camera_base: Array,
    rng: np.random.Generator,
    options: ImageLocalizationOptions,
) -> Array:
    """A pose (4, 4), and random ones around it: rotated about the middle of the machine, and
    shifted; (near_starts, 4, 4).
    """
    middle = _machine_middle(view)
    turn = rotation(rng.normal(size=(options.near_starts, 3)) * options.near_turn)
    turn[0] = np.eye(3)
    starts = T_camera_base @ pose(turn, middle - turn @ middle)
    away = np.sqrt(dot(starts[0, :3, 3], starts[0, :3, 3]))
    starts[1:, :3, 3] += away * rng.normal(size=(options.near_starts - 1, 3)) * options.near_shift
    return starts


def _machine_middle(view: StationView) -> Array:
    """Mean (3,) of the machine's joints in the first configuration of a view, base frame, m."""
    ends = view.machine.ends_at(view.joints, view.poses)
    return np.concatenate([ends.a[0], ends.b[0]]).mean(axis=0)


def _most(view: StationView, values: Array, samples: int, count: int) -> Array:
    """The ``count`` poses with the largest log-likelihood ratio."""
    return values[np.argsort(-_log_likelihood(view, values, samples))[:count]]


def _log_likelihood(view: StationView, values: Array, samples: int) -> Array:
    """Log-likelihood ratios (H,) of poses (H, 4, 4) by the silhouettes that no other leg hides or
    borders: with two legs on one line in the image, its edges would count twice.
    """
    one = np.zeros(1, dtype=int)
    distances = distances_under(view, values, one, samples, EDGE_OPTIONS.clearance)
    return distances.log_likelihood(mixture_of(distances, view.options)).sum(axis=(1, 2))


class _Tubes(NamedTuple):
    """The machine's T tubes in the configuration of the image, base frame.

    ends : (T, 3, 3) first, middle and last visible point of each axis.
    radius : (T,) m.
    centre : (3,) middle of the bounding box.
    size : m, largest distance of a point from the centre.
    """

    ends: Array
    radius: Array
    centre: Array
    size: float


def _hypotheses(view: StationView, chart: TubeChart, options: ImageLocalizationOptions) -> Array:
    """Camera poses T_camera_base (H, 4, 4), best first."""
    tubes = _tubes(view)
    width, height = chart.size
    half = min(width, height) / 2 / chart.scale
    # distances at which the machine fills the given shares of the image
    near, far = (
        tubes.size / np.sin(min(half * fill, options.widest)) for fill in reversed(options.filled)
    )
    count = int(np.ceil(np.log(far / near) / np.log(options.distance_ratio))) + 1
    distance = np.geomspace(near, far, count)
    direction = sphere(options.candidates.directions)
    rotation_to = frame_of(-direction)
    # a position in the image is a shift of the maps
    reach = [int(options.off_middle * n / chart.options.map_cell) for n in chart.size]
    steps = [np.arange(-cells, cells + 1, options.stride) for cells in reach]
    windows = _windows(chart.surprisal, steps, options)
    # for each distance and rotation, the best positions in the image for all directions
    values: list[Array] = []
    shifts: list[Integers] = []
    for away in distance:
        point = tubes.ends - (tubes.centre + direction * away)[:, None, None]
        in_view = np.einsum("pij,ptnj->ptni", rotation_to, point)
        charted = _charted_tubes(in_view, tubes.radius, chart)
        for turn in range(options.candidates.turns):
            angle = 2 * np.pi * turn / options.candidates.turns
            score = _scores(charted, angle, chart, windows, len(steps[1]), options)
            for _ in range(options.positions):
                best = score.argmax(axis=-1)[:, None]
                shifts += [best]
                values += [np.take_along_axis(score, best, axis=-1)]
                np.put_along_axis(score, best, -np.inf, axis=-1)
    # now (direction, distance x rotation x positions)
    value, best = (np.concatenate(part, axis=-1).T for part in (values, shifts))
    order = np.argsort(-value.ravel())[: options.charted]
    row, place = np.unravel_index(order, value.shape)
    step, shift = row // options.positions, best[row, place]
    # poses from the indices: direction, roll about the optical axis, tilt to the image position
    dx, dy = steps[0][shift % len(steps[0])], steps[1][shift // len(steps[0])]
    x, y = (d * chart.options.map_cell / chart.scale for d in (dx, dy))
    zero = np.zeros(len(order))
    tilt = rotation(np.stack([-y, x, zero], axis=-1))
    roll = rotation(
        np.stack(
            [zero, zero, 2 * np.pi / options.candidates.turns * (step % options.candidates.turns)],
            axis=-1,
        )
    )
    rot = tilt @ roll @ rotation_to[place]
    stand = tubes.centre + direction[place] * distance[step // options.candidates.turns][:, None]
    return pose(rot, -(rot @ stand[..., None])[..., 0])


def _tubes(view: StationView) -> _Tubes:
    """Tubes of the machine in the first configuration of the view."""
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


def _windows(
    surprisal: Integers, steps: Sequence[Integers], options: ImageLocalizationOptions
) -> Integers:
    """Values of the maps at all shifts to the right of each cell, (width, direction, y, x, Sx).

    The maps are padded by all shifts to each side, with cells without a tube.
    """
    ny, nx = (options.stride * len(s) for s in steps[::-1])
    padded = np.pad(surprisal, ((0, 0), (0, 0), (ny, ny), (nx, nx)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, nx, axis=-1)
    return np.ascontiguousarray(windows[..., :: options.stride])


class _ChartedTubes(NamedTuple):
    """T tubes on the chart from P positions, before the rotation about the optical axis.

    middle : (P, T, 2) fine cells from the middle of the chart.
    normal : (P, T) direction of the tubes' normals, rad.
    width_number : (P, T) indices of the tabulated widths.
    weight : (P, T) share of each tube in the length of all.
    """

    middle: Array
    normal: Array
    width_number: Integers
    weight: Array


def _charted_tubes(points: Array, radius: Array, chart: TubeChart) -> _ChartedTubes:
    """Tubes on the chart.

    points : (P, T, 3, 3) first, middle and last points of the tubes in the camera frames of P
        positions.
    radius : (T,) m.
    """
    # chart coordinates of the points: angle from the optical axis
    beside = np.hypot(points[..., 0], points[..., 1])
    angle = np.arctan2(beside, points[..., 2])
    cell = points[..., :2] * (chart.scale * angle / np.maximum(beside, 1e-12))[..., None]
    # direction, apparent width and weight of each tube
    chord = cell[:, :, 2] - cell[:, :, 0]
    normal = np.arctan2(chord[..., 0], -chord[..., 1])
    width = 2 * radius * chart.scale / np.sqrt(dot(points[:, :, 1], points[:, :, 1]))
    weight = np.hypot(chord[..., 0], chord[..., 1])
    weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
    return _ChartedTubes(cell[:, :, 1], normal, chart.width_number(width), weight)


def _scores(
    tubes: _ChartedTubes,
    turn: float,
    chart: TubeChart,
    windows: Integers,
    n_down: int,
    options: ImageLocalizationOptions,
) -> Array:
    """Mean map value (P, shifts) at the middles of the tubes, weighted by their length in the
    image.

    turn : rotation about the optical axis, rad.
    windows : as :func:`_windows` returns them. n_down : number of shifts downwards.
    """
    number = (
        np.rint((tubes.normal + turn) % np.pi * (chart.options.directions / np.pi)).astype(np.intp)
        % chart.options.directions
    )
    # first cell of each tube's window of shifts, in the padded maps
    middle = tubes.middle @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    at = np.floor((middle + chart.middle) / chart.options.map_cell).astype(np.intp)
    _, n_directions, height, width, n_right = windows.shape
    down = options.stride * np.arange(n_down)
    shifts = np.array([n_right, n_down])
    at += options.stride * (shifts - shifts // 2)
    at = np.clip(at, 0, [width - 1, height - 1 - down[-1]])
    place = (tubes.width_number * n_directions + number) * height + at[..., 1]
    place = place * width + at[..., 0]
    # a row of the window after the other
    rows = windows.reshape(-1, n_right)
    out = np.empty((len(at), n_down * n_right), dtype=np.float32)
    for k in range(0, len(at), options.batch):
        part = slice(k, k + options.batch)
        worth = rows.take(place[part, :, None] + width * down, axis=0)
        worth = worth.reshape(*worth.shape[:2], -1).astype(np.float32)
        out[part] = np.matmul(tubes.weight[part, None], worth)[:, 0]
    return out


def symmetric_poses(
    view: StationView, values: Array, options: ImageLocalizationOptions = IMAGE_LOCALIZATION_OPTIONS
) -> Array:
    """Poses (H n, 4, 4) of the machine rotated onto itself, from poses (H, 4, 4) and all n
    rotations.

    The rotations are about the normal of the plane of the base joints, by the
    angles of the folds that map every base joint close to another; a machine of equal parts looks
    nearly the same from there.
    """
    machine = view.machine
    base = machine.base_centers()
    middle = base.mean(axis=0)
    axis = np.linalg.svd(base - middle)[2][2]  # normal of their approximate plane
    near = options.joint_distance * np.sqrt(dot(base - middle, base - middle).max())
    turns: list[Array] = []
    for angle in 2 * np.pi * np.unique([k / n for n in options.folds for k in range(1, n)]):
        turn = rotation(angle * axis)
        shifted = (base - middle) @ turn.T + middle
        apart = np.sqrt(dot(shifted[:, None] - base, shifted[:, None] - base))
        if apart.min(axis=1).max() < near:
            turns.append(pose(turn, middle - turn @ middle))
    about = np.array(turns).reshape(-1, 4, 4)
    return (values[:, None] @ inverse(about)).reshape(-1, 4, 4)
