"""Residuals of all that is measured and their exact Jacobians, in standard deviations.

Three kinds of rows, each in one place here:

- **edges** (:class:`EdgeRows`), two each: ``L^-1 (basis^T n_predicted + shift * s)`` with L the
  Cholesky factor of the edge's covariance. The measured normal is the true one moved by
  ``basis @ (shift * s)`` when all edge points lie s px outward, and ``basis^T n_measured = 0``;
  hence the plus sign.
- **closures** (:func:`by_noise`), one a limb: ``c / (|dc/dq| sigma_q)``, [B] eq. 4, [C] eq. 5
  whitened; what no reading enters (rods of constant length, joints' axes) is taken as perfect and
  held to :data:`PERFECT_CLOSURE_SIGMA`.
- **poses** of boards (:func:`pose_rows`), six each: predicted as
  ``T_camera_base T_base_platform T_platform_board``, or ``T_camera_base T_base_board`` for a board
  fixed to the base ([A] 3.3). The error is the left perturbation (omega, tau) that leads from the
  measured pose to the predicted one, whitened by the measurement's own noise.

Measurements stand in K configurations of G places each, padded to a common count.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.cylinders import SIDE_SIGNS, SeenLines, edge_planes
from pkmcal.geometry.rigid import dot, pose_difference, skew
from pkmcal.identify.line_cells import LineCells
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import SHADING_SIGMA
from pkmcal.mechanisms.closure import Closure
from pkmcal.mechanisms.layout import LimbLayout

PERFECT_CLOSURE_SIGMA = 1e-6
"""Standard deviation (m) of closures without a reading: joints and rods without play. A third of
a good encoder's noise, so nothing is lost, and not so sharp that digits are."""

Item = TypeVar("Item", covariant=True)
Scalar = TypeVar("Scalar", bound=np.generic)
BlockNumbers = TypeVar("BlockNumbers", "EdgeBlocks", "EdgeData", "PoseBlocks", "PoseData")


class Kinds(NamedTuple, Generic[Item]):
    """Something of each sort of rows: of the edges, of the poses of boards and targets, and of what
    links configurations.

    An estimate weighs, counts and scales all kinds alike. Readings are none: no robust weight lets
    them go.
    """

    edges: Item
    poses: Item
    links: Item


@dataclass(frozen=True)
class MeasurementKind:
    """One kind of measurement in a problem.

    rows : those of a configuration that are its. present : (K, G) False for padding. weight :
    (B or 1, K, G). whiten : (B or 1, K, G, n, n).
    """

    rows: slice
    present: Booleans
    weight: Array
    whiten: Array

    @property
    def count(self) -> Integers:
        """Residuals of each measurement, (K, G): a board's pose has six, a point's three of them,
        padding none.
        """
        return np.any(self.whiten[0] != 0, axis=-1).sum(axis=-1)


def _among(numbers: BlockNumbers, configurations: slice, axis: int) -> BlockNumbers:
    """All arrays of a dataclass cut along the configurations' axis; what is the same for all of
    them, a single one or none, stays.
    """
    cut = (slice(None),) * axis + (configurations,)
    found = ((f.name, getattr(numbers, f.name)) for f in fields(numbers))
    arrays = ((name, x) for name, x in found if isinstance(x, np.ndarray))
    return replace(numbers, **{name: x[cut] for name, x in arrays if x.shape[axis] > 1})


@dataclass(frozen=True)
class EdgeBlocks:
    """Where the edges are: K configurations of G blocks, padded; the same for all runs. A leg has
    as many places as every other, side by side, in all configurations.

    Edges that share their noise are whitened together: a *block* is g edges (g = 1 for edges
    fitted in photographs, g = 2 for the two edges that stand for a measured axis, [A] Table 1)
    of one tube at one station, with one 2g x 2g whitening matrix and one robust weight.

    leg : (1, G). station, camera, radius : (K, G) station, camera, position of the tube's radius.
    side : (K, G, g). present : (K, G) False for padding. line : (K, G) number of the tube's side at
    its station, whose edges are shaded alike in all photographs, -1 where there is one edge alone;
    empty where nothing is shaded. tube : (K, G) number of the tube on its leg. crowd : (K, G) how
    many of its line share an edge's own shading, see :mod:`~pkmcal.identify.line_cells`, zero where
    nothing is shaded. cell : (K, G) which of the ``cells`` each is in, -1 for none.
    """

    leg: Integers
    station: Integers
    camera: Integers
    radius: Integers
    side: Integers
    present: Booleans
    tube: Integers
    crowd: Array
    cell: Integers
    cells: LineCells
    line: Integers = field(default_factory=lambda: np.zeros((0, 0), dtype=int))

    def among(self, configurations: slice) -> EdgeBlocks:
        """Those of some configurations."""
        return _among(self, configurations, 0)

    @cached_property
    def views(self) -> EdgeViews:
        """The same by views, padding left out."""
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
        camera = self.camera.ravel()[place[:, 0]] if place.size else station
        return EdgeViews(configuration, leg, station, camera, place, present)

    @cached_property
    def number(self) -> Integers:
        """(K, G) which each is of the views' blocks, (N m); any for padding."""
        views, out = self.views, np.zeros(self.present.size, dtype=int)
        out[views.place[views.present]] = np.flatnonzero(views.present)
        return out.reshape(self.present.shape)


@dataclass(frozen=True)
class EdgeViews:
    """What is seen of one leg in one photograph, N times: up to m blocks, whose edges are those of
    one line. Views of one leg from one station stand side by side.

    configuration, leg, station, camera : (N,). place : (N, m) where each block is among those of
    all configurations, (K G). present : (N, m) False for padding, which has another block's place.
    """

    configuration: Integers
    leg: Integers
    station: Integers
    camera: Integers
    place: Integers
    present: Booleans

    def taken(self, numbers: NDArray[Scalar], axis: int = 0) -> NDArray[Scalar]:
        """Numbers of the blocks (..., K, G, ...) by view, (..., N, m, ...); axis : that of K."""
        shape = numbers.shape
        flat = numbers.reshape(*shape[:axis], shape[axis] * shape[axis + 1], *shape[axis + 2 :])
        return flat.take(self.place, axis=axis)

    def limbs(self, n_legs: int) -> Integers:
        """Which each one's limb is, of those of all configurations, (K L)."""
        return self.configuration * n_legs + self.leg

    @cached_property
    def groups(self) -> list[slice]:
        """Views of one leg from one station."""
        changes = (np.diff(self.leg) != 0) | (np.diff(self.station) != 0)
        cuts = [0, *(np.flatnonzero(changes) + 1).tolist(), len(self.leg)]
        return [slice(*cut) for cut in pairwise(cuts) if cut[0] < cut[1]]


@dataclass(frozen=True)
class EdgeData:
    """Numbers measured in each run; leading axis B, or 1 where all runs share them.

    basis : (B, K, G, g, 3, 2). white : (B, K, G, 2g, 2g) whitening of each block's noise as it was
    stated, shading left out. optics : (B, K, G, 2g, w) change of
    the measured normals, less the predicted ones', by the w unknowns of their camera: the edge
    shift (px), then its intrinsics where they are refined (in units of their prior).
    joints : (B, K, m). weight : (B, K, G) of the blocks, 0..1 over the noise scale squared.
    shading : (B, n) px by which one unit of each line's shading moves its edges, its standard
    deviation; n = 1 where all have the same. breathing : (B, K, G, 2g, 1) the same change as optics
    by a unit of their station's focal breathing; zero numbers where nothing breathes. scale :
    (B, K, G) factor on the stated noise. own : (B, K, G) px, standard deviation of the shading of
    each edge beside its line's, that of all who share it counted.
    """

    basis: Array
    white: Array
    optics: Array
    joints: Array
    weight: Array
    shading: Array = field(default_factory=lambda: np.full((1, 1), SHADING_SIGMA))
    breathing: Array = field(default_factory=lambda: np.zeros((1, 1, 1, 1, 1)))
    scale: Array = field(default_factory=lambda: np.ones((1, 1, 1)))
    own: Array = field(default_factory=lambda: np.zeros((1, 1, 1)))

    def among(self, configurations: slice) -> EdgeData:
        """Those of some configurations."""
        return replace(_among(self, configurations, 1), shading=self.shading)

    @cached_property
    def by_shift(self) -> Array:
        """Rows by a pixel of shift, in the noise as it was stated, (B or 1, K, G, 2g)."""
        return (self.white @ self.optics[..., :1])[..., 0]

    @cached_property
    def whiten(self) -> Array:
        """The whitening, (B or 1, K, G, 2g, 2g), with the noise's scale and the edges' own shading:
        in the stated noise's units the covariance is ``scale^2 + own^2 v v^T``, v the
        :attr:`by_shift`, and its inverse root turns only what lies along v.
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
    """The edges' numbers by view, whitened and weighted: of each view (B or 1, N) its n rows, which
    are 2g of each of its m blocks. With the rows last NumPy runs along those of all views, and a
    number costs a nanosecond an operation.

    of_normals : (g, ..., 3, n) rows by changes of the normals, camera frame. by_optics : (w, ...,
    n) by the unknowns of their camera. by_breathing : (1, ..., n) by their station's focal
    breathing, none where nothing breathes. by_line : (..., n) by their line's shading, which moves
    them as the camera's shift moves all; edges that are their station's only one of a line have
    theirs among their noise. counts : (..., n) whether the block is there and has a weight. sign :
    (g, N, n) of the edges' sides.
    """

    of_normals: Array
    by_optics: Array
    by_breathing: Array
    by_line: Array
    counts: Booleans
    sign: Array

    @classmethod
    def of(cls, blocks: EdgeBlocks, data: EdgeData, *, breathe: bool) -> ViewData:
        """The numbers of all edges that are there; breathe : whether focal lengths do."""
        views = blocks.views
        counts = (views.taken(data.weight, 1) > 0) & views.present
        white = np.where(counts[..., None, None], views.taken(data.weighed, 1), 0.0)
        each = white.shape[-1]
        split = white.reshape(*white.shape[:-1], each // 2, 2)

        def by_row(numbers: Array) -> Array:
            """Numbers (..., m, 2g) of blocks."""
            return numbers.reshape(*numbers.shape[:-2], numbers.shape[-2] * each)

        def rows(by_unknowns: Array) -> Array:
            return by_row(np.einsum("...krq,...kqw->w...kr", white, by_unknowns, order="C"))

        by_optics = rows(views.taken(data.optics, 1))
        by_line, by_breathing = by_optics[0], by_optics[:0]
        if blocks.line.size:
            line, sigma = views.taken(blocks.line), data.shading
            own = sigma[:, line] if sigma.shape[1] > 1 else sigma[..., None]
            by_line = by_line * np.repeat(np.where(line < 0, 0.0, own), each, axis=-1)
        if breathe:
            by_breathing = rows(views.taken(data.breathing, 1))
        of_normals = split.swapaxes(-3, -2) @ views.taken(data.basis, 1).mT  # (..., m, g, 2g, 3)
        side = np.moveaxis(views.taken(blocks.side), -1, 0)
        return cls(
            by_row(np.moveaxis(of_normals, (-3, -1), (0, -3))),
            by_optics,
            by_breathing,
            by_line,
            np.repeat(counts, each, axis=-1),
            np.repeat(SIDE_SIGNS[side], each, axis=-1),
        )


@dataclass(frozen=True)
class EdgeRows:
    """The edges' rows at a state, and how they answer to the two ends of their line; the ends
    answer to all else. Arrays have the views (B, N), or their rows (B, N, n), last.

    T_camera_base : (B, S, 4, 4). lines : camera frame. frame : (B, N, 3, 3) their u, m and w.
    sine (...) and cosine (g, ...) : of :func:`~pkmcal.geometry.cylinders.edge_planes`, NaN where a
    leg passes through the camera. by_frame : (g, 3, ...) rows by changes of the normals along u, m
    and w.
    """

    blocks: EdgeBlocks
    data: ViewData
    closure: Closure
    T_camera_base: Array
    lines: SeenLines
    frame: Array
    sine: Array
    cosine: Array
    by_frame: Array

    def value(self, state: BatchState) -> Array:
        """Rows (B, N, n), zero where they do not count, with the state's cameras, lines and focal
        lengths.
        """
        data, views = self.data, self.blocks.views
        (_, along_m, along_w), *others = self.by_frame
        rows = self.cosine[0] * along_m - self.sine * along_w
        for cosine, (_, along_m, along_w) in zip(self.cosine[1:], others, strict=True):
            rows += cosine * along_m - self.sine * along_w
        for by_unknown, unknown in zip(
            data.by_optics, state.optics.transpose(2, 0, 1), strict=True
        ):
            rows += by_unknown * unknown[:, views.camera, None]
        if state.shading.shape[-1]:
            shift = state.shading[:, views.taken(self.blocks.line)]
            rows += data.by_line * self._of_blocks(shift)
        if state.breathing.shape[-1]:
            rows += data.by_breathing[0] * state.breathing[:, views.station, None]
        return np.where(data.counts, rows, 0.0)

    def _of_blocks(self, numbers: Array) -> Array:
        """Numbers of blocks (..., m) for each of their rows, (..., n)."""
        return np.repeat(numbers, 2 * len(self.cosine), axis=-1)

    def _of_views(self, numbers: Array) -> Array:
        """Numbers of views (...) for each of their rows, (..., n)."""
        n_rows = self.sine.shape[-1]
        return np.repeat(numbers, n_rows, axis=-1).reshape(*numbers.shape, n_rows)

    @cached_property
    def _turns(self) -> Array:
        """Rows by a shift of the whole line towards the camera, (g, ...): as much as by the radius;
        see :meth:`~pkmcal.geometry.cylinders.SeenLines.edges`.
        """
        along_m, along_w = self.by_frame[:, 1], self.by_frame[:, 2]
        turn = along_w + (self.sine / self.cosine) * along_m
        return turn / self._of_views(self.lines.distance)

    def by_ends(self) -> Array:
        """By what both ends do along m and along w, a before b, (4, B, N, n): nothing that they do
        along u is seen, and all derivatives are multiples of these.
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
        """By their tube's radius, (B, N, n)."""
        return -np.sum(self._turns, axis=0)

    def ends_by(self, freedoms: slice) -> Array:
        """How both ends, a before b, answer along m and along w, (B, N, 4, d + n_b + n_a + 6): to
        the configuration's own unknowns, to the parameters of b and of a, and to their station,
        whose (omega, tau) moves them by ``omega x (p - t) + tau``, with t the base's origin, camera
        frame.
        """
        c, views, line = self.closure, self.blocks.views, self.lines
        rot, origin = self.T_camera_base[..., :3, :3], self.T_camera_base[..., :3, 3]
        turns = np.concatenate([rot, skew(origin)], axis=-1).take(views.station, axis=1)
        turned = self.frame[..., 1:, :] @ turns
        across, swung = turned[..., :3], turned[..., 3:]
        by_internal = c.platform.by_internal
        parts = (c.b_by_pose[..., freedoms], by_internal, c.b_by, c.a_by)
        ends = across @ _side_by_side(parts, c.rows.distance.shape).take(
            views.limbs(c.layout.n_legs), axis=1
        )
        of_b = ends.shape[-1] - c.a_by.shape[-1]
        out = np.zeros((*ends.shape[:2], 4, ends.shape[-1] + 6))
        out[..., 2:, :of_b] = ends[..., :of_b]
        out[..., :2, of_b:-6] = ends[..., of_b:]
        nearest = line.distance[..., None] * line.u
        for k, place in ((0, line.before), (2, line.behind)):
            # with p = distance w + place u: omega x (p - t) along m is omega . (p x m + m x t)
            out[..., k, -6:-3] = place[..., None] * line.w - nearest + swung[..., 0, :]
            out[..., k + 1, -6:-3] = swung[..., 1, :] - place[..., None] * line.m
            out[..., k, -3:], out[..., k + 1, -3:] = line.m, line.w
        return out


def _side_by_side(parts: tuple[Array, ...], limbs: tuple[int, ...]) -> Array:
    """Derivatives (B, K, L, 3, n) of the limbs' ends, the limbs one after the other, (B, K L, 3,
    n); leading axes broadcast. limbs : (B, K, L).
    """
    out = np.empty((*limbs, 3, sum(part.shape[-1] for part in parts)))
    first = 0
    for part in parts:
        out[..., first : first + part.shape[-1]] = part
        first += part.shape[-1]
    return out.reshape(limbs[0], limbs[1] * limbs[2], 3, first)


def rows_at_blocks(blocks: EdgeBlocks, rows: Array) -> Array:
    """Rows (B, N, n) of views at the places of their blocks, (B, K, G, 2g); zero elsewhere."""
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
    both[:, 0], both[:, 1] = (end.transpose(3, 0, 1, 2) for end in (c.base.a, c.platform.b))
    both = both.reshape(3, 2, limbs[0], limbs[1] * limbs[2])
    ends = both.take(views.limbs(limbs[2]), axis=-1)
    moves = T_camera_base[..., :3, :].transpose(2, 3, 0, 1).take(views.station, axis=-1)
    ends = np.einsum("ij...,je...->ie...", moves[:, :3], ends) + moves[:, 3, None]
    lines = SeenLines.between(*ends.transpose(1, 2, 3, 0))
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


def by_noise(layout: LimbLayout, joint_noise: Array, by_reading: Array, rows: Array) -> Array:
    """Rows (..., E, n) of the closure in standard deviations; the noise's own derivative is
    multiplied by c = 0.

    joint_noise : what by_reading (..., E) broadcasts with. Rods on one motor share its reading's
    noise: with slopes g of the motor's rows their covariance is ``sigma^2 g g^T +
    PERFECT_CLOSURE_SIGMA^2``, whitened in closed form.
    """
    if not layout.shares_motors:
        return rows / closure_sigma(layout, joint_noise, by_reading)[..., None]
    for motor in range(layout.n_readings):
        slope = np.where(layout.row_motor == motor, by_reading, 0.0)
        size = np.sqrt(np.sum(slope**2, axis=-1, keepdims=True))
        unit = slope / np.where(size > 0, size, 1.0)
        less = 1 - PERFECT_CLOSURE_SIGMA / np.hypot(PERFECT_CLOSURE_SIGMA, joint_noise * size)
        rows = rows - (less * unit)[..., None] * (unit[..., None, :] @ rows)
    return rows / PERFECT_CLOSURE_SIGMA


def closure_sigma(layout: LimbLayout, joint_noise: Array, by_reading: Array) -> Array:
    """Standard deviation (..., E) of each closure where every motor moves one rod.

    A crank in line with its rod does not move it, so no closure is sharper than a perfect one; a
    rod that is read always moves with its reading, whose noise is one of lengths: told by its
    scale, it would be the same but for a thousandth, and change with an unknown.
    """
    if layout.reads_lengths:
        return np.where(layout.row_motor >= 0, joint_noise, PERFECT_CLOSURE_SIGMA)
    sigma = np.maximum(np.abs(by_reading) * joint_noise, PERFECT_CLOSURE_SIGMA)
    sigma = np.where(layout.row_is_rod, joint_noise, sigma)
    return np.where(layout.row_motor >= 0, sigma, PERFECT_CLOSURE_SIGMA)


def least_joint_noise(layout: LimbLayout, by_reading: Array) -> Array:
    """Noise of the readings (B,) below which no closure counts more, for slopes (B, K, E); 0 where
    a rod is read, whose closure is as sharp as its reading.
    """
    if layout.rod_reads[layout.closing].any() and not layout.shares_motors:
        return np.zeros(len(by_reading))
    steepest = np.abs(by_reading * (layout.row_motor >= 0)).max(axis=(1, 2))
    return PERFECT_CLOSURE_SIGMA / np.maximum(steepest, PERFECT_CLOSURE_SIGMA)


def joint_rows(layout: LimbLayout, by_reading: Array, rows: Array) -> Array:
    """Whitened closure rows (..., E) as one a reading, (..., m)."""
    if not layout.shares_motors:
        driven = layout.driven_rows
        order = np.argsort(layout.row_motor[driven], kind="stable")
        return rows[..., driven[order]]
    slope = by_reading[..., None] * layout.of_motor
    size = np.sqrt(np.sum(slope**2, axis=-2, keepdims=True))
    unit = slope / np.where(size > 0, size, 1.0)
    return (unit.mT @ rows[..., None])[..., 0]


@dataclass(frozen=True)
class PoseBlocks:
    """Where the poses are: K configurations of G poses, padded; the same for all runs.

    station, mount, camera : (K, G). present : (K, G) False for padding. on_platform : (M,) of the
    mounts. tolerance : (M,) of the sizes of boards, relative; those that have one are unknowns, in
    their order.
    """

    station: Integers
    mount: Integers
    present: Booleans
    on_platform: Booleans
    camera: Integers
    tolerance: Array

    @property
    def size(self) -> Integers:
        """(M,) number of each mount's size among those that are unknown; -1 for an exact one."""
        unsure = self.tolerance > 0
        return np.where(unsure, np.cumsum(unsure) - 1, -1)

    def among(self, configurations: slice) -> PoseBlocks:
        """Those of some configurations."""
        whole = _among(self, configurations, 0)
        return replace(whole, on_platform=self.on_platform, tolerance=self.tolerance)


@dataclass(frozen=True)
class PoseData:
    """Numbers measured in each run; leading axis B, or 1 where all runs share them.

    T_station_target : (B, K, G, 4, 4). whiten : (B, K, G, 6, 6). weight : (B, K, G). optics :
    (B, K, G, 6, w) change of the error by the w unknowns of their camera, as the edges'.
    breathing : (B, K, G, 6, 1) by their station's focal breathing.
    """

    T_station_target: Array
    whiten: Array
    weight: Array
    optics: Array
    breathing: Array = field(default_factory=lambda: np.zeros((1, 1, 1, 6, 0)))

    def among(self, configurations: slice) -> PoseData:
        """Those of some configurations."""
        return _among(self, configurations, 1)


class PoseRows(NamedTuple):
    """Rows (B, K, G, 6) and their derivatives, (B, K, G, 6, 6) each: by their station, by the
    platform's pose and by their mount; by their camera's unknowns (B, K, G, 6, w), by their
    station's focal breathing and by their board's size (B, K, G, 6, 1).
    """

    value: Array
    by_station: Array
    by_platform: Array
    by_mount: Array
    by_optics: Array
    by_breathing: Array
    by_size: Array


def pose_rows(
    blocks: PoseBlocks,
    data: PoseData,
    T_camera_base: Array,
    poses: Array,
    T_mount: Array,
    optics: Array,
    breathing: Array,
    sizes: Array,
) -> PoseRows:
    """Whitened errors of the predicted poses.

    T_camera_base (B, S, 4, 4), poses T_base_platform (B, K, 4, 4), T_mount (B, M, 4, 4), optics
    (B, C, w), breathing (B, S) or (B, 0), sizes (B, n). A board that is larger by a share s stands
    farther from the camera by the same share.
    """
    if not blocks.present.size:
        none = np.zeros((*poses.shape[:2], 0, 6, 6))
        optics = np.zeros((*none.shape[:-1], optics.shape[-1]))
        return PoseRows(none[..., 0], none, none, none, optics, none[..., :1], none[..., :1])
    moving = blocks.on_platform[blocks.mount][..., None, None]
    camera = T_camera_base[:, blocks.station]
    body = np.where(moving, poses[:, :, None], np.eye(4))
    mount = T_mount[:, blocks.mount]
    rot_c, rot_b = camera[..., :3, :3], body[..., :3, :3]
    arm = rot_b @ mount[..., :3, 3:]
    place = rot_c @ (arm + body[..., :3, 3:])
    predicted = camera @ body @ mount
    error = pose_difference(predicted, data.T_station_target)
    weigh = np.sqrt(data.weight)[..., None, None] * data.whiten
    turn = turn_jacobian(error[..., :3])

    def rows(by_turn: Array, by_shift_turn: Array, by_shift: Array) -> Array:
        """Derivative by (omega, tau) from those of the pose's turn and place."""
        out = np.zeros((*np.broadcast_shapes(by_turn.shape, place.shape)[:-2], 6, 6))
        out[..., :3, :3], out[..., 3:, :3] = turn @ by_turn, by_shift_turn
        out[..., 3:, 3:] = by_shift
        return weigh @ out

    eye, by_optics, by_breathing = np.eye(3), weigh @ data.optics, weigh @ data.breathing
    value = (weigh @ error[..., None] + by_optics @ optics[:, blocks.camera, :, None])[..., 0]
    if breathing.shape[-1]:
        value = value + by_breathing[..., 0] * breathing[:, blocks.station, None]
    away = -blocks.tolerance[blocks.mount][..., None] * data.T_station_target[..., :3, 3]
    by_size = weigh @ np.concatenate([np.zeros_like(away), away], axis=-1)[..., None]
    if sizes.shape[-1]:
        value = value + by_size[..., 0] * sizes[:, blocks.size[blocks.mount], None]
    return PoseRows(
        value,
        rows(eye, -skew(place[..., 0]), eye),
        np.where(moving, rows(rot_c, -rot_c @ skew(arm[..., 0]), rot_c), 0.0),
        rows(rot_c @ rot_b, np.zeros((3, 3)), rot_c @ rot_b),
        by_optics,
        by_breathing,
        by_size,
    )


def turn_jacobian(phi: Array) -> Array:
    """Change of a rotation vector (..., 3) by a further turn from the left, (..., 3, 3).

    The inverse left Jacobian of SO(3), with its series near zero.
    """
    angle2 = dot(phi, phi)[..., None, None]
    small = angle2 < 1e-6
    angle = np.sqrt(np.where(small, 1.0, angle2))
    exact = (1 - 0.5 * angle * np.cos(angle / 2) / np.sin(angle / 2)) / np.where(small, 1, angle2)
    k = skew(phi)
    return np.eye(3) - 0.5 * k + np.where(small, 1 / 12 + angle2 / 720, exact) * (k @ k)
