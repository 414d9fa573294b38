"""Joint centres of nominal model and calibration in one frame, with gauge-free covariances.

The frame of a machine is a convention. A frame defined by three joints makes these appear exact and
adds their errors to the other joints. So nominal model and calibration are registered by least
squares ([B] eq. 15), and the covariances are those about that fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.geometry.rigid import apply, register
from pkmcal.identify.gauge import BestFit, generators, projector
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import LimbEnds, limb_ends

COLLINEAR_SPREAD_SHARE = 1e-6
"""Distance of points from one line, relative to their spread, below which they determine no
rotation about it."""


@dataclass(frozen=True)
class Centres:
    """Joint centres of one body, m, in its calibrated frame.

    side : ``base`` or ``platform``.
    calibrated : (L, 3).
    nominal : (L, 3) nominal centres, registered to them by ``T_calibrated_nominal``.
    T_calibrated_nominal : (4, 4).
    covariance : (3L, 3L) about the fit, m^2.
    """

    side: str
    calibrated: Array
    nominal: Array
    T_calibrated_nominal: Array
    covariance: Array

    __repr__ = short_repr

    @property
    def change(self) -> Array:
        """Calibrated minus nominal, (L, 3) m."""
        return self.calibrated - self.nominal

    @property
    def blocks(self) -> Array:
        """Covariance of each centre, (L, 3, 3) m^2."""
        n = len(self.calibrated)
        return np.einsum("iaib->iab", self.covariance.reshape(n, 3, n, 3))

    @property
    def sigma(self) -> Array:
        """Standard deviation of a coordinate, root mean square over the three axes, (L,) m."""
        return np.sqrt(np.maximum(np.einsum("iaa->i", self.blocks), 0) / 3)


def joint_centres(nominal: Machine, calibrated: Machine, covariance: Array) -> tuple[Centres, ...]:
    """Base and platform centres; covariance (P, P) as returned by :func:`free_of_gauge`."""
    before, after = _ends(nominal), _ends(calibrated)
    sides = (
        ("base", before.a, after.a, after.a_by, nominal.layout.a_index),
        ("platform", before.b, after.b, after.b_by, nominal.layout.b_index),
    )
    results: list[Centres] = []
    for side, old, new, by, index in sides:
        over = laid_over(np.array(old), np.array(new))
        # derivatives (L, 3, n) by the parameters at index (L, n), as (3L, P); P stands for none
        n = len(covariance)
        flat = (by @ np.eye(n + 1)[index, :n]).reshape(-1, n)
        placed = apply(over, np.array(old))
        results.append(Centres(side, np.array(new), placed, over, flat @ covariance @ flat.T))
    return tuple(results)


def free_of_gauge(machine: Machine, covariance: Array) -> Array:
    """Covariance (P, P) of the parameters about the best fit of all centres to the nominal model,
    from a covariance in any gauge.
    """
    by_frames = generators(machine.layout, machine.values)
    keep = np.eye(len(covariance)) - by_frames @ projector(machine, machine.values, BestFit())
    return keep @ covariance @ keep.T


def laid_over(source: Array, target: Array) -> Array:
    """T_target_source (4, 4) of the least-squares registration; a shift alone where the points are
    collinear.
    """
    spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
    if len(source) < 3 or spread[1] < COLLINEAR_SPREAD_SHARE * spread[0]:
        shift = np.eye(4)
        shift[:3, 3] = (target - source).mean(axis=0)
        return shift
    return register(source, target)


def _ends(machine: Machine) -> LimbEnds:
    """Ends of all limbs at the middle readings, with both frames at the same place."""
    return limb_ends(machine.layout, machine.values, machine.middle_readings(), np.eye(4))
