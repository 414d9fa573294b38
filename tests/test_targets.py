"""Boards as measurements: poses from corners, and a board on the base that must stand still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from faults import raises
from pkmcal.boards.board import Detection, chessboard
from pkmcal.boards.poses import (
    board_views,
    detect_again,
    detect_in,
    one_a_configuration,
    standing_board,
)
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, perturb, pose, pose_difference, rotation
from test_boards import CAMERAS, FILES, board_of, render

CAMERA = CAMERAS["pinhole"]
NOISE = 0.05
"""px"""


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    return board_of(tmp_path_factory.mktemp("board"), FILES["charuco"])


def before(tilt=(0.3, -0.45, 0.1), place=(-0.12, -0.09, 0.45)):
    """A pose T_camera_board with the whole board in the image."""
    return pose(rotation(np.array(tilt)), np.array(place))


def poses_around(n, seed=0):
    """Tilted boards in different places, (n, 4, 4)."""
    rng = np.random.default_rng(seed)
    step = np.concatenate([rng.normal(0, 0.15, (n, 3)), rng.normal(0, 0.02, (n, 3))], axis=1)
    return perturb(np.tile(before(), (n, 1, 1)), step)


def detections(board, T_camera_board, seed=0, noise=NOISE, camera=CAMERA):
    """Output of a detector: corners with normal noise of stated size."""
    rng = np.random.default_rng(seed)
    pixels = camera.project(apply(T_camera_board[:, None], board.points))
    pixels = pixels + noise * rng.standard_normal(pixels.shape)
    ids = np.arange(len(board.points))
    return [
        Detection(f"{k:04d}.png", camera.image_size, ids, p, np.full(len(ids), noise))
        for k, p in enumerate(pixels)
    ]


def corners_in_view(board, value, rows=None, camera=CAMERA):
    rows = np.arange(len(value)) if rows is None else np.asarray(rows)
    return board_views(2, camera, rows, board, value)


def chi2(error, whiten):
    z = np.einsum("nij,nj->ni", whiten, error)
    return np.sum(z**2, axis=-1)


def without(detection, keep):
    """A detection of some of its corners."""
    return replace(
        detection,
        ids=detection.ids[keep],
        pixels=detection.pixels[keep],
        sigma=detection.sigma[keep],
    )


# poses and their uncertainty


def test_errors_of_poses_are_what_their_covariances_say(board):
    n = 200
    truth = poses_around(n)
    poses = one_a_configuration(corners_in_view(board, detections(board, truth)), mount=0)[0]
    assert len(poses) == n
    assert set(poses.station.tolist()) == {2}
    # 1200 squares of unit normals: four standard deviations of their mean
    value = chi2(pose_difference(poses.T_station_target, truth), poses.whiten)
    assert value.mean() / 6 == pytest.approx(1.0, abs=4 * np.sqrt(2 / (6 * n)))


def test_rendered_boards(board):
    """Whole images: the errors match their covariances."""
    truth = poses_around(4, seed=3)
    images = [render(CAMERA, T, board, seed=k) for k, T in enumerate(truth)]
    result = detect_in(images, board, [f"{k}.png" for k in range(4)])
    poses = one_a_configuration(corners_in_view(board, result), mount=0)[0]
    error = pose_difference(poses.T_station_target, truth)
    value = chi2(error, poses.whiten)
    # 24 squares; sigma is by what the corner's fit leaves, which is a little too large
    assert 0.2 < value.mean() / 6 < 1.5
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert np.all(rms[:3] < 1e-3)
    assert np.all(rms[3:] < 3e-4)


def test_a_hidden_part_costs_certainty_not_truth(board):
    T = poses_around(1)
    whole = detections(board, T)[0]
    part = without(whole, np.arange(12, 30))
    both = corners_in_view(board, [whole, part])
    error = pose_difference(both.poses.T_camera_board, np.tile(T, (2, 1, 1)))
    poses = one_a_configuration(both, 0)[0]
    assert np.all(chi2(error, poses.whiten) < 24)  # one in two thousand
    sigma = np.sqrt(np.einsum("nii->ni", both.poses.covariance))
    assert np.all(sigma[1] > 1.2 * sigma[0])


def test_outlying_corners_lose_their_weight(board):
    T = poses_around(3)
    value = detections(board, T)
    spoilt = value[1].pixels.copy()
    spoilt[[3, 17, 40]] += [[6.0, -4.0], [-5.0, 5.0], [8.0, 0.0]]
    value[1] = replace(value[1], pixels=spoilt)
    views = corners_in_view(board, value)
    assert np.all(views.poses.weight[1, [3, 17, 40]] == 0)
    assert views.poses.weight[1].sum() > 40
    poses = one_a_configuration(views, 0)[0]
    assert np.all(chi2(pose_difference(poses.T_station_target, T), poses.whiten) < 24)


def test_images_without_a_board_are_rejected_with_the_reason(board):
    values = detections(board, poses_around(3))
    none = np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0)
    values[1] = Detection("0001.png", CAMERA.image_size, *none, reason="nothing is recognised")
    views = corners_in_view(board, values, rows=[4, 5, 6])
    (item,) = views.rejected
    assert (item.station, item.configuration, item.leg) == (2, 5, -1)
    assert item.reason == "the board: nothing is recognised"
    assert one_a_configuration(views, 0)[0].configuration.tolist() == [4, 6]


def test_no_image_shows_it(board):
    none = np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0)
    missed = Detection("0000.png", CAMERA.image_size, *none, reason="nothing is recognised")
    views = corners_in_view(board, [missed])
    assert len(one_a_configuration(views, 0)[0]) == 0
    assert standing_board(views) is None


def test_a_tilt_that_is_not_sure_is_rejected(board):
    """Far away and seen from straight ahead, a board tilted left looks like one tilted right."""
    far = before(tilt=(0.0, 0.06, 0.0), place=(-0.12, -0.09, 6.0))
    views = corners_in_view(board, detections(board, far[None], noise=0.1))
    assert not views.usable[0]
    assert "its tilt is not sure" in views.rejected[0].reason
    near = before(tilt=(0.0, 0.5, 0.0))
    assert corners_in_view(board, detections(board, near[None], noise=0.1)).usable[0]


# boards that cannot be used


def test_a_board_that_looks_the_same_turned_round():
    turnable = chessboard((8, 6), 0.03)
    with raises(InputError, code="board.ambiguous", found="a chessboard of 8x6 inner corners"):
        corners_in_view(turnable, [])


def test_mirrored_images(board):
    results = [replace(d, mirrored=True) for d in detections(board, poses_around(2))]
    with raises(InputError, code="image.mirrored", where="0000.png and 0001.png"):
        corners_in_view(board, results)


def test_one_mirrored_image_is_named_alone(board):
    value = detections(board, poses_around(3))
    value[1] = replace(value[1], mirrored=True)
    with raises(InputError, code="image.mirrored", where="0001.png") as caught:
        corners_in_view(board, value)
    assert "2 other images" in caught.value.found


def test_corners_that_are_not_this_boards(board):
    """The images' squares are half as long again in one direction."""
    stretched = replace(board, points=board.points * [1.5, 1.0, 1.0])
    value = detections(stretched, poses_around(3))
    with raises(InputError, code="board.contradicted") as caught:
        corners_in_view(board, value)
    assert "px rms off their places (a ChArUco board of 9x7 squares)" in caught.value.found


def test_slow_ways_are_tried_on_some_chessboards_only(tmp_path, monkeypatch):
    tried = []

    def detect(image, _board, name="", quick=False):
        if not quick:
            tried.append(name)
        none = np.zeros(0, dtype=int), np.zeros((0, 2)), np.zeros(0)
        return Detection(name, (8, 6), *none, reason="none")

    monkeypatch.setattr("pkmcal.boards.poses.detect_board", detect)
    images = [np.zeros((6, 8), dtype=np.uint8)] * 9
    kinds = {kind: board_of(tmp_path, FILES[kind]) for kind in ("chessboard", "charuco")}
    for kind, most, count in (("chessboard", 3, 3), ("chessboard", 0, 0), ("charuco", 9, 0)):
        tried.clear()
        value = detect_in(images, kinds[kind], [str(k) for k in range(9)])
        assert len(detect_again(images, kinds[kind], value, most)) == 9
        assert len(tried) == count
        assert sorted(tried) == (["0", "4", "8"] if count else [])


# a board on the base


def still(board, n=8, moves=(), seed=0):
    """Detections of a board at rest; moves : {image: (6,) perturbation}."""
    T = np.tile(before(), (n, 1, 1))
    for k, step in dict(moves).items():
        T[k] = perturb(T[k], np.asarray(step))
    return detections(board, T, seed=seed)


AWAY = (0.0, 0.0, 0.0, 2e-3, 0.0, 0.0)


@pytest.mark.slow
def test_a_still_board_is_one_measurement(board):
    """Its covariance is that of the mean, and matches its error, over many sessions."""
    values, sigmas = [], []
    for seed in range(20):
        views = corners_in_view(board, still(board, seed=seed), rows=np.arange(8) + 3)
        stood = standing_board(views)
        assert stood.agreed.all()
        assert stood.rejected == ()
        poses = stood.poses(views, mount=0)
        assert (len(poses), poses.station[0], poses.configuration[0]) == (1, 2, 3)
        error = pose_difference(poses.T_station_target, before()[None])
        values.append(chi2(error, poses.whiten)[0])
        sigmas.append(np.sqrt(np.diag(stood.covariance) / np.diag(views.poses.covariance[0])))
    assert np.mean(values) / 6 == pytest.approx(1.0, abs=4 * np.sqrt(2 / 120))
    np.testing.assert_allclose(np.mean(sigmas, axis=0), 1 / np.sqrt(8), rtol=0.1)


@pytest.mark.parametrize("n", [4, 5, 8])
def test_a_board_between_two_places_is_not_still(board, n):
    views = corners_in_view(board, still(board, n, dict.fromkeys(range(1, n, 2), AWAY)))
    with raises(InputError, code="board.not_still"):
        standing_board(views)


def test_what_all_images_share_does_not_average_out(board):
    """Corners printed in slightly wrong places: more images do not reduce the pose's covariance."""
    rng = np.random.default_rng(5)
    printed = replace(board, points=board.points + [1, 1, 0] * rng.normal(0, 5e-5, (48, 3)))
    few, many = (
        standing_board(
            corners_in_view(board, detections(printed, np.tile(before(), (n, 1, 1)), noise=0.01))
        )
        for n in (2, 30)
    )
    assert many.noise == pytest.approx(0.055, rel=0.3)  # 0.05 mm at 1.1 px a mm
    np.testing.assert_allclose(np.diag(many.covariance), np.diag(few.covariance), rtol=0.15)


def test_a_trembling_camera_makes_the_pose_less_sure(board):
    rng = np.random.default_rng(2)
    tremble = {k: np.concatenate([np.zeros(3), rng.normal(0, 1e-4, 3)]) for k in range(8)}
    quiet = standing_board(corners_in_view(board, still(board)))
    shaken = standing_board(corners_in_view(board, still(board, moves=tremble)))
    assert shaken.agreed.all()
    assert shaken.scatter > 1.5 * quiet.scatter
    assert np.all(np.diag(shaken.covariance)[3:5] > 2 * np.diag(quiet.covariance)[3:5])


def test_one_image_is_enough_and_does_not_test_for_motion(board):
    views = corners_in_view(board, still(board, n=1))
    stood = standing_board(views)
    assert np.isnan(stood.scatter)
    np.testing.assert_allclose(stood.covariance, views.poses.covariance[0], rtol=0.2)


@pytest.mark.parametrize("odd", [0, 4, 7])
def test_one_image_that_disagrees_is_left_out(board, odd):
    stood = standing_board(corners_in_view(board, still(board, moves={odd: AWAY})))
    assert np.flatnonzero(~stood.agreed).tolist() == [odd]
    (item,) = stood.rejected
    assert item.configuration == odd
    assert item.reason.startswith("the board stands 1.9 px")
    assert item.reason.endswith(" from where the other images show it")


@pytest.mark.parametrize(
    ("moved", "last", "first"),
    [
        ([5, 6, 7], "0004.png", "0005.png"),
        ([6, 7], "0005.png", "0006.png"),
        ([0, 1], "0001.png", "0002.png"),
        ([3, 4], "0002.png", "0003.png"),
    ],
)
def test_a_board_that_moved(board, moved, last, first):
    with raises(InputError, code="board.not_still", where=first) as caught:
        standing_board(corners_in_view(board, still(board, moves=dict.fromkeys(moved, AWAY))))
    assert caught.value.what.endswith(f"after {last}")
    assert "px away (2.0 mm, 0.0" in caught.value.found


def test_a_board_that_never_stood_still(board):
    moves = {k: (0, 0, 0, 2e-3 * k, 0, 0) for k in (1, 3, 5)}
    with raises(InputError, code="board.not_still") as caught:
        standing_board(corners_in_view(board, still(board, moves=moves)))
    assert caught.value.found.startswith("3 of 8 images")


def test_all_camera_models_see_a_still_board(board):
    for model in ("fisheye", "unified"):
        camera = CAMERAS[model]
        place = before(place=(-0.12, -0.09, 0.2))
        values = detections(board, np.tile(place, (4, 1, 1)), camera=camera)
        stood = standing_board(corners_in_view(board, values, camera=camera))
        assert stood.agreed.all()
        error = pose_difference(stood.T_camera_board, place)
        assert error @ np.linalg.solve(stood.covariance, error) < 24
