"""Camera and board found from board poses and readings alone, on every machine of the catalogue."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError, ResultError
from pkmcal.geometry.rigid import perturb, pose, pose_difference, rotation
from pkmcal.identify.hand_eye import size_of, solve_pairs, start_from_poses
from pkmcal.measurements import (
    EdgeSet,
    Measurements,
    Mount,
    PoseSet,
    concatenate,
)
from pkmcal.mechanisms import catalogue, load_mechanism
from pkmcal.mechanisms.kinematics import on_manifold
from test_identify_scene import exact

NOISE = np.repeat([np.radians(0.03), 2e-4], 3)
BOARD = (Mount("board", "platform"),)
MACHINES = sorted(catalogue())


def true_machine(nominal, rng, shift=0.002, turn=0.035):
    table = nominal.parameters
    kinds = np.array([table.kinds[k] for k in table.first_of_free()])
    sigma = np.where(np.isin(kinds, ["axis", "angle"]), turn, shift) * (kinds != "radius")
    sigma = np.where(kinds == "scale", table.tolerances_free(), sigma)
    if nominal.name == "3-upu":  # its axes are parallel in pairs, or it does not translate
        sigma = sigma * (kinds != "axis")
    return nominal.with_values(
        nominal.values + table.free_matrix() @ (sigma * rng.normal(size=len(sigma)))
    )


def platform_poses(machine, rng, count=30):
    """Poses that the machine can take, and its readings there."""
    reach = 0.15 * size_of(machine)
    motion = machine.layout.motion
    steps = rng.uniform(-1, 1, (count, 6)) * np.repeat([0.25, reach], 3)
    value = on_manifold(
        machine.layout, machine.values, perturb(machine.home(), steps @ motion @ motion.T)
    )
    readings = machine.inverse(value.T_base_platform)
    good = value.converged & np.isfinite(readings).all(axis=1)
    assert good.sum() > count // 2
    return value.T_base_platform[good], readings[good]


def anywhere(rng, reach):
    """A pose turned by anything."""
    return pose(rotation(rng.normal(size=3) * 1.5), reach * rng.normal(size=3))


def simulated_poses(camera, body, mount, rng, station=0, number=0):
    n = len(body)
    noise = NOISE * rng.normal(size=(n, 6))
    return PoseSet(
        np.full(n, station),
        np.arange(n),
        np.full(n, number),
        perturb(camera @ body @ mount, noise),
        np.broadcast_to(np.diag(1 / NOISE), (n, 6, 6)),
    )


def measured(poses, joints, stations=1, mounts=BOARD):
    return Measurements(
        EdgeSet.empty(), joints, 1e-5, stations, np.zeros(stations, int), poses=poses, mounts=mounts
    )


def off(state, poses):
    """Median turn (rad) and shift (m) of the boards' predicted poses."""
    moving = state.on_platform[poses.mount][:, None, None]
    body = np.where(moving, state.T_base_platform[poses.configuration], np.eye(4))
    predicted = state.T_camera_base[poses.station] @ body @ state.T_mount[poses.mount]
    error = pose_difference(predicted, poses.T_station_target)
    return [float(np.median(np.linalg.norm(part, axis=1))) for part in (error[:, :3], error[:, 3:])]


@pytest.mark.parametrize("name", MACHINES)
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_every_machine_with_a_nominal_model_2_mm_and_2_degrees_off(name, seed):
    """Prediction as good as the nominal model allows; a wrong branch would be off by a radian."""
    rng = np.random.default_rng(seed)
    nominal = exact(name)
    truth = true_machine(nominal, rng)
    body, joints = platform_poses(truth, rng)
    camera, mount = anywhere(rng, 1.0), anywhere(rng, 0.05)
    data = measured(simulated_poses(camera, body, mount, rng), joints)
    state = start_from_poses(nominal, data)
    turn, shift = off(state, data.poses)
    assert turn < np.radians(6)
    assert shift < 0.02
    assert np.linalg.norm(pose_difference(state.T_camera_base[0], camera)[:3]) < np.radians(10)


@pytest.mark.parametrize("name", MACHINES)
def test_the_right_nominal_model_leaves_the_noise(name):
    rng = np.random.default_rng(1)
    machine = load_mechanism(name)
    body, joints = platform_poses(machine, rng)
    camera, mount = anywhere(rng, 1.0), anywhere(rng, 0.05)
    data = measured(simulated_poses(camera, body, mount, rng), joints)
    state = start_from_poses(machine, data)
    turn, shift = off(state, data.poses)
    assert turn < 2 * np.radians(0.03)
    assert shift < 1e-3
    values = pose_difference(state.T_camera_base[0], camera)
    assert np.linalg.norm(values[:3]) < 0.02


def test_what_the_motion_does_not_determine_stays_zero():
    """[C] III.C: a board's place on a platform that does not turn, and along the only axis."""
    rng = np.random.default_rng(0)
    body = np.broadcast_to(np.eye(4), (12, 4, 4)).copy()
    body[:, :3, 3] = rng.normal(size=(12, 3)) * 0.1
    camera, mount = anywhere(rng, 1.0), anywhere(rng, 0.05)
    still = solve_pairs(body[None], (camera @ body @ mount)[None], 0.4)
    np.testing.assert_allclose(still.T_mount[0, :3, 3], 0, atol=1e-12)
    body[:, :3, :3] = rotation(rng.normal(size=(12, 1)) * np.array([0, 0, 0.3]))
    one_axis = solve_pairs(body[None], (camera @ body @ mount)[None], 0.4)
    assert abs(one_axis.T_mount[0, 2, 3]) < 1e-9
    np.testing.assert_allclose(one_axis.T_mount[0, :2, 3], mount[:2, 3], atol=1e-4)
    for pair in (still, one_axis):
        # the rotations are fully determined, by the positions
        np.testing.assert_allclose(pair.T_camera_base[0, :3, :3], camera[:3, :3], atol=2e-3)


def test_boards_that_slipped_do_not_lead_astray():
    rng = np.random.default_rng(5)
    machine = load_mechanism("gough-stewart")
    body, joints = platform_poses(machine, rng)
    camera, mount = anywhere(rng, 1.0), anywhere(rng, 0.05)
    poses = simulated_poses(camera, body, mount, rng)
    wrong = poses.T_station_target.copy()
    wrong[:6] = wrong[:6] @ anywhere(rng, 0.1)
    state = start_from_poses(machine, measured(replace(poses, T_station_target=wrong), joints))
    values = pose_difference(state.T_camera_base[0], camera)
    assert np.linalg.norm(values[:3]) < 0.01
    assert np.linalg.norm(values[3:]) < 0.01


def test_several_stations_and_mounts_are_chained():
    """Station 2 sees only the board on the base, which station 1 sees too; station 3 a second
    board on the platform, whose pose is known roughly.
    """
    rng = np.random.default_rng(7)
    machine = load_mechanism("gough-stewart")
    body, joints = platform_poses(machine, rng)
    cameras = [anywhere(rng, 1.0) for _ in range(3)]
    mounts = [anywhere(rng, 0.05), anywhere(rng, 0.3), anywhere(rng, 0.05)]
    still = np.broadcast_to(np.eye(4), body.shape)
    poses = concatenate(
        [
            simulated_poses(cameras[0], body, mounts[0], rng),
            simulated_poses(cameras[0], still, mounts[1], rng, 0, 1),
            simulated_poses(cameras[1], still, mounts[1], rng, 1, 1),
            simulated_poses(cameras[2], body, mounts[2], rng, 2, 2),
        ]
    )
    kinds = (Mount("a", "platform"), Mount("b", "base"), Mount("c", "platform"))
    reference_values = np.full((3, 4, 4), np.nan)
    reference_values[2] = cameras[2]
    state = start_from_poses(machine, measured(poses, joints, 3, kinds), reference_values)
    assert np.array_equal(state.T_camera_base[2], cameras[2])
    error = pose_difference(state.T_camera_base, np.stack(cameras))
    assert np.abs(error).max() < 5e-3
    assert np.abs(pose_difference(state.T_mount, np.stack(mounts))).max() < 5e-3


def test_a_station_that_nothing_ties_is_reported():
    rng = np.random.default_rng(7)
    machine = load_mechanism("gough-stewart")
    body, joints = platform_poses(machine, rng)
    poses = simulated_poses(anywhere(rng, 1.0), body, anywhere(rng, 0.05), rng)
    with raises(InputError, code="station.unattached") as caught:
        start_from_poses(machine, measured(poses, joints, 2))
    assert "station 2 of 2" in caught.value.what
    with raises(InputError, code="station.unattached") as caught:
        start_from_poses(machine, measured(poses.select(np.arange(2)), joints))
    assert "station 1 of 1" in caught.value.what


def test_configurations_along_a_line_are_reported():
    rng = np.random.default_rng(7)
    body = np.broadcast_to(np.eye(4), (12, 4, 4)).copy()
    body[:, 0, 3] = np.linspace(-0.1, 0.1, 12)
    in_view = anywhere(rng, 1.0) @ body @ anywhere(rng, 0.05)
    with raises(ResultError, code="station.unidentifiable"):
        solve_pairs(body[None], in_view[None], 0.4)


def test_runs_are_solved_together():
    rng = np.random.default_rng(3)
    body = perturb(np.eye(4), rng.normal(size=(4, 20, 6)) * np.repeat([0.2, 0.1], 3))
    cameras = np.stack([anywhere(rng, 1.0) for _ in range(4)])
    mounts = np.stack([anywhere(rng, 0.05) for _ in range(4)])
    in_view = cameras[:, None] @ body @ mounts[:, None]
    together = solve_pairs(body, in_view, 0.4)
    for k in range(4):
        alone = solve_pairs(body[k : k + 1], in_view[k : k + 1], 0.4)
        np.testing.assert_allclose(together.T_camera_base[k], alone.T_camera_base[0], atol=1e-6)
    assert np.abs(pose_difference(together.T_camera_base, cameras)).max() < 2e-3
