"""A board on the platform, rendered: calibrated alone and with the legs, no pose by hand."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from conftest import FEW_IMPUTATIONS, run
from faults import raises
from pkmcal.calibration.calibrate import calibrate_session
from pkmcal.calibration.localization import boards_of, read_images
from pkmcal.calibration.results import calibration_document
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import inverse, perturb, pose_difference
from pkmcal.identify.hand_eye import solve_pairs
from pkmcal.identify.methods.estimates import by_method
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.report.calibration import save
from pkmcal.report.corners import board_corners
from pkmcal.report.provenance import used_images
from pkmcal.session.load import load_session
from pkmcal.simulation import load_truth
from rendered import by_command


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """One station, twelve configurations, by the command; tests must not write into it."""
    folder = tmp_path_factory.mktemp("platform") / "session"
    words = ("--on-platform", "--stations", "1", "--configurations", "12", "--size", "640x480")
    return by_command(folder, *words)


@pytest.fixture
def folder(rendered, tmp_path):
    """A copy to spoil, without the truth and without a pose by hand."""
    shutil.copytree(rendered, tmp_path / "session")
    (tmp_path / "session" / "truth.json").unlink()
    change(tmp_path / "session", lambda station: station.pop("pose"))
    return tmp_path / "session"


@pytest.fixture(scope="module")
def by_legs_and_board(rendered, tmp_path_factory):
    """Calibration by legs and board, without a pose by hand."""
    folder = shutil.copytree(rendered, tmp_path_factory.mktemp("both") / "session")
    (folder / "truth.json").unlink()
    change(folder, lambda station: station.pop("pose"))
    return calibrate_session(folder, options=FEW_IMPUTATIONS)


def change(folder, what):
    """Change the one station of session.yaml."""
    path = folder / "session.yaml"
    document = yaml.safe_load(path.read_text())
    what(document["stations"]["station1"])
    path.write_text(yaml.safe_dump(document))


def off(result, truth):
    """Platform's places at the configurations, root mean square distance from the true ones."""
    return apart(result.machine, truth)


def apart(machine, truth):
    """Errors of any machine after the best fit of both frames."""
    forward_kinematics, there = machine.forward(truth.joints), truth.T_base_platform
    frames = solve_pairs(forward_kinematics[None], there[None], 0.3)
    error = frames.T_camera_base[0] @ forward_kinematics @ frames.T_mount[0] - there
    return np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, axis=-1)))


def test_boards_are_where_they_are(rendered):
    session = load_session(rendered)
    assert session.without({0: "no place"}).images_taken == 12  # those left out are counted
    truth = load_truth(rendered, session.machine)
    poses = boards_of(session, read_images(session)).poses
    there = truth.T_camera_base[0] @ truth.T_base_platform @ truth.T_platform_board
    error = pose_difference(poses.T_station_target, there[poses.configuration])
    z2 = np.sum(np.einsum("nij,nj->ni", poses.whiten, error) ** 2, axis=1)
    assert len(poses) > 7
    assert np.all(z2 < 30)  # six squares each; one in twenty thousand


def test_corners_are_expected_where_the_calibrated_machine_has_them(by_legs_and_board):
    calibration = by_legs_and_board
    corners = board_corners(calibration.session, calibration.boards, calibration.estimate)
    assert len(corners) > 50
    # what the corners' own noise leaves, a few hundredths of a pixel
    assert np.sqrt(np.mean(corners.off[corners.used] ** 2)) < 0.15
    state, turn = calibration.estimate.state, 1e-3
    T_turned_camera = perturb(np.eye(4), np.array([0.0, turn, 0, 0, 0, 0]))
    turned = replace(state, T_camera_base=T_turned_camera @ state.T_camera_base)
    shifted = replace(calibration.estimate, state=turned)
    change = board_corners(calibration.session, calibration.boards, shifted).off - corners.off
    focal = calibration.session.stations[0].camera.parameters[0]
    # expected farther right by the focal length times the turn, and more towards the border
    np.testing.assert_allclose(change[:, 0], -focal * turn, rtol=0.3)


def test_legs_and_board_together_need_no_pose_by_hand(rendered, by_legs_and_board):
    result = by_legs_and_board
    truth = load_truth(rendered, result.session.machine)
    s = result.estimate.statistics
    assert s.n_edges > 100
    assert s.n_poses > 40
    assert off(result, truth) < 0.2 * apart(result.session.machine, truth)
    # the camera from the board, in frames that do not matter
    value = result.estimate.state
    visible = value.T_camera_base[0] @ value.T_base_platform @ value.T_mount[0]
    true = truth.T_camera_base[0] @ truth.T_base_platform @ truth.T_platform_board
    error = pose_difference(visible, true)
    assert np.sqrt(np.mean(error[:, 3:] ** 2)) < 5e-4
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 2e-3


def test_the_board_alone(folder, tmp_path):
    change(folder, lambda station: station.update(observe="board"))
    result = calibrate_session(folder)
    assert len(result.observation.edges) == 0
    assert result.estimate.statistics.pose_scale < 1.6
    assert result.boards.stations[0].views.usable.sum() > 7
    save(result, tmp_path / "out")
    document = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert document["targets"][0]["fixed_to"] == "platform"
    assert document["residuals"]["edges"] == []
    assert run("check", folder).code < 2


def test_cameras_are_refined_with_the_board(rendered, folder):
    """A focal length that is wrong by a two-hundredth is corrected by readings, which
    have lengths.
    """
    path = folder / "cameras" / "camera.yaml"
    document = yaml.safe_load(path.read_text())
    true = np.array(document["focal"])
    document["focal"] = (1.005 * true).tolist()
    n = len(load_session(rendered).stations[0].camera.parameters)
    sigma = np.zeros(n)
    sigma[:2] = 0.005 * true
    document["covariance"] = np.diag(sigma**2).tolist()
    path.write_text(yaml.safe_dump(document))
    change(folder, lambda station: station.update(observe="board"))
    result = calibrate_session(folder, refine_camera=True)
    camera = result.cameras.result(result.estimate, result.cameras.files[0])
    spread = np.sqrt(np.diag(camera.covariance))[:2]
    assert np.all(spread < 0.5 * sigma[:2])
    assert np.all(np.abs(camera.parameters[:2] - true) < 4 * spread)


@pytest.mark.slow
def test_an_image_of_another_configuration_is_let_go(folder):
    images = folder / "images" / "station1"
    names = sorted(path.name for path in images.iterdir())
    shutil.copy(images / names[3], images / names[5])
    result = calibrate_session(folder)
    lost = result.estimate.pose_weights < 0.5
    assert result.observation.poses.configuration[lost].tolist() == [5]
    assert any(
        r.configuration == 5 and "board lies" in r.reason for r in result.observation.rejected
    )
    by_units = {one.facts["of"]: one for one in result.verdict.of("rejected.units")}
    warned = by_units[f"{len(lost)} boards"]
    assert f"images/station1/{names[5]}" in warned.subject
    assert used_images(result.session, result.observation, result.estimate) == (11,)


def test_a_missing_board_file_and_another_camera(folder):
    (folder / "board.yaml").rename(folder / "away.yaml")
    where, expected = "session.yaml, line 2, board.file", f"a file {folder / 'board.yaml'}"
    with raises(InputError, where=where, found="board.yaml", expected=expected):
        load_session(folder)
    (folder / "away.yaml").rename(folder / "board.yaml")
    path = folder / "cameras" / "camera.yaml"
    path.write_text(path.read_text().replace("[640, 480]", "[800, 600]"))
    with raises(InputError, found="640x480", expected="800x600 (cameras/camera.yaml)"):
        load_session(folder)


def test_the_method_of_paper_c_does_not_estimate_the_size(folder):
    """The joint estimate reports the board's size, which the method takes from board.yaml."""
    path = folder / "board.yaml"  # a simulated board has its size exactly
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "tolerance": 0.001}))
    change(folder, lambda station: station.update(observe="board"))
    joint = calibrate_session(folder)
    method, machine = "inverse-kinematic", joint.session.machine
    estimate = by_method(method, machine, joint.measurements, joint.estimate, repetitions=3)
    alone = replace(joint, estimate=estimate, method=method)
    targets = [calibration_document(one)["targets"] for one in (joint, alone)]
    assert ["size" in target for (target,) in targets] == [True, False]
    assert BOARD_SIZE in joint.estimate.state.columns
    assert BOARD_SIZE not in estimate.state.columns


def test_inverse_of_a_known_station_is_reported(rendered):
    """The truth's own frames: a check on the simulator."""
    session = load_session(rendered)
    truth = load_truth(rendered, session.machine)
    eye = inverse(truth.T_camera_base[0])[:3, 3]
    centre = truth.T_base_platform[:, :3, 3].mean(axis=0)
    board = (truth.T_base_platform @ truth.T_platform_board)[:, :3, 2]
    # the board's z axis points into it, away from the viewer
    assert np.all(board @ (centre - eye) > 0)
