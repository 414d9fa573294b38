"""Joint readings: the kind, its rows (the closures of the limbs) and their noise.

One row a limb, ``c / (|dc/dq| sigma_q)``, [B] eq. 4, [C] eq. 5 whitened. Closures without a reading
(rods of constant length, axes of joints) count as exact, to PERFECT_CLOSURE_SIGMA.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, final

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.measurements.contract import MotorKind
from pkmcal.mechanisms.layout import LimbLayout

PERFECT_CLOSURE_SIGMA = 1e-6
"""Standard deviation (m) of closures without a reading: joints and rods without play. It is a third
of a good encoder's noise, so that no information is lost, and large enough for the conditioning of
the normal equations."""


def reading_sigma(noise: float, resolution: float, play: float) -> float:
    """Standard deviation of a reading, m or rad: of noise, of a step that is uniformly distributed,
    and of half of the play to either side.
    """
    return math.hypot(noise, resolution / 12**0.5, play / 2)


@final
class Readings(MotorKind):
    """Lengths, positions of sliders and angles of cranks, as the motors read them."""

    code: ClassVar = "readings"
    one: ClassVar = "reading"
    label: ClassVar = "readings"
    unit: ClassVar = "m or rad"
    numbers: ClassVar = 1
    key: ClassVar = "joints"


@dataclass(frozen=True)
class ReadingColumns:
    """Effects that change the readings.

    by : (K, m, c) derivatives of the readings.
    column : (c,) numbers of the effects.
    """

    by: Array
    column: Integers

    def among(self, configurations: slice) -> ReadingColumns:
        """The columns of some configurations."""
        return replace(self, by=self.by[configurations])

    def corrected(self, joints: Array, columns: Array) -> Array:
        """Readings (B, K, m) without the effects, whose numbers are ``columns`` (B, n)."""
        if not len(self.column):
            return joints
        return joints + np.einsum("kmc,bc->bkm", self.by, columns[:, self.column])


def closures_by_readings(layout: LimbLayout, by_reading: Array, by: Array) -> Array:
    """Derivatives (B, K, E, k) of the closures by k changes of the readings.

    by_reading : (B, K, E) slopes of the closures. by : (K, m, k) changes of the readings.
    """
    driven = layout.row_motor >= 0
    slope = np.where(driven, by_reading, 0.0)[..., None]
    return slope * by[:, np.where(driven, layout.row_motor, 0)]


def by_noise(layout: LimbLayout, joint_noise: Array, by_reading: Array, rows: Array) -> Array:
    """Rows (..., E, n) of the closure in standard deviations.

    The derivative of the noise is neglected; it would be multiplied by the closure, which is about
    zero. Rods on one motor share its reading's noise: with the slopes g of the motor's rows their
    covariance is ``sigma^2 g g^T + PERFECT_CLOSURE_SIGMA^2``, whitened in closed form.

    joint_noise : standard deviation of a reading, broadcasts with by_reading (..., E).
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

    A crank in line with its rod does not move it, so the standard deviation is at least that of a
    closure without a reading. A rod that is read moves with its reading, and the noise of the
    reading is used as one of lengths, without its scale: the difference is a thousandth, and the
    noise does not depend on an unknown.
    """
    if layout.reads_lengths:
        return np.where(layout.row_motor >= 0, joint_noise, PERFECT_CLOSURE_SIGMA)
    sigma = np.maximum(np.abs(by_reading) * joint_noise, PERFECT_CLOSURE_SIGMA)
    sigma = np.where(layout.row_is_rod, joint_noise, sigma)
    return np.where(layout.row_motor >= 0, sigma, PERFECT_CLOSURE_SIGMA)


def least_joint_noise(layout: LimbLayout, by_reading: Array) -> Array:
    """Noise of the readings (B,) below which no closure gains weight, for slopes (B, K, E).

    0 where a rod is read, since its closure then has the noise of its reading.
    """
    if layout.rod_reads[layout.closing].any() and not layout.shares_motors:
        return np.zeros(len(by_reading))
    steepest = np.abs(by_reading * (layout.row_motor >= 0)).max(axis=(1, 2))
    return PERFECT_CLOSURE_SIGMA / np.maximum(steepest, PERFECT_CLOSURE_SIGMA)


def joint_rows(layout: LimbLayout, by_reading: Array, rows: Array) -> Array:
    """Whitened closure rows (..., E) as one row per reading, (..., m)."""
    if not layout.shares_motors:
        driven = layout.driven_rows
        order = np.argsort(layout.row_motor[driven], kind="stable")
        return rows[..., driven[order]]
    slope = by_reading[..., None] * layout.of_motor
    size = np.sqrt(np.sum(slope**2, axis=-2, keepdims=True))
    unit = slope / np.where(size > 0, size, 1.0)
    return (unit.mT @ rows[..., None])[..., 0]
