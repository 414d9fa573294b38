"""The closure of every machine, |B_j - A_j| = length_j and what its joints' axes add.

The rows themselves and what kinematics needs are in :mod:`pkmcal.mechanisms.rows`; here are their
derivatives by the parameters. All functions take the parameter vector as an array (..., P), so
that a whole Monte-Carlo batch of machines is one call: leading axes of parameters, readings and
poses broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.angles import angle_rows
from pkmcal.mechanisms.carriers.contract import by_pose
from pkmcal.mechanisms.layout import MOTIONS, CarrierGroup, LimbLayout, layout_of
from pkmcal.mechanisms.rows import (
    BaseEnds,
    PlatformEnds,
    base_ends,
    by_readings,
    leg_readings,
    own_internal,
    platform_ends,
    rod_lengths,
    rows_between,
    stacked,
)

__all__ = [
    "MOTIONS",
    "CarrierGroup",
    "Closure",
    "LimbEnds",
    "LimbLayout",
    "along",
    "closure",
    "dense",
    "layout_of",
    "leg_readings",
    "limb_ends",
    "on_tangents",
    "rod_lengths",
]


@dataclass(frozen=True)
class LimbEnds:
    """Both ends of all limbs with derivatives; leading axes broadcast, then L legs.

    a, b : (..., L, 3) m, base frame.
    a_index, b_index : (L, n) parameters that each end depends on, P where there are fewer.
    a_by, b_by : (..., L, 3, n) derivatives by those parameters.
    a_by_reading : (..., L, 3). arm : (..., L, 3), what of b turns with the platform.
    n_parameters : P. b_by_internal : (..., L, 3, n) by the pose's internal coordinates.
    """

    a: Array
    b: Array
    a_index: Integers
    b_index: Integers
    a_by: Array
    b_by: Array
    a_by_reading: Array
    arm: Array
    n_parameters: int
    b_by_internal: Array

    @cached_property
    def b_by_pose(self) -> Array:
        """(..., L, 3, 6) derivatives of b by the pose's six numbers."""
        return by_pose(self.arm)


@dataclass(frozen=True)
class Closure:
    """The closure's rows, (..., E): lengths of the legs that close, then the axes' equations.

    value : m. u : (..., L, 3) unit directions from A to B of all legs. distance : (..., L) m.
    by_pose : (..., E, 6). by_internal : (..., E, n), n = 0 for a rigid platform.
    by_reading : (..., E) by the leg's own reading, zero where it has none.
    index, by_theta : (E, n) parameters that each row depends on, P where there is none, and the
    derivatives (..., E, n) by them.
    """

    value: Array
    u: Array
    distance: Array
    by_pose: Array
    by_internal: Array
    by_reading: Array
    index: Integers
    by_theta: Array
    ends: LimbEnds


def limb_ends(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array | None = None
) -> LimbEnds:
    """Both ends of every limb.

    theta : (..., P). readings : (..., m). poses : T_base_platform (..., 4, 4).
    internal : (..., n) the poses' internal coordinates; zero where they are not given.
    """
    base = base_ends(layout, theta, readings)
    platform = platform_ends(layout, theta, poses, internal)
    return _with_parameters(layout, theta, readings, poses, internal, base, platform)


def _with_parameters(
    layout: LimbLayout,
    theta: Array,
    readings: Array,
    poses: Array,
    internal: Array | None,
    base: BaseEnds,
    platform: PlatformEnds,
) -> LimbEnds:
    """The ends with their derivatives by the parameters."""
    q, at_legs = leg_readings(layout, readings), poses[..., None, :, :]
    a_by = [g.carrier.by_parameters(g.of(theta), q[..., g.legs]) for g in layout.base]
    b_by = [
        g.carrier.by_parameters(g.of(theta), at_legs, own_internal(layout, g, internal))
        for g in layout.platform
    ]
    all_a_by, a_index = _gather(layout, layout.base, a_by)
    all_b_by, b_index = _gather(layout, layout.platform, b_by)
    shape = np.broadcast_shapes(theta.shape[:-1], readings.shape[:-1])
    a, by_reading = (
        np.broadcast_to(x, (*shape, layout.n_legs, 3)) for x in (base.a, base.by_reading)
    )
    return LimbEnds(
        a,
        platform.b,
        a_index,
        b_index,
        all_a_by,
        all_b_by,
        by_reading,
        platform.arm,
        layout.n_parameters,
        platform.by_internal,
    )


def _gather(
    layout: LimbLayout, groups: tuple[CarrierGroup, ...], by_parameters: list[Array]
) -> tuple[Array, Integers]:
    """Carriers' derivatives put in the order of the legs, parameters padded to a common count."""
    if len(groups) == 1:
        return by_parameters[0], groups[0].index
    width = max(g.index.shape[1] for g in groups)
    index = np.full((layout.n_legs, width), layout.n_parameters)
    shape = np.broadcast_shapes(*(by.shape[:-3] for by in by_parameters))
    out = np.zeros((*shape, layout.n_legs, 3, width))
    for group, by in zip(groups, by_parameters, strict=True):
        n = group.index.shape[1]
        index[group.legs, :n] = group.index
        out[..., group.legs, :, :n] = by
    return out, index


def closure(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array | None = None
) -> Closure:
    """The closure's residuals and their exact derivatives; [B] eq. 4, [A] eq. 7 and 13, [C] eq. 4.

    theta : (..., P). readings : (..., m). poses : T_base_platform (..., 4, 4).
    internal : (..., n) the poses' internal coordinates; zero where they are not given.
    """
    base = base_ends(layout, theta, readings)
    platform = platform_ends(layout, theta, poses, internal)
    rows = rows_between(layout, theta, base, platform, poses)
    ends = _with_parameters(layout, theta, readings, poses, internal, base, platform)
    index, by_theta = _length_parameters(layout, rows.u, ends)
    if len(layout.angles):
        line = (ends.b - ends.a)[..., layout.angles.leg, :]
        angles = _angle_parameters(layout, theta, poses, line, ends)
        index, by_theta = _padded(layout, (index, by_theta), angles)
    return Closure(
        value=rows.value,
        u=rows.u,
        distance=rows.distance,
        by_pose=rows.by_pose,
        by_internal=rows.by_internal,
        by_reading=by_readings(layout, base, rows),
        index=index,
        by_theta=by_theta,
        ends=ends,
    )


def _length_parameters(layout: LimbLayout, u: Array, ends: LimbEnds) -> tuple[Integers, Array]:
    """Parameters (E, n) of |B - A| - length of the legs that close, and derivatives (..., E, n)."""
    keep = layout.closing
    parts = (-along(u, ends.a_by), along(u, ends.b_by), np.full((1, 1), -1.0))
    rod = np.where(keep, layout.rod, layout.n_parameters)[:, None]
    index = np.concatenate([ends.a_index, ends.b_index, rod], axis=1)
    by_theta = _side_by_side(parts)
    return (index, by_theta) if layout.all_close else (index[keep], by_theta[..., keep, :])


def _side_by_side(parts: tuple[Array, ...]) -> Array:
    """Derivatives (..., E, n) joined along their last axis; leading axes broadcast."""
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    whole = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts]
    return np.concatenate(whole, axis=-1)


def along(u: Array, by: Array) -> Array:
    """Derivatives (..., 3, n) of a point, along a direction (..., 3): (..., n)."""
    return (u[..., None, :] @ by)[..., 0, :]


def _angle_parameters(
    layout: LimbLayout, theta: Array, poses: Array, line: Array, ends: LimbEnds
) -> tuple[Integers, Array]:
    """The same of the axes' equations."""
    angles, leg = layout.angles, layout.angles.leg
    rows = angle_rows(angles, theta, poses[..., :3, :3], line)
    parts = (
        -along(rows.by_line, ends.a_by[..., leg, :, :]),
        along(rows.by_line, ends.b_by[..., leg, :, :]),
        rows.by_base_axis,
        rows.by_platform_axis,
    )
    none = layout.n_parameters
    index = (
        ends.a_index[leg],
        ends.b_index[leg],
        np.where(angles.on_base[:, None], angles.base, none),
        np.where(angles.on_platform[:, None], angles.platform, none),
    )
    return np.concatenate(index, axis=1), _side_by_side(parts)


def _padded(
    layout: LimbLayout, lengths: tuple[Integers, Array], angles: tuple[Integers, Array]
) -> tuple[Integers, Array]:
    """Length rows, then angle rows; parameters padded to a common count."""
    width = max(lengths[0].shape[1], angles[0].shape[1])
    index, by_theta = [], []
    for own, by in (lengths, angles):
        spare = width - own.shape[1]
        index.append(np.pad(own, ((0, 0), (0, spare)), constant_values=layout.n_parameters))
        by_theta.append(np.pad(by, [(0, 0)] * (by.ndim - 1) + [(0, spare)]))
    return np.concatenate(index), stacked(*by_theta)


def on_tangents(layout: LimbLayout, theta: Array, drawing: Array) -> Array:
    """Directions among theta (..., P) made as long as they must be to end on the tangent plane of
    the drawing's (P,); see :meth:`pkmcal.mechanisms.parameters.ParameterTable.on_tangents`.
    """
    axes = np.concatenate(layout.turning)
    if not axes.size:
        return theta
    out = np.array(theta)
    out[..., axes] = theta[..., axes] / dot(theta[..., axes], drawing[axes])[..., None]
    return out


def dense(rows: Closure, n_parameters: int) -> Array:
    """Derivatives of the rows by all parameters, (..., E, P)."""
    out = np.zeros((*rows.by_theta.shape[:-1], n_parameters + 1))
    place = np.broadcast_to(rows.index, rows.by_theta.shape)
    np.put_along_axis(out, place, rows.by_theta, axis=-1)
    return out[..., :n_parameters]
