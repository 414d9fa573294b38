"""The joint calibration of [A] 4.3 alone, as a setting of ``pkmcal study``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Array
from pkmcal.geometry.rigid import pose_difference
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.closure import by_own, closure, dense
from pkmcal.mechanisms.kinematics import forward
from pkmcal.papers.four_step import solve
from pkmcal.papers.leg_axes import centres_from_axes
from pkmcal.studies.calibrations import ESTIMATE, QUANTITIES, judged
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.paper_a import (
    EVALUATION,
    POSES,
    RIGHT,
    STATIONS,
    HexapodByAxes,
    Start,
    joint_estimate,
    measured_axes,
    parameters_of,
    study_machine,
    thirty,
)
from pkmcal.studies.simulated import SimulatedRuns
from pkmcal.studies.tasks import Batch, Key, Population, Quantity, Sample


@dataclass(frozen=True)
class JointByAxes:
    """The joint estimate from the corrected four steps. axes : [A] 4.3."""

    axes: HexapodByAxes = field(default_factory=HexapodByAxes)

    doing = "Joint calibrations of [A] 4.3"

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """As of all simulated calibrations."""
        return QUANTITIES

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the thirty parameters."""
        return tuple((name, "m") for name in thirty(study_machine()).names)

    def populations(self, runs: int) -> list[Population]:
        """As of all methods."""
        return self.axes.populations(runs)

    def draw(self, batch: Batch) -> SimulatedRuns:
        """As for all methods."""
        return self.axes.draw(batch)

    def solve(
        self,
        batch: Batch,  # noqa: ARG002 - as the protocol has it
        data: SimulatedRuns,
    ) -> dict[Key, Fitted]:
        """The four steps, and the joint estimate from there."""
        measured = measured_axes(data)
        steps = solve(data.machine, measured, *centres_from_axes(measured, STATIONS), "corrected")
        start = Start(parameters_of(data.machine, steps), steps.T_camera_base)
        return {ESTIMATE: joint_estimate(data, start)}

    def judge(
        self, batch: Batch, data: SimulatedRuns, found: Mapping[Key, Fitted]
    ) -> dict[Key, Sample]:
        """Errors of the thirty parameters, and of the platform at random poses of the workspace,
        in frames by three centres.
        """
        fit, machine = found[ESTIMATE], data.machine
        errors = (fit.theta - data.theta) @ thirty(machine).rows.T
        parameters = np.stack([errors, fit.sigma["parameters"]])
        tool = _tool(machine, data.theta, fit, batch.generator(EVALUATION))
        told = fit.told | {"failed": (fit.told["chi2"] > RIGHT).astype(float)}
        told["scale"] = np.ones(batch.runs)
        return {ESTIMATE: judged(parameters, tool, Fitted(fit.theta, told=told))}


def _tool(machine: Machine, true: Array, fit: Fitted, rng: np.random.Generator) -> Array:
    """Errors (2, B, POSES, 6) of the platform's pose (omega, tau), and their stated deviations."""
    layout, (low, high) = machine.layout, machine.joint_ranges.T
    readings = rng.uniform(low, high, (len(true), POSES, len(low)))
    home = np.broadcast_to(machine.home(), (1, 1, 4, 4))
    there, T_true = (
        forward(layout, theta[:, None], readings, home).T_base_platform
        for theta in (fit.theta, true)
    )
    off = pose_difference(there, T_true)
    c = closure(layout, fit.theta[:, None], readings, there)
    by = layout.own_motion @ np.linalg.solve(by_own(layout, c), dense(c, true.shape[1]))
    if fit.covariance is None:
        return np.stack([off, np.full(off.shape, np.nan)])
    variance = np.einsum("bkip,bpq,bkiq->bki", by, fit.covariance, by, optimize=True)
    return np.stack([off, np.sqrt(np.maximum(variance, 0.0))])
