"""A calibration against the truth of its simulated session; read only when all else is done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pkmcal.arrays import Array, rms
from pkmcal.identify.comparison import compare as machine_errors
from pkmcal.identify.estimate import State
from pkmcal.identify.gauge import default_gauge, in_gauge
from pkmcal.mechanisms import Machine
from pkmcal.simulation import Truth, load_truth

if TYPE_CHECKING:
    from pkmcal.calibration.calibrate import Calibration

WITHIN_TRUTH_SIGMAS = 2.0
"""Standard deviations within which 95 % of the values should lie."""


@dataclass(frozen=True)
class Errors:
    """Of a machine against the true one, frames laid over each other: m and rad.

    centre : mean distance of the joint centres. offset : root mean square. position,
    orientation : mean error of the platform's pose at the session's readings.
    """

    centre: float
    offset: float
    position: float
    orientation: float


@dataclass(frozen=True)
class AgainstTruth:
    """Errors before and after; count : values with a standard deviation, within : of them,
    those nearer to the truth than two of theirs.
    """

    drawing: Errors
    calibrated: Errors
    count: int
    within: int


def compare_with_truth(calibration: Calibration, session_folder: Path) -> AgainstTruth:
    """Compare with ``truth.json`` in the session's folder."""
    drawing = calibration.session.machine
    truth = load_truth(session_folder, drawing)
    off = _in_sigmas(calibration, truth)
    return AgainstTruth(
        drawing=_errors(drawing, truth),
        calibrated=_errors(calibration.machine, truth),
        count=off.size,
        within=int(np.sum(off < WITHIN_TRUTH_SIGMAS)),
    )


def _errors(machine: Machine, truth: Truth) -> Errors:
    value = machine_errors(machine, truth.machine, truth.joints)
    return Errors(
        centre=float(value.centre.mean()),
        offset=rms(value.offset) if value.offset.size else 0.0,
        position=float(np.nanmean(value.position)),
        orientation=float(np.nanmean(value.orientation)),
    )


def _in_sigmas(calibration: Calibration, truth: Truth) -> Array:
    """Distances of the values from the truth in standard deviations, in the result's frames."""
    estimate = calibration.estimate
    true = State(
        theta=truth.machine.values,
        T_camera_base=truth.T_camera_base,
        T_base_platform=truth.T_base_platform,
    )
    drawing = calibration.session.machine
    covariance, table = in_gauge(drawing, true, default_gauge(drawing)), drawing.parameters
    # an axis by its two turns: along itself it changes by squares of small angles only
    error = table.to_free(estimate.machine.values) - table.to_free(covariance.theta)
    to_free = np.linalg.pinv(table.free_matrix())
    sigma = np.sqrt(np.maximum(np.diag(to_free @ estimate.covariance @ to_free.T), 0.0))
    above_limit = sigma > 1e-9  # what defines the frames has no deviation
    return np.abs(error)[above_limit] / sigma[above_limit]
