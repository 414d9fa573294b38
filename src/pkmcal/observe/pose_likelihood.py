"""Log-likelihood ratio of a camera pose by the edges of images, and its maximization.

Poses are refined by damped steps on the distances of predicted silhouettes from image edges
(:mod:`pkmcal.observe.distance_tables`). A point of a predicted silhouette has either an edge of the
machine near by, or one by chance: a mixture with two parameters, which are estimated for each pose.
The log-likelihood ratio is against chance alone, and is weighted by the length of the silhouettes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, of_components, perturb, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.distance_tables import CHANCE_DISTANCE_BIN, DistanceTables
from pkmcal.observe.predict import (
    EdgePoints,
    LegsInCamera,
    TubeList,
    edge_points,
    legs_in_camera,
    normals_of_edges,
    of_edges,
    tubes_of,
    visible_stretch,
)

FIRST_DAMPING = 1e-3
"""First damping of a step, relative to the diagonal of the normal equations."""
DISTANCE_OUTSIDE_IMAGE = 1e4
"""Distance (reduced px) of points outside the image: no edge is near."""
LEAST_LOG_LIKELIHOOD_GAIN = 0.1
"""Gain of a step's log-likelihood below which no other follows; one measurement has tens."""
SILHOUETTE_PLACES_AT_ONCE = 30_000
"""Points on silhouettes that are looked up together, so that intermediate arrays stay in the
processor's cache."""
LAST_REACH = 4.0
"""Reduced pixels at which the final score cuts distances off."""
FEWEST_RIVALS, MOST_RIVALS = 8, 24
"""Number of other readings for each image, which give the likelihoods by chance."""
ELSEWHERE_TURN_AND_SHIFT = np.repeat([0.2, 0.1], 3)
"""Turn (rad) and shift (in distances of base and platform) of a platform that is elsewhere."""
SILHOUETTES_APART = 8.0
"""Reduced pixels between the silhouettes of two poses from which they are not the same pose."""


@dataclass(frozen=True)
class StationView:
    """One station's images and the machine that should be in them.

    configuration : (K,) rows of the session's readings. all_joints : (M, m) these readings.
    all_poses : T_base_platform (M, 4, 4) by the nominal model. guessed : legs in the images under
    hypotheses, (H, K, L), one for each candidate pose; None where the legs are as read.
    """

    machine: Machine
    camera: Camera
    configuration: Integers
    all_joints: Array
    all_poses: Array
    tables: DistanceTables
    guessed: LegsInCamera | None = None

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
        """Poses (K, 4, 4) of the platform in the images."""
        return self.all_poses[self.configuration]

    @cached_property
    def all_legs(self) -> LegsInCamera:
        """The legs' axes in the base frame, (M, L), in the search's single precision."""
        return self.legs_at(self.all_poses, self.all_joints)

    def legs_at(self, poses: Array, joints: Array) -> LegsInCamera:
        """The same at other poses (..., 4, 4) and readings (..., m)."""
        return legs_in_camera(self.machine, np.eye(4), poses, joints).single()

    def legs(self, photographs: Integers) -> LegsInCamera:
        """Legs in some images (n,): (n, L), or (H, n, L) under hypotheses."""
        if self.guessed is not None:
            return self.guessed[:, photographs]
        return self.all_legs[self.configuration[photographs]]

    def guess(self, which: slice | Integers) -> StationView:
        """The same view with some of the hypotheses, if there is one for each candidate pose."""
        if self.guessed is None or len(self.guessed) == 1:
            return self
        return replace(self, guessed=self.guessed[which])

    def few(self, count: int) -> Integers:
        """Indices of up to ``count`` images, spread over all."""
        return evenly(len(self.configuration), count)

    def with_joints(self, joints: Array) -> StationView:
        """The same images with other readings (M, m)."""
        fk = self.machine.forward_result(joints).T_base_platform
        return replace(self, all_joints=joints, all_poses=fk)

    def select(self, photographs: Integers) -> StationView:
        """The view of some of the images."""
        return replace(
            self,
            configuration=self.configuration[photographs],
            tables=self.tables.select(photographs),
            guessed=self.guessed and self.guessed[:, photographs],
        )

    def rivals(self, rng: np.random.Generator) -> LegsInCamera:
        """Legs (R, K, L) at readings of other configurations than the images': each time those so
        many rows later; where the session has few, with displaced platforms too.
        """
        count, own = len(self.all_joints), self.configuration
        steps = np.unique(np.linspace(1, max(count - 1, 1), MOST_RIVALS).astype(int))
        steps = steps[steps < count]
        others = self.all_legs[(own + steps[:, None]) % count]
        rest = max(FEWEST_RIVALS - len(steps), 0)
        if not rest:
            return others
        away = rng.normal(size=(rest, len(own), 6)) * ELSEWHERE_TURN_AND_SHIFT
        away[..., 3:] *= np.linalg.norm(self.poses[:, :3, 3], axis=-1, keepdims=True)
        return others.joined(self.legs_at(perturb(self.poses, away), self.joints))


def distinct_silhouettes(view: StationView, candidates: Array, photographs: Integers) -> list[int]:
    """Indices of candidates (H, 4, 4), best first, that are not the same pose as a better one."""
    if len(candidates) < 2:
        return list(range(len(candidates)))
    legs = view.legs(photographs).under(candidates)
    pixel = edge_points(view.machine, view.camera, legs, view.tubes, 2).pixel
    retained: list[int] = []
    for h in range(len(candidates)):
        away = pixel[retained] - pixel[h]
        off = np.nan_to_num(np.hypot(away[..., 0], away[..., 1])) / view.tables.scale
        if all(np.median(other) > SILHOUETTES_APART for other in off):
            retained.append(h)
    return retained


def score(
    view: StationView, T_camera_base: Array, photographs: Integers, reach: float, samples: int = 5
) -> Array:
    """Mean distance from predicted edges to picture edges, cut off at ``reach``: (H,), 0 to 1,
    which edges behind the camera count as.

    T_camera_base : (H, 4, 4) hypotheses. reach : reduced pixels. Edges are taken as the chords
    between their ends, which is exact for a pinhole and near enough for this search elsewhere.
    """
    parts = _parts(view, len(T_camera_base), len(photographs) * samples)
    if len(parts) > 1:
        return np.concatenate(
            [score(view.guess(k), T_camera_base[k], photographs, reach, samples) for k in parts]
        )
    tubes = view.tubes
    legs = view.legs(photographs).under(T_camera_base)
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
    number = np.arange(len(view.configuration))[photographs][:, None]
    distance, inside = view.tables.look_up(direction, points, number)
    cost = np.where(inside & ok, np.minimum(distance, reach) / reach, 1.0).mean(axis=0)
    weight = np.nan_to_num(np.hypot(chord[..., 0], chord[..., 1]))
    total = np.maximum(np.sum(weight, axis=(1, 2)), 1e-9)
    before = np.mean(weight > 0, axis=(1, 2))  # or a camera among the legs would fit at once
    return before * (np.sum(cost * weight, axis=(1, 2)) / total) + (1 - before)


class _Mixture(NamedTuple):
    """Mixture of distances for each pose, (H,): share of chance matches, and standard deviation
    (reduced px) of the others.
    """

    share: Array
    sigma: Array

    def likelier(self, at: Distances) -> Array:
        """Density (H, E, n) of distances of the machine's edges, times their share, relative to the
        density by chance.
        """
        share, sigma = (v.astype(np.float32)[:, None, None] for v in self)
        near = np.exp(at.distance**2 * (-0.5 / sigma**2))
        return near * ((1 - share) * np.sqrt(2 / np.pi) / sigma) * at.rare


class Distances(NamedTuple):
    """Distances of image edges from points on predicted edges, of all images in a row, (H, E, n).

    distance : reduced pixels, DISTANCE_OUTSIDE_IMAGE outside the image. rare : reciprocal of the
    density of such distances by chance. length : reduced pixels of silhouette that each point
    stands for, 0 outside the image.
    """

    distance: Array
    rare: Array
    length: Array

    def mixture(self, mixture: _Mixture, rounds: int = 3, widest: float = LAST_REACH) -> _Mixture:
        """The likeliest mixture, from a first one (expectation maximization)."""
        total = np.maximum(_summed(self.length), 1e-9)
        for _ in range(rounds):
            own = self.length * self.own(mixture)
            mine = _summed(own)
            square = _summed(own * self.distance**2) / np.maximum(mine, 1e-9)
            sigma = np.clip(np.sqrt(square), CHANCE_DISTANCE_BIN, widest)
            mixture = _Mixture(np.clip(1 - mine / total, 0.01, 0.99), sigma)
        return mixture

    def own(self, mixture: _Mixture) -> Array:
        """Posterior probability (H, E, n) that the edge of each point is the machine's."""
        own = mixture.likelier(self)
        return own / (own + mixture.share.astype(np.float32)[:, None, None])

    def log_likelihood(self, mixture: _Mixture) -> Array:
        """Log-likelihood ratio (H, E, n) of each point against chance."""
        share = mixture.share.astype(np.float32)[:, None, None]
        return self.length * np.log(mixture.likelier(self) + share)


class _Linearization(NamedTuple):
    """Distances with their derivatives.

    slope : (H, E, n) derivative of the distances by the edge's outward motion (m). begins, grows :
    (H, 6, E) and (H, 3, E) outward motion of an edge by a motion of the camera frame: at its first
    point, and how much more a turn moves the last.
    """

    distances: Distances
    slope: Array
    begins: Array
    grows: Array

    def weight(self, reach: float) -> Array:
        """Geman-McClure weights: distances beyond the reach are of another edge."""
        return (1 + (self.distances.distance * (1 / reach)) ** 2) ** -2

    def cost(self, reach: float) -> Array:
        """Cost (H,) that the weights minimize: mean over points of 0 to 1, 1 outside the image."""
        part = (self.distances.distance * (1 / reach)) ** 2
        return (part / (1 + part)).reshape(len(part), -1).mean(axis=-1)

    def where(self, better: Booleans, other: _Linearization) -> _Linearization:
        """Some of the runs from here, the others from ``other``."""
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
    photographs: Integers,
    samples: int,
    reaches: tuple[float, ...],
) -> Array:
    """Levenberg-Marquardt on the distances, candidates (H, 4, 4) in one batch, a step a reach.

    Parallel legs hardly determine the camera's pose; undamped, steps diverge there.
    """
    linearization = linearize_distances(view, candidates, photographs, samples)
    damping = np.full(len(candidates), FIRST_DAMPING)
    for reach in reaches:
        trial = _step(candidates, linearization, linearization.weight(reach), damping)
        in_view = linearize_distances(view, trial, photographs, samples)
        better = in_view.cost(reach) < linearization.cost(reach)
        candidates = np.where(better[:, None, None], trial, candidates)
        linearization = in_view.where(better, linearization)
        damping = np.where(better, 0.3, 10.0) * damping
    return candidates


def refine_ml(
    view: StationView,
    candidates: Array,
    photographs: Integers,
    samples: int,
    steps: int,
    widest: float = LAST_REACH,
) -> tuple[Array, Array]:
    """Maximize the log-likelihood ratio; the edges' scatter, up to ``widest`` reduced pixels, is
    estimated on the way.

    Returns poses (H, 4, 4) and their log-likelihood ratios (H,).
    """
    linearization = linearize_distances(view, candidates, photographs, samples)
    damping = np.full(len(candidates), FIRST_DAMPING)
    mixture = first_mixture(len(candidates))
    last = float("inf")
    for _ in range(steps):
        mixture = linearization.distances.mixture(mixture, widest=widest)
        trial = _step(
            candidates,
            linearization,
            linearization.distances.length * linearization.distances.own(mixture),
            damping,
        )
        in_view = linearize_distances(view, trial, photographs, samples)
        gain = _summed(in_view.distances.log_likelihood(mixture)) - _summed(
            linearization.distances.log_likelihood(mixture)
        )
        better = gain > 0
        candidates = np.where(better[:, None, None], trial, candidates)
        linearization = in_view.where(better, linearization)
        damping = np.where(better, 0.3, 10.0) * damping
        most = float(gain.max())
        if max(last, most) < LEAST_LOG_LIKELIHOOD_GAIN:
            break  # one step may have been too long
        last = most
    mixture = linearization.distances.mixture(first_mixture(len(candidates)), 10, widest)
    return candidates, _summed(linearization.distances.log_likelihood(mixture))


def first_mixture(count: int) -> _Mixture:
    """First mixture of ``count`` poses: half edges, half chance."""
    return _Mixture(np.full(count, 0.5), np.full(count, LAST_REACH / 2))


def log_likelihood_of(
    view: StationView, candidates: Array, photographs: Integers, samples: int
) -> Array:
    """Log-likelihood ratios (H, K) of candidates (H, 4, 4) in each image."""
    count = distances_under(view, candidates, photographs, samples)
    mixture = count.mixture(first_mixture(len(candidates)), rounds=10)
    return by_photograph(count.log_likelihood(mixture), len(photographs))


def by_photograph(log_likelihood_ratio: Array, count: int) -> Array:
    """Sums (H, K) over the points of each image, or of each name, (H, E, n) of all in a row."""
    return log_likelihood_ratio.reshape(len(log_likelihood_ratio), count, -1).sum(
        axis=-1, dtype=float
    )


def log_likelihood_by_name(view: StationView, T_camera_base: Array, names: Integers) -> Array:
    """Log-likelihood ratios (K, n) of a pose (4, 4) in each image under each of the names (n,),
    rows of the readings; with the mixture of the names that the view has.
    """
    every = view.few(len(view.configuration))
    own = distances_under(view, T_camera_base[None], every, 8)
    mixture = own.mixture(first_mixture(1), rounds=10)
    # where the legs are under a name, they are so in any photograph
    legs = view.all_legs[names].under(T_camera_base[None])
    points = edge_points(view.machine, view.camera, legs, view.tubes, 8)
    direction = view.tables.direction(points.outward)
    fits: list[Array] = []
    for part in _parts(view, len(every), len(names) * 8):
        number = every[part, None, None, None]
        distance, inside = view.tables.look_up(direction, points.pixel, number, between=True)
        named = _distances(view, points, direction, distance, inside & points.valid)
        fits.append(by_photograph(named.log_likelihood(mixture), len(names)))
    return np.concatenate(fits)


def settled(view: StationView, T_camera_base: Array) -> Array:
    """The likeliest pose (4, 4) near another."""
    every = view.few(len(view.configuration))
    return refine_ml(view, T_camera_base[None], every, 8, 8)[0][0]


def likelihood_from(view: StationView, places: Array) -> float:
    """Largest log-likelihood ratio of all images to which any of the poses (H, 4, 4) is refined.

    Searches for one explanation end up to fifty measurements apart; so explanations of the same
    images are compared from the same poses.
    """
    every = view.few(len(view.configuration))
    return float(refine_ml(view, places, every, 8, 8)[1].max())


def correlation_length(view: StationView, T_camera_base: Array) -> float:
    """Mean length (reduced px) of half a predicted edge: errors of the points of an edge are
    correlated, so each half counts as one measurement.
    """
    every = view.few(len(view.configuration))
    length = distances_under(view, T_camera_base[None], every, 2).length[0]
    in_view = length[length > 0]
    # two samples stand for an edge's length each; where no edge is in the picture none counts
    return float(in_view.mean()) / 2 if in_view.size else 1.0


def _parts(view: StationView, count: int, places: int) -> list[slice]:
    """Slices of ``count`` poses, or images, that are evaluated together, at ``places`` points of
    each edge.
    """
    each = max(places * len(view.tubes), 1)
    parts = max(min(round(count * each / SILHOUETTE_PLACES_AT_ONCE), count), 1)
    ends = [count * k // parts for k in range(parts + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


def distances_under(
    view: StationView, candidates: Array, photographs: Integers, samples: int
) -> Distances:
    """Distances under the edges predicted from poses (H, 4, 4)."""
    parts = _parts(view, len(candidates), len(photographs) * samples)
    if len(parts) > 1:
        each = [distances_under(view.guess(k), candidates[k], photographs, samples) for k in parts]
        return Distances(*map(np.concatenate, zip(*each, strict=True)))
    points, direction, number = _edges_under(view, candidates, photographs, samples)
    distance, inside = view.tables.look_up(direction, points.pixel, number, between=True)
    return _distances(view, points, direction, distance, inside & points.valid)


def linearize_distances(
    view: StationView, candidates: Array, photographs: Integers, samples: int
) -> _Linearization:
    """Distances under predicted edges, with derivatives by the poses."""
    parts = _parts(view, len(candidates), len(photographs) * samples)
    if len(parts) > 1:
        passes = [
            linearize_distances(view.guess(k), candidates[k], photographs, samples) for k in parts
        ]
        distances, *rest = zip(*passes, strict=True)
        every = Distances(*map(np.concatenate, zip(*distances, strict=True)))
        return _Linearization(every, *map(np.concatenate, rest))
    points, direction, number = _edges_under(view, candidates, photographs, samples)
    distance, slope, inside = view.tables.look_along(
        direction, points.pixel, points.outward, number
    )
    inside = inside & points.valid
    # an edge moves outward by n . (omega x P + tau), of motions of the camera frame
    first, last = points.point[..., 0, :], points.point[..., -1, :]
    visible = np.any(inside, axis=-1, keepdims=True)[..., 0]
    return _Linearization(
        _distances(view, points, direction, distance, inside),
        (slope * np.where(inside, points.gain, 0.0)).reshape(len(candidates), -1, samples),
        _stacked((cross(first, points.normal), points.normal), visible),
        _stacked((cross(last - first, points.normal),), visible),
    )


def _edges_under(
    view: StationView, candidates: Array, photographs: Integers, samples: int
) -> tuple[EdgePoints, Integers, Integers]:
    """Predicted edges (H, K, E, n), their directions, and the images' indices (K, 1, 1)."""
    number = np.arange(len(view.configuration))[photographs][:, None, None]
    legs = view.legs(photographs).under(candidates)
    points = edge_points(view.machine, view.camera, legs, view.tubes, samples)
    return points, view.tables.direction(points.outward), number


def _distances(
    view: StationView, points: EdgePoints, direction: Integers, values: Array, inside: Booleans
) -> Distances:
    """Distances with ``values`` (H, K, E, n) at predicted points, which are in the image where
    ``inside``, of all images in a row.
    """
    shape = (len(values), -1, values.shape[-1])
    inside = np.broadcast_to(inside, values.shape)
    chord = points.pixel[..., -1, :] - points.pixel[..., 0, :]
    length = np.hypot(chord[..., 0], chord[..., 1])
    length /= np.float32(view.tables.scale * (shape[-1] - 1))
    return Distances(
        np.where(inside, values, DISTANCE_OUTSIDE_IMAGE).reshape(shape),
        (1 / view.tables.by_chance(direction, values)).reshape(shape),
        np.where(inside, length[..., None], 0.0).reshape(shape),
    )


def _stacked(vectors: tuple[Array, ...], visible: Booleans) -> Array:
    """Components (H, 3 n, E) of n vectors (H, K, E, 3) of all edges in a row, 0 where hidden."""
    out = np.zeros((len(visible), 3 * len(vectors), visible[0].size), np.float32)
    for k, vector in enumerate(vectors):
        for c in range(3):
            part = out[:, 3 * k + c].reshape(visible.shape)
            np.copyto(part, vector[..., c], where=visible)
    return out


def _step(candidates: Array, station_edges: _Linearization, weight: Array, damping: Array) -> Array:
    """One damped Gauss-Newton step of every candidate's pose, (H, 4, 4).

    weight : (H, E, n) of the points. damping : (H,).
    """
    # the places of an edge lie evenly between its first and its last
    at = np.linspace(0, 1, weight.shape[-1], dtype=np.float32)
    powers = np.stack([at**0, at, at**2], axis=-1)
    weighted = weight * station_edges.slope
    one, both, two = ((weighted * station_edges.slope) @ powers).transpose(2, 0, 1)[:, :, None]
    here, there = ((weighted * station_edges.distances.distance) @ powers[:, :2]).transpose(2, 0, 1)
    begins, grows = station_edges.begins, station_edges.grows
    normal = (begins * one) @ begins.mT
    mixed = (grows * both) @ begins.mT
    normal[:, :3] += mixed
    normal[:, :, :3] += mixed.mT
    normal[:, :3, :3] += (grows * two) @ grows.mT
    right = begins @ here[..., None]
    right[:, :3] += grows @ there[..., None]
    normal, right = normal.astype(float), right.astype(float)
    diagonal = np.einsum("hii->hi", normal) + 1e-12
    normal = normal + (damping[:, None] * diagonal)[..., None] * np.eye(6)
    step = -np.linalg.solve(normal, right)[..., 0]
    step = np.clip(step, -0.1, 0.1)  # further, the tables' slopes say nothing
    # turn about the camera: R <- Exp(omega) R, t <- Exp(omega) t + tau
    return pose(rotation(step[:, :3]), step[:, 3:]) @ candidates
