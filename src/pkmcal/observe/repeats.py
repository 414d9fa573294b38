"""Mean edges of repeated images of a configuration, with the noise that the repeats show.

[A] 4.2 measures the noise by repeats. The profiles of one image show how well an edge agrees with
its model; errors that differ from one image to the next (sensor noise, vibration, air, light) show
in repeats only. Errors that repeats have in common, such as shading, do not average out. With n
repeats, each with the stated covariance C and with the sample covariance S about their mean,

    covariance of the mean = (the common part of C) + S / n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot
from pkmcal.measurements import EdgeSet, Rejection
from pkmcal.observe.legs import StationEdges

SCATTER_PRIOR_FREEDOM = 10.0
"""Degrees of freedom with which the scatter of a wider group is the prior of a narrower one: an
edge with few repeats takes the scatter of its leg, a leg with few configurations that of its
station."""
FAR_REPEAT_DEVIATIONS = 5.0
"""Standard deviations from the other repeats beyond which a repeat is an outlier."""
HARMLESS_REPEAT_DEVIATIONS = 1.0
"""Stated standard deviations within which a repeat is an inlier, however well the others agree."""
MAJORITY_OF_REPEATS = 0.5
"""Share of a configuration's repeats that an edge has to exceed: edges that are measured only now
and then are faint, and a pixel off as often as not."""
_RARE = "seen in only {} of {} repeats"
_OUT = "a repeat lies {:.1f} standard deviations from the others, which are used without it"
_DISPUTED = "its repeats lie up to {:.1f} standard deviations off, and no majority agrees"


@dataclass(frozen=True)
class Groups:
    """Partition of N items into G groups.

    first : (G,) index of one item of each. member : (N,) group of each item. count : (G,) sizes.
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
        """Permutation (N,) of the items, random within each group."""
        inside = np.argsort(self.member, kind="stable")
        out = np.empty_like(inside)
        out[inside] = np.lexsort((rng.random(len(inside)), self.member))
        return out


def groups_of(*keys: Integers) -> Groups:
    """Groups of items with equal keys, each (N,)."""
    _, first, member, count = np.unique(
        np.stack(keys, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    return Groups(first, member.reshape(-1), count)


def same_edges(edges: EdgeSet) -> Groups:
    """Groups of repeats of one edge: equal station, configuration, leg, tube and side."""
    return groups_of(edges.station, edges.configuration, edges.leg, edges.tube, edges.side)


def combined(station_edges: StationEdges) -> StationEdges:
    """Mean edges of a measurement pass, one for all repeats of each; unchanged without repeats."""
    groups = same_edges(station_edges.edges)
    if len(groups.first) == len(station_edges.edges):
        return station_edges
    odd = odd_ones(station_edges.edges, groups)
    keep = ~odd.any
    edges = station_edges.edges.select(keep)
    groups = same_edges(edges)
    number = np.full(len(keep), -1)
    number[keep] = groups.member
    point_edge = number[station_edges.point_edge]
    text = (*station_edges.rejected, *_rejections(station_edges.edges, odd))
    return replace(
        station_edges,
        edges=mean_edges(edges, groups),
        rejected=tuple(dict.fromkeys(text)),  # what is hidden is so in every repeat
        points=station_edges.points[point_edge >= 0],
        point_edge=point_edge[point_edge >= 0],
    )


def mean_edges(edges: EdgeSet, groups: Groups) -> EdgeSet:
    """Mean edge of each of G groups of repeats, with :func:`mean_covariance`."""
    normal = groups.mean(edges.normal)
    normal /= np.sqrt(dot(normal, normal))[:, None]
    stated = groups.mean(edges.covariance)
    return replace(
        edges.select(groups.first),
        normal=normal,
        # repeats lie milliradians apart: the coordinates of one serve for all
        basis=tangent_basis(normal, edges.basis[groups.first, :, 0]),
        covariance=mean_covariance(stated, repeat_scatter(edges, groups), groups.count),
        shift=groups.mean(edges.shift),
        span=groups.mean(edges.span),
        by_intrinsics=groups.mean(edges.by_intrinsics),
    )


def mean_covariance(stated: Array, scatter: Array, count: Integers) -> Array:
    """Covariance (G, 2, 2) of the mean of ``count`` (G,) repeats, from those of a single one.

    Along each principal axis of the scatter S in units of the stated C, S = s C. Sensor noise is
    part of C, for it roughens profiles as well, so 1 - s of C is common. Where s > 1, C cannot
    contain the scatter (a shaken camera leaves crisp profiles), and all of C is common. In between
    either may hold, and the larger of s and 1 - s is common, a half at least.
    """
    root = np.linalg.cholesky(stated)
    back = np.linalg.inv(root)
    share, axes = np.linalg.eigh(back @ scatter @ back.mT)
    share = np.maximum(share, 0.0)
    common = np.maximum(1.0 - share, np.minimum(share, 1.0))
    parts = root @ axes * np.sqrt(common + share / count[:, None])[:, None, :]
    return parts @ parts.mT


def turns_from_first(edges: EdgeSet, groups: Groups) -> Array:
    """Turn (N, 2), rad, of each edge from the first of its group, in that one's tangent basis."""
    reference = groups.first[groups.member]
    turn = edges.normal - edges.normal[reference]
    return (turn[:, None, :] @ edges.basis[reference])[:, 0]


def pixel_units(edges: EdgeSet) -> Array:
    """Turns (N, 2), rad, by a shift of a pixel, and by a tilt of a pixel over the edge's length.

    The tilt is up to a factor, the leg's distance. In these units edges of all lengths have equal
    scatter.
    """
    pixel = np.sqrt(dot(edges.shift, edges.shift))
    length = np.maximum(edges.span[:, 1] - edges.span[:, 0], 1e-3)
    return np.stack([pixel, pixel / length], axis=1)


def repeat_scatter(edges: EdgeSet, groups: Groups) -> Array:
    """Covariance (G, 2, 2), rad^2, of a single repeat of each edge, from the repeats alone.

    The scatter of an edge is shrunk towards that of the same edge of its leg in all configurations,
    and that towards the scatter of its station, by their degrees of freedom.
    """
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
    scatter, prior = np.zeros_like(squares), 0.0
    for level in levels:
        total, number = level.total(squares), level.total(np.asarray(freedom))
        weight = np.maximum(number + prior, 1.0)[level.member]
        scatter = (total[level.member] + prior * scatter) / weight[:, None, None]
        prior = SCATTER_PRIOR_FREEDOM
    return scatter * unit[:, :, None] * unit[:, None, :]


@dataclass(frozen=True)
class OddOnes:
    """Rejected repeats, all (N,).

    off : stated standard deviations from the median of the repeats. out : far from a majority that
    agrees. disputed : of repeats without such a majority. rare : of an edge that few of the repeats
    show, while ``most`` of them show others.
    """

    off: Array
    out: Booleans
    disputed: Booleans
    rare: Booleans
    most: Integers

    @property
    def any(self) -> Booleans:
        """Whether a repeat is rejected, for any reason."""
        return self.out | self.disputed | self.rare


def odd_ones(edges: EdgeSet, groups: Groups) -> OddOnes:
    """Repeats that are further from their median than noise explains."""
    turn, unit = turns_from_first(edges, groups), pixel_units(edges)
    away = np.abs(turn - groups.median(turn)[groups.member])
    stated = np.sqrt(edges.covariance[:, [0, 1], [0, 1]])
    far = (away > FAR_REPEAT_DEVIATIONS * _typical_spread(turn / unit, groups) * unit) & (
        away > HARMLESS_REPEAT_DEVIATIONS * stated
    )
    far = far.any(axis=1)
    count = groups.count[groups.member]
    photos = groups_of(edges.station, edges.configuration)
    most = np.zeros(len(photos.first), dtype=int)
    np.maximum.at(most, photos.member, count)
    most = most[photos.member]
    rare = count <= MAJORITY_OF_REPEATS * most
    disputed = (
        groups.total((~far).astype(float))[groups.member] <= MAJORITY_OF_REPEATS * count
    ) & ~rare
    # a lone photograph is its own majority
    rare &= most > 1
    return OddOnes((away / stated).max(axis=1), far & ~disputed & ~rare, disputed, rare, most)


def _typical_spread(turn: Array, groups: Groups) -> Array:
    """Robust standard deviation (2,) of a repeat: by the median over edges of their variances,
    corrected for the median of a chi-squared variable (Wilson and Hilferty, 1931).
    """
    several = groups.count > 1
    freedom = np.maximum(groups.count - 1.0, 1.0)[:, None]
    away = turn - groups.mean(turn)[groups.member]
    square = groups.total(away * away) / freedom
    if not several.any():
        return np.full(2, np.inf)
    return np.sqrt(np.median((square / (1 - 2 / (9 * freedom)) ** 3)[several], axis=0))


def _rejections(edges: EdgeSet, odd: OddOnes) -> list[Rejection]:
    """Rejections with their reasons: each outlying repeat, and each disputed or rare edge once."""
    out = [edges.rejection(k, _OUT.format(odd.off[k])) for k in np.flatnonzero(odd.out).tolist()]
    for kind in (odd.disputed, odd.rare):
        rows = np.flatnonzero(kind)
        groups = same_edges(edges.select(rows)) if rows.size else None
        if groups is None:
            continue
        apart = np.zeros(len(groups.first))
        np.maximum.at(apart, groups.member, odd.off[rows])
        for k, count, far in zip(rows[groups.first].tolist(), groups.count, apart, strict=True):
            text = _RARE.format(count, odd.most[k]) if kind is odd.rare else _DISPUTED.format(far)
            out.append(edges.rejection(k, text))
    return out
