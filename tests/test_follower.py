"""A machine followed pose by pose: as the search for any machine finds it."""

from __future__ import annotations

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import GeometryError, InputError
from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.follower import FOLLOWER, rods_of
from pkmcal.mechanisms.kinematics import CONVERGED_CLOSURE_ERROR

SLOW = {"3-rps", "3-upu", "four-belt", "h4-rods"}
"""Machines with axes' equations, a hinge, or more rods than degrees of freedom use the search."""


def path(machine, count, size=0.02):
    """Readings (count, m) that wander from home, a step of a millimetre or a milliradian each."""
    home = machine.inverse(machine.home())
    phase = np.arange(1, machine.n_joints + 1)
    return home + size * (1 - np.cos(np.arange(count)[:, None] * 0.05 * phase / phase[-1]))


def closes(machine, readings):
    return machine.forward_result(readings, machine.home()).converged.all()


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_a_path_is_followed(name):
    machine = load_mechanism(name)
    assert (rods_of(machine.layout, machine.values) is None) == (name in SLOW)
    readings = path(machine, 60, 0.005)
    if machine.redundancy:  # moved so that its readings close
        poses = np.repeat(machine.home()[None], 60, axis=0)
        poses[:, 0, 3] += 1e-3 * np.arange(60)
        readings = machine.inverse(poses)
    assert closes(machine, readings)
    follow = machine.follower()
    values = np.array([follow(row) for row in readings])
    np.testing.assert_array_equal(follow.T_base_platform, values[-1])
    wanted = machine.forward(readings, values)
    np.testing.assert_allclose(values, wanted, atol=1e-10)


def test_one_of_other_values_and_another_start():
    """With a calibrated machine's values, not the nominal ones; started at its pose."""
    nominal = load_mechanism("gough-stewart")
    rng = np.random.default_rng(0)
    values = nominal.values + nominal.parameters.tolerance * rng.normal(size=nominal.values.size)
    machine = nominal.with_values(values)
    there = perturb(machine.home(), np.array([0.2, -0.1, 0.15, 0.03, -0.02, 0.03]))
    follow = machine.follower(there)
    np.testing.assert_allclose(follow(machine.inverse(there)), there, atol=1e-12)


def test_rounding_does_not_add_up():
    machine = load_mechanism("gough-stewart")
    readings = path(machine, 120)
    follow = machine.follower()
    for k in range(2 * FOLLOWER.poses_between_squarings):
        values = follow(readings[k % 120])
    np.testing.assert_allclose(values[:3, :3] @ values[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(
        machine.inverse(values), readings[k % 120], atol=CONVERGED_CLOSURE_ERROR
    )


def test_a_leap_is_searched():
    """A jump to the other end of the range: equal to the search from the pose before."""
    machine = load_mechanism("gough-stewart")
    follow = machine.follower()
    before = follow(machine.inverse(machine.home()))
    far = machine.joint_ranges.mean(axis=1) + np.array([0.04, -0.03, 0.04, 0.05, -0.02, 0.03])
    np.testing.assert_allclose(follow(far), machine.forward(far, before), atol=1e-10)


def test_readings_out_of_reach_are_reported_and_forgotten():
    machine = load_mechanism("gough-stewart")
    follow = machine.follower()
    home = machine.inverse(machine.home())
    before = follow(home)
    for wrong in (home + np.array([0, 0, 1.0, 0, 0, -0.3]), np.full(6, np.nan)):
        with raises(GeometryError, code="readings.unreachable"):
            follow(wrong)
        np.testing.assert_array_equal(follow.T_base_platform, before)
    np.testing.assert_allclose(follow(home), before, atol=1e-12)


def test_one_configuration_at_a_time():
    follow = load_mechanism("gough-stewart").follower()
    with raises(InputError, found="(2, 6)", expected="(6,): one configuration at a time"):
        follow(np.zeros((2, 6)))
    with raises(InputError, found="(3,)", expected="(n, 4, 4)"):
        load_mechanism("gough-stewart").follower(np.zeros(3))
