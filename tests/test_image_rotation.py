"""Images that a program has rotated by half a turn, with a camera file from before."""

from __future__ import annotations

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

import pkmcal
from pkmcal.calibration import calibrate
from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.calibration.image_rotation import (
    rotation_finding,
    turned_round,
    upside_down,
    upside_down_images,
)
from pkmcal.calibration.machine_source import load_source
from pkmcal.calibration.saved_calibration import load
from pkmcal.cameras import load_camera
from pkmcal.errors import InputError
from pkmcal.files import csv_text
from pkmcal.files.tables import read_csv
from pkmcal.identify.score import OneStepUpdate, ScoreTests
from pkmcal.judge.new_data import _as_calibrated
from pkmcal.outcome.hypotheses import Ranked, decide
from pkmcal.report.calibration import save
from test_calibration import check_calibration

CUT = (32, 20)
"""Columns and rows that are cut from the images, which puts the camera's centre beside the middle.
"""


@pytest.fixture(scope="module")
def turned(demo, tmp_path_factory):
    """The demonstration's session, with images cut and rotated by half a turn, and no poses."""
    folder = shutil.copytree(demo.session, tmp_path_factory.mktemp("turned") / "session")
    for path in (folder / "images").rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert cv2.imwrite(str(path), image[: -CUT[1], : -CUT[0]][::-1, ::-1])
    file = folder / "cameras" / "camera.yaml"
    camera = yaml.safe_load(file.read_text())
    camera["image_size"] = [int(n - cut) for n, cut in zip(camera["image_size"], CUT, strict=True)]
    file.write_text(yaml.safe_dump(camera))
    document = yaml.safe_load((folder / "session.yaml").read_text())
    for station in document["stations"].values():
        station.pop("pose")
    (folder / "session.yaml").write_text(yaml.safe_dump(document))
    return folder


@pytest.fixture
def turned_calibration(calibrated):
    """The demonstration's calibration as if its images had been upside down."""
    session, file = calibrated.session, "cameras/camera.yaml"
    camera = session.stations[0].camera.turned_by_half()
    one = upside_down_images(file, [station.entry for station in session.stations], camera)
    return replace(calibrated, session=one.apply(session), upside_down=(one,))


@pytest.mark.slow
def test_upside_down_images_are_known_by_their_cameras_centre(turned):
    """As accurate as upright images, and the right camera file is reported.

    The required certainty is tested below.
    """
    values = pkmcal.calibrate(turned)
    check_calibration(values, turned, 0.2e-3 * np.sqrt(18 / 12) * 640 / 480)
    (hint,) = values.verdict.of("image.upside_down")
    assert hint.subject == "cameras/camera.yaml"
    assert hint.facts["stations"] == ("station1", "station2", "station3")
    # 447 less 241.18, 339 less 178.48
    assert hint.facts["centre_x"] == pytest.approx(205.82)
    assert hint.facts["centre_y"] == pytest.approx(160.52)
    assert "Copy camera-camera.yaml from the result's folder to the session's" in hint.text
    assert not values.violations
    own = load_camera(turned / "cameras" / "camera.yaml").turned_by_half()
    for station in values.session.stations:
        np.testing.assert_array_equal(station.camera.parameters, own.parameters)


@pytest.mark.slow
def test_a_motor_that_counts_the_other_way_beside_upside_down_images(turned, tmp_path):
    """The readings are refused before any repair; right ones lead to the repair, as above."""
    folder = shutil.copytree(turned, tmp_path / "session")
    table = read_csv(folder / "joints.csv")
    joints = table.values.copy()
    joints[:, 2] = joints[:, 2].min() + joints[:, 2].max() + 0.004 - joints[:, 2]
    (folder / "joints.csv").write_text(csv_text(table.columns, table.names, joints))
    with pytest.raises(InputError) as caught:
        pkmcal.calibrate(folder)
    assert caught.value.code == "readings.reversed"


def test_upright_images_are_left_as_they_are(calibrated):
    assert not calibrated.verdict.of("image")
    for station in calibrated.session.stations:
        own = load_camera(calibrated.session.folder / station.camera_file)
        np.testing.assert_array_equal(station.camera.parameters, own.parameters)


@pytest.mark.slow
def test_where_it_is_likely_it_is_stated(demo, monkeypatch):
    """And the images are measured as they are."""

    def likely(session, turns):
        station = session.stations[0]
        file, camera = station.camera_file, station.camera.turned_by_half()
        return (Ranked(upside_down_images(file, ["station1"], camera), np.log(376.0)),)

    monkeypatch.setattr(calibrate, "upside_down", likely)
    results = pkmcal.calibrate(demo.session)
    (warning,) = results.verdict.of("image.perhaps_upside_down")
    assert (warning.subject, warning.station) == ("cameras/camera.yaml", None)
    assert warning.facts["stations"] == ("station1",)
    assert warning.facts["odds"] == pytest.approx(376.0)
    assert results.upside_down == ()
    own = load_camera(demo.session / "cameras" / "camera.yaml")
    np.testing.assert_array_equal(results.session.stations[0].camera.parameters, own.parameters)


def test_odds_that_are_too_few_are_stated_with_what_to_do(calibrated):
    camera = calibrated.session.stations[0].camera.turned_by_half()
    one = Ranked(upside_down_images("cameras/camera.yaml", ["station1"], camera), np.log(376.0))
    finding = rotation_finding(one)
    assert (finding.code, finding.subject) == ("image.perhaps_upside_down", "cameras/camera.yaml")
    assert finding.facts["odds"] == pytest.approx(376.0)


def lens(session, centre, covariance=None):
    """Session whose camera's centre is so many px beside the middle, as in its file."""
    file, camera = session.stations[0].camera_file, session.stations[0].camera
    parameters = camera.parameters.copy()
    parameters[2:4] = (np.array(camera.image_size) - 1) / 2 + centre
    camera = replace(camera, parameters=parameters, covariance=covariance)
    return turned_round(session, {file: camera})


@pytest.mark.parametrize(
    ("values", "sigma", "decided"),
    [((0.0, 0.1, -0.1), 0.04, None), ((0.9, 1.1, 0.8), 0.12, True), ((0.9, 1.1, 0.8), 0.8, None),
     ((2.0, 2.1, 2.0), 0.1, None), ((1.0, 1.0, 0.0), 0.1, None), ((1.0, 0.3, 1.0), 0.3, True),
     ((1.0, 0.0, 0.0), np.array([0.1, np.inf, np.inf]), True), ((0.0, 0.0, 0.0), np.inf, None),
     ((0.8, 0.7, 0.75), 0.35, False)],
    ids=["upright", "upside down", "not told", "another camera", "one station is upright",
         "one tells little", "one alone tells", "none tells", "not sure"],
)  # fmt: skip
def test_what_fits_has_to_be_sure_and_near(calibrated, monkeypatch, values, sigma, decided):
    sigmas = np.broadcast_to(sigma, 3)
    information = zip(values, sigmas, strict=True)
    fits = [OneStepUpdate(np.array([v]), np.array([s]), np.zeros(1)) for v, s in information]
    monkeypatch.setattr(ScoreTests, "fitted", lambda *_: fits)
    session = lens(calibrated.session, (8.0, -5.0))
    (camera,) = {id(station.camera): station.camera for station in session.stations}.values()
    results = upside_down(session, calibrated)
    subjects = [(one.hypothesis.subject, one.hypothesis.facts["stations"]) for one in results]
    expected = ("cameras/camera.yaml", ("station1", "station2", "station3"))
    assert subjects == [expected] * (decided is not None)
    for one in results:
        assert (decide([one]) is not None) == decided
        turned = one.hypothesis.camera.parameters
        np.testing.assert_array_equal(turned, camera.turned_by_half().parameters)


@pytest.mark.parametrize(
    ("centre", "sigma", "decided"),
    [((8.0, -5.0), None, True), ((0.5, -0.5), None, False), ((0.0, 0.0), None, False),
     ((0.5, -0.5), 0.05, True), ((0.5, -0.5), 0.0, True), ((8.0, -5.0), 8.0, False)],
    ids=["beside the middle", "half a pixel beside", "in the middle", "known to less", "exactly",
         "not known"],
)  # fmt: skip
def test_a_file_may_be_wrong_by_what_it_states(calibrated, monkeypatch, centre, sigma, decided):
    """A centre that is half a pixel from the middle may be on the other side without any turn."""
    fit = OneStepUpdate(np.array([0.9]), np.array([0.05]), np.zeros(1))
    monkeypatch.setattr(ScoreTests, "fitted", lambda _, freed: [fit] * len(freed))
    n = len(calibrated.session.stations[0].camera.parameters)
    covariance = None
    if sigma is not None:
        covariance = np.diag([1.0, 1.0, sigma**2, sigma**2] + [0.0] * (n - 4))
    assert len(upside_down(lens(calibrated.session, centre, covariance), calibrated)) == decided


def test_the_file_that_is_named_is_the_one_that_is_written(turned_calibration, tmp_path):
    """Beside the result, where every loader of a calibration finds it; and as a fact for
    programs.
    """
    folder = tmp_path / "calibration"
    save(turned_calibration, folder)
    own = turned_calibration.session.stations[0].camera
    saved = load(folder)
    (row,) = saved.document["cameras"]
    assert row["upside_down"] is True
    camera = load_camera(folder / "camera-camera.yaml")
    np.testing.assert_allclose(camera.parameters, own.parameters)
    source = load_source(folder, turned_calibration.session.folder)
    for in_view in source.cameras.values():
        np.testing.assert_allclose(in_view.parameters, own.parameters)


def test_new_images_are_taken_to_be_as_those_of_the_calibration_were(
    turned_calibration, calibrated, tmp_path
):
    """As long as the file is the same; one that was set right is not turned again."""
    save(turned_calibration, tmp_path / "calibration")
    saved = load(tmp_path / "calibration")
    session = calibrated.session
    own, upright = turned_calibration.session.stations[0].camera, session.stations[0].camera
    right = turned_round(session, {"cameras/camera.yaml": own})
    for before, after in ((session, own), (right, own), (lens(session, (3.0, 3.0)), None)):
        for station, was in zip(_as_calibrated(saved, before), before.stations, strict=True):
            wanted = was.camera if after is None else after
            np.testing.assert_allclose(station.camera.parameters, wanted.parameters)
    assert not np.allclose(own.parameters, upright.parameters)


def test_cameras_that_are_estimated_are_not_asked_about(calibrated):
    refined = refinement_of(calibrated.session, refine=True)
    assert upside_down(calibrated.session, replace(calibrated, cameras=refined)) == ()
