"""The search for poses in large batches: order of memory, elimination, steps, one closure."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.geometry.batches import batch_last, damped_step, is_batch_last, stepped
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.closure import base_ends, closure, platform_ends, rows_between
from pkmcal.mechanisms.kinematics import KINEMATICS, base_batch_last
from test_kinematics import SMALL, hexapod, workspace


@pytest.fixture(params=[*sorted(catalogue()), *SMALL], scope="module")
def machine(request):
    return SMALL[request.param]() if request.param in SMALL else load_mechanism(request.param)


def test_many_poses_are_solved_as_one_is(machine):
    """Several thousand, in another order of memory, over more than one chunk, with rows among them
    that cannot be closed."""
    poses = np.tile(workspace(machine, 6, 10), (KINEMATICS.chunk // 5, 1, 1))
    readings = machine.inverse(poses)
    hopeless = [3, 17, KINEMATICS.chunk + 4]
    readings[hopeless, 0] += 50.0
    fk = machine.forward_result(readings, machine.home())
    converged = np.ones(len(poses), dtype=bool)
    angles = machine.joint_units == ("rad",) * machine.n_joints
    if not angles:  # fifty radians are some other angle
        converged[hopeless] = False
        np.testing.assert_array_equal(fk.converged, converged)
    ordinary = np.setdiff1d(np.arange(len(poses)), hopeless)
    np.testing.assert_allclose(fk.T_base_platform[ordinary], poses[ordinary], atol=1e-11)
    alone = machine.forward_result(readings[hopeless[0]], machine.home())
    if not angles:
        assert np.log10(fk.error[hopeless[0]] / alone.error) == pytest.approx(0, abs=0.1)
    for k in (0, 5):
        one = machine.forward_result(readings[k])
        np.testing.assert_allclose(fk.T_base_platform[k], one.T_base_platform, atol=1e-13)


def test_rows_in_the_other_order_of_memory_are_the_same(machine):
    poses = workspace(machine, 6, 13)
    readings = machine.inverse(poses)
    internal = np.zeros((6, machine.layout.n_internal))
    plain = closure(machine.layout, machine.values, readings, poses, internal)
    last, layout, theta = batch_last(poses), machine.layout, machine.values
    base = base_batch_last(base_ends(layout, theta, readings))
    platform = platform_ends(layout, theta, last, batch_last(internal))
    other = rows_between(layout, theta, base, platform, last)
    assert is_batch_last(other.by_pose)
    for name in ("value", "by_pose", "by_internal"):
        np.testing.assert_allclose(getattr(other, name), getattr(plain.rows, name), atol=1e-15)


@pytest.mark.parametrize(("rows", "unknowns"), [(3, 3), (6, 6), (8, 8), (8, 5), (1, 1)])
def test_one_elimination_for_all_is_the_same_as_one_each(rows, unknowns):
    """Normal equations square the condition, here about 100: a few 1e-12 of the step remain."""
    rng = np.random.default_rng(14)
    jac = np.eye(rows, unknowns) + 0.3 * rng.normal(size=(200, rows, unknowns))
    jac *= np.geomspace(1, 100, unknowns)
    value, damping = rng.normal(size=(200, rows)), 10.0 ** rng.uniform(-9, 1, 200)
    plain = damped_step(jac, value, damping)
    other = damped_step(batch_last(jac), batch_last(value), damping)
    # the problem itself, stacked with its damping
    scale = np.sqrt(damping[:, None] * np.sum(jac**2, axis=1))
    stacked = np.concatenate([jac, scale[:, None] * np.eye(unknowns)], axis=1)
    right = np.concatenate([value, np.zeros((200, unknowns))], axis=1)
    exact = np.stack([np.linalg.lstsq(a, b)[0] for a, b in zip(stacked, right, strict=True)])
    size = np.linalg.norm(exact * np.geomspace(1, 100, unknowns), axis=1).max()
    for item in (plain, other):
        error = (item - exact) * np.geomspace(1, 100, unknowns)
        assert np.median(np.abs(error)) < 1e-13 * size
        assert np.abs(error).max() < 1e-6 * size


def test_a_singular_row_does_not_spoil_the_elimination_of_the_others():
    jac = np.tile(np.eye(3), (20, 1, 1))
    jac[4] = 0.0
    step = damped_step(batch_last(jac), batch_last(np.ones((20, 3))), np.zeros(20))
    np.testing.assert_array_equal(np.delete(step, 4, axis=0), 1.0)


@pytest.mark.parametrize("order", [np.asarray, batch_last])
def test_a_searchs_steps_are_rotations_and_perturb_to_second_order(order):
    rng = np.random.default_rng(15)
    poses = perturb(np.eye(4), rng.normal(size=(30, 6)))
    far = stepped(order(poses), order(rng.normal(size=(30, 6))))
    turn = far[:, :3, :3]
    np.testing.assert_allclose(
        turn @ np.swapaxes(turn, 1, 2), np.tile(np.eye(3), (30, 1, 1)), atol=1e-14
    )
    np.testing.assert_array_equal(far[:, 3], np.tile([0, 0, 0, 1], (30, 1)))
    for size in (1e-2, 1e-3):
        delta = size * rng.normal(size=(30, 6))
        off = stepped(order(poses), order(delta)) - perturb(poses, delta)
        assert np.abs(off).max() < size**3 * 10
    assert np.abs(off).max() > 1e-12  # it is not Exp


def test_home_is_found_once_and_cannot_be_spoilt():
    machine = hexapod()
    first = machine.home()
    first[0, 3] = 9.0
    assert machine.home()[0, 3] != 9.0
    shifted = machine.values.copy()
    shifted[2::7] += 0.01  # other values, another home
    assert not np.allclose(machine.with_values(shifted).home(), machine.home(), atol=1e-6)
