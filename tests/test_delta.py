"""Deltas and the other driven machines of the catalogue: kinematics, frames, estimates."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import slow_but
from pkmcal.geometry.rigid import perturb, pose
from pkmcal.identify.gauge import alignment, changed_frames, default_gauge, freedoms
from pkmcal.identify.state import State
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.closure import closure
from pose_sessions import estimated, measured

DRIVEN = ("delta", "linear-delta", "6-rus", "hexaglide")


def around_home(machine, rng, count=60):
    """Poses a twelfth of the machine's size, and 15 degrees, about home."""
    size = np.linalg.norm(machine.home()[:3, 3] - machine.base_centers().mean(axis=0))
    steps = rng.uniform(-1, 1, (count, 6)) * np.repeat([0.26, 0.25 * size], 3)
    motion = machine.layout.motion
    return perturb(machine.home(), steps @ motion @ motion.T)


def changed(machine, rng, share=0.5):
    """Machine with errors of half of its nominal model's tolerances."""
    table = machine.parameters
    step = share * table.tolerances_free() * rng.normal(size=table.free_matrix().shape[1])
    return machine.with_values(machine.values + table.free_matrix() @ step)


def test_delta_by_three_spheres():
    """The platform's centre lies rod-long from the elbows moved in by its radius."""
    machine = load_mechanism("delta")
    rng = np.random.default_rng(0)
    q = rng.uniform(0.1, 0.9, (20, 3))
    forward_kinematics = machine.forward(q)[:, :3, 3]
    for j, angle in enumerate(np.deg2rad([90, 210, 330])):
        out = np.array([np.cos(angle), np.sin(angle), 0])
        elbow = (0.085 - 0.035 + 0.1 * np.cos(q[:, j, None])) * out
        elbow = elbow - 0.1 * np.sin(q[:, j, None]) * [0, 0, 1]
        # the file gives centres to a tenth of a millimetre
        np.testing.assert_allclose(
            np.linalg.norm(forward_kinematics - elbow, axis=1), 0.22, atol=1e-4
        )
    assert (forward_kinematics[:, 2] < -0.1).all()


def test_linear_delta_by_its_carriages_heights():
    machine = load_mechanism("linear-delta")
    T = pose(np.eye(3), np.array([[0.03, -0.02, 0.1], [0.0, 0.0, 0.05]]))
    expected = [
        [
            t[2, 3] + np.sqrt(0.27**2 - np.sum((t[:2, 3] + b[:2] - a[:2]) ** 2))
            for a, b in zip(machine.base_centers(), machine.platform_centers(), strict=True)
        ]
        for t in T
    ]
    np.testing.assert_allclose(machine.inverse(T), expected, atol=1e-15)


@pytest.mark.parametrize("name", DRIVEN)
def test_readings_in_and_out(name):
    rng = np.random.default_rng(1)
    machine = load_mechanism(name)
    for each in (machine, changed(machine, rng)):
        poses = around_home(each, rng)
        readings = each.inverse(poses)
        poses, readings = (x[np.isfinite(readings).all(axis=1)] for x in (poses, readings))
        assert len(poses) > 30
        fk = each.forward_result(readings)
        assert fk.converged.all()
        np.testing.assert_allclose(fk.T_base_platform, poses, atol=1e-10)


@pytest.mark.parametrize("name", ["delta", "6-rus"])
def test_home_is_derived_without_being_stated(name):
    """Mid-range readings close a machine with cranks on the side to which they reach; for guides
    the side of the platform is undetermined.
    """
    machine = load_mechanism(name)
    silent = type(machine)(
        machine.document.model_copy(update={"home": None}),
        machine.parameters,
        machine.layout,
        machine.values,
    )
    home = silent.home()
    assert np.sign(home[2, 3]) == np.sign(machine.home()[2, 3])
    np.testing.assert_allclose(machine.inverse(home), machine.middle_readings(), atol=1e-9)


@pytest.mark.parametrize("name", [*DRIVEN, "h4"])
def test_frames_change_no_reading(name):
    """Any allowed frame change, made large: readings and closure stay, and the gauge undoes it."""
    rng = np.random.default_rng(2)
    machine = load_mechanism(name)
    poses = around_home(machine, rng, 8)
    basis = freedoms(machine)
    assert basis.shape[1] == {"delta": 9, "linear-delta": 9, "h4": 3}.get(name, 12)
    y = basis @ rng.normal(size=basis.shape[1]) * 0.2
    e, f = perturb(np.eye(4), y[:6]), perturb(np.eye(4), y[6:])
    state = State(machine.values, np.eye(4)[None], poses)
    shifted = changed_frames(machine.layout, state, e, f)
    readings = machine.inverse(poses)
    finite = np.isfinite(readings).all(axis=1)
    c = closure(machine.layout, shifted.theta, readings[finite], shifted.T_base_platform[finite])
    np.testing.assert_allclose(c.rows.value, 0, atol=1e-13)
    back_e, back_f = alignment(machine, shifted, default_gauge(machine))
    again = changed_frames(machine.layout, shifted, back_e, back_f)
    again = machine.parameters.unit_axes(again.theta)
    expected = machine.parameters.unit_axes(machine.values)
    np.testing.assert_allclose(again, expected, atol=1e-9)


@pytest.mark.parametrize("name", slow_but(("delta", "hexaglide"), DRIVEN))
def test_errors_are_as_large_as_they_say(name):
    """Board poses of 0.2 mm and 0.03 degrees: the predicted board has the expected error."""
    machine = load_mechanism(name)
    ratios, chi2 = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = changed(machine, rng, share=1.0)
        poses = around_home(truth, rng)
        poses = poses[np.isfinite(truth.inverse(poses)).all(axis=1)]
        case = measured(truth, poses, rng)
        value = estimated(machine, case, rng)
        assert value.statistics.stopped == "converged"
        chi2.append(value.statistics.chi2 / value.statistics.dof)
        sigma = np.sqrt(np.diag(value.covariance))
        ratios.append(value.pose_residuals.std())
        assert (sigma >= 0).all()
    assert 0.85 < np.mean(chi2) < 1.15
    assert np.mean(ratios) < 1.1
