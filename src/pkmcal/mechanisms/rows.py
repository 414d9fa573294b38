"""The closure's rows and how they change with the pose: what kinematics needs.

:mod:`pkmcal.mechanisms.limbs` builds on them and adds the derivatives by the parameters. What moves
with the readings only, :func:`base_ends`, is apart, so that a search for the pose finds it once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.angles import angle_rows
from pkmcal.mechanisms.batches import fresh, moments
from pkmcal.mechanisms.layout import CarrierGroup, LimbLayout


class BaseEnds(NamedTuple):
    """What the readings decide; leading axes broadcast.

    a, by_reading : (..., L, 3), the limbs' ends, m, and their derivatives by the legs' readings.
    length : (..., L) of the rods, m; NaN for passive ones.
    """

    a: Array
    by_reading: Array
    length: Array


class PlatformEnds(NamedTuple):
    """What the pose decides: b, arm (..., L, 3), m, base frame; B moves by ``omega x arm + tau``.

    by_internal : (..., L, 3, n) by the pose's internal coordinates.
    """

    b: Array
    arm: Array
    by_internal: Array


class Rows(NamedTuple):
    """The closure's rows, (..., E): lengths of the legs that close, then the axes' equations.

    value : m. by_pose : (..., E, 6). by_internal : (..., E, n), n = 0 for a rigid platform.
    u : (..., L, 3) unit directions from A to B of all legs. distance : (..., L) m.
    w : (..., A, 3) what the limbs' lines are square to, by the axes' equations.
    """

    value: Array
    by_pose: Array
    by_internal: Array
    u: Array
    distance: Array
    w: Array


def pose_rows(
    layout: LimbLayout, theta: Array, readings: Array, poses: Array, internal: Array | None = None
) -> Rows:
    """The rows at readings (..., m) and poses (..., 4, 4); theta (..., P), internal (..., n)."""
    base = base_ends(layout, theta, readings)
    return rows_between(layout, theta, base, platform_ends(layout, theta, poses, internal), poses)


def base_ends(layout: LimbLayout, theta: Array, readings: Array) -> BaseEnds:
    """The base side at readings (..., m), m or rad."""
    q = leg_readings(layout, readings)
    placed = [g.carrier.place(g.of(theta), q[..., g.legs]) for g in layout.base]
    a, by_reading = (_gathered(layout.base, side) for side in zip(*placed, strict=True))
    return BaseEnds(a, by_reading, _lengths(layout, theta, q))


def platform_ends(
    layout: LimbLayout,
    theta: Array,
    poses: Array,
    internal: Array | None = None,
    parameters: tuple[Array, ...] | None = None,
) -> PlatformEnds:
    """The platform side at poses T_base_platform (..., 4, 4) and internal coordinates (..., n).

    parameters : each group's out of theta, for whoever asks often.
    """
    at_legs = poses[..., None, :, :]
    parameters = platform_parameters(layout, theta) if parameters is None else parameters
    placed = [
        g.carrier.place(own, at_legs, own_internal(layout, g, internal))
        for g, own in zip(layout.platform, parameters, strict=True)
    ]
    b, arm = (_gathered(layout.platform, side) for side in zip(*placed, strict=True))
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
    """Each platform group's parameters (..., g, n)."""
    return tuple(g.of(theta) for g in layout.platform)


def own_internal(layout: LimbLayout, group: CarrierGroup, internal: Array | None) -> Array | None:
    """The internal coordinates (..., g) of a group's legs."""
    if internal is None or not group.carrier.turns:
        return None
    return internal[..., layout.internal[group.legs]]


def rows_between(
    layout: LimbLayout, theta: Array, base: BaseEnds, platform: PlatformEnds, poses: Array
) -> Rows:
    """|B - A| - length, and the axes' equations; [B] eq. 4, [A] eq. 7 and 13, [C] eq. 4."""
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
    if not layout.all_close:
        rows = rows._replace(
            value=rows.value[..., layout.closing],
            by_pose=rows.by_pose[..., layout.closing, :],
            by_internal=rows.by_internal[..., layout.closing, :],
        )
    return _with_angles(layout, theta, poses, line, platform, rows) if len(layout.angles) else rows


def limb_lines(base: BaseEnds, platform: PlatformEnds) -> tuple[Array, Array]:
    """B - A (..., L, 3) and how long it is (..., L), m."""
    line = platform.b - base.a
    return line, np.sqrt(dot(line, line))


def _with_angles(
    layout: LimbLayout, theta: Array, poses: Array, line: Array, platform: PlatformEnds, rows: Rows
) -> Rows:
    """The same with the axes' equations below."""
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


def by_readings(layout: LimbLayout, base: BaseEnds, rows: Rows) -> Array:
    """Derivatives (..., E) of the rows by their legs' own readings, zero where there is none."""
    by = -dot(rows.u, base.by_reading) - layout.rod_reads
    by = by if layout.all_close else by[..., layout.closing]
    if not len(layout.angles):
        return by
    angles = -dot(rows.w, base.by_reading[..., layout.angles.leg, :])
    return stacked(by[..., None], angles[..., None])[..., 0]


def _by_pose(arm: Array, w: Array) -> Array:
    """Rows (..., 6) of a point's motion along directions w (..., 3): (arm x w, w)."""
    out = fresh(w, (*np.broadcast_shapes(arm.shape, w.shape)[:-1], 6))
    moments(arm, w, out[..., :3])
    out[..., 3:] = w
    return out


def _by_internal(w: Array, by_internal: Array) -> Array:
    """Derivatives (..., 3, n) of the points, along directions w (..., 3): (..., n)."""
    if not by_internal.shape[-1]:
        return by_internal[..., 0, :]
    out = w[..., 0, None] * by_internal[..., 0, :]
    for k in (1, 2):
        out += w[..., k, None] * by_internal[..., k, :]
    return out


def leg_readings(layout: LimbLayout, readings: Array) -> Array:
    """Readings (..., m) spread over the legs (..., L), zero for legs without one."""
    return np.where(layout.actuated >= 0, readings[..., np.maximum(layout.actuated, 0)], 0.0)


def rod_lengths(layout: LimbLayout, theta: Array, readings: Array) -> Array:
    """Length of every rod (..., L), m: reading + offset, or the constant; [B] eq. 4.

    NaN for passive rods, whose length nobody knows.
    """
    return _lengths(layout, theta, leg_readings(layout, readings))


def _lengths(layout: LimbLayout, theta: Array, leg_reading: Array) -> Array:
    own = np.where(layout.closing, theta[..., layout.rod], np.nan)
    return own + np.where(layout.rod_reads, leg_reading, 0.0)


def _gathered(groups: tuple[CarrierGroup, ...], points: tuple[Array, ...]) -> Array:
    """Groups' points (..., g, 3) in the order of the legs, (..., L, 3)."""
    if len(groups) == 1:
        return points[0]
    count = sum(len(g.legs) for g in groups)
    shape = np.broadcast_shapes(*(p.shape[:-2] for p in points))
    out = fresh(points[0], (*shape, count, 3))
    for group, point in zip(groups, points, strict=True):
        out[..., group.legs, :] = point
    return out


def stacked(first: Array, second: Array) -> Array:
    """Rows (..., E, n) of both, one below the other; leading axes broadcast."""
    shape = np.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    split = first.shape[-2]
    out = fresh(first, (*shape, split + second.shape[-2], first.shape[-1]))
    out[..., :split, :], out[..., split:, :] = first, second
    return out
