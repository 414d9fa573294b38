"""Simulation of [B] V.B, Fig. 10: a hexapod controlled by the edges of its legs, with several
assumptions on its base.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.control.image import Eye
from pkmcal.control.machine_view import MachineView, machine_view
from pkmcal.control.simulation import LoopSettings, ServoRuns, simulate_servo_runs
from pkmcal.control.study import Belief, Trials, Uncertainty, estimates, outcome
from pkmcal.geometry.rigid import apply, inverse, register
from pkmcal.identify.gauge import centre_index
from pkmcal.placement.edges import EdgeNoise
from pkmcal.studies.paper_b import (
    PERSPECTIVE_VIEW,
    controlled_machine,
    hexapod_with_cylinder_legs,
    views_by_name,
)

PAPER_B_LOOP_SETTINGS = LoopSettings(law="edges", gain=1.0, rate=12.5, delay=1, duration=10.0,
                    noise=EdgeNoise(shift=0.02, tilt=0.02))  # fmt: skip
CONTROL_START_READINGS = np.array([0.385, 0.445, 0.405, 0.455, 0.375, 0.425])
CONTROL_GOAL_READINGS = np.array([0.445, 0.395, 0.440, 0.385, 0.445, 0.400])
"""Readings (m) for the configurations of [B] Fig. 9, which the paper shows without numbers."""
CAMERA_BY_HAND_ERRORS = {"hand": (0.03, 3.0), "coarse": (0.1, 10.0)}
"""Errors of a camera pose that is measured by hand, m and degrees: with a ruler, and estimated by
eye.
"""
E1, E2 = "cad", "linear"


class ControlledHexapod(NamedTuple):
    """Simulation of [B] Fig. 10.

    eye : the camera in front of the true machine. trials : by assumption: the ``true`` geometry, E1
    ``cad``, E2 ``linear``, E3 by ``hand``, and ``coarse``. centres : (R, L, 3) base joints by each
    of them, m, camera frame.
    """

    eye: Eye
    trials: dict[str, Trials]
    centres: dict[str, Array]


def controlled_by_estimates(centres: Array, seed: int) -> ControlledHexapod:
    """Run the same motion with every estimate. centres : (R, L, 3) by [B] eq. 14, camera frame, for
    each run.
    """
    machine, nominal = controlled_machine(), hexapod_with_cylinder_legs()
    view = views_by_name()[PERSPECTIVE_VIEW]
    true = machine_view(machine, view.T_camera_base)
    eye = Eye.of(true, view.camera)
    runs = len(centres)
    rng = np.random.default_rng(seed)
    # Assumptions: the truth, cameras placed by hand, and both estimates by edges.
    exact = Uncertainty(np.zeros((len(machine.values),) * 2), np.zeros(3), np.zeros(3))
    beliefs: dict[str, Belief] = {}
    for name, (position, degrees) in CAMERA_BY_HAND_ERRORS.items():
        drawn_beliefs = estimates(
            true, nominal.values, exact, runs, rng, position, float(np.radians(degrees))
        )
        beliefs.setdefault("true", drawn_beliefs[0])
        beliefs[name] = replace(drawn_beliefs[3], name=name)
    T = np.broadcast_to(view.T_camera_base, (runs, 4, 4))
    theta = np.tile(nominal.values, (runs, 1))
    theta[:, centre_index(machine.layout)[0]] = apply(inverse(T)[:, None], centres)
    beliefs[E2] = _belief(E2, "Linear", true, theta, T)
    fitted = register(np.broadcast_to(nominal.base_centers(), centres.shape), centres)
    as_drawn = np.broadcast_to(nominal.values, theta.shape)
    beliefs[E1] = _belief(E1, "Nominal model, fitted", true, as_drawn, fitted)
    # The same motion with each of them.
    start, goal = (
        np.broadcast_to(machine.forward(q), (runs, 4, 4))
        for q in (CONTROL_START_READINGS, CONTROL_GOAL_READINGS)
    )
    ran: dict[str, ServoRuns] = {
        # the same noise for all, so that they differ only by their estimates
        name: simulate_servo_runs(
            eye, belief.view, start, goal, PAPER_B_LOOP_SETTINGS, np.random.default_rng(seed)
        )
        for name, belief in beliefs.items()
    }
    trials = {
        name: outcome(machine, belief, ran[name], ran["true"]) for name, belief in beliefs.items()
    }
    index = centre_index(machine.layout)[0]
    where = {
        name: apply(b.view.T_camera_base[..., None, :, :], b.view.theta[..., index])
        for name, b in beliefs.items()
    }
    return ControlledHexapod(eye, trials, {name: np.array(c) for name, c in where.items()})


def _belief(name: str, title: str, true: MachineView, values: Array, T: Array) -> Belief:
    return Belief(name, title, replace(true, machine=true.machine.with_values(values),
                                       T_camera_base=T))  # fmt: skip
