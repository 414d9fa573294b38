"""A session whose stations are joined by a board on the base: rendered, checked, calibrated."""

from __future__ import annotations

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from conftest import run
from faults import raises, replaced
from pkmcal.api.check import CheckResult
from pkmcal.boards.prints import Print
from pkmcal.boards.stations import find_boards
from pkmcal.boards.views import Boards, StationBoard
from pkmcal.calibration.handheld import localize_case
from pkmcal.calibration.localization import (
    boards_of,
    check_observable,
    localize_by_legs,
    localize_stations,
    platform_poses,
    read_images,
)
from pkmcal.checks.check import check_session
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import angle_between, apply, inverse, pose, pose_difference, rotation
from pkmcal.mechanisms import load_mechanism
from pkmcal.outcome import Level
from pkmcal.session.load import load_session
from pkmcal.simulation import board_for, load_truth
from pkmcal.simulation.board import BASE_BOARD_DIAGONAL, board_from_fields
from pkmcal.simulation.scene import discs_of
from rendered import BOARD_SESSION, by_command
from test_bad_input import only


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Two stations of four configurations each, by the command; tests must not write into it."""
    return by_command(tmp_path_factory.mktemp("board") / "session", *BOARD_SESSION)


@pytest.fixture
def folder(rendered, tmp_path):
    """A copy to spoil, without the truth."""
    shutil.copytree(rendered, tmp_path / "session")
    (tmp_path / "session" / "truth.json").unlink()
    return tmp_path / "session"


@pytest.fixture(scope="module")
def observed(rendered):
    """A session, its images and the boards in them."""
    session = load_session(rendered)
    images = read_images(session)
    return session, images, boards_of(session, images)


def without_pose(folder, station):
    """Remove a station's pose by hand."""
    path = folder / "session.yaml"
    head, rest = path.read_text().split(f"  {station}:")
    start = rest.index("    pose:")
    end = rest.index("      up:")
    end = rest.index("\n", end) + 1
    path.write_text(f"{head}  {station}:" + rest[:start] + rest[end:])


# the renderer's boards


def test_rendered_corners_are_true_to_two_hundredths_of_a_pixel(rendered, observed):
    session, _, boards = observed
    truth = load_truth(rendered, session.machine)
    for number, station in boards.stations.items():
        T_camera_board = truth.T_camera_base[number] @ truth.T_base_board
        camera = session.stations[number].camera
        there = camera.project(apply(T_camera_board, station.views.board.points))
        off = (station.views.views.pixels - there)[station.views.poses.weight > 0.5]
        assert len(off) > 30
        assert np.sqrt(np.mean(off**2)) < 0.02
        assert np.all(np.abs(off.mean(axis=0)) < 0.005)


def test_poses_from_rendered_images(rendered, observed):
    session, _, boards = observed
    truth = load_truth(rendered, session.machine)
    poses = boards.poses
    assert poses.station.tolist() == [0, 1]
    T = truth.T_camera_base[poses.station] @ truth.T_base_board
    error = pose_difference(poses.T_station_target, T)
    z2 = np.sum(np.einsum("nij,nj->ni", poses.whiten, error) ** 2, axis=1)
    assert np.all(z2 < 24)  # six squares each; one in two thousand
    assert np.all(np.abs(error[:, :3]) < 2e-3)
    assert np.all(np.abs(error[:, 3:]) < 5e-4)


@pytest.mark.parametrize(
    "fields",
    [
        {"type": "charuco", "squares": [6, 5], "square": 0.03, "marker": 0.022,
         "dictionary": "DICT_4X4_50"},
        {"type": "charuco", "squares": [5, 6], "square": 0.03, "marker": 0.022,
         "dictionary": "DICT_5X5_100", "legacy": True},
        {"type": "chessboard", "corners": [6, 5], "square": 0.03},
        {"type": "aruco_grid", "markers": [4, 3], "marker": 0.03, "gap": 0.01, "first_id": 5,
         "dictionary": "DICT_APRILTAG_36h11"},
    ],
)  # fmt: skip
def test_prints_are_what_the_detectors_look_for(fields):
    """The print drawn straight on, half a millimetre a pixel, is found whole and in its place."""
    from pkmcal.boards.find import detect_board

    board = board_from_fields(fields)
    printed = Print.of(board)
    step, margin = 0.0005, 0.02
    x = np.arange(printed.x[0] - margin, printed.x[-1] + margin, step)
    y = np.arange(printed.y[0] - margin, printed.y[-1] + margin, step)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    dark = printed.dark_at(grid[..., 0].ravel(), grid[..., 1].ravel()).reshape(grid.shape[:2])
    image = cv2.GaussianBlur(np.where(dark, 20, 220).astype(np.uint8), (0, 0), 0.7)
    in_view = detect_board(image, board)
    assert len(in_view.ids) == len(board.points)
    places = in_view.pixels * step + [x[0], y[0]]
    # cells are drawn by their pixels' centres, so to half a pixel
    np.testing.assert_allclose(places, board.points[in_view.ids, :2], atol=0.6 * step)


def test_a_board_is_made_in_proportion_to_the_machine():
    machine = load_mechanism("gough-stewart")
    board = board_for(machine)
    size = np.hypot(*(np.array(board.document["squares"]) + 1)) * board.document["square"]
    assert size == pytest.approx(BASE_BOARD_DIAGONAL * discs_of(machine).base_radius, rel=0.02)


# stations through the board


@pytest.mark.parametrize(
    "without",
    [["station2"], pytest.param(["station1", "station2"], marks=pytest.mark.slow)],
)
def test_stations_without_a_pose_are_found_through_the_board(rendered, folder, without):
    """Without any station's pose, legs determine the stations; the board then joins them."""
    for station in without:
        without_pose(folder, station)
    session = load_session(folder)
    assert [s.T_camera_base is None for s in session.stations] == [
        name in without for name in ("station1", "station2")
    ]
    check_observable(session)
    images = read_images(session)
    boards = boards_of(session, images)
    T = localize_stations(session, images, boards, np.random.default_rng(0))
    truth = load_truth(rendered, session.machine)
    error = pose_difference(inverse(T), inverse(truth.T_camera_base))
    # as near as the search comes from a pose by hand; the estimate's start need not be nearer
    assert np.all(np.linalg.norm(error[:, 3:], axis=1) < 0.06)
    assert np.all(np.linalg.norm(error[:, :3], axis=1) < np.deg2rad(3))


def test_poses_joined_are_exact(observed):
    """T_camera_base = T_camera_board T_board_other T_other_base."""
    _, _, boards = observed
    rng = np.random.default_rng(1)
    T_base_board = pose(rotation(rng.normal(size=3)), rng.normal(size=3))
    T = [s.stood.T_camera_board @ inverse(T_base_board) for s in boards.stations.values()]
    first = boards.joined([None, T[1]])[0]
    np.testing.assert_allclose(first, T[0], atol=1e-12)
    given = [np.eye(4), T[1]]
    assert all(a is b for a, b in zip(boards.joined(given), given, strict=True))
    assert boards.joined([None, None]) == [None, None]
    assert Boards().joined([None, T[1]])[0] is None


@pytest.mark.slow
def test_a_station_whose_pose_by_hand_is_wrong_is_found_all_the_same(folder):
    path = folder / "session.yaml"
    text = path.read_text()
    start = text.index("      position:", text.index("  station2:"))
    path.write_text(
        text[:start] + "      position: [0.9, 0.9, 1.1]" + text[text.index("\n", start) :]
    )
    session = load_session(folder)
    images = read_images(session)
    boards = boards_of(session, images)
    T = localize_stations(session, images, boards, np.random.default_rng(1))
    assert np.linalg.norm(inverse(T[1])[:3, 3] - [0.9, 0.9, 1.1]) > 0.3
    # without the board too: a pose by hand that shows nothing is only where the search begins
    rng = np.random.default_rng(1)
    alone = localize_by_legs(session, images[1:], platform_poses(session), [rng])
    assert alone.complete
    off = pose_difference(alone.localizations[0].T_camera_base, T[1])
    assert np.rad2deg(np.linalg.norm(off[:3])) < 3
    assert np.linalg.norm(off[3:]) < 0.06


# the commands


def test_check_reports_the_board(folder):
    checked = check_session(folder)
    assert not [finding for finding in checked.findings if finding.station]
    for station in checked.stations:
        assert station.board is not None
        assert station.board.found == 4
        assert station.board.corners > 10
        assert station.board.corners_of == 20
        assert station.board.rms < 0.03
        assert station.board.scatter < 0.03
        assert 0.5 < station.board.distance < 3
    result = CheckResult.of(checked)
    assert "4 of 4" in result.summary()
    assert "Wander" in result.summary()
    assert result.document["stations"][0]["board"]["found"] == 4


def test_calibrating_with_the_board(folder):
    from pkmcal.calibration.calibrate import calibrate_session

    result = calibrate_session(folder)
    assert len(result.measurements.poses) == 2
    assert [(m.name, m.body) for m in result.measurements.mounts] == [("board", "base")]
    assert result.estimate.state.T_mount.shape == (1, 4, 4)
    assert len(result.boards.stations) == 2


def shifted(folder, station, first):
    """Images of a station, from a first one on shifted by two pixels."""
    for path in sorted((folder / "images" / station).iterdir())[first:]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert cv2.imwrite(str(path), np.roll(picture, 2, axis=1))


def test_a_camera_that_moved(folder):
    only(folder, "station1")
    shifted(folder, "station1", 2)
    checked = check_session(folder)
    assert checked.exit_code == 2
    (text,) = [f.text for f in checked.findings if f.level is Level.WRONG]
    assert text.startswith(
        "images/station1/0002.png: the board, or the camera, moved after images/station1/0001.png;"
        " found the board 2.0 px away"
    )
    assert run("calibrate", folder).err == f"Error: {text}\n"


def test_an_image_that_disagrees_is_reported(folder):
    only(folder, "station1")
    shifted(folder, "station1", 3)
    session = load_session(folder)
    boards = boards_of(session, read_images(session))
    assert [r.reason for r in boards.rejected] == [
        "the board stands 2.0 px from where the other images show it"
    ]


def test_another_board_than_described(folder):
    only(folder, "station1")
    path = folder / "board.yaml"
    path.write_text(path.read_text().replace("DICT_4X4_50", "DICT_5X5_50"))
    session = load_session(folder)
    with pytest.raises(InputError) as caught:
        boards_of(session, read_images(session))
    assert caught.value.code == "board.another"
    assert caught.value.where == "session.yaml, stations.station1: 0000.png"
    assert "markers of DICT_4X4_50" in caught.value.found


def test_a_board_that_is_nowhere(folder):
    session, image = load_session(folder), np.full((60, 80), 90, np.uint8)
    assert cv2.imwrite(str(folder / "images" / "station1" / "0000.png"), image)
    # one small image: if no board is found, one of every other kind is searched as well
    one = session.stations[0]
    camera = replace(one.camera, image_size=(80, 60))
    one = replace(one, camera=camera, images=one.images[:1])
    session = replace(session, stations=(one, *session.stations[1:]))
    with raises(InputError, code="board.not_found", where="images/station1/0000.png"):
        find_boards(session, {0: [image]})


@pytest.mark.parametrize(
    ("body", "code"), [("base", "board.seen_once"), ("platform", "board.few_images")]
)
def test_one_image_of_a_board_is_noted(folder, observed, body, code):
    """Three of four images are grey at the board's place; one station is enough to detect it."""
    only(folder, "station1")
    replaced(folder / "session.yaml", "fixed_to: base", f"fixed_to: {body}")
    board = observed[2].stations[0]
    corners = np.nanmean(board.views.views.pixels[0], axis=0)
    for path in sorted((folder / "images" / "station1").iterdir())[1:]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        x, y = (int(v) for v in corners)
        picture[max(y - 75, 0) : y + 75, max(x - 75, 0) : x + 75] = 60
        assert cv2.imwrite(str(path), picture)
    codes = [f.code for f in check_session(folder).findings]
    assert [c for c in codes if c in ("board.seen_once", "board.few_images")] == [code]


def test_a_board_on_the_platform_needs_no_rough_pose(folder):
    replaced(folder / "session.yaml", "fixed_to: base", "fixed_to: platform")
    for station in ("station1", "station2"):
        without_pose(folder, station)
    check_observable(load_session(folder))


def test_a_board_on_the_platform_gives_a_measurement_a_image(observed):
    """Quantities that a session with such a board uses; here it is at rest, which is not tested."""
    session, images, _ = observed
    moving = replace(session, board_body="platform")
    boards = find_boards(moving, {p.station: p.images for p in images})
    assert len(boards.poses) == 8
    assert boards.poses.configuration.tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert all(isinstance(s, StationBoard) and s.stood is None for s in boards.stations.values())


def test_hand_held_images_with_poses_of_their_own_and_a_board(rendered, observed):
    """The board does not replace the poses that a person states."""
    session, images, _ = observed
    truth = load_truth(rendered, session.machine)
    stations, single = [], []
    for p, station in zip(images, session.stations, strict=True):
        for k, image in enumerate(station.images):
            single.append(replace(p.select(np.array([k])), station=len(stations)))
            name = f"{station.name}-{k}"
            stations.append(replace(station, name=name, handheld=True, images=(image,)))
    session = replace(session, stations=tuple(stations))
    boards = boards_of(session, single)
    assert len(boards.stations) == len(stations) == 8
    results = localize_case(session, single, boards, np.random.default_rng(0))
    names = [one.name for one in results.session.stations]
    assert len(names) > 4
    true = truth.T_camera_base[[truth.stations.index(name.rpartition("-")[0]) for name in names]]
    assert np.degrees(angle_between(results.scene.T_camera_base, true)).max() < 4
