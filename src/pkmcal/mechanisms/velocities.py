"""Velocities: how fast the readings change when the platform moves, and the other way round.

A twist is (omega, tau), rad/s and m/s, the rate of the left perturbation of
:mod:`pkmcal.geometry.rigid`: omega turns the platform about its own origin, tau moves that origin,
both along the base frame's axes. [B] eq. 6-7 in general: the closure's derivatives give
``by_pose twist + by_internal hinges' rates + by_reading readings' rates = 0``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import dot
from pkmcal.mechanisms.kinematics import inverse_result, own_scale
from pkmcal.mechanisms.layout import LimbLayout
from pkmcal.mechanisms.limbs import Closure
from pkmcal.mechanisms.rows import (
    BaseEnds,
    Rows,
    base_ends,
    by_readings,
    platform_ends,
    rows_between,
)

LOST = 1e-9
"""Smallest singular value of a scaled Jacobian that still gives rates: a pose is right to 1e-12 m
(:data:`pkmcal.mechanisms.closing.CONVERGED`), so below it not three digits would be right."""


class _Moving(NamedTuple):
    """The closure at poses that inverse kinematics closes, and its derivatives by readings."""

    base: BaseEnds
    rows: Rows
    by_reading: Array


def inverse_jacobian(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Readings' rates from the twist, (..., m, 6): ``rates = out @ twist``, [B] eq. 6-7.

    theta (..., P), poses T_base_platform (..., 4, 4). Units: m/rad and m/m of a rod or slider,
    rad/rad and rad/m of a crank. It is the derivative of the inverse kinematics; a machine with
    fewer than six freedoms can make only the twists that :func:`forward_jacobian` spans, and of
    others it says what inverse kinematics would. NaN where a limb cannot reach, and at a serial
    singularity (a crank in line with its rod), where the twist tells the rate of no reading.
    """
    c = _moving(layout, theta, poses)
    if layout.shares_motors:
        return _of_shared(layout, theta, c)
    rows = layout.driven_rows[np.argsort(layout.row_motor[layout.driven_rows])]
    legs = np.flatnonzero(layout.closing)[rows]
    gain = c.by_reading[..., rows]
    usable = np.abs(gain) > LOST * _reading_scale(layout, c.base)[..., legs]
    return -c.rows.by_pose[..., rows, :] / np.where(usable, gain, np.nan)[..., None]


def forward_jacobian(layout: LimbLayout, theta: Array, poses: Array) -> Array:
    """Twist from the readings' rates, (..., 6, m): ``twist = out @ rates``.

    theta (..., P), poses T_base_platform (..., 4, 4). Constant rods, joints' axes, bars and the
    motion that the file names hold exactly: each column is a twist that the machine can make. NaN
    where a limb cannot reach, and where the pose is singular: there the platform can move with all
    motors locked. Where two rods or more hold the same freedom, rates that fit one pose only are
    answered exactly and others by least squares.
    """
    c = _moving(layout, theta, poses)
    scale = own_scale(layout, theta)
    inverted = _pseudo_inverse(layout.by_own(c.rows) * scale[..., None, :])
    return -layout.own_motion[:6] @ (
        scale[..., :, None] * (inverted @ _by_motors(layout, c.by_reading))
    )


def readings_rows(layout: LimbLayout, c: Closure) -> Array:
    """Derivatives of the closure's rows by the readings, (..., E, m)."""
    return _by_motors(layout, c.by_reading)


def _by_motors(layout: LimbLayout, by_reading: Array) -> Array:
    """Derivatives (..., E) by the legs' own readings in the columns of their motors."""
    pick = layout.row_motor[:, None] == np.arange(layout.n_readings)
    return np.where(pick, by_reading[..., None], 0.0)


def _moving(layout: LimbLayout, theta: Array, poses: Array) -> _Moving:
    readings, internal = inverse_result(layout, theta, poses)
    base = base_ends(layout, theta, readings)
    platform = platform_ends(layout, theta, poses, internal)
    rows = rows_between(layout, theta, base, platform, poses)
    return _Moving(base, rows, by_readings(layout, base, rows))


def _of_shared(layout: LimbLayout, theta: Array, c: _Moving) -> Array:
    """Readings' rates (..., m, 6) of machines with several rods a motor: with the hinges' rates,
    the best that all rows say, as the inverse kinematics settles them.
    """
    m = layout.n_readings
    legs = np.flatnonzero(layout.closing)
    by_motor = layout.actuated[legs][:, None] == np.arange(m)
    largest = np.where(by_motor, _reading_scale(layout, c.base)[..., legs, None], 0.0).max(axis=-2)
    hinges = own_scale(layout, theta)[..., layout.motion.shape[1] :]
    shape = np.broadcast_shapes(largest.shape[:-1], hinges.shape[:-1])
    parts = (1 / largest, hinges)
    scale = np.concatenate([np.broadcast_to(p, (*shape, p.shape[-1])) for p in parts], axis=-1)
    drives = _by_motors(layout, c.by_reading)
    jac = np.concatenate([drives, c.rows.by_internal], axis=-1) * scale[..., None, :]
    rates = -_pseudo_inverse(jac) @ c.rows.by_pose
    return (scale[..., :, None] * rates)[..., :m, :]


def _reading_scale(layout: LimbLayout, base: BaseEnds) -> Array:
    """How far a unit of its reading moves each limb's end or changes its length, (..., L)."""
    return np.sqrt(dot(base.by_reading, base.by_reading)) + layout.rod_reads


def _pseudo_inverse(jac: Array) -> Array:
    """Pseudo-inverse (..., d, E) of scaled rows (..., E, d); NaN where they lose a freedom."""
    if jac.shape[-2] < jac.shape[-1]:
        return np.full((*jac.shape[:-2], jac.shape[-1], jac.shape[-2]), np.nan)
    known = np.asarray(np.isfinite(jac).all(axis=(-1, -2)))
    u, s, vt = np.linalg.svd(np.where(known[..., None, None], jac, 0.0), full_matrices=False)
    usable = known[..., None] & (s[..., -1:] > LOST)
    weights = np.where(usable, 1 / np.where(usable, s, 1.0), np.nan)
    return np.swapaxes(vt, -1, -2) @ (weights[..., None] * np.swapaxes(u, -1, -2))
