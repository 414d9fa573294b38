"""Thermal growth of drives and frame, by the temperatures in the readings' table.

With the temperature T of a configuration and its mean over the session, a length L of the machine
is L (1 + g (T - mean)). Two coefficients g are estimated, with a prior of zero mean and steel's
coefficient as sigma: one for drives (screws, racks and their zeros), one for the frame (joint
centres, arms, rods of constant length). A growth of the parameters theta has the same effect on a
closure c as a change of its reading q, to first order: ``dc/dq dq = dc/dtheta dtheta``. The
estimated machine is that at the mean temperature.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import Column, Measurements
from pkmcal.measurements.sets import Effect
from pkmcal.mechanisms.closure import closure, dense
from pkmcal.outcome.finding import Finding, note
from pkmcal.session.load import Session

THERMAL_GROWTH = "readings.growth"
STEEL_EXPANSION = 11.5e-6
"""Relative growth of steel's length, 1/K: the coefficients' prior sigma."""
SUBJECTS = ("drives", "frame")


def thermal_effects(session: Session) -> tuple[Effect, ...]:
    """Effect of the session's temperatures on its readings; none without temperatures."""
    if session.temperature is None:
        return ()
    machine, fk = session.machine, session.forward
    layout, table = machine.layout, machine.parameters
    at = closure(layout, machine.values, session.joints, fk.T_base_platform, fk.internal)
    slope = at.by_reading[..., None] * layout.of_motor
    square = np.sum(slope**2, axis=1)
    lengths = np.array(table.units) == "m"
    zeros = np.array([part == "zero" for part in table.parts])
    by_theta = dense(at, len(table)) * machine.values

    def as_reading(parameters: np.ndarray) -> np.ndarray:
        grown = np.sum(by_theta[..., parameters], axis=-1)
        return np.sum(slope * grown[..., None], axis=1) / square

    moved = np.where(np.array(machine.joint_units) == "m", session.joints, 0.0)
    each = (moved + as_reading(lengths & zeros), as_reading(lengths & ~zeros))
    warmer = (session.temperature - session.temperature.mean())[:, None, None]

    def growth(measurements: Measurements) -> Iterator[Column]:
        del measurements
        prior = np.full((1, 1), STEEL_EXPANSION)
        for subject, by in zip(SUBJECTS, each, strict=True):
            readings = warmer * by[..., None]
            yield Column(THERMAL_GROWTH, subject, readings=readings, prior=prior)

    return (growth,)


def growth_notes(session: Session, estimate: Estimate) -> Iterator[Finding]:
    """Note on the thermal growth that was estimated, 1/K, and the mean temperature."""
    values = estimate.state.columns.get(THERMAL_GROWTH)
    if session.temperature is None or values is None:
        return
    sigma = estimate.column_sigma(THERMAL_GROWTH)
    yield note(
        "readings.growth",
        mean=float(session.temperature.mean()),
        drives=1e6 * float(values[0]),
        sigma_drives=1e6 * float(sigma[0]),
        frame=1e6 * float(values[1]),
        sigma_frame=1e6 * float(sigma[1]),
    )
