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
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.batches import NEXT
from pkmcal.geometry.cylinders import EdgeNormals, edge_normal_jacobians
from pkmcal.geometry.rigid import cross, dot, pose_difference, skew
from pkmcal.identify.unknowns import BatchState
from pkmcal.measurements import SHADING_SIGMA
from pkmcal.mechanisms.closure import Closure
from pkmcal.mechanisms.layout import LimbLayout

PERFECT = 1e-6
"""Standard deviation (m) of closures without a reading: joints and rods without play. A third of
a good encoder's noise, so nothing is lost, and not so sharp that digits are."""

Item = TypeVar("Item", covariant=True)
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
    as many places as every other, side by side, in all configurations: its rows have the same
    parameters, see :class:`pkmcal.solver.Compact`.

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

    @cached_property
    def by_optics(self) -> Array:
        """Rows by the unknowns of their camera, (B or 1, K, G, 2g, w)."""
        return self.weighed @ self.optics

    @cached_property
    def by_breathing(self) -> Array:
        """Rows by their station's focal breathing, (B or 1, K, G, 2g, 1)."""
        return self.weighed @ self.breathing

    @cached_property
    def of_normals(self) -> Array:
        """Rows by changes of the normals, whitening and weights included, (g, 3, 2g, ...) with
        the blocks (B or 1, K, G) last.
        """
        shape = self.weighed.shape
        split = self.weighed.reshape(*shape[:-1], shape[-1] // 2, 2)
        return np.einsum("...rej,...eij->eir...", split, self.basis, order="C")


@dataclass(frozen=True)
class EdgeRows:
    """The edges' rows at a state, and how they answer to what they depend on.

    In the arrays here the blocks (B, K, G) stand last and vectors' components before them: NumPy
    then runs along rows of many blocks, and a block costs a few nanoseconds an operation.

    T_camera_base : (3, 4, ...) of each block's station. a, b : (3, ...) both ends of their limbs
    in the camera frame. normals : predicted there, [B] eq. 3, (g, 3, ...) each.
    """

    blocks: EdgeBlocks
    data: EdgeData
    closure: Closure
    T_camera_base: Array
    a: Array
    b: Array
    normals: EdgeNormals

    def value(self, state: BatchState) -> Array:
        """Rows (B, K, G, 2g), zero where they do not count, with the state's cameras, lines and
        focal lengths.
        """
        optics, shading, breathing = state.optics, state.shading, state.breathing
        rows = np.moveaxis(self._whitened(self.normals.n), 0, -1)
        rows = rows + (self.by_optics @ optics[:, self.blocks.camera, :, None])[..., 0]
        if shading.shape[-1]:
            rows = rows + self.by_line[..., 0] * shading[:, self.blocks.line, None]
        if breathing.shape[-1]:
            rows = rows + self.by_breathing[..., 0] * breathing[:, self.blocks.station, None]
        return np.where((self.data.weight == 0)[..., None], 0.0, rows)

    @property
    def by_optics(self) -> Array:
        """By their camera's unknowns, (B or 1, K, G, 2g, w)."""
        return self.data.by_optics

    @property
    def by_line(self) -> Array:
        """By their line's shading, which moves them as the camera's shift moves all, (..., 1);
        edges that are their station's only one of a line have theirs among their noise.
        """
        sigma = self.data.shading
        own = sigma[:, self.blocks.line] if sigma.shape[1] > 1 else sigma[:, :, None]
        own = np.where(self.blocks.line < 0, 0.0, own)
        return self.by_optics[..., :1] * own[..., None, None]

    @property
    def by_breathing(self) -> Array:
        """By their station's focal breathing, (B or 1, K, G, 2g, 1)."""
        return self.data.by_breathing

    @property
    def lost(self) -> Booleans:
        """Where derivatives are not finite, (...)."""
        return ~np.isfinite(np.sum(self._pulls[0] + self._pulls[1], axis=(0, 1)))

    @property
    def by_machine(self) -> tuple[Array, Array, Array]:
        """By the parameters of both ends and by the radius, (n, 2g, ...) each."""
        c = self.closure
        radius = np.sum(self._pulls[0] + self._pulls[1], axis=0)[None]
        return self._by_a(self._along(c.a_by)), self._by_b(self._along(c.b_by)), radius

    @property
    def by_station(self) -> Array:
        """By their station's (omega, tau), (6, 2g, ...): both ends turn about its origin and go
        with it, which moves n.p by ``omega . (arm x n) + tau . n``.
        """
        n, origin = self.normals.n, self.T_camera_base[:, 3]
        arm, of_b = (
            np.einsum("er...,j...->jer...", pull, end - origin)
            for pull, end in zip(self._pulls, (self.a, self.b), strict=True)
        )
        arm += of_b
        out = np.empty((6, arm.shape[2], *n.shape[2:]))
        for k, (i, j) in enumerate(NEXT):
            np.einsum("er...,e...->r...", arm[i], n[:, j], out=out[k])
            out[k] -= np.einsum("er...,e...->r...", arm[j], n[:, i])
        np.einsum("er...,ec...->cr...", self._pulls[0] + self._pulls[1], n, out=out[3:])
        return out

    def by_own(self, freedoms: slice) -> Array:
        """By the configuration's own unknowns (d, 2g, ...): the platform's freedoms of its six, and
        what is internal.
        """
        platform = self.closure.platform
        arm = _of_legs(platform.arm, 1, self.blocks)
        by = np.concatenate([_moments(arm, self._n_base), self._n_base], axis=1)[:, freedoms]
        if platform.by_internal.shape[-1]:
            by = np.concatenate([by, self._along(platform.by_internal)], axis=1)
        return self._by_b(by)

    @cached_property
    def _n_base(self) -> Array:
        """The normals in the base frame, (g, 3, ...)."""
        return np.einsum("ij...,ei...->ej...", self.T_camera_base[:, :3], self.normals.n)

    def _along(self, by: Array) -> Array:
        """Derivatives of the limbs' ends (B, K, L, 3, n), along the blocks' normals (g, n, ...)."""
        own = _of_legs(by, 2, self.blocks)
        return np.einsum("ej...,jc...->ec...", self._n_base, own)

    @cached_property
    def _pulls(self) -> tuple[Array, Array]:
        """Rows by n.a and by n.b, (g, 2g, ...) each: all derivatives are multiples of these."""
        return self._whitened_each(self.normals.by_a), self._whitened_each(self.normals.by_b)

    def _by_a(self, along: Array) -> Array:
        """Rows (n, 2g, ...) from changes of n.a (g, n, ...)."""
        return np.einsum("er...,ec...->cr...", self._pulls[0], along)

    def _by_b(self, along: Array) -> Array:
        """Rows (n, 2g, ...) from changes of n.b (g, n, ...)."""
        return np.einsum("er...,ec...->cr...", self._pulls[1], along)

    def _whitened(self, vectors: Array) -> Array:
        """basis^T v, whitened and weighted: (g, 3, ...) -> (2g, ...)."""
        return np.einsum("eir...,ei...->r...", self.data.of_normals, vectors)

    def _whitened_each(self, vectors: Array) -> Array:
        """The same of each edge's vector alone, (g, 2g, ...)."""
        return np.einsum("eir...,ei...->er...", self.data.of_normals, vectors)


def _of_legs(array: Array, components: int, blocks: EdgeBlocks) -> Array:
    """Vectors or matrices of all legs (B, K, L, c) for the blocks' legs, (c, B, K, G)."""
    return np.take(_components_first(array, components), blocks.leg[0], axis=-1)


def _of_stations(array: Array, components: int, blocks: EdgeBlocks) -> Array:
    """The same of all stations (B, S, c)."""
    return np.take(_components_first(array, components), blocks.station, axis=-1)


def _components_first(array: Array, components: int) -> Array:
    return np.moveaxis(array, range(-components, 0), range(components))


def _moments(arm: Array, n: Array) -> Array:
    """Moments ``arm x n`` of arms (3, ...) and the blocks' normals (g, 3, ...)."""
    return np.moveaxis(cross(np.moveaxis(arm, 0, -1), np.moveaxis(n, 1, -1)), -1, 1)


def edge_rows(
    blocks: EdgeBlocks, data: EdgeData, c: Closure, radius: Array, T_camera_base: Array
) -> EdgeRows:
    """Rows of the edges from the machine's closure (B, K), the blocks' radii (B, K, G) and the
    stations (B, S, 4, 4).
    """
    ends = np.broadcast_arrays(c.base.a, c.platform.b)
    station = _of_stations(T_camera_base[..., :3, :], 2, blocks)
    a, b = (
        np.einsum("ij...,j...->i...", station[:, :3], _of_legs(end, 1, blocks)) + station[:, 3]
        for end in ends
    )
    side = np.moveaxis(blocks.side, -1, 0)[:, None]
    found = edge_normal_jacobians(np.moveaxis(a, 0, -1), np.moveaxis(b, 0, -1), radius, side)
    normals = EdgeNormals(*(np.ascontiguousarray(np.moveaxis(x, -1, 1)) for x in found))
    return EdgeRows(blocks, data, c, station, a, b, normals)


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
    rod = np.append(layout.rod_reads[layout.closing], np.zeros(len(layout.angles), dtype=bool))
    sigma = np.abs(by_reading) * joint_noise
    sigma = np.where(rod, joint_noise, np.maximum(sigma, PERFECT))
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
