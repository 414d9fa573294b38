"""Assembly modes: all are found, counted and signed, and the probability of missing one
is stated.
"""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.geometry.rigid import perturb
from pkmcal.mechanisms import assembly_modes, catalogue, load_mechanism
from pkmcal.mechanisms.closure import closure
from test_kinematics import CONVERGED_CLOSURE_ERROR, hexapod, machine_of, tripod, workspace, yawed

APART = 1e-6


def random_hexapod(seed):
    """A hexapod whose centres are moved, from nothing up to half of its size either way, and the
    pose of many whose readings lie best in the ranges."""
    machine = load_mechanism("gough-stewart")
    rng = np.random.default_rng(seed)
    centres = np.array(["center" in name for name in machine.parameters.names])
    shifted = 0.25 * (seed % 20) / 19 * rng.uniform(-1, 1, centres.sum())
    values = machine.values.copy()
    values[centres] += shifted
    machine = machine.with_values(values)
    poses = perturb(
        load_mechanism("gough-stewart").home(),
        rng.uniform(-1, 1, (2000, 6)) * np.repeat([0.5, 0.2], 3),
    )
    readings = machine.inverse(poses)
    low, high = machine.joint_ranges.T
    best = np.argmin(np.maximum(low - readings, readings - high).max(axis=-1))
    return machine, poses[best], readings[best]


def search(machine, readings, home, seed, most=100_000, finds=10):
    options = assembly_modes.AssemblyModeOptions(finds=finds)
    return assembly_modes.assembly_modes(
        machine.layout, machine.values, readings, home, np.random.default_rng(seed), most, options
    )


def exhaustive(machine, readings, home, seed, starts):
    """The same search without a stopping rule, until its last start."""
    return search(machine, readings, home, seed, starts, 10**9)


def assert_same(value, long):
    assert len(value) == len(long)
    for T in long.poses:
        assert np.abs(value.poses - T).max(axis=(-1, -2)).min() < APART


@pytest.mark.parametrize("seed", [0, 6, 12, 19])
def test_modes_of_random_hexapods_are_those_of_a_long_search(seed):
    machine, T, readings = random_hexapod(seed)
    value = search(machine, readings, T, seed)
    assert value.complete
    assert np.abs(value.poses - T).max(axis=(-1, -2)).min() < APART  # the pose it came from
    long = exhaustive(machine, readings, T, 1000 + seed, 5000)
    assert not long.complete
    assert long.starts == 5000
    assert_same(value, long)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_modes_of_twenty_random_hexapods_against_200000_starts(seed):
    machine, T, readings = random_hexapod(seed)
    value = search(machine, readings, T, seed)
    assert value.complete
    assert_same(value, exhaustive(machine, readings, T, 1000 + seed, 200_000))


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_mode_closes_the_machine_once(name):
    machine = load_mechanism(name)
    readings = machine.inverse(machine.home())
    values = machine.assembly_modes_result(readings, np.random.default_rng(0))
    c = closure(machine.layout, machine.values, readings, values.poses, values.internal)
    assert np.abs(c.rows.value).max() < CONVERGED_CLOSURE_ERROR
    # home is the first, with its own sign
    np.testing.assert_allclose(values.poses[0], machine.home(), atol=1e-6)
    if machine.layout.overdetermined:  # no determinant to compare the assemblies
        assert set(values.sign) == {0}
    else:
        assert values.sign[0] == 1
        assert set(values.sign) <= {-1, 1}
    assert values.mode_numbers.sum() == values.closed <= values.starts
    assert values.mode_numbers.min() >= assembly_modes.ASSEMBLY_MODE_OPTIONS.finds
    numbers = np.concatenate(
        [
            values.poses[:, :3].reshape(len(values), -1),
            np.cos(values.internal),
            np.sin(values.internal),
        ],
        axis=1,
    )
    gaps = np.abs(numbers[:, None] - numbers[None]).max(axis=-1) + np.eye(len(values))
    assert gaps.min() > APART


def test_mirror_images_have_the_other_sign():
    """A reflection in the base's plane turns the determinant of six rows in space about."""
    machine = hexapod()
    values = machine.assembly_modes_result(machine.inverse(yawed(20)), np.random.default_rng(1))
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    for T, sign in zip(values.poses, values.sign, strict=True):
        other = int(np.argmin(np.abs(values.poses - flip @ T @ flip).max(axis=(-1, -2))))
        assert values.sign[other] == -sign


def test_a_sign_is_that_of_same_assembly():
    machine = hexapod()
    values = machine.assembly_modes_result(machine.inverse(yawed(20)), np.random.default_rng(2))
    np.testing.assert_array_equal(machine.same_assembly(values.poses), values.sign > 0)


def test_what_may_be_missing_shrinks_with_the_starts():
    """n starts miss a share p with probability (1 - p)^n: a thousandth at the stated share."""
    machine, T, readings = random_hexapod(3)
    short = search(machine, readings, T, 0)
    long = exhaustive(machine, readings, T, 0, 10_000)
    for item in (short, long):
        assert (1 - item.missing) ** item.closed == pytest.approx(1e-3)
    assert long.missing < short.missing / 5
    # and the modes that there are, are met more often than that
    assert short.mode_numbers.min() / short.closed > short.missing


def test_readings_that_close_nothing_have_no_mode():
    machine = hexapod()
    count = search(machine, np.array([0.4] * 5 + [3.0]), machine.home(), 0, most=5000)
    assert len(count) == 0
    assert count.missing == 1.0
    assert not count.complete
    assert count.poses.shape == (0, 4, 4)


def test_the_same_seed_finds_the_same():
    machine, T, readings = random_hexapod(5)
    first, second = (search(machine, readings, T, 7) for _ in range(2))
    np.testing.assert_array_equal(first.poses, second.poses)
    np.testing.assert_array_equal(first.mode_numbers, second.mode_numbers)


def test_modes_of_a_tripod_keep_its_orientation():
    machine = tripod()
    count = machine.assembly_modes_result(machine.inverse(machine.home()), np.random.default_rng(0))
    np.testing.assert_array_equal(count.poses[:, :3, :3], np.tile(np.eye(3), (len(count), 1, 1)))
    assert sorted(count.sign) == [-1, 1]


def test_more_rods_than_freedoms_have_no_sign():
    """Four rods hold three translations: no determinant, and no promise."""
    rod = "actuated: true, range: [0.3, 0.6]"
    feet = [(0.3, 0, 0), (0, 0.3, 0), (-0.3, 0, 0), (0, -0.3, 0)]
    machine = machine_of(
        "translation", [(foot, (0, 0, 0), rod) for foot in feet], "home: {position: [0, 0, 0.3]}\n"
    )
    readings = machine.inverse(machine.home())
    count = machine.assembly_modes_result(readings, np.random.default_rng(0))
    assert len(count) == 2
    np.testing.assert_array_equal(count.sign, 0)
    assert machine.same_assembly(count.poses).all()


def test_poses_of_the_workspace_are_among_their_modes():
    machine = hexapod()
    for T in workspace(machine, 3, 4):
        modes = machine.assembly_modes(machine.inverse(T), np.random.default_rng(0))
        assert np.abs(modes - T).max(axis=(-1, -2)).min() < APART
