"""Combination of repeated images of a configuration, with the noise estimated from the repeats.

[A] 4.2 measures noise by repeats. An image's own profiles determine how well an edge agrees with
its model; variations between images (sensor noise, vibration, air, light) are observed by repeats
only. Errors that the repeats have in common, such as shading, do not average out. For n repeats,
each with the stated covariance C and with the covariance S of their scatter about the mean,

    covariance of the mean = (the part of C that the repeats have in common) + S / n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot
from pkmcal.levels import CONTRADICTION_SIGMAS, MAJORITY
from pkmcal.measurements import EdgeSet, Rejection
from pkmcal.observe.legs import StationEdges
from pkmcal.outcome.finding import note


@dataclass(frozen=True)
class RepeatOptions:
    """Constants of the combination of repeats."""

    # degrees of freedom with which the scatter of a wider group enters that of a narrower one: an
    # edge with few repeats has the scatter of its leg, a leg with few configurations that of its
    # station
    prior_freedom: float = 10.0
    # distance of a repeat from the others, in standard deviations, beyond which it is rejected
    # (statistical: 6 in 10^7 of normal errors)
    far: float = CONTRADICTION_SIGMAS
    # share of a configuration's repeats that must be exceeded by those with an edge: edges that
    # are measured now and then are faint, and may well be a pixel off
    majority: float = MAJORITY


REPEAT_OPTIONS = RepeatOptions()


@dataclass(frozen=True)
class Groups:
    """Partition of N items into G groups.

    first : (G,) one item of each group.
    member : (N,) group of each item.
    count : (G,) sizes.
    """

    first: Integers
    member: Integers
    count: Integers

    def total(self, values: Array) -> Array:
        """Sums (G, ...) of values (N, ...) by group."""
        out = np.zeros((len(self.first), *values.shape[1:]))
        np.add.at(out, self.member, values)
        return out

    def mean(self, values: Array) -> Array:
        """Means (G, ...) of values (N, ...) by group."""
        return self.total(values) / self.count.reshape(-1, *[1] * (values.ndim - 1))

    def median(self, values: Array) -> Array:
        """Medians (G, n) of values (N, n) by group, each component by itself."""
        start = np.cumsum(self.count) - self.count
        low, high = start + (self.count - 1) // 2, start + self.count // 2
        order = np.stack([np.lexsort((column, self.member)) for column in values.T], axis=1)
        ordered = np.take_along_axis(values, order, axis=0)
        return (ordered[low] + ordered[high]) / 2

    def exchanged(self, rng: np.random.Generator) -> Integers:
        """Indices (N,) of the items, randomly permuted within each group."""
        inside = np.argsort(self.member, kind="stable")
        out = np.empty_like(inside)
        out[inside] = np.lexsort((rng.random(len(inside)), self.member))
        return out


def groups_of(*keys: Integers) -> Groups:
    """Groups of items with equal keys; each key is (N,)."""
    _, first, member, count = np.unique(
        np.stack(keys, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    return Groups(first, member.reshape(-1), count)


def same_edges(edges: EdgeSet) -> Groups:
    """Groups of the repeats of an edge: same station, configuration, leg, tube and side."""
    return groups_of(edges.station, edges.configuration, edges.leg, edges.tube, edges.side)


def combine_repeats(
    station_edges: StationEdges, options: RepeatOptions = REPEAT_OPTIONS
) -> StationEdges:
    """Replace the repeats of each edge of a measurement pass by their mean.

    Outlying repeats are rejected first, with a reason. A pass without repeats is returned
    unchanged.
    """
    groups = same_edges(station_edges.edges)
    if len(groups.first) == len(station_edges.edges):
        return station_edges
    odd = outlying_repeats(station_edges.edges, groups, options=options)
    # reject outliers and renumber the points' edges
    keep = ~odd.any
    edges = station_edges.edges.select(keep)
    groups = same_edges(edges)
    number = np.full(len(keep), -1)
    number[keep] = groups.member
    point_edge = number[station_edges.point_edge]
    text = (*station_edges.rejected, *_rejections(station_edges.edges, odd))
    return replace(
        station_edges,
        edges=mean_edges(edges, groups, options=options),
        rejected=tuple(dict.fromkeys(text)),  # a hidden edge is hidden in every repeat
        points=station_edges.points[point_edge >= 0],
        point_edge=point_edge[point_edge >= 0],
    )


def mean_edges(edges: EdgeSet, groups: Groups, options: RepeatOptions = REPEAT_OPTIONS) -> EdgeSet:
    """Mean edge (G,) of each group of repeats, with a covariance from their scatter."""
    normal = groups.mean(edges.normal)
    normal /= np.sqrt(dot(normal, normal))[:, None]
    stated = groups.mean(edges.covariance)
    return replace(
        edges.select(groups.first),
        normal=normal,
        # repeats differ by milliradians: the tangent basis of one serves for all
        basis=tangent_basis(normal, edges.basis[groups.first, :, 0]),
        covariance=mean_covariance(
            stated, repeat_scatter(edges, groups, options=options), groups.count
        ),
        shift=groups.mean(edges.shift),
        span=groups.mean(edges.span),
        by_intrinsics=groups.mean(edges.by_intrinsics),
    )


def mean_covariance(stated: Array, scatter: Array, count: Integers) -> Array:
    """Covariance (G, 2, 2) of the mean of ``count`` (G,) repeats from the covariances of one
    repeat.

    S is evaluated along its principal axes in units of C, S = s C. Sensor noise is part of C,
    because it also roughens profiles, so 1 - s of C remains common. Where s > 1, the scatter cannot
    be part of C (a shaken camera leaves crisp profiles), and all of C remains. In between either
    may hold, and s of C remains, so that the common part is a half at least.

    stated : (G, 2, 2), C.
    scatter : (G, 2, 2), S.
    """
    root = np.linalg.cholesky(stated)
    back = np.linalg.inv(root)
    share, axes = np.linalg.eigh(back @ scatter @ back.mT)
    share = np.maximum(share, 0.0)
    common = np.maximum(1.0 - share, np.minimum(share, 1.0))
    parts = root @ axes * np.sqrt(common + share / count[:, None])[:, None, :]
    return parts @ parts.mT


def turns_from_first(edges: EdgeSet, groups: Groups) -> Array:
    """Rotation (N, 2), rad, of each edge from the first of its group, in the latter's tangent
    basis.
    """
    reference = groups.first[groups.member]
    turn = edges.normal - edges.normal[reference]
    return (turn[:, None, :] @ edges.basis[reference])[:, 0]


def pixel_units(edges: EdgeSet) -> Array:
    """Rotations (N, 2), rad, that correspond to a shift by one pixel and to a tilt of one pixel
    over the edge's length.

    The tilt is up to a factor, the leg's distance. In these units edges of different lengths have
    the same scatter.
    """
    pixel = np.sqrt(dot(edges.shift, edges.shift))
    length = np.maximum(edges.span[:, 1] - edges.span[:, 0], 1e-3)
    return np.stack([pixel, pixel / length], axis=1)


def repeat_scatter(
    edges: EdgeSet, groups: Groups, options: RepeatOptions = REPEAT_OPTIONS
) -> Array:
    """Covariance (G, 2, 2), rad^2, of a single repeat of each edge, estimated from the repeats
    alone.

    An edge's own scatter is shrunk towards that of the same edge in all configurations, and this
    towards that of its station, by degrees of freedom.
    """
    # deviations from the means, in pixels, and their products
    unit = groups.mean(pixel_units(edges))
    turn = turns_from_first(edges, groups)
    turn = (turn - groups.mean(turn)[groups.member]) / unit[groups.member]
    squares = groups.total(turn[:, :, None] * turn[:, None, :])
    freedom, first = groups.count - 1.0, edges.select(groups.first)
    levels = (
        groups_of(first.station),
        groups_of(first.station, first.leg, first.tube, first.side),
        groups_of(np.arange(len(first))),
    )
    # from station to edge, each level with the wider one as its prior
    scatter, prior = np.zeros_like(squares), 0.0
    for level in levels:
        total, number = level.total(squares), level.total(np.asarray(freedom))
        weight = np.maximum(number + prior, 1.0)[level.member]
        scatter = (total[level.member] + prior * scatter) / weight[:, None, None]
        prior = options.prior_freedom
    return scatter * unit[:, :, None] * unit[:, None, :]


@dataclass(frozen=True)
class OutlyingRepeats:
    """Rejected repeats, all arrays (N,).

    off : distance from the median of the repeats, in stated standard deviations.
    out : far from a majority that agrees.
    disputed : one of a group without such a majority.
    rare : of an edge that was measured in at most half of the repeats.
    most : number of repeats of the configuration, counted by its most often measured edge.
    """

    off: Array
    out: Booleans
    disputed: Booleans
    rare: Booleans
    most: Integers

    @property
    def any(self) -> Booleans:
        """Whether a repeat is rejected for any reason."""
        return self.out | self.disputed | self.rare


def outlying_repeats(
    edges: EdgeSet, groups: Groups, options: RepeatOptions = REPEAT_OPTIONS
) -> OutlyingRepeats:
    """Repeats of one station that are further from their group's median than noise explains."""
    turn, unit = turns_from_first(edges, groups), pixel_units(edges)
    away = np.abs(turn - groups.median(turn)[groups.member])
    stated = np.sqrt(edges.covariance[:, [0, 1], [0, 1]])
    # spread (2,) of a repeat of a typical edge, robust against a few bad ones: the median of the
    # edges' variances, corrected by the ratio of median and mean (Wilson-Hilferty)
    several, spread = groups.count > 1, np.full(2, np.inf)
    if several.any():
        freedom = np.maximum(groups.count - 1.0, 1.0)[:, None]
        scaled = turn / unit
        scaled = scaled - groups.mean(scaled)[groups.member]
        variance = groups.total(scaled * scaled) / freedom / (1 - 2 / (9 * freedom)) ** 3
        spread = np.sqrt(np.median(variance[several], axis=0))
    # within its stated noise a repeat is an inlier however well the others agree
    far = (away > options.far * spread * unit) & (away > stated)
    far = far.any(axis=1)
    count = groups.count[groups.member]
    photos = groups_of(edges.station, edges.configuration)
    most = np.zeros(len(photos.first), dtype=int)
    np.maximum.at(most, photos.member, count)
    most = most[photos.member]
    rare = count <= options.majority * most
    disputed = (
        groups.total((~far).astype(float))[groups.member] <= options.majority * count
    ) & ~rare
    # a single image is its own majority
    rare &= most > 1
    return OutlyingRepeats(
        (away / stated).max(axis=1), far & ~disputed & ~rare, disputed, rare, most
    )


def _rejections(edges: EdgeSet, odd: OutlyingRepeats) -> list[Rejection]:
    """Rejections with their reasons: one for each repeat that is out, one for each other edge."""
    out: list[Rejection] = []
    for k in np.flatnonzero(odd.out).tolist():
        reason = note("repeats.outlier", distance=odd.off[k])
        out.append(edges.rejection(k, reason.text, reason.code))
    for kind in (odd.disputed, odd.rare):
        rows = np.flatnonzero(kind)
        if not rows.size:
            continue
        groups = same_edges(edges.select(rows))
        apart = np.zeros(len(groups.first))
        np.maximum.at(apart, groups.member, odd.off[rows])
        for k, count, far in zip(rows[groups.first].tolist(), groups.count, apart, strict=True):
            reason = (
                note("repeats.rare", number=int(count), of=int(odd.most[k]))
                if kind is odd.rare
                else note("repeats.disputed", distance=far)
            )
            out.append(edges.rejection(k, reason.text, reason.code))
    return out
