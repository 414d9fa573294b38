"""Joint centres of drawing and calibration in one frame, with covariances that no gauge favours.

The frame of a machine is a convention: nailing it to three joints makes those look exact and
puts their errors on the others. So drawing and calibration are laid over each other by least
squares ([B] eq. 15), and the covariances are those about such a fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers, short_repr
from pkmcal.geometry.rigid import apply, register
from pkmcal.identify.gauge import BestFit, generators, projector
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import LimbEnds, limb_ends

COLLINEAR_SPREAD_SHARE = 1e-6
"""Points nearer to one line than this part of their spread fix no rotation about it."""


@dataclass(frozen=True)
class Centres:
    """The joint centres of one body, m, in its frame as calibrated.

    side : ``base`` or ``platform``. calibrated : (L, 3). drawing : (L, 3) laid over them by
    ``T_calibrated_drawing`` (4, 4). covariance : (3L, 3L) about the fit, m^2.
    """

    side: str
    calibrated: Array
    drawing: Array
    T_calibrated_drawing: Array
    covariance: Array

    __repr__ = short_repr

    @property
    def change(self) -> Array:
        """Calibrated minus drawing, (L, 3) m."""
        return self.calibrated - self.drawing

    @property
    def blocks(self) -> Array:
        """Each centre's own covariance, (L, 3, 3) m^2."""
        n = len(self.calibrated)
        return np.einsum("iaib->iab", self.covariance.reshape(n, 3, n, 3))

    @property
    def sigma(self) -> Array:
        """Standard deviation of a coordinate, averaged over the three axes, (L,) m."""
        return np.sqrt(np.maximum(np.einsum("iaa->i", self.blocks), 0) / 3)


def joint_centres(drawing: Machine, calibrated: Machine, covariance: Array) -> tuple[Centres, ...]:
    """Base and platform centres; covariance (P, P) as :func:`free_of_gauge` leaves it."""
    before, after = _ends(drawing), _ends(calibrated)
    sides = (
        ("base", before.a, after.a, after.a_by, drawing.layout.a_index),
        ("platform", before.b, after.b, after.b_by, drawing.layout.b_index),
    )
    results: list[Centres] = []
    for side, old, new, by, index in sides:
        over = laid_over(np.array(old), np.array(new))
        reference_values = _spread(by, index, covariance)
        results.append(
            Centres(side, np.array(new), apply(over, np.array(old)), over, reference_values)
        )
    return tuple(results)


def free_of_gauge(machine: Machine, covariance: Array) -> Array:
    """The covariance (P, P) of a machine's parameters, told in any frames, about the best fit of
    all centres to the drawing.
    """
    by_frames = generators(machine.layout, machine.values)
    keep = np.eye(len(covariance)) - by_frames @ projector(machine, machine.values, BestFit())
    return keep @ covariance @ keep.T


def laid_over(source: Array, target: Array) -> Array:
    """T_target_source (4, 4) of the best fit; a shift alone where the points are on one line."""
    spread = np.linalg.svd(source - source.mean(axis=0), compute_uv=False)
    if len(source) < 3 or spread[1] < COLLINEAR_SPREAD_SHARE * spread[0]:
        shift = np.eye(4)
        shift[:3, 3] = (target - source).mean(axis=0)
        return shift
    return register(source, target)


def _ends(machine: Machine) -> LimbEnds:
    return limb_ends(machine.layout, machine.values, machine.middle_readings(), np.eye(4))


def _spread(by: Array, index: Integers, covariance: Array) -> Array:
    """Covariance (3L, 3L) of points whose derivatives (L, 3, n) are by parameters at (L, n)."""
    n = len(covariance)
    flat = (by @ np.eye(n + 1)[index, :n]).reshape(-1, n)
    return flat @ covariance @ flat.T
