"""`pkmcal camera` as a user runs it: images of a board in, a camera file out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import run, two_camera_models
from document_keys import assert_keys
from pkmcal.cameras import load_camera
from rendered import once
from test_boards import board_of, camera_of, render
from test_camera_calibration import poses_for

BOARD = "type: charuco\nsquares: [8, 6]\nsquare: 0.03\nmarker: 0.022\ndictionary: DICT_5X5_100\n"
TRUTH = camera_of("pinhole", 620.0, 622.0, 318.0, 242.0, -0.12, 0.05, 0.0, 0.0, 0.0)


@pytest.fixture(scope="session")
def boards(common):
    """A folder with board.yaml and eight images of it; tests must not write into it."""

    def make(folder: Path) -> None:
        folder.mkdir()
        board = board_of(folder, BOARD)
        for k, pose in enumerate(poses_for(TRUTH, 8, seed=2)):
            cv2.imwrite(str(folder / f"p{k}.png"), render(TRUTH, pose, board, seed=k))

    return once(common / "boards", make)


def test_a_camera_is_calibrated(boards, tmp_path):
    done = run("camera", boards, "-o", tmp_path / "out", "--to", "opencv", "--json")
    assert done.code == 0, done.err
    value = load_camera(tmp_path / "out" / "camera.yaml")
    assert value.model == done.json["camera"]["model"] == "pinhole"
    assert_keys("camera --json", done.json)
    sigma = np.sqrt(np.diag(value.covariance))
    off = (value.parameters - TRUTH.parameters)[:4] / sigma[:4]
    # four numbers from eight images; beyond four standard deviations these would be wrong
    assert np.all(np.abs(off) < 4)
    assert sigma[0] < 1.0
    assert {"camera.html", "camera.json", "camera.opencv.yaml"} <= {
        p.name for p in (tmp_path / "out").iterdir()
    }


def test_a_sessions_board_images(boards, tmp_path):
    """A session that observes a board is enough: it has the images and the board."""
    folder = tmp_path / "session"
    (folder / "images").mkdir(parents=True)
    for path in boards.glob("*.png"):
        (folder / "images" / path.name).write_bytes(path.read_bytes())
    (folder / "board.yaml").write_text(BOARD)
    (folder / "session.yaml").write_text(
        "pkmcal: 1\nmechanism: m.yaml\njoints: {file: j.csv, noise: 1e-5}\nboard: board.yaml\n"
        "stations:\n"
        "  top: {camera: c.yaml, images: 'images/{configuration}.png', observe: board}\n"
    )
    with two_camera_models():
        done = run("camera", folder, "-o", tmp_path / "out", "--model", "pinhole", "--json")
    assert done.code == 0, done.err
    text = (folder / "session.yaml").read_text().replace("observe: board", "observe: legs")
    (folder / "session.yaml").write_text(text)
    refused = run("camera", folder, "-o", tmp_path / "out2", "--json")
    assert (refused.code, refused.json["code"]) == (2, "session.no_board")
    for words, instead, code, where in (
        ("board: board.yaml", "board: [1, 2]", "error.input", "session.yaml, line 4, board"),
        ("board: board.yaml", "board: b.yaml", "file.missing", "session.yaml, line 4, board"),
        (
            "observe: legs",
            "observe: ledge",
            "error.input",
            "session.yaml, line 6, stations.top.observe",
        ),
    ):
        (folder / "session.yaml").write_text(
            text.replace(words, instead).replace("observe: legs", "observe: board")
        )
        refused = run("camera", folder, "-o", tmp_path / "out2", "--json")
        assert (refused.code, refused.json["code"]) == (2, code)
        assert refused.json["where"] == where


def test_missing_files_are_reported(boards, tmp_path):
    cases = {
        ("camera", tmp_path / "nowhere"): ("file.missing", tmp_path / "nowhere"),
        ("camera", tmp_path): ("images.none", tmp_path),
        ("camera", boards, "--board", tmp_path / "b.yaml"): ("file.missing", tmp_path / "b.yaml"),
    }
    for words, (code, where) in cases.items():
        done = run(*words, "-o", tmp_path / "out", "--json")
        assert (done.code, done.json["code"], done.json["where"]) == (2, code, str(where))
