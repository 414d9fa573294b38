"""Repeated images of a board as one pose: known noise is recovered, outlying repeats are
rejected.
"""

from __future__ import annotations

import numpy as np
import pytest

from pkmcal.boards.board import Detection
from pkmcal.boards.poses import mean_poses, one_a_configuration
from pkmcal.geometry.rigid import apply, perturb, pose_difference
from test_targets import CAMERA, board, corners_in_view, poses_around  # noqa: F401 - board is a fixture

CONFIGURATIONS, REPEATS = 300, 5
SIGMA = np.repeat([3e-4, 2e-4], 3)
"""Noise of one image's pose, rad and m."""
FOUR = 4 * np.sqrt(2 / (6 * CONFIGURATIONS))
"""Four standard deviations of the mean of as many squares of unit normals."""


def repeated(alone, common, seed=0, n=CONFIGURATIONS, repeats=REPEATS):
    """True poses (n, 4, 4), and repeats of each with independent and common errors, as shares of
    the variance that each image states.
    """
    rng = np.random.default_rng(seed)
    truth = poses_around(n, seed)
    shared = np.repeat(np.sqrt(common) * SIGMA * rng.normal(size=(n, 6)), repeats, axis=0)
    own = np.sqrt(alone) * SIGMA * rng.normal(size=(n * repeats, 6))
    rows = np.repeat(np.arange(n), repeats)
    T = perturb(truth[rows], shared + own)
    return truth, rows, T, np.broadcast_to(np.diag(SIGMA**2), (len(rows), 6, 6))


def squares(value, truth):
    """Mean of the errors' squares by the stated covariance, one number of six."""
    error = pose_difference(value.pose, truth)
    white = np.linalg.solve(np.linalg.cholesky(value.covariance), error[..., None])
    return float(np.mean(white**2))


@pytest.mark.parametrize("common", [0.0, 0.5, 0.9])
def test_errors_are_what_the_mean_states(common):
    truth, rows, T, covariance = repeated(1 - common, common)
    value = mean_poses(rows, T, covariance, common)
    assert value.used.all()
    assert squares(value, truth) == pytest.approx(1.0, abs=FOUR)
    expected = SIGMA * np.sqrt(common + (1 - common) / REPEATS)
    np.testing.assert_allclose(np.sqrt(np.diag(value.covariance[0])), expected, rtol=0.03)


def test_a_floor_that_shakes_is_measured():
    """Repeats that scatter three times more than they state, whatever they have in common."""
    for common in (0.0, 0.5):
        truth, rows, T, covariance = repeated(9.0 * (1 - common), common, seed=1)
        value = mean_poses(rows, T, covariance, common)
        assert squares(value, truth) == pytest.approx(1.0, abs=FOUR)
        variance = common + 9 * (1 - common) / REPEATS
        np.testing.assert_allclose(
            np.diagonal(value.covariance, axis1=1, axis2=2) / SIGMA**2, variance, rtol=0.1
        )


def test_repeats_that_agree_too_well_promise_nothing_more():
    _, rows, T, covariance = repeated(0.01, 0.0)
    count = mean_poses(rows, T, covariance, 0.0)
    np.testing.assert_allclose(count.covariance, covariance[: len(count.pose)] / REPEATS)


def test_what_is_common_does_not_average_out():
    """The error of a hundred repeats is the common part, and the covariance contains it."""
    truth, rows, T, covariance = repeated(0.5, 0.5, n=30, repeats=100)
    value = mean_poses(rows, T, covariance, 0.5)
    error = pose_difference(value.pose, truth)
    assert np.sqrt(np.mean((error / SIGMA) ** 2)) == pytest.approx(np.sqrt(0.505), rel=0.2)
    assert squares(value, truth) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 180))
    wrong = mean_poses(rows, T, covariance, 0.0)
    assert squares(wrong, truth) > 20


def test_a_repeat_elsewhere_is_let_go():
    _, rows, T, covariance = repeated(1.0, 0.0, n=20)
    spoilt = T.copy()
    spoilt[12] = perturb(T[12], 40 * SIGMA)
    results = mean_poses(rows, spoilt, covariance, 0.0)
    assert np.flatnonzero(~results.used).tolist() == [12]
    assert results.off[12] == pytest.approx(40, rel=0.1)
    without = np.delete(np.arange(len(rows)), 12)
    expected = mean_poses(rows[without], T[without], covariance[without], 0.0)
    np.testing.assert_allclose(results.pose, expected.pose, atol=1e-12)
    # one repeat less, so a little less is known of it
    assert results.covariance[2, 0, 0] / results.covariance[0, 0, 0] == pytest.approx(5 / 4)


def test_of_two_that_differ_both_stay():
    _, rows, T, covariance = repeated(1.0, 0.0, n=20, repeats=2)
    T[6] = perturb(T[6], 40 * SIGMA)
    value = mean_poses(rows, T, covariance, 0.0)
    assert value.used.all()
    assert value.covariance[0, 0, 0] > 10 * SIGMA[0] ** 2


# boards in images


def images(board, rows, noise, seed=0):  # noqa: F811
    """Detections of one board pose for each row, and the true poses of the rows in order."""
    rng = np.random.default_rng(seed)
    truth = poses_around(int(rows.max()) + 1)
    pixels = CAMERA.project(apply(truth[rows][:, None], board.points))
    pixels = pixels + noise * rng.normal(size=pixels.shape)
    ids = np.arange(len(board.points))
    results = [
        Detection(f"{k:04d}.png", CAMERA.image_size, ids, p, np.full(len(ids), noise))
        for k, p in enumerate(pixels)
    ]
    return results, truth


def test_images_of_one_configuration_become_one_measurement(board):  # noqa: F811
    rows = np.repeat(np.arange(60), 4)
    value, truth = images(board, rows, 0.1)
    poses, odd = one_a_configuration(corners_in_view(board, value, rows), mount=3)
    assert poses.configuration.tolist() == list(range(60))
    assert set(poses.mount.tolist()) == {3}
    assert odd == ()
    error = pose_difference(poses.T_station_target, truth)
    white = np.einsum("nij,nj->ni", poses.whiten, error)
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.3)
    single, _ = one_a_configuration(corners_in_view(board, value[::4], rows[::4]), mount=3)
    gain = np.linalg.norm(poses.whiten, axis=(1, 2)) / np.linalg.norm(single.whiten, axis=(1, 2))
    np.testing.assert_allclose(gain, 2.0, rtol=0.15)  # the root of four images


def test_an_odd_image_is_named(board):  # noqa: F811
    rows = np.repeat(np.arange(6), 4)
    values, truth = images(board, rows, 0.1)
    shifted = perturb(truth[2], np.array([0, 0, 0, 2e-3, 0, 0]))
    pixels = CAMERA.project(apply(shifted, board.points))
    values[9] = Detection(values[9].name, CAMERA.image_size, values[9].ids, pixels, values[9].sigma)
    _, (odd,) = one_a_configuration(corners_in_view(board, values, rows), mount=0)
    assert odd.configuration == 2
    assert "from where the repeats show it" in odd.reason
