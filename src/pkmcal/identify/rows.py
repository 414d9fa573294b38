"""Residuals of all that is measured and their exact Jacobians, in standard deviations.

Three kinds of rows, each in one place here:

- **edges** (:class:`EdgeRows`), two each: ``L^-1 (basis^T n_predicted + shift * s)`` with L the
  Cholesky factor of the edge's covariance. The measured normal is the true one moved by
  ``basis @ (shift * s)`` when all edge points lie s px outward, and ``basis^T n_measured = 0``;
  hence the plus sign.
- **closures** (:func:`by_noise`), one a limb: ``c / (|dc/dq| sigma_q)``, [B] eq. 4, [C] eq. 5
  whitened; what no reading enters (rods of constant length, joints' axes) is taken as perfect and
  held to :data:`PERFECT`.
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
from pkmcal.geometry.batches import NEXT
from pkmcal.geometry.cylinders import SIDE_SIGNS, SeenLines, edge_planes
from pkmcal.geometry.rigid import dot, inverse, pose_difference, skew
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import SHADING_SIGMA
from pkmcal.mechanisms.closure import Closure
from pkmcal.mechanisms.layout import LimbLayout

PERFECT = 1e-6
"""Standard deviation (m) of closures without a reading: joints and rods without play. A third of
a good encoder's noise, so nothing is lost, and not so sharp that digits are."""

Item = TypeVar("Item", covariant=True)
Scalar = TypeVar("Scalar", bound=np.generic)
Numbers = TypeVar("Numbers", "EdgeBlocks", "EdgeData", "PoseBlocks", "PoseData")


class Kinds(NamedTuple, Generic[Item]):
    """Something of each kind of measurement: of the edges, and of the boards' poses.

    An estimate weighs, counts and scales all kinds alike. Readings are none: no robust weight lets
    them go.
    """

    edges: Item
    poses: Item


@dataclass(frozen=True)
class Kind:
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


def _among(numbers: Numbers, configurations: slice, axis: int) -> Numbers:
    """All arrays of a dataclass cut along the configurations' axis; what is the same for all of
    them, a single one or none, stays.
    """
    cut = (slice(None),) * axis + (configurations,)
    found = ((f.name, getattr(numbers, f.name)) for f in fields(numbers))
    return replace(numbers, **{name: x[cut] for name, x in found if x.shape[axis] > 1})


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
    many of its line share an edge's own shading (:func:`~pkmcal.identify.assembly.crowd`), zero
    where nothing is shaded.
    """

    leg: Integers
    station: Integers
    camera: Integers
    radius: Integers
    side: Integers
    present: Booleans
    tube: Integers
    crowd: Array
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
        place = (configuration * self.present.shape[1] + number[order[first]])[None]
        place = np.repeat(place, int(slot.max(initial=-1)) + 1, axis=0)
        place[slot, view] = (keys[2] * self.present.shape[1]) + number[order]
        present = np.zeros(place.shape, dtype=bool)
        present[slot, view] = True
        camera = self.camera.ravel()[place[0]] if place.size else station
        return EdgeViews(configuration, leg, station, camera, place, present)


@dataclass(frozen=True)
class EdgeViews:
    """What is seen of one leg in one photograph, N times: up to m blocks, whose edges are those of
    one line. Views of one leg from one station stand side by side.

    configuration, leg, station, camera : (N,). place : (m, N) where each block is among those of
    all configurations, (K G). present : (m, N) False for padding, which has another block's place.
    """

    configuration: Integers
    leg: Integers
    station: Integers
    camera: Integers
    place: Integers
    present: Booleans

    def taken(self, numbers: NDArray[Scalar], axis: int = 0) -> NDArray[Scalar]:
        """Numbers of the blocks (..., K, G, ...) by view, (..., m, N, ...); axis : that of K."""
        shape = numbers.shape
        flat = numbers.reshape(*shape[:axis], shape[axis] * shape[axis + 1], *shape[axis + 2 :])
        return flat.take(self.place, axis=axis)

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
    """The edges' numbers by view, whitened and weighted, with the blocks (B or 1, m, N) last: NumPy
    then runs along rows of many views, and a number costs a nanosecond an operation.

    of_normals : (g, 3, 2g, ...) rows by changes of the normals, camera frame. by_optics : (w, 2g,
    ...) by the unknowns of their camera. by_breathing : (1, 2g, ...) by their station's focal
    breathing, none where nothing breathes. by_line : (2g, ...) by their line's shading, which moves
    them as the camera's shift moves all; edges that are their station's only one of a line have
    theirs among their noise. counts : (...) blocks that are there and have a weight. sign : (g, 1,
    m, N) of the edges' sides.
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
        split = white.reshape(*white.shape[:-1], white.shape[-1] // 2, 2)

        def rows(by_unknowns: Array) -> Array:
            return np.einsum("...rq,...qw->wr...", white, by_unknowns, order="C")

        by_optics = rows(views.taken(data.optics, 1))
        by_line, by_breathing = by_optics[0], by_optics[:0]
        if blocks.line.size:
            line, sigma = views.taken(blocks.line), data.shading
            own = sigma[:, line] if sigma.shape[1] > 1 else sigma[..., None]
            by_line = by_line * np.where(line < 0, 0.0, own)
        if breathe:
            by_breathing = rows(views.taken(data.breathing, 1))
        return cls(
            np.einsum("...rej,...eij->eir...", split, views.taken(data.basis, 1), order="C"),
            by_optics,
            by_breathing,
            by_line,
            counts,
            SIDE_SIGNS[np.moveaxis(views.taken(blocks.side), -1, 0)[:, None]],
        )


@dataclass(frozen=True)
class EdgeRows:
    """The edges' rows at a state, and how they answer to the two ends of their line; the ends
    answer to all else. Arrays have the views (B, N) last, or the blocks (B, m, N).

    rot_camera_base : (3, 3, ...) of the views' stations. ends : (2, 3, ...) base frame. lines : the
    same from the camera's centre. frame : (3, 3, ...) their u, m and w. sine (...) and cosine
    (g, ...) : of :func:`~pkmcal.geometry.cylinders.edge_planes`, NaN where a leg passes through the
    camera.
    by_frame : (3, g, 2g, ...) rows by changes of the normals along u, m and w.
    """

    blocks: EdgeBlocks
    data: ViewData
    closure: Closure
    rot_camera_base: Array
    ends: Array
    lines: SeenLines
    frame: Array
    sine: Array
    cosine: Array
    by_frame: Array

    def value(self, state: BatchState) -> Array:
        """Rows (2g, B, m, N), zero where they do not count, with the state's cameras, lines and
        focal lengths.
        """
        data, views = self.data, self.blocks.views
        _, along_m, along_w = self.by_frame
        rows = np.sum(self.cosine[:, None] * along_m - self.sine * along_w, axis=0)
        for by_unknown, unknown in zip(
            data.by_optics, state.optics.transpose(2, 0, 1), strict=True
        ):
            rows += by_unknown * unknown[:, None, views.camera]
        if state.shading.shape[-1]:
            rows += data.by_line * state.shading[:, views.taken(self.blocks.line)]
        if state.breathing.shape[-1]:
            rows += data.by_breathing[0] * state.breathing[:, None, views.station]
        return np.where(data.counts, rows, 0.0)

    @cached_property
    def _pulls(self) -> tuple[Array, Array, Array]:
        """Rows by n.a, by n.b and by the radius, (g, 2g, ...) each: all derivatives are multiples
        of these, see :meth:`~pkmcal.geometry.cylinders.SeenLines.edges`.
        """
        (along_u, along_m, along_w), line = self.by_frame, self.lines
        turn = along_w + (self.sine / self.cosine)[:, None] * along_m
        shift = along_u / line.length[:, None]
        turn = turn / line.distance[:, None]
        before, behind = (
            x[:, None] for x in (line.before / line.length, line.behind / line.length)
        )
        return shift - behind * turn, before * turn - shift, -turn

    def by_ends(self) -> Array:
        """By both ends in the base frame, a before b, (B, N, m, 2g, 6)."""
        _, m, w = self.frame
        normals = self.cosine[:, None] * m[:, :, None] - self.sine * w[:, :, None]
        n_rows, n_runs, n_blocks, n_views = self.by_frame.shape[2:]
        out = np.empty((n_runs, n_views, n_blocks, n_rows, 6))
        for k, pulls in enumerate(self._pulls[:2]):
            by_end = out.transpose(4, 3, 0, 2, 1)[3 * k : 3 * k + 3]
            np.multiply(pulls[0], normals[0, :, None], out=by_end)
            for pull, normal in zip(pulls[1:], normals[1:], strict=True):
                by_end += pull * normal[:, None]
        return out

    def by_radius(self) -> Array:
        """By their tube's radius, (2g, ...)."""
        return np.sum(self._pulls[2], axis=0)

    def ends_by(self, freedoms: slice) -> Array:
        """How both ends, a before b, answer in the base frame, (B, N, 6, d + n_a + n_b + 6): to the
        configuration's own unknowns, to the parameters of either end, and to their station, whose
        (omega, tau) acts as if it moved the ends p by ``R^T (omega x R p + tau)``.
        """
        c, views = self.closure, self.blocks.views
        own, by_internal = c.b_by_pose[..., freedoms], c.platform.by_internal
        if by_internal.shape[-1]:
            own = np.concatenate([own, by_internal], axis=-1)
        parts = (own, c.a_by, c.b_by)
        shape = np.broadcast_shapes(*(part.shape[:-2] for part in parts))
        widths = [part.shape[-1] for part in parts]
        legs = np.zeros((*shape, 6, sum(widths) + 6))
        first, second = widths[0], widths[0] + widths[1]
        legs[..., 3:, :first] = own
        legs[..., :3, first:second] = c.a_by
        legs[..., 3:, second:-6] = c.b_by
        n_runs, count, n_legs = shape
        flat = legs.reshape(n_runs, count * n_legs, *legs.shape[-2:])
        out = flat.take(views.configuration * n_legs + views.leg, axis=1)
        axes = self.rot_camera_base  # (camera's axis, base's component, ...)
        for k, end in enumerate(self.ends):
            rows = slice(3 * k, 3 * k + 3)
            out[..., rows, -3:] = axes.transpose(2, 3, 1, 0)
            for c, (i, j) in enumerate(NEXT):
                turned = axes[:, i] * end[j] - axes[:, j] * end[i]
                out[..., 3 * k + c, -6:-3] = turned.transpose(1, 2, 0)
        return out


def placed(blocks: EdgeBlocks, rows: Array) -> Array:
    """Rows (2g, B, m, N) of views at the places of their blocks, (B, K, G, 2g); zero elsewhere."""
    views, (count, each), n_runs = blocks.views, blocks.present.shape, rows.shape[1]
    out = np.zeros((n_runs, count * each + 1, len(rows)))
    out[:, np.where(views.present, views.place, -1)] = np.moveaxis(rows, 0, -1)
    return out[:, :-1].reshape(n_runs, count, each, len(rows))


def _components_first(array: Array, components: int) -> Array:
    return np.moveaxis(array, range(-components, 0), range(components))


def edge_rows(
    blocks: EdgeBlocks, data: ViewData, c: Closure, theta: Array, T_camera_base: Array
) -> EdgeRows:
    """Rows of the edges from the machine's closure (B, K), its parameters (B, P) and the stations
    (B, S, 4, 4).
    """
    views = blocks.views
    n_legs = c.layout.n_legs
    both = np.stack(np.broadcast_arrays(c.base.a, c.platform.b))
    both = np.ascontiguousarray(_components_first(both, 1)).reshape(3, 2, len(both[0]), -1)
    ends = both.take(views.configuration * n_legs + views.leg, axis=-1)
    rot = _components_first(T_camera_base[..., :3, :3], 2).take(views.station, axis=-1)
    centre = _components_first(inverse(T_camera_base)[..., :3, 3], 1).take(views.station, axis=-1)
    lines = SeenLines.between(*np.moveaxis(ends - centre[:, None], 0, -1))
    frame = np.stack([np.moveaxis(axis, -1, 0) for axis in lines[:3]])
    in_camera = np.einsum("ij...,fj...->fi...", rot, frame)
    radius = theta.take(views.taken(blocks.radius), axis=-1)
    return EdgeRows(
        blocks,
        data,
        c,
        rot,
        np.moveaxis(ends, 0, 1),
        lines,
        frame,
        *edge_planes(lines.distance[:, None], radius, data.sign),
        np.einsum("eir...,fi...->fer...", data.of_normals, in_camera[:, :, :, None]),
    )


def by_noise(layout: LimbLayout, joint_noise: Array, by_reading: Array, rows: Array) -> Array:
    """Rows (..., E, n) of the closure in standard deviations; the noise's own derivative is
    multiplied by c = 0.

    joint_noise : what by_reading (..., E) broadcasts with. Rods on one motor share its reading's
    noise: with slopes g of the motor's rows their covariance is ``sigma^2 g g^T + PERFECT^2``,
    whitened in closed form.
    """
    if not layout.shares_motors:
        return rows / closure_sigma(layout, joint_noise, by_reading)[..., None]
    for motor in range(layout.n_readings):
        slope = np.where(layout.row_motor == motor, by_reading, 0.0)
        size = np.sqrt(np.sum(slope**2, axis=-1, keepdims=True))
        unit = slope / np.where(size > 0, size, 1.0)
        less = 1 - PERFECT / np.hypot(PERFECT, joint_noise * size)
        rows = rows - (less * unit)[..., None] * (unit[..., None, :] @ rows)
    return rows / PERFECT


def closure_sigma(layout: LimbLayout, joint_noise: Array, by_reading: Array) -> Array:
    """Standard deviation (..., E) of each closure where every motor moves one rod.

    A crank in line with its rod does not move it, so no closure is sharper than a perfect one; a
    rod that is read always moves with its reading, whose noise is one of lengths: told by its
    scale, it would be the same but for a thousandth, and change with an unknown.
    """
    sigma = np.maximum(np.abs(by_reading) * joint_noise, PERFECT)
    sigma = np.where(layout.row_is_rod, joint_noise, sigma)
    return np.where(layout.row_motor >= 0, sigma, PERFECT)


def least_joint_noise(layout: LimbLayout, by_reading: Array) -> Array:
    """Noise of the readings (B,) below which no closure counts more, for slopes (B, K, E); 0 where
    a rod is read, whose closure is as sharp as its reading.
    """
    if layout.rod_reads[layout.closing].any() and not layout.shares_motors:
        return np.zeros(len(by_reading))
    steepest = np.abs(by_reading * (layout.row_motor >= 0)).max(axis=(1, 2))
    return PERFECT / np.maximum(steepest, PERFECT)


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
