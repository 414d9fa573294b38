"""The closure of every machine, |B_j - A_j| = length_j and what its joints' axes add.

All functions take the parameter vector as an array (..., P), so that a whole Monte-Carlo
batch of machines is one call: leading axes of parameters, readings and poses broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.angles import angle_rows
from pkmcal.mechanisms.carriers.contract import CarriedPoint
from pkmcal.mechanisms.layout import MOTIONS, CarrierGroup, LimbLayout, layout_of

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
    a_by_reading : (..., L, 3); b_by_pose : (..., L, 3, 6). n_parameters : P.
    b_by_internal : (..., L, 3, n) by the pose's internal coordinates.
    """

    a: Array
    b: Array
    a_index: Integers
    b_index: Integers
    a_by: Array
    b_by: Array
    a_by_reading: Array
    b_by_pose: Array
    n_parameters: int
    b_by_internal: Array


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
    q = leg_readings(layout, readings)
    a, a_index = _gather(
        layout, layout.base, [g.carrier.point(g.of(theta), q[..., g.legs]) for g in layout.base]
    )
    points: list[CarriedPoint] = []
    for g in layout.platform:
        phi = None
        if internal is not None and g.carrier.turns:
            phi = internal[..., layout.internal[g.legs]]
        points.append(g.carrier.point(g.of(theta), poses[..., None, :, :], phi))
    b, b_index = _gather(layout, layout.platform, points)
    return LimbEnds(
        a.value,
        b.value,
        a_index,
        b_index,
        a.by_parameters,
        b.by_parameters,
        a.by_motion,
        b.by_motion,
        layout.n_parameters,
        _by_internal(layout, theta, poses, internal, b.value.shape),
    )


def _by_internal(
    layout: LimbLayout, theta: Array, poses: Array, internal: Array | None, shape: tuple[int, ...]
) -> Array:
    """Derivatives (..., L, 3, n) of the platform's ends by the internal coordinates."""
    out = np.zeros((*shape, layout.n_internal))
    for g in layout.platform if layout.n_internal else ():
        if g.carrier.turns:
            column = layout.internal[g.legs]
            phi = None if internal is None else internal[..., column]
            by = g.carrier.by_internal(g.of(theta), poses[..., None, :, :], phi)
            out[..., g.legs, :, column] = np.moveaxis(by, -2, 0)
    return out


def leg_readings(layout: LimbLayout, readings: Array) -> Array:
    """Readings (..., m) spread over the legs (..., L), zero for legs without one."""
    return np.where(layout.actuated >= 0, readings[..., np.maximum(layout.actuated, 0)], 0.0)


def rod_lengths(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Length of every rod (..., L), m: reading + offset, or the constant; [B] eq. 4.

    NaN for passive rods, whose length nobody knows.
    """
    own = np.where(layout.closing, theta[..., layout.rod], np.nan)
    return own + np.where(layout.rod_reads, leg_readings(layout, readings), 0.0)


def _gather(
    layout: LimbLayout, groups: tuple[CarrierGroup, ...], points: list[CarriedPoint]
) -> tuple[CarriedPoint, Integers]:
    """Carriers' results put in the order of the legs, parameters padded to a common count."""
    if len(groups) == 1:
        return points[0], groups[0].index
    width = max(g.index.shape[1] for g in groups)
    index = np.full((layout.n_legs, width), layout.n_parameters)
    shape = np.broadcast_shapes(*(p.value.shape[:-2] for p in points))
    motion = points[0].by_motion.shape[len(points[0].value.shape) - 1 :]
    value = np.zeros((*shape, layout.n_legs, 3))
    by_motion = np.zeros((*shape, layout.n_legs, *motion))
    by_parameters = np.zeros((*shape, layout.n_legs, 3, width))
    for group, point in zip(groups, points, strict=True):
        n = group.index.shape[1]
        index[group.legs, :n] = group.index
        value[..., group.legs, :] = point.value
        by_motion[(..., group.legs, *[slice(None)] * len(motion))] = point.by_motion
        by_parameters[..., group.legs, :, :n] = point.by_parameters
    return CarriedPoint(value, by_motion, by_parameters), index


def closure(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array | None = None
) -> Closure:
    """The closure's residuals and their exact derivatives; [B] eq. 4, [A] eq. 7 and 13, [C] eq. 4.

    theta : (..., P). readings : (..., m). poses : T_base_platform (..., 4, 4).
    internal : (..., n) the poses' internal coordinates; zero where they are not given.
    """
    ends = limb_ends(layout, theta, readings, poses, internal)
    d = ends.b - ends.a
    distance = np.sqrt(dot(d, d))
    u = d / distance[..., None]
    lengths = _length_rows(layout, theta, readings, u, distance, ends)
    if not len(layout.angles):
        return lengths
    return _joined(lengths, _angle_closure(layout, theta, poses, d, lengths))


def _length_rows(
    layout: LimbLayout, theta: Array, readings: Array, u: Array, distance: Array, ends: LimbEnds
) -> Closure:
    """|B - A| - length of the legs that close."""
    rod = np.where(layout.closing, layout.rod, layout.n_parameters)[:, None]
    by_a, by_b = -along(u, ends.a_by), along(u, ends.b_by)
    value = distance - rod_lengths(layout, theta, readings)
    shape = np.broadcast_shapes(by_a.shape[:-1], by_b.shape[:-1], value.shape)
    parts = (by_a, by_b, np.full((1, 1), -1.0))
    by_theta = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts]
    rows = Closure(
        value=value,
        u=u,
        distance=distance,
        by_pose=along(u, ends.b_by_pose),
        by_internal=along(u, ends.b_by_internal),
        by_reading=-dot(u, ends.a_by_reading) - layout.rod_reads,
        index=np.concatenate([ends.a_index, ends.b_index, rod], axis=1),
        by_theta=np.concatenate(by_theta, axis=-1),
        ends=ends,
    )
    if layout.closing.all():
        return rows
    keep = layout.closing
    return replace(
        rows,
        value=rows.value[..., keep],
        by_pose=rows.by_pose[..., keep, :],
        by_internal=rows.by_internal[..., keep, :],
        by_reading=rows.by_reading[..., keep],
        index=rows.index[keep],
        by_theta=rows.by_theta[..., keep, :],
    )


def along(u: Array, by: Array) -> Array:
    """Derivatives (..., 3, n) of a point, along a direction (..., 3): (..., n)."""
    return (u[..., None, :] @ by)[..., 0, :]


def _angle_closure(
    layout: LimbLayout, theta: Array, poses: Array, line: Array, lengths: Closure
) -> Closure:
    """The axes' equations as closure rows."""
    angles, ends = layout.angles, lengths.ends
    leg = angles.leg
    rows = angle_rows(angles, theta, poses[..., :3, :3], line[..., leg, :])
    w = rows.by_line
    by_pose = along(w, ends.b_by_pose[..., leg, :, :])
    by_pose = by_pose + np.concatenate([rows.by_turn, np.zeros_like(rows.by_turn)], axis=-1)
    parts = (
        -along(w, ends.a_by[..., leg, :, :]),
        along(w, ends.b_by[..., leg, :, :]),
        rows.by_base_axis,
        rows.by_platform_axis,
    )
    shape = np.broadcast_shapes(*(part.shape[:-1] for part in parts))
    by_theta = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in parts]
    none = layout.n_parameters
    index = (
        ends.a_index[leg],
        ends.b_index[leg],
        np.where(angles.on_base[:, None], angles.base, none),
        np.where(angles.on_platform[:, None], angles.platform, none),
    )
    return replace(
        lengths,
        value=rows.value,
        by_pose=by_pose,
        by_internal=along(w, ends.b_by_internal[..., leg, :, :]),
        by_reading=-dot(w, ends.a_by_reading[..., leg, :]),
        index=np.concatenate(index, axis=1),
        by_theta=np.concatenate(by_theta, axis=-1),
    )


def _joined(lengths: Closure, angles: Closure) -> Closure:
    """Length rows, then angle rows; parameters padded to a common count."""
    width = max(lengths.index.shape[1], angles.index.shape[1])
    none = lengths.ends.n_parameters
    index, by_theta = [], []
    for rows in (lengths, angles):
        spare = width - rows.index.shape[1]
        index.append(np.pad(rows.index, ((0, 0), (0, spare)), constant_values=none))
        padding = [(0, 0)] * (rows.by_theta.ndim - 1) + [(0, spare)]
        by_theta.append(np.pad(rows.by_theta, padding))
    return replace(
        lengths,
        value=_stacked(lengths.value[..., None], angles.value[..., None])[..., 0],
        by_pose=_stacked(lengths.by_pose, angles.by_pose),
        by_internal=_stacked(lengths.by_internal, angles.by_internal),
        by_reading=_stacked(lengths.by_reading[..., None], angles.by_reading[..., None])[..., 0],
        index=np.concatenate(index),
        by_theta=_stacked(*by_theta),
    )


def _stacked(first: Array, second: Array) -> Array:
    """Rows (..., E, n) of both, one below the other; leading axes broadcast."""
    shape = np.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    rows = [np.broadcast_to(part, (*shape, *part.shape[-2:])) for part in (first, second)]
    return np.concatenate(rows, axis=-2)


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
