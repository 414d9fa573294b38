"""Log-likelihood ratio of a camera pose by the edges of images, and its maximization.

Poses descend by damped steps on the distances of predicted silhouettes from image edges
(:mod:`pkmcal.observe.distance_tables`). Near a point of a predicted silhouette there is either an
image edge of the machine or one by chance: a mixture whose two parameters are estimated for each
pose. The likelihood of the mixture relative to chance alone, weighted by the length of the
silhouettes, is the log-likelihood ratio of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, dot, of_components, perturb, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.distance_tables import DISTANCE_TABLE_OPTIONS, DistanceTables
from pkmcal.observe.predict import (
    EdgePoints,
    LegsInCamera,
    TubeList,
    edge_points,
    legs_in_camera,
    normals_of_edges,
    of_edges,
    tubes_of,
    unobstructed,
    visible_stretch,
)
from pkmcal.solver.marquardt import Damping

DISTANCE_OUTSIDE_IMAGE = 1e4
"""Distance, in reduced pixels, of points outside the image: stands for infinity."""


@dataclass(frozen=True)
class LikelihoodOptions:
    """Constants of the likelihood of a pose and of its maximization; lengths in reduced pixels."""

    # gain in log-likelihood ratio below which the maximization stops; one measurement contributes
    # tens of it
    least_gain: float = 0.1
    # number of silhouette points processed together, so that intermediate results stay in the
    # processor's cache (numerical: no effect on results)
    points_at_once: int = 30_000
    # smallest scatter of silhouettes: a bin of the chance distances
    least_sigma: float = DISTANCE_TABLE_OPTIONS.bin_width
    # truncation distance of the final score, and largest scatter of silhouettes about image edges
    last_reach: float = 4.0
    # fewest sets of other readings for each image, from which the distribution of the likelihood
    # by chance is estimated
    fewest_rivals: int = 8
    # most such sets: the standard deviation of so many is known to 15 %
    most_rivals: int = 24
    # standard deviation of the rotation of a randomly displaced platform, rad
    elsewhere_turn: float = 0.2
    # standard deviation of its shift, relative to the distance between base and platform
    elsewhere_shift: float = 0.1
    # steps of expectation maximization of a mixture that is used afterwards; within a descent
    # three suffice, for the poses change too
    mixture_rounds: int = 10
    # angle within which two predicted edges have the same direction: they match the same edges in
    # the distance tables
    same_direction: float = np.pi / DISTANCE_TABLE_OPTIONS.directions
    # longest step of a pose, rad and m: the tables' slopes are valid nearby only
    longest_step: float = 0.1

    @property
    def apart(self) -> float:
        """Smallest median distance between the silhouettes of two different poses, reduced pixels:
        twice the largest scatter.
        """
        return 2 * self.last_reach


LIKELIHOOD_OPTIONS = LikelihoodOptions()


@dataclass(frozen=True)
class StationView:
    """Input of the search: one station's images and the machine that they should show.

    configuration : (K,) rows of the session's readings.
    all_joints : (M, m) readings of the session.
    all_poses : T_base_platform (M, 4, 4) by the nominal model.
    tables : distance tables of the K images.
    guessed : (H, K, L) hypothetical legs in the images, base frame, one for each candidate pose (or
        H = 1); None where the legs follow the readings.
    options : of the likelihood.
    earlier_joints : (E, m) readings of the same machine at other poses, None for none; rivals of
        the images' own.
    """

    machine: Machine
    camera: Camera
    configuration: Integers
    all_joints: Array
    all_poses: Array
    tables: DistanceTables
    guessed: LegsInCamera | None = None
    options: LikelihoodOptions = LIKELIHOOD_OPTIONS
    earlier_joints: Array | None = None

    @cached_property
    def tubes(self) -> TubeList:
        """The machine's tubes."""
        return tubes_of(self.machine)

    @property
    def joints(self) -> Array:
        """Readings (K, m) of the images."""
        return self.all_joints[self.configuration]

    @property
    def poses(self) -> Array:
        """Platform poses T_base_platform (K, 4, 4) of the images."""
        return self.all_poses[self.configuration]

    @cached_property
    def all_legs(self) -> LegsInCamera:
        """Leg axes (M, L), base frame, in single precision."""
        return self.legs_at(self.all_poses, self.all_joints)

    def legs_at(self, poses: Array, joints: Array) -> LegsInCamera:
        """Leg axes (..., L), base frame, at poses (..., 4, 4) and readings (..., m), in single
        precision.
        """
        return legs_in_camera(self.machine, np.eye(4), poses, joints).single()

    def legs(self, images: Integers) -> LegsInCamera:
        """Leg axes (n, L) in some images, (n,); (H, n, L) for hypothetical legs."""
        if self.guessed is not None:
            return self.guessed[:, images]
        return self.all_legs[self.configuration[images]]

    def guess(self, which: slice | Integers) -> StationView:
        """View with some of the hypothetical legs; unchanged if there is one set or none."""
        if self.guessed is None or len(self.guessed) == 1:
            return self
        return replace(self, guessed=self.guessed[which])

    def few(self, count: int) -> Integers:
        """Numbers of up to ``count`` images, spread evenly over all."""
        return evenly(len(self.configuration), count)

    def with_joints(self, joints: Array) -> StationView:
        """View of the same images with other readings (M, m)."""
        fk = self.machine.forward_result(joints).T_base_platform
        return replace(self, all_joints=joints, all_poses=fk)

    def select(self, images: Integers) -> StationView:
        """View of some of the images."""
        return replace(
            self,
            configuration=self.configuration[images],
            tables=self.tables.select(images),
            guessed=self.guessed and self.guessed[:, images],
        )

    def rivals(self, rng: np.random.Generator) -> LegsInCamera:
        """Legs (R, K, L) at readings that are not the images' own.

        Each set has the readings of the configurations that follow by a fixed number of rows, of
        the session and then of earlier ones; if there are few, randomly displaced platforms are
        added.
        """
        every, own = self.all_legs, self.configuration
        if self.earlier_joints is not None:
            earlier = self.machine.forward_result(self.earlier_joints).T_base_platform
            every = every.joined(self.legs_at(earlier, self.earlier_joints))
        count = len(every.a)
        steps = np.unique(np.linspace(1, max(count - 1, 1), self.options.most_rivals).astype(int))
        steps = steps[steps < count]
        others = every[(own + steps[:, None]) % count]
        rest = max(self.options.fewest_rivals - len(steps), 0)
        if not rest:
            return others
        away = rng.normal(size=(rest, len(own), 6)) * np.repeat(
            [self.options.elsewhere_turn, self.options.elsewhere_shift], 3
        )
        away[..., 3:] *= np.linalg.norm(self.poses[:, :3, 3], axis=-1, keepdims=True)
        return others.joined(self.legs_at(perturb(self.poses, away), self.joints))


def distinct_silhouettes(view: StationView, candidates: Array, images: Integers) -> list[int]:
    """Indices of the candidates (H, 4, 4), best first, that are not the same as a better one.

    Two poses are the same if the median distance of their silhouettes is small.
    """
    if len(candidates) < 2:
        return list(range(len(candidates)))
    legs = view.legs(images).under(candidates)
    pixel = edge_points(view.machine, view.camera, legs, view.tubes, 2).pixel
    retained = [0]
    for h in range(1, len(candidates)):
        away = pixel[retained] - pixel[h]
        off = np.nan_to_num(np.hypot(away[..., 0], away[..., 1])) / view.tables.scale
        if np.all(np.median(off.reshape(len(off), -1), axis=1) > view.options.apart):
            retained.append(h)
    return retained


def score(
    view: StationView, T_camera_base: Array, images: Integers, reach: float, samples: int = 5
) -> Array:
    """Mean truncated distance of predicted edges from image edges, relative to ``reach``: (H,), 0
    to 1.

    Edges behind the camera count as 1. Edges are approximated by the chords between their ends,
    which is exact for a pinhole camera and close enough for this search otherwise.

    T_camera_base : (H, 4, 4) hypotheses.
    reach : truncation distance, reduced pixels.
    samples : points along an edge.
    """
    parts = divided(view, len(T_camera_base), len(images) * samples)
    if len(parts) > 1:
        return np.concatenate(
            [score(view.guess(k), T_camera_base[k], images, reach, samples) for k in parts]
        )
    tubes = view.tubes
    legs = view.legs(images).under(T_camera_base)
    a, b, u = of_edges(legs, tubes)
    radius = view.machine.values[tubes.radius].astype(a.dtype)
    normal, ok = normals_of_edges(a, u, radius, tubes)
    first, last = visible_stretch(a, b, tubes)
    base = a + radius[:, None] * normal
    begin, end = (view.camera.project(base + at[..., None] * u) for at in (first, last))
    chord = end - begin
    direction = view.tables.direction(of_components(-chord[..., 1], chord[..., 0]))
    fraction = ((np.arange(samples) + 0.5) / samples).astype(a.dtype)
    points = begin + fraction[:, None, None, None, None] * chord  # (n, H, K, E, 2)
    number = np.arange(len(view.configuration))[images][:, None]
    distance, inside = view.tables.look_up(direction, points, number)
    cost = np.where(inside & ok, np.minimum(distance, reach) / reach, 1.0).mean(axis=0)
    weight = np.nan_to_num(np.hypot(chord[..., 0], chord[..., 1]))
    total = np.maximum(np.sum(weight, axis=(1, 2)), 1e-9)
    before = np.mean(weight > 0, axis=(1, 2))  # or a camera among the legs would fit anything
    return before * (np.sum(cost * weight, axis=(1, 2)) / total) + (1 - before)


class _Mixture(NamedTuple):
    """Mixture parameters of each hypothesis, (H,).

    share : of the distances that are by chance.
    sigma : standard deviation (reduced px) of the others.
    """

    share: Array
    sigma: Array

    def likelier(self, at: Distances) -> Array:
        """Density (H, E, n) of the distances from the machine's edges, times the share of these,
        divided by the density of chance distances.
        """
        share, sigma = (v.astype(np.float32)[:, None, None] for v in self)
        near = np.exp(at.distance**2 * (-0.5 / sigma**2))
        return near * ((1 - share) * np.sqrt(2 / np.pi) / sigma) * at.rare


class Distances(NamedTuple):
    """Distances from predicted edges to image edges, (H, E, n), with the edges of all images in a
    row.

    distance : reduced pixels, DISTANCE_OUTSIDE_IMAGE outside the image.
    rare : reciprocal of the density of such distances by chance.
    length : reduced pixels of silhouette that each point represents, 0 outside the image.
    """

    distance: Array
    rare: Array
    length: Array

    def mixture(
        self,
        mixture: _Mixture,
        rounds: int = 3,
        widest: float | None = None,
        options: LikelihoodOptions = LIKELIHOOD_OPTIONS,
    ) -> _Mixture:
        """Maximum-likelihood mixture, by expectation maximization from an initial one.

        widest : upper bound of sigma; None for that of the options.
        """
        widest = options.last_reach if widest is None else widest
        total = np.maximum(_summed(self.length), 1e-9)
        for _ in range(rounds):
            own = self.length * self.own(mixture)
            mine = _summed(own)
            square = _summed(own * self.distance**2) / np.maximum(mine, 1e-9)
            sigma = np.clip(np.sqrt(square), options.least_sigma, widest)
            mixture = _Mixture(np.clip(1 - mine / total, 0.01, 0.99), sigma)
        return mixture

    def own(self, mixture: _Mixture) -> Array:
        """Probability (H, E, n) that each point's image edge belongs to the machine."""
        own = mixture.likelier(self)
        return own / (own + mixture.share.astype(np.float32)[:, None, None])

    def log_likelihood(self, mixture: _Mixture) -> Array:
        """Log-likelihood ratio (H, E, n) of each point against chance."""
        share = mixture.share.astype(np.float32)[:, None, None]
        return self.length * np.log(mixture.likelier(self) + share)


class _Linearization(NamedTuple):
    """Distances linearized in the camera pose.

    slope : (H, E, n) derivative of the distances by an outward motion of the edge, per metre.
    begins, grows : (H, 6, E) and (H, 3, E) derivative of the edge's outward position, m, by a
        motion (omega, tau) of the camera frame: at the edge's first point, and the increase of its
        rotational part to the last.
    """

    distances: Distances
    slope: Array
    begins: Array
    grows: Array

    def weight(self, reach: float) -> Array:
        """Geman-McClure weights (H, E, n): beyond the reach a distance belongs to another edge."""
        return (1 + (self.distances.distance * (1 / reach)) ** 2) ** -2

    def cost(self, reach: float) -> Array:
        """Geman-McClure cost (H,), the mean over all points: 0 to 1, and 1 outside the image."""
        part = (self.distances.distance * (1 / reach)) ** 2
        return (part / (1 + part)).reshape(len(part), -1).mean(axis=-1)

    def where(self, better: Booleans, other: _Linearization) -> _Linearization:
        """Linearization of the hypotheses in ``better`` (H,) from here, of the rest from the other
        one.
        """
        if better.all():
            return self

        def either(mine: Array, its: Array) -> Array:
            out = mine.copy()
            out[~better] = its[~better]
            return out

        return _Linearization(
            Distances(*map(either, self.distances, other.distances)),
            either(self.slope, other.slope),
            either(self.begins, other.begins),
            either(self.grows, other.grows),
        )


def _summed(values: Array) -> Array:
    """Sums (H,) over all points (H, E, n)."""
    return values.reshape(len(values), -1).sum(axis=-1, dtype=float)


def refine_lm(
    view: StationView,
    candidates: Array,
    images: Integers,
    samples: int,
    reaches: tuple[float, ...],
) -> Array:
    """Levenberg-Marquardt descent of candidates (H, 4, 4), side by side, one step for each reach.

    Vertical legs hardly determine the camera's position along them; undamped steps diverge there.
    """
    linearization = linearize_distances(view, candidates, images, samples)
    damping = Damping.first(len(candidates))
    for reach in reaches:
        trial = _step(
            candidates,
            linearization,
            linearization.weight(reach),
            damping,
            view.options.longest_step,
        )
        in_view = linearize_distances(view, trial, images, samples)
        better = in_view.cost(reach) < linearization.cost(reach)
        candidates = np.where(better[:, None, None], trial, candidates)
        linearization = in_view.where(better, linearization)
        damping = damping.after(better)
    return candidates


def refine_ml(
    view: StationView,
    candidates: Array,
    images: Integers,
    samples: int,
    steps: int,
    widest: float | None = None,
) -> tuple[Array, Array]:
    """Maximum-likelihood poses near candidates (H, 4, 4), and their log-likelihood ratios (H,).

    Levenberg-Marquardt steps; the scatter of the edges, up to ``widest`` reduced pixels (None for
    the options' limit), is estimated in alternation.
    """
    linearization = linearize_distances(view, candidates, images, samples)
    damping = Damping.first(len(candidates))
    mixture = first_mixture(len(candidates), view.options)
    last = float("inf")
    for _ in range(steps):
        # mixture at the current poses, then one step of each
        mixture = linearization.distances.mixture(mixture, widest=widest, options=view.options)
        trial = _step(
            candidates,
            linearization,
            linearization.distances.length * linearization.distances.own(mixture),
            damping,
            view.options.longest_step,
        )
        in_view = linearize_distances(view, trial, images, samples)
        gain = _summed(in_view.distances.log_likelihood(mixture)) - _summed(
            linearization.distances.log_likelihood(mixture)
        )
        better = gain > 0
        candidates = np.where(better[:, None, None], trial, candidates)
        linearization = in_view.where(better, linearization)
        damping = damping.after(better)
        most = float(gain.max())
        if max(last, most) < view.options.least_gain:
            break  # a single step may have been too long
        last = most
    start = first_mixture(len(candidates), view.options)
    rounds = view.options.mixture_rounds
    mixture = linearization.distances.mixture(start, rounds, widest, view.options)
    each = linearization.distances.log_likelihood(mixture)
    return candidates, _summed(each / coinciding_edges(view, candidates, images, samples))


def first_mixture(count: int, options: LikelihoodOptions = LIKELIHOOD_OPTIONS) -> _Mixture:
    """Initial mixture of ``count`` hypotheses: half of the distances by chance."""
    return _Mixture(np.full(count, 0.5), np.full(count, options.last_reach / 2))


def mixture_of(distances: Distances, options: LikelihoodOptions = LIKELIHOOD_OPTIONS) -> _Mixture:
    """Maximum-likelihood mixture of the distances of each hypothesis."""
    start = first_mixture(len(distances.distance), options)
    return distances.mixture(start, options.mixture_rounds, options=options)


def by_image(log_likelihood_ratio: Array, count: int) -> Array:
    """Sums (H, K) over the points of each image, or each configuration, from (H, E, n) in a row."""
    return log_likelihood_ratio.reshape(len(log_likelihood_ratio), count, -1).sum(
        axis=-1, dtype=float
    )


def log_likelihood_by_name(view: StationView, T_camera_base: Array, names: Integers) -> Array:
    """Log-likelihood ratio (K, n) of a pose (4, 4) in each image for each of some configurations.

    The scatter of the edges is that with the images' own configurations.

    names : (n,) rows of the readings.
    """
    every = view.few(len(view.configuration))
    own = distances_under(view, T_camera_base[None], every, 8)
    mixture = mixture_of(own, view.options)
    # the legs of a configuration are the same for every image
    legs = view.all_legs[names].under(T_camera_base[None])
    points = edge_points(view.machine, view.camera, legs, view.tubes, 8)
    direction = view.tables.direction(points.outward)
    fits: list[Array] = []
    for part in divided(view, len(every), len(names) * 8):
        number = every[part, None, None, None]
        distance, inside = view.tables.look_up(direction, points.pixel, number, between=True)
        named = _distances(view, points, direction, distance, inside & points.valid)
        fits.append(by_image(named.log_likelihood(mixture), len(names)))
    return np.concatenate(fits)


def settled(view: StationView, T_camera_base: Array) -> Array:
    """Maximum-likelihood pose (4, 4) near another one, from all images."""
    every = view.few(len(view.configuration))
    return refine_ml(view, T_camera_base[None], every, 8, 8)[0][0]


def likelihood_from(view: StationView, places: Array) -> float:
    """Largest log-likelihood ratio, in all images, that is reached from any of the poses (H, 4, 4).

    Different searches end up to fifty measurements apart, so hypotheses about the same images are
    compared from the same poses.
    """
    every = view.few(len(view.configuration))
    return float(refine_ml(view, places, every, 8, 8)[1].max())


def correlation_length(view: StationView, T_camera_base: Array) -> float:
    """Mean length of half a predicted edge, in reduced pixels.

    The errors along an edge are correlated, so each half counts as one measurement.
    """
    every = view.few(len(view.configuration))
    length = distances_under(view, T_camera_base[None], every, 2).length[0]
    in_view = length[length > 0]
    # each of two samples represents one edge length; without any edge in the image the value is 1
    return float(in_view.mean()) / 2 if in_view.size else 1.0


def divided(view: StationView, count: int, places: int) -> list[slice]:
    """Slices of ``count`` hypotheses, or images, that are processed together, with ``places``
    points on each edge.
    """
    each = max(places * len(view.tubes), 1)
    parts = max(min(round(count * each / view.options.points_at_once), count), 1)
    ends = [count * k // parts for k in range(parts + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


def distances_under(
    view: StationView,
    candidates: Array,
    images: Integers,
    samples: int,
    clearance: float | None = None,
) -> Distances:
    """Distances at the edges predicted from poses (H, 4, 4).

    clearance : px from the outlines of other legs within which points are left out, as those are
        that another leg hides; None for all points.
    """
    parts = divided(view, len(candidates), len(images) * samples)
    if len(parts) > 1:
        each = [
            distances_under(view.guess(k), candidates[k], images, samples, clearance) for k in parts
        ]
        return Distances(*map(np.concatenate, zip(*each, strict=True)))
    points, direction, number = _edges_under(view, candidates, images, samples)
    distance, inside = view.tables.look_up(direction, points.pixel, number, between=True)
    inside = inside & points.valid
    if clearance is not None:
        legs = view.legs(images).under(candidates)
        inside &= unobstructed(view.machine, view.camera, legs, view.tubes, points, clearance)
    return _distances(view, points, direction, distance, inside)


def coinciding_edges(view: StationView, candidates: Array, images: Integers, samples: int) -> Array:
    """Number of predicted edges that coincide at each point (H, E, n), its own included.

    Edges coincide on the same side of their legs, in the same direction, where the scatter of
    silhouettes does not separate them. All of them match the same image edge, which is evidence for
    one leg only. Otherwise a pose from which two legs lie behind each other would fit better than
    the correct one. To leave out whatever another leg hides or borders, as for single images
    (:func:`~pkmcal.observe.image_localization.weighed_poses`), loses evidence of stations: a
    mirrored hexapod is then taken for one numbered backwards.
    """
    parts = divided(view, len(candidates), len(images) * samples * 4)
    if len(parts) > 1:
        return np.concatenate(
            [coinciding_edges(view.guess(k), candidates[k], images, samples) for k in parts]
        )
    points, _, _ = _edges_under(view, candidates, images, samples)
    # each condition is linear in a point, or in its outward normal: (H, K, E n, 2) times (2, E)
    begin, normal = points.pixel[..., 0, :], points.outward[..., points.outward.shape[-2] // 2, :]
    chord = points.pixel[..., -1, :] - begin
    flat = (*begin.shape[:-2], -1, 2)
    pixel, outward = points.pixel.reshape(flat), points.outward.reshape(flat)
    own = np.arange(pixel.shape[-2]) // samples, np.arange(pixel.shape[-2])
    with np.errstate(invalid="ignore", over="ignore"):  # edges beside the camera have no image
        chord = chord / np.maximum(dot(chord, chord), 1e-9)[..., None]
        along = pixel @ chord.mT - dot(begin, chord)[..., None, :]
        across = np.abs(pixel @ normal.mT - dot(begin, normal)[..., None, :])
        coincides = (outward @ normal.mT > np.cos(view.options.same_direction)) & (
            across < view.options.apart * view.tables.scale
        )
        coincides &= (along >= 0) & (along <= 1)
    coincides[..., own[1], own[0]] = True
    return coincides.sum(axis=-1).reshape(len(candidates), -1, samples).astype(np.float32)


def linearize_distances(
    view: StationView, candidates: Array, images: Integers, samples: int
) -> _Linearization:
    """Distances at the edges predicted from poses (H, 4, 4), with their derivatives."""
    parts = divided(view, len(candidates), len(images) * samples)
    if len(parts) > 1:
        passes = [linearize_distances(view.guess(k), candidates[k], images, samples) for k in parts]
        distances, *rest = zip(*passes, strict=True)
        every = Distances(*map(np.concatenate, zip(*distances, strict=True)))
        return _Linearization(every, *map(np.concatenate, rest))
    points, direction, number = _edges_under(view, candidates, images, samples)
    distance, slope, inside = view.tables.look_along(
        direction, points.pixel, points.outward, number
    )
    inside = inside & points.valid
    # outward motion of an edge: n . (omega x P + tau) for a motion of the camera frame
    first, last = points.point[..., 0, :], points.point[..., -1, :]
    visible = np.any(inside, axis=-1, keepdims=True)[..., 0]
    return _Linearization(
        _distances(view, points, direction, distance, inside),
        (slope * np.where(inside, points.gain, 0.0)).reshape(len(candidates), -1, samples),
        _stacked((cross(first, points.normal), points.normal), visible),
        _stacked((cross(last - first, points.normal),), visible),
    )


def _edges_under(
    view: StationView, candidates: Array, images: Integers, samples: int
) -> tuple[EdgePoints, Integers, Integers]:
    """Predicted edges (H, K, E, n), their direction numbers, and the images' numbers (K, 1, 1)."""
    number = np.arange(len(view.configuration))[images][:, None, None]
    legs = view.legs(images).under(candidates)
    points = edge_points(view.machine, view.camera, legs, view.tubes, samples)
    return points, view.tables.direction(points.outward), number


def _distances(
    view: StationView, points: EdgePoints, direction: Integers, values: Array, inside: Booleans
) -> Distances:
    """Distances, with chance densities and lengths, from table values (H, K, E, n), images in a
    row.

    inside : which points have an image and lie in it.
    """
    shape = (len(values), -1, values.shape[-1])
    inside = np.broadcast_to(inside, values.shape)
    chord = points.pixel[..., -1, :] - points.pixel[..., 0, :]
    # at most the image's diagonal: of an edge that passes close to the camera a single point may
    # lie in the image, and would count as thousands of pixels of silhouette; NaN if an end of the
    # edge has no image
    diagonal = np.float32(np.hypot(*view.camera.image_size))
    length = np.fmin(np.hypot(chord[..., 0], chord[..., 1]), diagonal)
    length /= np.float32(view.tables.scale * (shape[-1] - 1))
    return Distances(
        np.where(inside, values, DISTANCE_OUTSIDE_IMAGE).reshape(shape),
        (1 / view.tables.by_chance(direction, values)).reshape(shape),
        np.where(inside, length[..., None], 0.0).reshape(shape),
    )


def _stacked(vectors: tuple[Array, ...], visible: Booleans) -> Array:
    """Components (H, 3 n, E) of n vectors (H, K, E, 3), edges of all images in a row; 0 if not
    visible.
    """
    out = np.zeros((len(visible), 3 * len(vectors), visible[0].size), np.float32)
    for k, vector in enumerate(vectors):
        for c in range(3):
            part = out[:, 3 * k + c].reshape(visible.shape)
            np.copyto(part, vector[..., c], where=visible)
    return out


def _step(
    candidates: Array,
    linearization: _Linearization,
    weight: Array,
    damping: Damping,
    longest: float,
) -> Array:
    """One Levenberg-Marquardt step of every candidate's pose, (H, 4, 4).

    With t = 0..1 along an edge, its outward motion by the camera's (omega, tau) is

        (begins + t [grows; 0]) . (omega, tau)

    so the normal equations need only the sums over t^0, t and t^2 of the weighted squares.

    weight : (H, E, n) of the points.
    longest : limit of each component of the step, rad and m.
    """
    # points are evenly spaced from the first to the last of an edge
    at = np.linspace(0, 1, weight.shape[-1], dtype=np.float32)
    powers = np.stack([at**0, at, at**2], axis=-1)
    weighted = weight * linearization.slope
    one, both, two = ((weighted * linearization.slope) @ powers).transpose(2, 0, 1)[:, :, None]
    here, there = ((weighted * linearization.distances.distance) @ powers[:, :2]).transpose(2, 0, 1)
    begins, grows = linearization.begins, linearization.grows
    # normal equations, of which omega's block has the terms in t
    normal = (begins * one) @ begins.mT
    mixed = (grows * both) @ begins.mT
    normal[:, :3] += mixed
    normal[:, :, :3] += mixed.mT
    normal[:, :3, :3] += (grows * two) @ grows.mT
    right = begins @ here[..., None]
    right[:, :3] += grows @ there[..., None]
    step = -damping.step(normal.astype(float), right[..., 0].astype(float))
    step = np.clip(step, -longest, longest)
    # rotation about the camera: R <- Exp(omega) R, t <- Exp(omega) t + tau
    return pose(rotation(step[:, :3]), step[:, 3:]) @ candidates
