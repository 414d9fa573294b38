"""Assembly modes: all that exist are found, counted, signed, and what may be missing is told."""

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
    moved = 0.25 * (seed % 20) / 19 * rng.uniform(-1, 1, centres.sum())
    values = machine.values.copy()
    values[centres] += moved
    machine = machine.with_values(values)
    poses = perturb(
        load_mechanism("gough-stewart").home(),
        rng.uniform(-1, 1, (2000, 6)) * np.repeat([0.5, 0.2], 3),
    )
    readings = machine.inverse(poses)
    low, high = machine.joint_ranges.T
    best = np.argmin(np.maximum(low - readings, readings - high).max(axis=-1))
    return machine, poses[best], readings[best]


def search(machine, readings, home, seed, most=100_000):
    return assembly_modes.assembly_modes(
        machine.layout, machine.values, readings, home, np.random.default_rng(seed), most
    )


def exhaustive(machine, readings, home, seed, starts, monkeypatch):
    """The same search, made to go on to its last start."""
    with monkeypatch.context() as patch:
        patch.setattr(assembly_modes, "RAREST_MODE_FINDS", 10**9)
        return search(machine, readings, home, seed, starts)


def assert_same(found, long):
    assert len(found) == len(long)
    for T in long.poses:
        assert np.abs(found.poses - T).max(axis=(-1, -2)).min() < APART


@pytest.mark.parametrize("seed", [0, 6, 12, 19])
def test_modes_of_random_hexapods_are_those_of_a_long_search(seed, monkeypatch):
    machine, T, readings = random_hexapod(seed)
    found = search(machine, readings, T, seed)
    assert found.complete
    assert np.abs(found.poses - T).max(axis=(-1, -2)).min() < APART  # the pose it came from
    long = exhaustive(machine, readings, T, 1000 + seed, 5000, monkeypatch)
    assert not long.complete
    assert long.starts == 5000
    assert_same(found, long)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_modes_of_twenty_random_hexapods_against_200000_starts(seed, monkeypatch):
    machine, T, readings = random_hexapod(seed)
    found = search(machine, readings, T, seed)
    assert found.complete
    assert_same(found, exhaustive(machine, readings, T, 1000 + seed, 200_000, monkeypatch))


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_every_mode_closes_the_machine_once(name):
    machine = load_mechanism(name)
    readings = machine.inverse(machine.home())
    found = machine.assembly_modes_result(readings, np.random.default_rng(0))
    c = closure(machine.layout, machine.values, readings, found.poses, found.internal)
    assert np.abs(c.rows.value).max() < CONVERGED_CLOSURE_ERROR
    # home is the first, with its own sign
    np.testing.assert_allclose(found.poses[0], machine.home(), atol=1e-6)
    if machine.layout.overdetermined:  # no determinant tells its assemblies apart
        assert set(found.sign) == {0}
    else:
        assert found.sign[0] == 1
        assert set(found.sign) <= {-1, 1}
    assert found.found.sum() == found.closed <= found.starts
    assert found.found.min() >= assembly_modes.RAREST_MODE_FINDS
    numbers = np.concatenate(
        [
            found.poses[:, :3].reshape(len(found), -1),
            np.cos(found.internal),
            np.sin(found.internal),
        ],
        axis=1,
    )
    gaps = np.abs(numbers[:, None] - numbers[None]).max(axis=-1) + np.eye(len(found))
    assert gaps.min() > APART


def test_mirror_images_have_the_other_sign():
    """A reflection in the base's plane turns the determinant of six rows in space about."""
    machine = hexapod()
    found = machine.assembly_modes_result(machine.inverse(yawed(20)), np.random.default_rng(1))
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    for T, sign in zip(found.poses, found.sign, strict=True):
        other = int(np.argmin(np.abs(found.poses - flip @ T @ flip).max(axis=(-1, -2))))
        assert found.sign[other] == -sign


def test_a_sign_is_that_of_same_assembly():
    machine = hexapod()
    found = machine.assembly_modes_result(machine.inverse(yawed(20)), np.random.default_rng(2))
    np.testing.assert_array_equal(machine.same_assembly(found.poses), found.sign > 0)


def test_what_may_be_missing_shrinks_with_the_starts(monkeypatch):
    """A share p is missed by n starts with (1 - p)^n: a thousandth at what is told."""
    machine, T, readings = random_hexapod(3)
    short = search(machine, readings, T, 0)
    long = exhaustive(machine, readings, T, 0, 10_000, monkeypatch)
    for found in (short, long):
        assert (1 - found.missing) ** found.closed == pytest.approx(1e-3)
    assert long.missing < short.missing / 5
    # and the modes that there are, are met more often than that
    assert short.found.min() / short.closed > short.missing


def test_readings_that_close_nothing_have_no_mode():
    machine = hexapod()
    found = search(machine, np.array([0.4] * 5 + [3.0]), machine.home(), 0, most=5000)
    assert len(found) == 0
    assert found.missing == 1.0
    assert not found.complete
    assert found.poses.shape == (0, 4, 4)


def test_the_same_seed_finds_the_same():
    machine, T, readings = random_hexapod(5)
    first, second = (search(machine, readings, T, 7) for _ in range(2))
    np.testing.assert_array_equal(first.poses, second.poses)
    np.testing.assert_array_equal(first.found, second.found)


def test_modes_of_a_tripod_keep_its_orientation():
    machine = tripod()
    found = machine.assembly_modes_result(machine.inverse(machine.home()), np.random.default_rng(0))
    np.testing.assert_array_equal(found.poses[:, :3, :3], np.tile(np.eye(3), (len(found), 1, 1)))
    assert sorted(found.sign) == [-1, 1]


def test_more_rods_than_freedoms_have_no_sign():
    """Four rods hold three translations: no determinant, and no promise."""
    rod = "actuated: true, range: [0.3, 0.6]"
    feet = [(0.3, 0, 0), (0, 0.3, 0), (-0.3, 0, 0), (0, -0.3, 0)]
    machine = machine_of(
        "translation", [(foot, (0, 0, 0), rod) for foot in feet], "home: {position: [0, 0, 0.3]}\n"
    )
    readings = machine.inverse(machine.home())
    found = machine.assembly_modes_result(readings, np.random.default_rng(0))
    assert len(found) == 2
    np.testing.assert_array_equal(found.sign, 0)
    assert machine.same_assembly(found.poses).all()


def test_poses_of_the_workspace_are_among_their_modes():
    machine = hexapod()
    for T in workspace(machine, 3, 4):
        modes = machine.assembly_modes(machine.inverse(T), np.random.default_rng(0))
        assert np.abs(modes - T).max(axis=(-1, -2)).min() < APART
