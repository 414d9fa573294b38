"""One camera that sees an H4's forearms and the board on its platform, in one estimate.

Without images; with images in test_simulate_driven.
"""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.geometry.rigid import look_at, perturb
from pkmcal.identify.bundle import bundle
from pkmcal.identify.start import start_state
from pkmcal.measurements import EdgeSet, Measurements, Mount, PoseSet
from pkmcal.mechanisms import load_mechanism
from pkmcal.placement.edges import EdgeNoise, simulate_edges
from pkmcal.simulation import true_machine, with_forearms
from test_joint_machines import camera

READING = 1e-5
POSE = np.array([3e-4] * 3 + [1e-4] * 3)


@pytest.fixture(scope="module")
def machine():
    """The H4 with forearms that a camera can see."""
    return with_forearms(load_mechanism("h4"))


FOREARMS, BOARD, BOTH = (True, False), (False, True), (True, True)


def estimates(machine, seed, *kinds):
    """Estimates of one true machine from the forearms, from the board or from both."""
    rng = np.random.default_rng(seed)
    home, n = machine.home(), 30
    step = np.zeros((n, 6))
    step[:, 3:], step[:, 2] = rng.uniform(-0.12, 0.12, (n, 3)), rng.uniform(-0.7, 0.7, n)
    poses = perturb(home, step)
    eye = np.array([1.3, 0.3, -0.2])
    T = look_at(eye, 0.6 * home[:3, 3], np.array([0, 0, 1.0]))[None]
    true = true_machine(machine, 1.0, rng)
    noise = EdgeNoise(shift=0.1, tilt=0.1)
    edges, joints = simulate_edges(true, T, camera(), poses, noise, rng, joint_noise=READING)
    T_mount = perturb(np.eye(4), np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.05]))
    in_view = perturb(T[0] @ poses @ T_mount, POSE * rng.normal(size=(n, 6)))
    whiten = np.broadcast_to(np.diag(1 / POSE), (n, 6, 6))
    board = PoseSet(np.zeros(n, int), np.arange(n), np.zeros(n, int), in_view, whiten)
    rough = perturb(T, 0.01 * rng.normal(size=(1, 6)))
    for by_forearms, by_board in kinds:
        measurements = Measurements(
            edges if by_forearms else EdgeSet.empty(),
            joints,
            READING,
            1,
            np.zeros(1, int),
            poses=board if by_board else PoseSet.empty(),
            mounts=(Mount("board", "platform"),) if by_board else (),
        )
        yield bundle(machine, measurements, start_state(machine, measurements, rough))


def test_forearms_and_board_together_know_more_than_each(machine):
    motor = np.flatnonzero(np.array(machine.parameters.kinds) == "angle")
    legs, board, both = (
        np.diag(e.covariance)[motor] for e in estimates(machine, 0, FOREARMS, BOARD, BOTH)
    )
    assert np.all(both < legs)
    assert np.all(both < board)
    # as much as two independent sources: what is worth less than 0.8 of that would be lost
    assert np.all(1 / both > 0.8 * (1 / legs + 1 / board))


def test_what_both_see_agrees(machine):
    statistics = [e.statistics for seed in range(3) for e in estimates(machine, seed, BOTH)]
    assert 0.8 < np.mean([s.chi2 / s.dof for s in statistics]) < 1.2
