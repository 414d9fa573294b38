"""Silhouette edges of legs in images: the kind, its measurements and their rows.

Two rows an edge, ``L^-1 (basis^T n_predicted - C x)`` with L the Cholesky factor of the edge's
covariance and C its derivatives by the numbers x of the columns
(:mod:`pkmcal.measurements.columns`). ``basis^T n_measured = 0``. When all points of an edge lie s
px outward, the measured normal is the true one plus ``basis @ (shift * s)``, so the derivative of
an edge shift is ``C = -shift``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import ClassVar, NamedTuple, TypeVar, final

import numpy as np
from numpy.typing import NDArray

from pkmcal.arrays import Array, Booleans, Integers, short_repr, with_zero
from pkmcal.geometry.cylinders import SIDE_SIGNS, LineSilhouettes, edge_planes
from pkmcal.geometry.rigid import skew
from pkmcal.measurements.contract import ImageKind
from pkmcal.measurements.line_cells import LineCells
from pkmcal.measurements.rows import among
from pkmcal.mechanisms.closure import Closure

SHADING_SIGMA = 0.03
"""Standard deviation (px) of the shift by shading of all edges of one side of a tube at one
station, under even light. Hard light and polished metal cause ten times as much, so the data may
enlarge it. 0.02 in path-traced images of matt machines, 0.05 in those of our own renderer."""

OWN_SHADING = 0.015
"""Standard deviation (px) of the shift by shading of one edge in addition to the common shift of
its line, under even light; highlights and mirror images in metal cause ten times as much."""

Scalar = TypeVar("Scalar", bound=np.generic)


@final
class Edges(ImageKind):
    """Edges of legs."""

    code: ClassVar = "edges"
    one: ClassVar = "edge"
    label: ClassVar = "edges"
    unit: ClassVar = "px"
    numbers: ClassVar = 2
    rows: ClassVar = "edges"
    observe: ClassVar = "legs"


@dataclass(frozen=True)
class EdgeSet:
    """Silhouette edges of legs in images; N edges, flat arrays, all indices from 0.

    station, configuration, leg, tube, side : (N,) indices of each edge; side as in
        :mod:`pkmcal.geometry.cylinders` (0 or 1).
    normal : (N, 3) unit normal of the plane of edge and camera centre, camera frame, pointing away
        from the leg's axis.
    basis : (N, 3, 2) orthonormal tangent basis at the normal: shift first, tilt second.
    covariance : (N, 2, 2) of the normal in that basis, rad^2.
    shift : (N, 2) change of the normal, in that basis, when every point of the edge moves outward
        by one pixel (rad/px).
    span : (N, 2) first and last visible position along the leg, m from A.
    by_intrinsics : (N, 2, n) change of the normal, in that basis, by the camera's parameters with
        the edge's pixels fixed; n = 0 where it is not needed.
    by_focal : (N, 2) change of the normal by the relative excess of the focal lengths, where these
        differ between images; otherwise zero.
    shading : (N,) px, standard deviation of each edge's shift by shading in addition to the common
        shift of its line; correlated between edges of a line with similar normals
        (:mod:`~pkmcal.measurements.line_cells`). Used where measurements are ``shaded``.
    coarse : (N,) whether the edge follows from the fit of a whole machine's silhouettes to image
        edges (:mod:`pkmcal.observe.silhouettes`) instead of a measurement of its own.
    """

    station: Integers
    configuration: Integers
    leg: Integers
    tube: Integers
    side: Integers
    normal: Array
    basis: Array
    covariance: Array
    shift: Array
    span: Array
    by_intrinsics: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))
    by_focal: Array = field(default_factory=lambda: np.zeros((0, 2)))
    shading: Array = field(default_factory=lambda: np.zeros(0))
    coarse: Booleans = field(default_factory=lambda: np.zeros(0, dtype=bool))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        """Set absent fields to empty, zero or usual values of the right length."""
        if len(self.coarse) != len(self.station):
            object.__setattr__(self, "coarse", np.zeros(len(self.station), dtype=bool))
        if len(self.by_intrinsics) != len(self.station):
            object.__setattr__(self, "by_intrinsics", np.zeros((len(self.station), 2, 0)))
        if len(self.by_focal) != len(self.station):
            object.__setattr__(self, "by_focal", np.zeros((len(self.station), 2)))
        if len(self.shading) != len(self.station):
            object.__setattr__(self, "shading", np.full(len(self.station), OWN_SHADING))

    @classmethod
    def empty(cls) -> EdgeSet:
        """A set without edges, for sessions of boards alone."""
        none = np.zeros(0, dtype=int)
        each = [np.zeros((0, *shape)) for shape in ((3,), (3, 2), (2, 2), (2,), (2,))]
        normal, basis, covariance, shift, span = each
        return cls(none, none, none, none, none, normal, basis, covariance, shift, span)

    def __len__(self) -> int:
        return len(self.station)

    def select(self, keep: Booleans | Integers) -> EdgeSet:
        """The edges selected by a mask or by positions."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    def same_as(self, other: EdgeSet) -> tuple[Integers, Integers]:
        """Positions, in this set and in another, of the edges in both sets.

        Equal edges have the same station, configuration, leg, tube and side, and occur once in a
        set.
        """
        each = [
            np.stack([of.station, of.configuration, of.leg, of.tube, of.side], axis=1)
            for of in (self, other)
        ]
        number = np.unique(np.concatenate(each), axis=0, return_inverse=True)[1].ravel()
        own, others = number[: len(self)], number[len(self) :]
        return np.intersect1d(own, others, return_indices=True)[1:]

    def scaled(self, factor: float) -> EdgeSet:
        """The edges with standard deviations larger by a factor."""
        return replace(self, covariance=self.covariance * factor**2)

    def rejection(self, k: int, reason: str, code: str = "") -> Rejection:
        """Rejection of the edge at position k, with a reason and its code."""
        return Rejection(
            station=int(self.station[k]),
            configuration=int(self.configuration[k]),
            leg=int(self.leg[k]),
            tube=int(self.tube[k]),
            side=int(self.side[k]),
            reason=reason,
            code=code,
        )


@dataclass(frozen=True)
class Rejection:
    """A measurement that was rejected or not detected, with the reason.

    tube and side are -1 for a whole leg, leg is -1 for a whole image. code : of the finding whose
    sentence the reason is, empty for other reasons.
    """

    station: int
    configuration: int
    leg: int
    tube: int
    side: int
    reason: str
    code: str = ""


@dataclass(frozen=True)
class EdgeBlocks:
    """Positions of the edges: K configurations of G blocks, padded; the same for all runs.

    Edges that share their noise are whitened together: a *block* is g edges of one tube at one
    station (g = 1 for edges measured in images, g = 2 for the two edges that stand for a measured
    axis, [A] Table 1), with one 2g x 2g whitening matrix and one robust weight. Each leg has the
    same number of consecutive positions in all configurations.

    leg : (1, G).
    station, radius : (K, G) station, and position of the tube's radius among the parameters.
    side : (K, G, g).
    present : (K, G) False for padding.
    column : (K, G, w) numbers of the unknown effects that change each edge, -1 for none.
    alone : (K, G) px, standard deviation of the shading of edges that are a line of their own, zero
        for all others.
    tube : (K, G) number of the tube on its leg.
    n_effective : (K, G) number of edges of its line that share an edge's own shading
        (:mod:`~pkmcal.measurements.line_cells`), zero without shading.
    cell : (K, G) number of each edge's cell among ``cells``, -1 for none.
    cells : cells of edges with similar normals.
    """

    leg: Integers
    station: Integers
    radius: Integers
    side: Integers
    present: Booleans
    column: Integers
    alone: Array
    tube: Integers
    n_effective: Array
    cell: Integers
    cells: LineCells

    def among(self, configurations: slice) -> EdgeBlocks:
        """The blocks of some configurations."""
        return among(self, configurations, 0)

    @cached_property
    def views(self) -> EdgeViews:
        """Blocks sorted by view, without padding."""
        configuration, number = np.nonzero(self.present)
        leg, station = self.leg[0, number], self.station[configuration, number]
        order = np.lexsort((number, configuration, station, leg))
        keys = np.stack([leg, station, configuration])[:, order]
        begins = np.append(True, np.any(keys[:, 1:] != keys[:, :-1], axis=0))[: len(order)]
        first = np.flatnonzero(begins)
        view = np.cumsum(begins) - 1
        slot = np.arange(len(order)) - first[view]
        leg, station, configuration = keys[:, first]
        place = configuration * self.present.shape[1] + number[order[first]]
        place = np.repeat(place[:, None], int(slot.max(initial=-1)) + 1, axis=1)
        place[view, slot] = (keys[2] * self.present.shape[1]) + number[order]
        present = np.zeros(place.shape, dtype=bool)
        present[view, slot] = True
        return EdgeViews(configuration, leg, station, place, present)

    @cached_property
    def view_columns(self) -> ViewColumns:
        """Effects that change the edges of each view."""
        views = self.views
        group = np.repeat(np.arange(len(views.groups)), [c.stop - c.start for c in views.groups])
        column = views.taken(self.column)
        used, base = column >= 0, int(self.column.max(initial=0)) + 1
        keys, inverse = np.unique((group[:, None, None] * base + column)[used], return_inverse=True)
        of_group, number = np.divmod(keys, base)
        slot = np.arange(len(keys)) - np.searchsorted(of_group, of_group)
        of_groups = np.full((len(views.groups), int(slot.max(initial=-1)) + 1), -1)
        of_groups[of_group, slot] = number
        slots = np.full(column.shape, -1)
        slots[used] = slot[inverse.reshape(-1)]
        return ViewColumns(of_groups, of_groups[group], slots)

    @cached_property
    def number(self) -> Integers:
        """Number (K, G) of each block among those of the views, (N m); arbitrary for padding."""
        views, out = self.views, np.zeros(self.present.size, dtype=int)
        out[views.place[views.present]] = np.flatnonzero(views.present)
        return out.reshape(self.present.shape)


class ViewColumns(NamedTuple):
    """Numbers of the effects that change the edges of views.

    of_groups : (groups, W) of each group of views, in increasing order, -1 for padding.
    of_views : (N, W) the same by view.
    slots : (N, m, w) position of each block's numbers among those of its view, -1 for none.
    """

    of_groups: Integers
    of_views: Integers
    slots: Integers


@dataclass(frozen=True)
class EdgeViews:
    """N views, each of one leg in one image: up to m blocks, with edges of one axis.

    Views of one leg from one station are contiguous.

    configuration, leg, station : (N,).
    place : (N, m) position of each block among those of all configurations, (K G).
    present : (N, m) False for padding, which has another block's position.
    """

    configuration: Integers
    leg: Integers
    station: Integers
    place: Integers
    present: Booleans

    def taken(self, numbers: NDArray[Scalar], axis: int = 0) -> NDArray[Scalar]:
        """Gather numbers of blocks (..., K, G, ...) by view, (..., N, m, ...); axis : that of K."""
        shape = numbers.shape
        flat = numbers.reshape(*shape[:axis], shape[axis] * shape[axis + 1], *shape[axis + 2 :])
        return flat.take(self.place, axis=axis)

    def limbs(self, n_legs: int) -> Integers:
        """Number of each view's limb among those of all configurations, (K L)."""
        return self.configuration * n_legs + self.leg

    @cached_property
    def groups(self) -> list[slice]:
        """Slices of the views of one leg from one station."""
        changes = (np.diff(self.leg) != 0) | (np.diff(self.station) != 0)
        cuts = [0, *(np.flatnonzero(changes) + 1).tolist(), len(self.leg)]
        return [slice(*cut) for cut in pairwise(cuts) if cut[0] < cut[1]]


@dataclass(frozen=True)
class EdgeData:
    """Measured values of each run; leading axis B, or 1 where all runs share them.

    basis : (B, K, G, g, 3, 2).
    white : (B, K, G, 2g, 2g) whitening of each block's stated noise, without shading.
    shift : (B, K, G, 2g) change of the measured normals by a pixel outward.
    joints : (B, K, m).
    weight : (B, K, G) robust weight of each block, 0..1, divided by the squared noise scale.
    columns : (B, K, G, 2g, w) derivatives of the rows, before whitening, by the effects in
        ``EdgeBlocks.column``.
    unit : (B or 1, n) units of the n numbers of all effects: px, standard deviations, for the
        lines' shading, 1 for all others.
    scale : (B, K, G) factor on the stated noise.
    own : (B, K, G) px, standard deviation of each edge's own shading, multiplied by the root of the
        number of edges that share it.
    """

    basis: Array
    white: Array
    shift: Array
    joints: Array
    weight: Array
    columns: Array = field(default_factory=lambda: np.zeros((1, 1, 1, 1, 0)))
    unit: Array = field(default_factory=lambda: np.ones((1, 0)))
    scale: Array = field(default_factory=lambda: np.ones((1, 1, 1)))
    own: Array = field(default_factory=lambda: np.zeros((1, 1, 1)))

    def among(self, configurations: slice) -> EdgeData:
        """The data of some configurations."""
        return replace(among(self, configurations, 1), unit=self.unit)

    @cached_property
    def by_shift(self) -> Array:
        """Derivative (B or 1, K, G, 2g) of the rows, in stated noise, by a shift of one pixel."""
        return (self.white @ self.shift[..., None])[..., 0]

    @cached_property
    def whiten(self) -> Array:
        """Whitening (B or 1, K, G, 2g, 2g) of the noise with its scale and the edges' own shading.

        In units of the stated noise the covariance is ``scale^2 + own^2 v v^T`` with v the
        :attr:`by_shift`; its inverse root differs from ``1 / scale`` along v only.
        """
        if not self.own.any():
            return self.white / self.scale[..., None, None]
        v, square = self.by_shift, np.sum(self.by_shift**2, axis=-1)
        ratio = self.scale / np.sqrt(self.scale**2 + self.own**2 * square)
        along = v * ((ratio - 1) / np.where(square > 0, square, 1.0))[..., None]
        turned = self.white + along[..., None] * (v[..., None, :] @ self.white)
        return turned / self.scale[..., None, None]

    @cached_property
    def weighed(self) -> Array:
        """The whitening with the weights, (B or 1, K, G, 2g, 2g)."""
        return np.sqrt(self.weight)[..., None, None] * self.whiten


@dataclass(frozen=True)
class ViewData:
    """Derivatives of the edges by view, whitened and weighted.

    Each view (B or 1, N) has n rows, 2g for each of its m blocks. Rows are the last axis, so that
    NumPy's inner loops run over all views.

    of_normals : (g, ..., 3, n) by changes of the normals, camera frame.
    by_columns : (W, ..., n) by the effects of their group (:class:`ViewColumns`).
    counts : (..., n) whether the block is present and has a weight.
    sign : (g, N, n) sign of the edges' sides.
    """

    of_normals: Array
    by_columns: Array
    counts: Booleans
    sign: Array

    @classmethod
    def of(cls, blocks: EdgeBlocks, data: EdgeData) -> ViewData:
        """Derivatives of all edges that are present."""
        views = blocks.views
        counts = (views.taken(data.weight, 1) > 0) & views.present
        white = np.where(counts[..., None, None], views.taken(data.weighed, 1), 0.0)
        each = white.shape[-1]
        split = white.reshape(*white.shape[:-1], each // 2, 2)

        def by_row(numbers: Array) -> Array:
            """Numbers (..., m, 2g) of blocks."""
            return numbers.reshape(*numbers.shape[:-2], numbers.shape[-2] * each)

        by_column = np.einsum(
            "...krq,...kqw->w...kr", white, views.taken(data.columns, 1), order="C"
        )
        if np.any(data.unit != 1):
            unit = data.unit[:, views.taken(blocks.column)]
            by_column = by_column * np.moveaxis(unit, -1, 0)[..., None]
        to = blocks.view_columns
        by_columns = np.zeros((to.of_groups.shape[1], *by_row(by_column).shape[1:]))
        for by, slot in zip(by_row(by_column), np.moveaxis(to.slots, -1, 0), strict=True):
            for k in np.unique(slot[slot >= 0]).tolist():
                by_columns[k] += np.where(np.repeat(slot == k, each, axis=-1), by, 0.0)
        of_normals = split.swapaxes(-3, -2) @ views.taken(data.basis, 1).mT  # (..., m, g, 2g, 3)
        side = np.moveaxis(views.taken(blocks.side), -1, 0)
        return cls(
            by_row(np.moveaxis(of_normals, (-3, -1), (0, -3))),
            by_columns,
            np.repeat(counts, each, axis=-1),
            np.repeat(SIDE_SIGNS[side], each, axis=-1),
        )


@dataclass(frozen=True)
class EdgeRows:
    """Rows of the edges at a state, with their derivatives by the two ends of their axis.

    All other derivatives follow by the chain rule. The last axes are the views (B, N), or their
    rows (B, N, n).

    T_camera_base : (B, S, 4, 4).
    lines : axes in the camera frame.
    frame : (B, N, 3, 3) u, m and w of the lines.
    sine, cosine : (...) and (g, ...), of :func:`~pkmcal.geometry.cylinders.edge_planes`, NaN where
        a leg passes through the camera.
    by_frame : (g, 3, ...) derivatives of the rows by changes of the normals along u, m and w.
    """

    blocks: EdgeBlocks
    data: ViewData
    closure: Closure
    T_camera_base: Array
    lines: LineSilhouettes
    frame: Array
    sine: Array
    cosine: Array
    by_frame: Array

    def value(self, columns: Array) -> Array:
        """Rows (B, N, n) at the numbers ``columns`` (B, n) of the effects; zero for padding and
        rejected edges.
        """
        data, (_, of_views, _) = self.data, self.blocks.view_columns
        (_, along_m, along_w), *others = self.by_frame
        rows = self.cosine[0] * along_m - self.sine * along_w
        for cosine, (_, along_m, along_w) in zip(self.cosine[1:], others, strict=True):
            rows += cosine * along_m - self.sine * along_w
        numbers = with_zero(columns)  # the last one is for padding
        for by, column in zip(data.by_columns, of_views.T, strict=True):
            rows += by * numbers[:, column, None]
        return np.where(data.counts, rows, 0.0)

    def _of_views(self, numbers: Array) -> Array:
        """Values of views (...) repeated for each of their rows, (..., n)."""
        n_rows = self.sine.shape[-1]
        return np.repeat(numbers, n_rows, axis=-1).reshape(*numbers.shape, n_rows)

    @cached_property
    def _turns(self) -> Array:
        """Derivative (g, ...) of the rows by a shift of the whole axis towards the camera.

        Equal to the derivative by the radius; see
        :meth:`~pkmcal.geometry.cylinders.LineSilhouettes.edges`.
        """
        along_m, along_w = self.by_frame[:, 1], self.by_frame[:, 2]
        turn = along_w + (self.sine / self.cosine) * along_m
        return turn / self._of_views(self.lines.distance)

    def by_ends(self) -> Array:
        """Derivatives (4, B, N, n) by both ends along m and along w, a before b.

        Motions along u do not change an edge; all other derivatives are multiples of these.
        """
        line, out = self.lines, np.empty((4, *self.sine.shape))
        shift = self.by_frame[:, 0] / self._of_views(line.length)
        by_b = self._of_views(line.before / line.length) * self._turns - shift
        by_a = -self._turns - by_b
        for k, pulls in ((0, by_a), (2, by_b)):
            np.multiply(pulls[0], self.cosine[0], out=out[k])
            np.multiply(pulls[0], -self.sine, out=out[k + 1])
            for pull, cosine in zip(pulls[1:], self.cosine[1:], strict=True):
                out[k] += pull * cosine
                out[k + 1] -= pull * self.sine
        return out

    def by_radius(self) -> Array:
        """Derivatives (B, N, n) by the tube's radius."""
        return -np.sum(self._turns, axis=0)

    def ends_by(self, freedoms: slice) -> Array:
        """Derivatives (B, N, 4, d + n_b + n_a + n_axes + 6) of both ends, a before b, along m and
        along w.

        By the configuration's own unknowns, the parameters of b and of a, where joints have offset
        axes the six of both axes, and the station, whose
        (omega, tau) moves the ends by ``omega x (p - t) + tau``, with t the base's origin in the
        camera frame.
        """
        c, views, line = self.closure, self.blocks.views, self.lines
        rot, origin = self.T_camera_base[..., :3, :3], self.T_camera_base[..., :3, 3]
        turns = np.concatenate([rot, skew(origin)], axis=-1).take(views.station, axis=1)
        turned = self.frame[..., 1:, :] @ turns
        across, swung = turned[..., :3], turned[..., 3:]
        by_internal = c.platform.by_internal
        parts = (c.b_by_pose[..., freedoms], by_internal, c.b_by, c.a_by)
        every, limbs = _side_by_side(parts, c.rows.distance.shape), views.limbs(c.layout.n_legs)
        ends = across @ every.take(limbs, axis=1)
        of_b = ends.shape[-1] - c.a_by.shape[-1]
        n_axes = 6 if len(c.layout.offsets) else 0
        out = np.zeros((*ends.shape[:2], 4, ends.shape[-1] + n_axes + 6))
        out[..., 2:, :of_b] = ends[..., :of_b]
        out[..., :2, of_b : ends.shape[-1]] = ends[..., of_b:]
        if c.layout.windings:  # a moves on its pulley with b
            by_b = c.a_by_b.reshape(len(every), -1, 3, 3)
            out[..., :2, :of_b] = across @ (by_b @ every[..., :of_b]).take(limbs, axis=1)
        if n_axes:  # both ends move on their joints' second axes
            shifted = _shifts_by(c, every.reshape(*c.rows.distance.shape, 3, -1), of_b, freedoms)
            shifted = np.moveaxis(shifted, 3, 0).reshape(2, *every.shape[:2], 3, -1)
            for k, by in enumerate(shifted):
                out[..., 2 * k : 2 * k + 2, :-6] += across @ by.take(limbs, axis=1)
        nearest = line.distance[..., None] * line.u
        for k, place in ((0, line.before), (2, line.behind)):
            # with p = distance w + place u: omega x (p - t) along m is omega . (p x m + m x t)
            out[..., k, -6:-3] = place[..., None] * line.w - nearest + swung[..., 0, :]
            out[..., k + 1, -6:-3] = swung[..., 1, :] - place[..., None] * line.m
            out[..., k, -3:], out[..., k + 1, -3:] = line.m, line.w
        return out


def _shifts_by(c: Closure, every: Array, of_b: int, freedoms: slice) -> Array:
    """Derivatives (B, K, L, 2, 3, n + 6) of the vectors from A and B to the ends of the rods.

    every : (B, K, L, 3, n) derivatives of b in the first ``of_b`` columns, those of a in the
        others; the first columns are the pose's ``freedoms``.
    """
    leg, shifts = c.layout.offsets.leg, c.shifts
    own = every[..., leg, :, :]
    by_line = np.concatenate([own[..., :of_b], -own[..., of_b:]], axis=-1)
    axes = np.concatenate([shifts.by_base_axis, shifts.by_platform_axis], axis=-1)
    by = np.concatenate([shifts.by_line @ by_line[..., None, :, :], axes], axis=-1)
    turns = np.eye(3, 6)[:, freedoms]
    by[..., : turns.shape[1]] += shifts.by_turn @ turns
    out = np.zeros((*every.shape[:3], *by.shape[-3:]))
    out[..., leg, :, :, :] = by
    return out


def _side_by_side(parts: tuple[Array, ...], limbs: tuple[int, ...]) -> Array:
    """Derivatives (B, K, L, 3, n) of the limbs' ends, concatenated over groups of limbs, (B, K L,
    3, n).

    Leading axes broadcast. limbs : (B, K, L).
    """
    out = np.empty((*limbs, 3, sum(part.shape[-1] for part in parts)))
    first = 0
    for part in parts:
        out[..., first : first + part.shape[-1]] = part
        first += part.shape[-1]
    return out.reshape(limbs[0], limbs[1] * limbs[2], 3, first)


def rows_at_blocks(blocks: EdgeBlocks, rows: Array) -> Array:
    """Rows (B, N, n) of views at the positions of their blocks, (B, K, G, 2g); zero elsewhere."""
    views, (n_runs, n, _), each = blocks.views, rows.shape, 2 * blocks.side.shape[-1]
    if not n:
        return np.zeros((n_runs, *blocks.present.shape, each))
    of_blocks = rows.reshape(n_runs, views.place.size, each)
    return np.where(blocks.present[..., None], of_blocks.take(blocks.number, axis=1), 0.0)


def edge_rows(
    blocks: EdgeBlocks, data: ViewData, c: Closure, theta: Array, T_camera_base: Array
) -> EdgeRows:
    """Rows of the edges from the machine's closure (B, K), its parameters (B, P) and the stations
    (B, S, 4, 4).
    """
    views, limbs = blocks.views, c.rows.distance.shape
    both = np.empty((3, 2, *limbs))
    both[:, 0], both[:, 1] = (end.transpose(3, 0, 1, 2) for end in c.rods)
    both = both.reshape(3, 2, limbs[0], limbs[1] * limbs[2])
    ends = both.take(views.limbs(limbs[2]), axis=-1)
    moves = T_camera_base[..., :3, :].transpose(2, 3, 0, 1).take(views.station, axis=-1)
    ends = np.einsum("ij...,je...->ie...", moves[:, :3], ends) + moves[:, 3, None]
    lines = LineSilhouettes.between(*ends.transpose(1, 2, 3, 0))
    frame = np.empty((*lines.distance.shape, 3, 3))
    for k, axis in enumerate(lines[:3]):
        frame[..., k, :] = axis
    n_edges, n_rows = len(data.sign), data.sign.shape[-1]
    by_frame = np.empty((n_edges, 3, *lines.distance.shape, n_rows))
    np.matmul(frame, data.of_normals, out=by_frame.transpose(0, 2, 3, 1, 4))
    radius = np.repeat(theta.take(views.taken(blocks.radius), axis=-1), 2 * n_edges, axis=-1)
    distance = np.repeat(lines.distance, n_rows, axis=-1).reshape(radius.shape)
    planes = edge_planes(distance, radius, data.sign[:, None])
    return EdgeRows(blocks, data, c, T_camera_base, lines, frame, *planes, by_frame)
