"""Comparison of a calibration with the truth of its simulated session."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pkmcal.arrays import Array, rms
from pkmcal.calibration.calibrate import Calibration
from pkmcal.identify.gauge import default_gauge, in_gauge
from pkmcal.identify.state import State
from pkmcal.judge.machine_errors import compare as machine_errors
from pkmcal.mechanisms import Machine
from pkmcal.simulation import Truth, load_truth

WITHIN_TRUTH_SIGMAS = 2.0
"""Standard deviations within which 95 % of the values should be."""


@dataclass(frozen=True)
class Errors:
    """Errors of a machine with respect to the true one, after registration of the frames; m and
    rad.

    centre : mean distance of the joint centres.
    offset : root mean square error of the readings' offsets.
    position, orientation : mean errors of the platform's pose at the session's readings.
    """

    centre: float
    offset: float
    position: float
    orientation: float


@dataclass(frozen=True)
class AgainstTruth:
    """Errors of the nominal and of the calibrated machine.

    count : number of values with a standard deviation. within : number of those within two standard
    deviations of the truth.
    """

    drawing: Errors
    calibrated: Errors
    count: int
    within: int


def compare_with_truth(calibration: Calibration, session_folder: Path) -> AgainstTruth:
    """Compare a calibration with ``truth.json`` in the session's folder."""
    nominal = calibration.session.machine
    truth = load_truth(session_folder, nominal)
    off = _in_sigmas(calibration, truth)
    return AgainstTruth(
        drawing=_errors(nominal, truth),
        calibrated=_errors(calibration.machine, truth),
        count=off.size,
        within=int(np.sum(off < WITHIN_TRUTH_SIGMAS)),
    )


def _errors(machine: Machine, truth: Truth) -> Errors:
    errors = machine_errors(machine, truth.machine, truth.joints)
    return Errors(
        centre=float(errors.centre.mean()),
        offset=rms(errors.offset) if errors.offset.size else 0.0,
        position=float(np.nanmean(errors.position)),
        orientation=float(np.nanmean(errors.orientation)),
    )


def _in_sigmas(calibration: Calibration, truth: Truth) -> Array:
    """Errors of the values in standard deviations, in the result's gauge."""
    estimate = calibration.estimate
    true = State(
        theta=truth.machine.values,
        T_camera_base=truth.T_camera_base,
        T_base_platform=truth.T_base_platform,
    )
    nominal = calibration.session.machine
    true_in_gauge, table = in_gauge(nominal, true, default_gauge(nominal)), nominal.parameters
    # An axis has two free turns; along itself it changes only to second order.
    error = table.to_free(estimate.machine.values) - table.to_free(true_in_gauge.theta)
    to_free = np.linalg.pinv(table.free_matrix())
    sigma = np.sqrt(np.maximum(np.diag(to_free @ estimate.covariance @ to_free.T), 0.0))
    free = sigma > 1e-9  # values that define the gauge have no standard deviation
    return np.abs(error)[free] / sigma[free]
