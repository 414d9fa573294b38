"""Poses moved by hand: what was taken hold of is under the mouse, with every camera model."""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.cameras import camera_models
from pkmcal.geometry.rigid import apply, inverse, look_at, perturb, pose_difference
from pkmcal.mechanisms import load_mechanism
from pkmcal.mechanisms.closure import limb_ends
from pkmcal.viewing.gestures import (
    PINNED_JOINT_SIGMA,
    aimed,
    farther,
    pinned,
    rolled,
    triangle_poses,
    turned_as_ball,
)

CAMERAS = {
    "pinhole": [705.0, 706.0, 402.3, 297.8, -0.11, 0.09, 0.0004, -0.0003, 0.0],
    "fisheye": [420.0, 421.0, 401.0, 299.0, 0.01, -0.002, 0.0, 0.0],
    "unified": [500.0, 500.0, 400.0, 300.0, 0.9],
}
START, END = np.array([350.0, 260.0]), np.array([437.0, 301.0])


@pytest.fixture(params=CAMERAS)
def camera(request):
    model = camera_models()[request.param]
    parameters = np.zeros(len(model((800, 600), np.zeros(20)).parameter_names))
    given = CAMERAS[request.param]
    parameters[: len(given)] = given
    return model((800, 600), parameters)


@pytest.fixture(scope="module")
def points():
    machine = load_mechanism("gough-stewart")
    home = machine.home()
    ends = limb_ends(machine.layout, machine.values, machine.inverse(home[None])[0], home)
    return np.concatenate([ends.a, ends.b])


T = look_at(np.array([0.6, -0.8, 0.5]), np.array([0.02, 0.01, 0.2]), np.array([0.1, 0.0, 1.0]))


def projected(camera, T_camera_base, points):
    return camera.project(apply(T_camera_base, points))


def test_what_is_pulled_stays_under_the_mouse(camera):
    for away in (0.3, 2.0):
        point = apply(inverse(T), away * camera.ray(START))
        np.testing.assert_allclose(
            projected(camera, aimed(camera, T, START, END), point), END, atol=1e-5
        )


def test_a_turn_follows_the_mouse_and_leaves_the_middle(camera, points):
    middle, done = points.mean(axis=0), turned_as_ball(camera, T, points, START, END)
    np.testing.assert_allclose(apply(done, middle), apply(T, middle), atol=1e-12)
    ray = apply(T, middle) / np.linalg.norm(apply(T, middle))
    near = apply(inverse(T), apply(T, middle) - 0.1 * ray)  # on the side of the camera
    assert (projected(camera, done, near) - projected(camera, T, near)) @ (END - START) > 0


def test_a_roll_is_about_the_middle(camera, points):
    middle, done = points.mean(axis=0), rolled(camera, T, points, START, END)
    at = projected(camera, T, middle)
    np.testing.assert_allclose(projected(camera, done, middle), at, atol=1e-6)
    turn = pose_difference(done, T)[:3]
    sight = apply(T, middle) / np.linalg.norm(apply(T, middle))
    np.testing.assert_allclose(np.cross(turn, sight), 0, atol=1e-12)
    before, after = START - at, END - at
    assert (before[0] * after[1] - before[1] * after[0]) * (turn @ sight) > 0


def test_the_distance_grows_along_the_ray(camera, points):
    middle = points.mean(axis=0)
    at = projected(camera, T, middle)
    done = farther(camera, T, points, at, 1.5)
    np.testing.assert_allclose(apply(done, middle), 1.5 * apply(T, middle), atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_joints_come_to_their_places(camera, points, count):
    truth = perturb(T, np.array([0.05, -0.08, 0.1, 0.05, -0.04, 0.08]))
    pins = points[[0, 9, 4, 7, 2][:count]]
    places = projected(camera, truth, pins)
    done = pinned(camera, T, points, pins, places)
    # exactly; where all freedoms move, the pose by hand weighs in, within what a hand can do
    near = 1e-4 if count < 3 else PINNED_JOINT_SIGMA
    np.testing.assert_allclose(projected(camera, done, pins), places, atol=near)
    if count == 5:  # fewer joints fit from several places
        error = pose_difference(inverse(done), inverse(truth))
        assert np.linalg.norm(error[:3]) < 1e-3
        assert np.linalg.norm(error[3:]) < 1e-3


@pytest.mark.parametrize("count", [3, 5])
def test_three_joints_have_up_to_four_poses_the_true_one_among_them(camera, points, count):
    truth = perturb(T, np.array([0.4, -0.8, 1.0, 0.05, -0.04, 0.08]))
    pins = points[[0, 9, 4, 7, 2][:count]]
    places = projected(camera, truth, pins)
    poses = triangle_poses(camera, pins, places)
    assert 1 <= len(poses) <= 4
    assert (apply(poses[:, None], pins[:3])[..., 2] > 0).all()
    errors = [np.linalg.norm(pose_difference(one, truth)) for one in poses]
    assert min(errors) < 1e-5
    exact = [np.sort(np.abs(projected(camera, one, pins) - places).max(axis=1)) for one in poses]
    np.testing.assert_allclose(np.array(exact)[:, :3], 0.0, atol=1e-3)


def test_two_joints_have_no_such_pose(camera, points):
    places = projected(camera, T, points[:2])
    assert triangle_poses(camera, points[:2], places).shape == (0, 4, 4)


def test_a_pull_outside_the_picture_of_a_mirror_moves_nothing(points):
    camera = camera_models()["unified"](
        (800, 600), np.array([200.0, 200, 400, 300, 1.2, 0, 0, 0, 0, 0])
    )
    outside = np.array([5000.0, 0.0])
    assert np.isnan(camera.ray(outside)).all()
    np.testing.assert_array_equal(aimed(camera, T, START, outside), T)
    np.testing.assert_array_equal(turned_as_ball(camera, T, points, outside, END), T)
