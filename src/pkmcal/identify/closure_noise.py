"""What the closures' rows are worth: the noise of the readings that enter them."""

from __future__ import annotations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.mechanisms.closure import LimbLayout

PERFECT = 1e-6
"""Standard deviation (m) of closures without a reading: joints and rods without play. A third of
a good encoder's noise, so nothing is lost, and not so sharp that digits are."""


def by_noise(layout: LimbLayout, joint_noise: float, by_reading: Array, rows: Array) -> Array:
    """Rows (..., E, n) of the closure in standard deviations; the noise's own derivative is
    multiplied by c = 0.

    by_reading : (..., E). Rods on one motor share its reading's noise: with slopes g of the
    motor's rows their covariance is ``sigma^2 g g^T + PERFECT^2``, whitened in closed form.
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


def closure_sigma(layout: LimbLayout, joint_noise: float, by_reading: Array) -> Array:
    """Standard deviation (..., E) of each closure where every motor moves one rod.

    A crank in line with its rod does not move it, so no closure is sharper than a perfect one; a
    rod that is read always moves with its reading.
    """
    rod = np.append(layout.rod_reads[layout.closing], np.zeros(len(layout.angles), dtype=bool))
    sigma = np.abs(by_reading) * joint_noise
    sigma = np.where(rod, sigma, np.maximum(sigma, PERFECT))
    return np.where(layout.row_motor >= 0, sigma, PERFECT)


def joint_rows(layout: LimbLayout, by_reading: Array, rows: Array) -> Array:
    """Whitened closure rows (..., E) as one a reading, (..., m)."""
    if not layout.shares_motors:
        driven = layout.driven_rows
        order = np.argsort(layout.row_motor[driven], kind="stable")
        return rows[..., driven[order]]
    motors = layout.row_motor[:, None] == np.arange(layout.n_readings)
    slope = by_reading[..., None] * motors
    size = np.sqrt(np.sum(slope**2, axis=-2, keepdims=True))
    unit = slope / np.where(size > 0, size, 1.0)
    return (np.swapaxes(unit, -1, -2) @ rows[..., None])[..., 0]
