"""Closure equations of all machines: |B_j - A_j| = length_j, and equations from joints' axes.

There are E rows, the lengths of the legs that close, then the axes' equations, with derivatives::

    row                pose           hinges    own reading       parameters
    |B - A| - length   (arm x u, u)   u . dB    -u . dA - scale   of A, B, rod, scale
    (B - A) . w        (arm x w, w)   w . dB    -w . dA           of A, B, two axes

A screw that the joints turn adds lead / (2 pi) phi to its leg's first row, which then depends on
two axes as well (:func:`~pkmcal.mechanisms.joints.screw_rows`), and so do universal joints whose
axes do not meet (:func:`~pkmcal.mechanisms.joints.offset_rows`).

(w of an axis on the platform rotates with the pose, which adds a term in omega.)

A row depends on one leg only, so derivatives by readings and parameters are stored by row, with the
indices of the parameters (``index``), not as dense matrices. :func:`base_ends` evaluates the part
that depends on the readings alone, so that a search for the pose needs it once.
:class:`~pkmcal.mechanisms.layout.LimbLayout` holds the indices of each limb's carriers, parameters
and reading.

All functions accept parameters of shape (..., P), so a batch of machines in a Monte-Carlo study is
one call: leading axes of parameters, readings and poses broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.batches import fresh, moments
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.carriers.contract import by_pose
from pkmcal.mechanisms.joints import (
    AngleRows,
    RodShifts,
    angle_rows,
    offset_rows,
    rod_shifts,
    screw_rows,
)
from pkmcal.mechanisms.layout import CarrierGroup, LimbLayout


class BaseEnds(NamedTuple):
    """Base side of the limbs at given readings; leading axes broadcast.

    a, by_reading : (..., L, 3) ends A, m, base frame, and their derivatives by each leg's reading.
    length, rate : (..., L) of the rods, m, and derivatives by each leg's reading; lengths are NaN
        for passive ones.
    """

    a: Array
    by_reading: Array
    length: Array
    rate: Array


class PlatformEnds(NamedTuple):
    """Platform side of the limbs at a given pose, m, base frame.

    b, arm : (..., L, 3) ends B, and the lever arms: B moves by ``omega x arm + tau``.
    by_internal : (..., L, 3, n) derivatives of b by the pose's internal coordinates.
    """

    b: Array
    arm: Array
    by_internal: Array


class Rows(NamedTuple):
    """Residuals of the closure (..., E), m: lengths of the legs that close, then the axes'
    equations.

    by_pose : (..., E, 6).
    by_internal : (..., E, n), n = 0 for a rigid platform.
    u : (..., L, 3) unit directions from A to B of all legs.
    distance : (..., L) |B - A|, m.
    w : (..., A, 3) directions to which the axes' equations make the limbs' lines orthogonal.
    """

    value: Array
    by_pose: Array
    by_internal: Array
    u: Array
    distance: Array
    w: Array


def base_ends(layout: LimbLayout, theta: Array, readings: Array) -> BaseEnds:
    """Base side of the limbs at readings (..., m), m or rad."""
    q = joint_values(layout, theta, readings)
    placed = [g.carrier.place(g.of(theta), q[..., g.legs]) for g in layout.base]
    a, by_value = (_leg_points(layout.base, side) for side in zip(*placed, strict=True))
    scale = scales(layout, theta)
    length, rate = _rod_lengths(layout, theta, q), rod_rates(layout, theta)
    if layout.windings:
        length, rate = (np.array(x) for x in np.broadcast_arrays(length, rate))
        for g in layout.windings:
            paid, by_paid, _ = g.carrier.paid_out(g.of(theta), q[..., g.legs])
            length[..., g.legs] += paid
            rate[..., g.legs] += by_paid * scale[..., g.legs]
    return BaseEnds(a, by_value * scale[..., None], length, rate)


def at_tangents(
    layout: LimbLayout, theta: Array, base: BaseEnds, platform: PlatformEnds
) -> BaseEnds:
    """Base side with the ends A of cables where their free parts begin, and the lengths of these
    parts.
    """
    if not layout.windings:
        return base
    shape = np.broadcast_shapes(base.a.shape, platform.b.shape)
    a, length = np.array(np.broadcast_to(base.a, shape)), base.length
    length = np.array(np.broadcast_to(length, np.broadcast_shapes(length.shape, shape[:-1])))
    for g in layout.windings:
        a[..., g.legs, :], wound = g.carrier.tangent_point(g.of(theta), platform.b[..., g.legs, :])
        length[..., g.legs] -= wound
    return base._replace(a=a, length=length)


def platform_ends(
    layout: LimbLayout,
    theta: Array,
    poses: Array,
    internal: Array | None = None,
    parameters: tuple[Array, ...] | None = None,
) -> PlatformEnds:
    """Platform side of the limbs at poses T_base_platform (..., 4, 4) and internal coordinates
    (..., n).

    parameters : :func:`platform_parameters` of theta, if already evaluated.
    """
    at_legs = poses[..., None, :, :]
    parameters = platform_parameters(layout, theta) if parameters is None else parameters
    placed = [
        g.carrier.place(own, at_legs, own_internal(layout, g, internal))
        for g, own in zip(layout.platform, parameters, strict=True)
    ]
    b, arm = (_leg_points(layout.platform, side) for side in zip(*placed, strict=True))
    if not layout.n_internal:
        return PlatformEnds(b, arm, b[..., None][..., :0])
    by_internal = fresh(b, (*b.shape, layout.n_internal))
    by_internal[...] = 0.0
    for g, own in zip(layout.platform, parameters, strict=True):
        if g.carrier.turns:
            by = g.carrier.by_internal(own, at_legs, own_internal(layout, g, internal))
            by_internal[..., g.legs, :, layout.internal[g.legs]] = np.moveaxis(by, -2, 0)
    return PlatformEnds(b, arm, by_internal)


def platform_parameters(layout: LimbLayout, theta: Array) -> tuple[Array, ...]:
    """Parameters (..., g, n) of each group of platform carriers."""
    return tuple(g.of(theta) for g in layout.platform)


def own_internal(layout: LimbLayout, group: CarrierGroup, internal: Array | None) -> Array | None:
    """Internal coordinates (..., g) of a group's legs; None without any."""
    if internal is None or not group.carrier.turns:
        return None
    return internal[..., layout.internal[group.legs]]


def rows_between(
    layout: LimbLayout, theta: Array, base: BaseEnds, platform: PlatformEnds, poses: Array
) -> Rows:
    """Closure rows |B - A| - length and the axes' equations; [B] eq. 4, [A] eq. 7 and 13, [C] eq.
    4.
    """
    line, distance = limb_lines(base, platform)
    u = line / distance[..., None]
    rows = Rows(
        value=distance - base.length,
        by_pose=_by_pose(platform.arm, u),
        by_internal=_by_internal(u, platform.by_internal),
        u=u,
        distance=distance,
        w=u[..., :0, :],
    )
    if layout.growing.size:
        rows = _with_growth(layout, theta, poses, line, platform, rows)
    if not layout.all_close:
        rows = rows._replace(
            value=rows.value[..., layout.closing],
            by_pose=rows.by_pose[..., layout.closing, :],
            by_internal=rows.by_internal[..., layout.closing, :],
        )
    return _with_angles(layout, theta, poses, line, platform, rows) if len(layout.angles) else rows


def limb_lines(base: BaseEnds, platform: PlatformEnds) -> tuple[Array, Array]:
    """Vectors B - A (..., L, 3) and their lengths (..., L), m."""
    line = platform.b - base.a
    return line, np.sqrt(dot(line, line))


def _with_growth(
    layout: LimbLayout, theta: Array, poses: Array, line: Array, platform: PlatformEnds, rows: Rows
) -> Rows:
    """Rows of all legs' lengths with what screws and offset axes add to them."""
    leg = layout.growing
    turned = rod_growth(layout, theta, poses, line)
    by_pose = _by_pose(platform.arm[..., leg, :], turned.by_line)
    by_pose[..., :3] += turned.by_turn
    rows.value[..., leg] += turned.value
    rows.by_pose[..., leg, :] += by_pose
    rows.by_internal[..., leg, :] += _by_internal(
        turned.by_line, platform.by_internal[..., leg, :, :]
    )
    return rows


def rod_growth(layout: LimbLayout, theta: Array, poses: Array, line: Array) -> AngleRows:
    """Excess of the readings over |B - A| of the legs ``layout.growing``, with derivatives.

    line : (..., L, 3) B - A of all legs, m.
    """
    rot, parts = poses[..., :3, :3], list[AngleRows]()
    if len(layout.screws):
        parts.append(screw_rows(layout.screws, theta, rot, line[..., layout.screws.leg, :]))
    if len(layout.offsets):
        parts.append(offset_rows(layout.offsets, theta, rot, line[..., layout.offsets.leg, :]))
    if len(parts) == 1:
        return parts[0]
    value, *others = zip(*parts, strict=True)
    return AngleRows(np.concatenate(value, axis=-1), *(np.concatenate(x, axis=-2) for x in others))


def _with_angles(
    layout: LimbLayout, theta: Array, poses: Array, line: Array, platform: PlatformEnds, rows: Rows
) -> Rows:
    """Closure rows extended by the axes' equations."""
    leg = layout.angles.leg
    angles = angle_rows(layout.angles, theta, poses[..., :3, :3], line[..., leg, :])
    by_pose = _by_pose(platform.arm[..., leg, :], angles.by_line)
    by_pose[..., :3] += angles.by_turn
    by_internal = _by_internal(angles.by_line, platform.by_internal[..., leg, :, :])
    return rows._replace(
        value=stacked(rows.value[..., None], angles.value[..., None])[..., 0],
        by_pose=stacked(rows.by_pose, by_pose),
        by_internal=stacked(rows.by_internal, by_internal),
        w=angles.by_line,
    )


def _by_pose(arm: Array, w: Array) -> Array:
    """Derivatives (..., 6) by the pose of points' coordinates along directions w (..., 3):
    (arm x w, w).
    """
    out = fresh(w, (*np.broadcast_shapes(arm.shape, w.shape)[:-1], 6))
    moments(arm, w, out[..., :3])
    out[..., 3:] = w
    return out


def _by_internal(w: Array, by_internal: Array) -> Array:
    """Derivatives (..., n) by internal coordinates of points' coordinates along directions w
    (..., 3).

    by_internal : (..., 3, n) derivatives of the points.
    """
    if not by_internal.shape[-1]:
        return by_internal[..., 0, :]
    out = w[..., 0, None] * by_internal[..., 0, :]
    for k in (1, 2):
        out += w[..., k, None] * by_internal[..., k, :]
    return out


def joint_values(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Motion of each leg's motor (..., L), m or rad, at readings (..., m): scale * reading, zero
    for legs without a reading.
    """
    return scales(layout, theta) * _leg_readings(layout, readings)


def scales(layout: LimbLayout, theta: Array) -> Array:
    """Scale of each leg's reading, (..., L), or (L,) if all are exact."""
    if not layout.some_scales_unsure:
        return layout.exact_scale
    estimated = theta[..., layout.scale_or_first]
    return np.where(layout.unsure_scales, estimated, layout.exact_scale)


def rod_rates(layout: LimbLayout, theta: Array) -> Array:
    """Derivative of each rod's length by its leg's reading (..., L): the scale, or zero."""
    return np.where(layout.rod_reads, scales(layout, theta), 0.0)


def _leg_readings(layout: LimbLayout, readings: Array) -> Array:
    """Readings (..., m) by leg (..., L), zero for legs without a reading."""
    own = readings[..., layout.reading_or_first]
    return own if layout.all_read else np.where(layout.actuated >= 0, own, 0.0)


def rod_lengths(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Length of each rod (..., L), m: scale * reading + offset, or the constant; [B] eq. 4.

    NaN for passive rods, whose length is unknown.
    """
    return _rod_lengths(layout, theta, joint_values(layout, theta, readings))


def _rod_lengths(layout: LimbLayout, theta: Array, joint_value: Array) -> Array:
    """Length of each rod (..., L), m, from the motions (..., L) of the legs' motors."""
    own = np.where(layout.closing, theta[..., layout.rod], np.nan)
    return own + np.where(layout.rod_reads, joint_value, 0.0)


def _leg_points(groups: tuple[CarrierGroup, ...], points: tuple[Array, ...]) -> Array:
    """Points of groups (..., g, 3) in the order of the legs, (..., L, 3)."""
    if len(groups) == 1:
        return points[0]
    count = sum(len(g.legs) for g in groups)
    shape = np.broadcast_shapes(*(p.shape[:-2] for p in points))
    out = fresh(points[0], (*shape, count, 3))
    for group, point in zip(groups, points, strict=True):
        out[..., group.legs, :] = point
    return out


def stacked(first: Array, second: Array) -> Array:
    """Rows (..., E, n) of two arrays, one below the other; leading axes broadcast."""
    shape = np.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    split = first.shape[-2]
    out = fresh(first, (*shape, split + second.shape[-2], first.shape[-1]))
    out[..., :split, :], out[..., split:, :] = first, second
    return out


def skeletons(layout: LimbLayout, theta: Array, joint_value: Array) -> tuple[Array, ...]:
    """Points along each leg's arm on the base, for nominal models: L arrays (..., k, 3), m, base
    frame.

    Each begins where a motor holds the arm and ends at A; only A without an arm.
    joint_value : (..., L), see :func:`joint_values`.
    """
    out: dict[int, Array] = {}
    for g in layout.base:
        points = g.carrier.skeleton(g.of(theta), joint_value[..., g.legs])
        out |= {int(j): points[..., k, :, :] for k, j in enumerate(g.legs)}
    return tuple(out[j] for j in range(layout.n_legs))


@dataclass(frozen=True)
class LimbEnds:
    """Ends of all limbs with their derivatives; leading axes broadcast, then L legs.

    theta : (..., P).
    readings : (..., m).
    poses : T_base_platform (..., 4, 4).
    internal : (..., n), None for zero.
    base, platform : the parts that depend on the readings, and on the pose.

    Derivatives are evaluated on first use; a trial step of a search, or a nominal model, needs
    none.
    """

    layout: LimbLayout
    theta: Array
    readings: Array
    poses: Array
    internal: Array | None
    base: BaseEnds
    platform: PlatformEnds

    @cached_property
    def a(self) -> Array:
        """Ends A (..., L, 3), m, base frame."""
        return self._at_readings(self.base.a)

    @property
    def b(self) -> Array:
        """Ends B (..., L, 3), m, base frame."""
        return self.platform.b

    @cached_property
    def a_by_reading(self) -> Array:
        """Derivatives (..., L, 3) of a by the legs' readings."""
        return self._at_readings(self.base.by_reading)

    @cached_property
    def shifts(self) -> RodShifts:
        """Vectors from A and B to the ends of the rods ``layout.offsets.leg``."""
        offsets, rot = self.layout.offsets, self.poses[..., :3, :3]
        return rod_shifts(offsets, self.theta, rot, (self.b - self.a)[..., offsets.leg, :])

    @cached_property
    def rods(self) -> tuple[Array, Array]:
        """Ends (..., L, 3) of the rods, on whose line their tubes are, m, base frame: A and B,
        except where a joint's second axis is at an offset from its first one.
        """
        if not len(self.layout.offsets):
            return self.a, self.b
        shape = np.broadcast_shapes(self.a.shape, self.b.shape)
        ends = [np.array(np.broadcast_to(end, shape)) for end in (self.a, self.b)]
        for end, shift in zip(ends, np.moveaxis(self.shifts.value, -2, 0), strict=True):
            end[..., self.layout.offsets.leg, :] += shift
        return ends[0], ends[1]

    def _at_readings(self, values: Array) -> Array:
        """Values of the base side (..., L, 3), broadcast to the batch's shape."""
        shape = np.broadcast_shapes(self.theta.shape[:-1], self.readings.shape[:-1])
        shape = np.broadcast_shapes(values.shape, (*shape, self.layout.n_legs, 3))
        return np.broadcast_to(values, shape)

    @cached_property
    def a_by_b(self) -> Array:
        """Derivatives (..., L, 3, 3) of a by b; zero but for cables over pulleys."""
        layout = self.layout
        out = np.zeros((*self.b.shape, 3))
        for g in layout.windings:
            by = g.carrier.tangent_by_b(g.of(self.theta), self.b[..., g.legs, :])
            out[..., g.legs, :, :] = by
        return out

    @cached_property
    def b_by_pose(self) -> Array:
        """Derivatives (..., L, 3, 6) of b by the pose's six numbers."""
        return by_pose(self.platform.arm)

    @cached_property
    def a_by(self) -> Array:
        """Derivatives (..., L, 3, n) of a by the parameters at the layout's ``a_index``."""
        layout, theta = self.layout, self.theta
        q = joint_values(layout, theta, self.readings)
        by = [
            self._winding_by(g)[0]
            if g.winds
            else g.carrier.by_parameters(g.of(theta), q[..., g.legs])
            for g in layout.base
        ]
        padded = _leg_derivatives(layout.n_legs, layout.base, by)
        if not layout.scales_move_a:
            return padded
        raw = _leg_readings(layout, self.readings) / scales(layout, theta)
        return _side_by_side((padded, (self.a_by_reading * raw[..., None])[..., None]))

    def _winding_by(self, group: CarrierGroup) -> tuple[Array, Array]:
        """Derivatives (..., g, 3, n) of the ends A of cables, and (..., g, n) of the lengths up to
        them, by the carriers' parameters.
        """
        at = self.b[..., group.legs, :]
        return group.carrier.tangent_by_parameters(group.of(self.theta), at)

    @cached_property
    def b_by(self) -> Array:
        """Derivatives (..., L, 3, n) of b by the parameters at the layout's ``b_index``."""
        layout, at_legs = self.layout, self.poses[..., None, :, :]
        by = [
            g.carrier.by_parameters(
                g.of(self.theta), at_legs, own_internal(layout, g, self.internal)
            )
            for g in layout.platform
        ]
        return _leg_derivatives(layout.n_legs, layout.platform, by)


@dataclass(frozen=True)
class Closure(LimbEnds):
    """Closure rows with the limbs' ends."""

    rows: Rows

    @cached_property
    def by_reading(self) -> Array:
        """Derivatives (..., E) by the reading of each row's leg, zero without one."""
        layout, by_own_reading = self.layout, self.base.by_reading
        by = -dot(self.rows.u, by_own_reading) - self.base.rate
        by = by if layout.all_close else by[..., layout.closing]
        if not len(layout.angles):
            return by
        angles = -dot(self.rows.w, by_own_reading[..., layout.angles.leg, :])
        return stacked(by[..., None], angles[..., None])[..., 0]

    @property
    def index(self) -> Integers:
        """Indices (E, n) of the parameters on which each row depends, P as padding."""
        return self.layout.closure_index

    @cached_property
    def by_theta(self) -> Array:
        """Derivatives (..., E, n) by the parameters at ``index``."""
        lengths = self._by_length()
        if not len(self.layout.angles):
            return lengths
        angles = self._by_angles()
        width = self.index.shape[1]
        spares = (
            [(0, 0)] * (by.ndim - 1) + [(0, width - by.shape[-1])] for by in (lengths, angles)
        )
        return stacked(
            *(np.pad(by, spare) for by, spare in zip((lengths, angles), spares, strict=True))
        )

    def _by_length(self) -> Array:
        """Derivatives of |B - A| - length, for the legs that close."""
        layout, slope, axes = self.layout, self.rows.u, ()
        if layout.growing.size:
            leg = layout.growing
            turned = rod_growth(layout, self.theta, self.poses, self.b - self.a)
            slope = np.array(slope)
            slope[..., leg, :] += turned.by_line
            by_axes = np.zeros((*slope.shape[:-1], 6))
            by_axes[..., leg, :3] = turned.by_base_axis
            by_axes[..., leg, 3:] = turned.by_platform_axis
            axes = (by_axes,)
        by_a = -along(slope, self.a_by)
        if layout.windings:
            by_a = self._with_cables(by_a)
        parts = (by_a, along(slope, self.b_by), np.full((1, 1), -1.0))
        if layout.scales_move_rods:
            grown = np.where(layout.rod_reads, _leg_readings(layout, self.readings), 0.0)
            parts = (*parts, -grown[..., None])
        by_theta = _side_by_side((*parts, *axes))
        return by_theta if layout.all_close else by_theta[..., layout.closing, :]

    def _with_cables(self, by_a: Array) -> Array:
        """Derivatives (..., L, n) by the parameters at ``a_index`` with those of the lengths on
        pulleys and of the lengths paid out.
        """
        layout, out = self.layout, np.array(by_a)
        q = joint_values(layout, self.theta, self.readings)
        for g in layout.windings:
            paid = g.carrier.paid_out(g.of(self.theta), q[..., g.legs])[2]
            n = paid.shape[-1]
            out[..., g.legs, :n] += self._winding_by(g)[1] - paid
        if layout.scales_move_a:
            raw = _leg_readings(layout, self.readings) / scales(layout, self.theta)
            driven = layout.lengthens & ~layout.rod_reads
            out[..., -1] -= np.where(driven, self.base.rate * raw, 0.0)
        return out

    def _by_angles(self) -> Array:
        """Derivatives of the axes' equations."""
        layout, leg = self.layout, self.layout.angles.leg
        line = (self.b - self.a)[..., leg, :]
        rows = angle_rows(layout.angles, self.theta, self.poses[..., :3, :3], line)
        parts = (
            -along(rows.by_line, self.a_by[..., leg, :, :]),
            along(rows.by_line, self.b_by[..., leg, :, :]),
            rows.by_base_axis,
            rows.by_platform_axis,
        )
        return _side_by_side(parts)


def limb_ends(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array | None = None
) -> LimbEnds:
    """Ends of all limbs.

    theta : (..., P).
    readings : (..., m).
    poses : T_base_platform (..., 4, 4).
    internal : (..., n) internal coordinates of the poses, zero by default.
    """
    platform = platform_ends(layout, theta, poses, internal)
    base = at_tangents(layout, theta, base_ends(layout, theta, readings), platform)
    return LimbEnds(layout, theta, readings, poses, internal, base, platform)


def _leg_derivatives(
    n_legs: int, groups: tuple[CarrierGroup, ...], by_parameters: list[Array]
) -> Array:
    """Carriers' derivatives in the order of the legs (..., L, 3, n), padded with zeros to the
    largest number of parameters.
    """
    if len(groups) == 1:
        return by_parameters[0]
    lead = np.broadcast_shapes(*(by.shape[:-3] for by in by_parameters))
    out = np.zeros((*lead, n_legs, 3, max(by.shape[-1] for by in by_parameters)))
    for group, by in zip(groups, by_parameters, strict=True):
        out[..., group.legs, :, : by.shape[-1]] = by
    return out


def closure(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array | None = None
) -> Closure:
    """Closure residuals and their exact derivatives; [B] eq. 4, [A] eq. 7 and 13, [C] eq. 4.

    theta : (..., P).
    readings : (..., m).
    poses : T_base_platform (..., 4, 4).
    internal : (..., n) internal coordinates of the poses, zero by default.
    """
    platform = platform_ends(layout, theta, poses, internal)
    base = at_tangents(layout, theta, base_ends(layout, theta, readings), platform)
    rows = rows_between(layout, theta, base, platform, poses)
    return Closure(layout, theta, readings, poses, internal, base, platform, rows)


def by_motors(layout: LimbLayout, by_reading: Array) -> Array:
    """Derivatives (..., E, m) by all readings from derivatives (..., E) by each row's reading."""
    return np.where(layout.of_motor, by_reading[..., None], 0.0)


def by_own(layout: LimbLayout, rows: Rows) -> Array:
    """Derivatives (..., E, d + n) of the rows by the pose's freedoms and internal coordinates."""
    by_pose = rows.by_pose[..., layout.freedoms]
    if not layout.n_internal:
        return by_pose
    return np.concatenate([by_pose, rows.by_internal], axis=-1)


def _side_by_side(parts: tuple[Array, ...]) -> Array:
    """Derivatives (..., E, n) concatenated along their last axis; leading axes broadcast."""
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    out = np.empty((*shape, sum(part.shape[-1] for part in parts)))
    first = 0
    for part in parts:
        out[..., first : first + part.shape[-1]] = part
        first += part.shape[-1]
    return out


def along(u: Array, by: Array) -> Array:
    """Derivatives (..., n) of a point's coordinate along a direction (..., 3), from the point's
    (..., 3, n).
    """
    return (u[..., None, :] @ by)[..., 0, :]


def on_tangents(layout: LimbLayout, theta: Array, nominal: Array) -> Array:
    """Parameters (..., P) with direction vectors rescaled to end on the tangent plane at the
    nominal directions.

    nominal : (P,) nominal values; see
        :meth:`pkmcal.mechanisms.parameters.ParameterTable.on_tangents`.
    """
    axes = np.concatenate(layout.turning)
    if not axes.size:
        return theta
    out = np.array(theta)
    out[..., axes] = theta[..., axes] / dot(theta[..., axes], nominal[axes])[..., None]
    return out


def dense(c: Closure, n_parameters: int) -> Array:
    """Dense derivatives (..., E, P) of the closure rows by all parameters."""
    out = np.zeros((*c.by_theta.shape[:-1], n_parameters + 1))
    place = np.broadcast_to(c.index, c.by_theta.shape)
    np.put_along_axis(out, place, c.by_theta, axis=-1)
    return out[..., :n_parameters]
