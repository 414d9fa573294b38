"""Robust starts: the loss that belongs to the weights, and which of two solutions is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import printers
from pkmcal.boards.views import Boards
from pkmcal.calibration.camera_refinement import measurements_of, refinement_of
from pkmcal.firmware.session import write_printer_session
from pkmcal.identify.assembly import assemble, batch_of
from pkmcal.identify.gauge import default_gauge
from pkmcal.identify.robust import anneal, robust_cost, robust_start
from pkmcal.identify.start import start_state
from pkmcal.session.load import load_session
from pkmcal.solver.kernels import (
    FULL_WEIGHT_DISTANCE,
    NO_WEIGHT_DISTANCE,
    final_loss,
    final_weights,
)
from pkmcal.solver.search import of_runs, take

SAYS = printers.Settings(radius=118.0, rod=(240.0,) * 3, endstop=(260.0,) * 3)


def ring(n, radius=75.0):
    """The centre, and places on a ring (n, 2), mm."""
    a = 0.2 + 2 * np.pi * np.arange(n - 1) / (n - 1)
    return np.concatenate([np.zeros((1, 2)), radius * np.column_stack([np.cos(a), np.sin(a)])])


def problem_of(folder, off, n, wrong=0.0):
    """The problem, and its start, of n heights of a printer whose radius is ``off`` mm larger than
    its firmware's value; wrong : mm, of the second height.
    """
    true = printers.machine(replace(SAYS, radius=SAYS.radius + off))
    readings = printers.felt(true, ring(n), 0.005, np.random.default_rng(1))
    readings[1] += wrong
    folder.mkdir()
    (folder / "printer.cfg").write_text(printers.printer_cfg(SAYS, readings))
    write_printer_session(folder / "kit", folder / "printer.cfg")
    session = load_session(folder / "kit")
    machine = session.machine
    cameras = refinement_of(session, False)
    measurements = measurements_of(session, Boards(), None, cameras)
    home = machine.forward(session.joints)
    station = np.eye(4)
    station[2, 3] = -np.median(home[:, 2, 3])
    start = start_state(machine, measurements, station[None])
    assembled = assemble(machine, measurements, default_gauge(machine))
    return assembled.problem, batch_of(machine, assembled, start)


def test_the_loss_is_the_integral_of_the_weights():
    d = np.linspace(0, 8, 4001)
    slope = np.gradient(final_loss(d), d)
    np.testing.assert_allclose(slope[1:-1], (2 * d * final_weights(d))[1:-1], atol=2e-2)
    np.testing.assert_allclose(final_loss(np.array([1.0, FULL_WEIGHT_DISTANCE])), [1, 16])
    most = final_loss(np.array([NO_WEIGHT_DISTANCE, 1e9, np.inf, np.nan]))
    np.testing.assert_allclose(most, most[0])


def test_no_solution_wins_by_its_noise_scale(tmp_path):
    """Heights that scatter by three times their noise cost least at three times their noise, and
    the cost there is that of a normal distribution.
    """
    problem, start = problem_of(tmp_path / "one", 0.0, 40)
    target = problem.pose_data.T_station_target.copy()
    target[..., 2, 3] += 6e-5 * np.random.default_rng(2).normal(size=target.shape[:3])
    problem = replace(problem, pose_data=replace(problem.pose_data, T_station_target=target))
    cost, weight, scale = robust_cost(problem, start)
    rows = problem.unweighted(start).poses
    rms = np.sqrt(np.mean(np.sum(rows**2, axis=-1)))
    assert scale.poses[0] == pytest.approx(rms, rel=0.01)
    assert weight.poses.min() == 1
    values = problem.residuals(start)
    other = np.sum(values.value[..., problem.closure_rows] ** 2) + np.sum(values.shared_value**2)
    assert cost[0] - other == pytest.approx(40 * (1 + 2 * np.log(rms)), rel=1e-3)
    stated, _, one = robust_cost(problem, start, scaled=False)
    assert one.poses[0] == 1
    assert stated[0] > cost[0]


def test_each_run_keeps_the_better_of_its_two_starts(tmp_path):
    """Two runs at once: of one the radius is wrong, and the ring would fit without it; of the other
    one height of thirteen is. What comes out is what each alone comes to.
    """
    one, begin = problem_of(tmp_path / "radius", -1.9, 13)
    other, _ = problem_of(tmp_path / "height", 0.2, 13, wrong=1.0)
    both = replace(
        one,
        data=joined(one.data, other.data, "joints"),
        pose_data=joined(one.pose_data, other.pose_data, "T_station_target"),
    )
    start = take(begin, np.zeros(2, dtype=int))
    annealed = anneal(one, begin).weight.poses[0, :, 0]
    assert np.flatnonzero(annealed < 0.5).tolist() == [0]
    value = robust_start(both, start)
    assert value.weight.poses[0].min() > 0.9
    assert np.flatnonzero(value.weight.poses[1, :, 0] < 0.5).tolist() == [1]
    for run in range(2):
        alone = robust_start(both.select(np.array([run])), begin)
        np.testing.assert_allclose(alone.weight.poses[0], value.weight.poses[run], atol=1e-6)
        np.testing.assert_allclose(alone.state.z[0], value.state.z[run], atol=1e-7)


def joined(one, other, name):
    """Data of two runs that differ in one array."""
    arrays = [of_runs(getattr(part, name), np.zeros(1, dtype=int)) for part in (one, other)]
    return replace(one, **{name: np.concatenate(arrays)})
