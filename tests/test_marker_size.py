"""A ChArUco board whose markers differ in size from its file."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from faults import raises
from pkmcal.boards.detect import detect_boards, marker_share
from pkmcal.boards.find import detect_board, detect_markers, dictionary
from pkmcal.errors import InputError
from test_boards import CAMERAS, FILES, board_of, render
from test_targets import poses_around

TRUE = 0.022 / 0.03


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    board = board_of(tmp_path_factory.mktemp("board"), FILES["charuco"])
    return [render(CAMERAS["pinhole"], T, board, seed=k) for k, T in enumerate(poses_around(4))]


@pytest.fixture
def paths(images, tmp_path):
    out = [tmp_path / f"{k}.png" for k in range(len(images))]
    for path, image in zip(out, images, strict=True):
        cv2.imwrite(str(path), image)
    return out


def described(tmp_path, marker):
    return board_of(tmp_path, FILES["charuco"].replace("marker: 0.022", f"marker: {marker}"))


def test_markers_are_measured_in_images(images, tmp_path):
    board = board_of(tmp_path, FILES["charuco"])
    words = dictionary(board.document["dictionary"])
    shares = [
        marker_share(detect_markers(image, words), board, detect_board(image, board))
        for image in images
    ]
    np.testing.assert_allclose(shares, TRUE, rtol=0.03)


@pytest.mark.parametrize("marker", [0.015, 0.019, 0.026])
def test_a_wrong_size_is_reported_with_the_right_one(paths, tmp_path, marker):
    with raises(InputError, code="board.marker_size") as caught:
        detect_boards(paths, described(tmp_path, marker))
    assert caught.value.expected.endswith(f"by marker: {marker} and square: 0.03")
    assert caught.value.found.startswith("markers 0.7")


@pytest.mark.parametrize("marker", [0.021, 0.022, 0.0235])
def test_what_a_ruler_may_be_off_is_accepted(paths, tmp_path, marker):
    assert all(detection.success for detection in detect_boards(paths, described(tmp_path, marker)))
