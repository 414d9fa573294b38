"""Effects on the readings that a mechanism file or a session states: sag under a load or stretch by
measured forces, thermal growth.

An effect has k coefficients with a prior: the compliance of drives and legs relative to what the
file states, the growth of drives and frame per kelvin (:mod:`pkmcal.mechanisms.disturbances`). The
change of the readings by the prior mean is a known correction; the deviations of the coefficients
from the mean are unknowns of the estimate, with one column for each effect
(:mod:`pkmcal.measurements.columns`). The calibrated machine's file states the estimated
coefficients, so that they apply to its later sessions.

Forces and growth are evaluated for the nominal machine at its readings first, which is right to
first order, then for an earlier estimate at its poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pkmcal.arrays import Array, short_repr
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements import Column, Measurements
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.disturbances import (
    growth_by_readings,
    growth_of,
    is_compliant,
    sag,
    tool_shift,
)
from pkmcal.mechanisms.document import STEEL_EXPANSION, STIFFNESS_TOLERANCE, Growth
from pkmcal.outcome.finding import Finding, note, wrong
from pkmcal.session.load import Session

THERMAL_GROWTH, COMPLIANCE = "readings.growth", "machine.compliance"


@dataclass(frozen=True)
class ReadingEffect:
    """Effect of k coefficients on the readings.

    code : of its column.
    by : (K, m, k) derivative of the readings by the coefficients.
    mean, root : (k,) prior mean of the coefficients, and (k, k) square root of their prior
        covariance.
    """

    code: str
    by: Array
    mean: Array
    root: Array

    __repr__ = short_repr

    @property
    def correction(self) -> Array:
        """Change (K, m) of the readings by the mean of the coefficients."""
        return self.by @ self.mean

    def __call__(self, measurements: Measurements) -> Iterator[Column]:
        """Column of the deviations of the coefficients from their mean."""
        del measurements
        yield Column(self.code, readings=self.by, prior=self.root)

    def estimated(self, estimate: Estimate) -> tuple[Array, Array]:
        """Coefficients (k,) of an estimate and their covariance (k, k); those of the prior if they
        are no unknowns of the estimate.
        """
        if self.code not in estimate.column_covariance:
            return self.mean, self.root @ self.root.T
        return (
            self.mean + estimate.state.columns[self.code],
            estimate.column_covariance[self.code],
        )


def reading_effects(
    machine: Machine,
    joints: Array,
    poses: Array,
    temperature: Array | None,
    forces: Array | None = None,
) -> tuple[ReadingEffect, ...]:
    """Effects on readings (K, m), at poses T_base_platform (K, 4, 4).

    temperature : (K,) °C, forces : (K, m) on the readings, N or N m; None where not measured.
    """
    out: list[ReadingEffect] = []
    if _yields(machine, forces):
        root = np.full((1, 1), machine.document.tolerance.stiffness or STIFFNESS_TOLERANCE)
        by = sag(machine, poses, forces)[..., None]
        out.append(ReadingEffect(COMPLIANCE, by, np.ones(1), root))
    if temperature is not None:
        growth = growth_of(machine, temperature)
        warmer = (temperature - growth.temperature)[:, None, None]
        out.append(
            ReadingEffect(
                THERMAL_GROWTH,
                warmer * growth_by_readings(machine, joints, poses),
                np.array([growth.drives, growth.frame]),
                growth.root,
            )
        )
    return tuple(out)


def effects_of_session(
    session: Session, estimate: Estimate | None = None
) -> tuple[ReadingEffect, ...]:
    """Effects on a session's readings, by the nominal machine or by an earlier estimate."""
    if session.temperature is None and not _yields(session.machine, session.forces):
        return ()  # forward kinematics are slow, and may fail
    machine, poses = session.machine, session.forward.T_base_platform
    if estimate is not None:
        machine, poses = estimate.machine, estimate.state.T_base_platform
    return reading_effects(machine, session.joints, poses, session.temperature, session.forces)


def _yields(machine: Machine, forces: Array | None) -> bool:
    """Whether the file states a compliance, and forces are measured or follow from a load."""
    return is_compliant(machine) and not (forces is None and machine.document.load is None)


def with_estimated_effects(session: Session, estimate: Estimate) -> Estimate:
    """The estimate, whose machine's file states the estimated coefficients."""
    document = estimate.machine.document
    for effect in effects_of_session(session):
        value, covariance = effect.estimated(estimate)
        sigma = np.sqrt(np.diag(covariance))
        if effect.code == COMPLIANCE and value[0] > 0:
            legs = tuple(
                leg.model_copy(
                    update={
                        "stiffness": leg.stiffness and leg.stiffness / value[0],
                        "axial_rigidity": leg.axial_rigidity and leg.axial_rigidity / value[0],
                    }
                )
                for leg in document.legs
            )
            tolerance = document.tolerance.model_copy(
                update={"stiffness": float(sigma[0] / value[0])}
            )
            document = document.model_copy(update={"legs": legs, "tolerance": tolerance})
        if effect.code == THERMAL_GROWTH and session.temperature is not None:
            growth = Growth(
                temperature=growth_of(session.machine, session.temperature).temperature,
                drives=value[0],
                frame=value[1],
                sigma=tuple(sigma),
                correlation=covariance[0, 1] / (sigma[0] * sigma[1]),
            )
            document = document.model_copy(update={"growth": growth})
    return replace(estimate, machine=replace(estimate.machine, document=document))


def effect_notes(session: Session, estimate: Estimate) -> Iterator[Finding]:
    """Notes on the estimated coefficients, and a reason against a negative compliance."""
    document, used = session.machine.document, estimate.configurations
    for effect in effects_of_session(session):
        value, covariance = effect.estimated(estimate)
        sigma = np.sqrt(np.diag(covariance))
        if effect.code == COMPLIANCE:
            load, forces = document.load, session.forces
            poses = estimate.state.T_base_platform[used]
            yields = sag(session.machine, poses, None if forces is None else forces[used])
            shift = tool_shift(estimate.machine, poses, value[0] * yields)
            facts = {
                "value": float(value[0]),
                "sigma": float(sigma[0]),
                "prior": float(effect.root[0, 0]),
                "by": "load" if forces is None else "forces",
                "mass": load.mass if load and forces is None else None,
                "tool_shift": None
                if estimate.machine.layout.underdetermined
                else float(np.sqrt(np.nanmean(np.sum(shift**2, axis=-1)))),
            }
            if value[0] > 0:
                yield note("machine.compliance", **facts)
            else:  # no drive yields against its force, and no mechanism file can state that
                yield wrong("machine.compliance_negative", **facts)
        if effect.code == THERMAL_GROWTH and session.temperature is not None:
            yield note(
                "readings.growth",
                mean=growth_of(session.machine, session.temperature).temperature,
                steel=None if document.growth else 1e6 * STEEL_EXPANSION,
                drives=1e6 * float(value[0]),
                sigma_drives=1e6 * float(sigma[0]),
                frame=1e6 * float(value[1]),
                sigma_frame=1e6 * float(sigma[1]),
            )
