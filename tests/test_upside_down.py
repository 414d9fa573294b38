"""Photographs that a program has turned by half, against a camera file of before."""

from __future__ import annotations

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

import pkmcal
from pkmcal.calibration.gather import refinement_of
from pkmcal.calibration.upside_down import upside_down
from pkmcal.cameras import load_camera
from pkmcal.identify.score import Departures, Freed
from test_calibration import check_found

CUT = (32, 20)
"""Columns and rows that are cut from the pictures, which puts the camera's centre beside the
middle."""


@pytest.fixture(scope="module")
def turned(demo, tmp_path_factory):
    """The demonstration's session, its pictures cut and turned by half and no pose told."""
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


def test_upside_down_photographs_are_known_by_their_cameras_centre(turned):
    """As good as upright ones, and told how the camera's file would be theirs."""
    found = pkmcal.calibrate(turned)
    check_found(found, turned, 0.2e-3 * np.sqrt(18 / 12) * 640 / 480)
    (hint,) = [text for text in found.verdict.advice if "upside down" in text]
    assert hint.startswith(
        "The photographs of station1, station2 and station3 are upside down against"
        " cameras/camera.yaml: so say their edges, at odds of more than 1000 to 1."
    )
    # 447 less 241.18, 339 less 178.48; the lens turned by half, too
    assert "write center: [205.82, 160.52] and distortion: [-0.11, 0.09, -0.0004, 0.0003, 0]" in (
        hint
    )
    assert not found.departures
    own = load_camera(turned / "cameras" / "camera.yaml").turned_by_half()
    for station in found.session.stations:
        np.testing.assert_array_equal(station.camera.parameters, own.parameters)


def test_upright_photographs_are_left_as_they_are(calibrated):
    assert not any("upside down" in text for text in calibrated.verdict.advice)
    for station in calibrated.session.stations:
        own = load_camera(calibrated.session.folder / station.camera_file)
        np.testing.assert_array_equal(station.camera.parameters, own.parameters)


@pytest.mark.parametrize(
    ("value", "sigma", "known"),
    [(0.0, 0.02, False), (0.9, 0.07, True), (0.9, 0.4, False), (2.0, 0.1, False)],
    ids=["upright", "upside down", "not told", "another camera"],
)
def test_what_fits_has_to_be_sure_and_near(calibrated, monkeypatch, value, sigma, known):
    fit = Freed(np.array([value]), np.array([sigma]), np.zeros(1))
    monkeypatch.setattr(Departures, "fitted", lambda *_: [fit])
    found = upside_down(calibrated.session, calibrated)
    assert [one.file for one in found] == ["cameras/camera.yaml"] * known
    assert [one.entries for one in found] == [("station1", "station2", "station3")] * known


def test_cameras_that_are_estimated_are_not_asked_about(calibrated):
    refined = refinement_of(calibrated.session, refine=True)
    assert upside_down(calibrated.session, replace(calibrated, cameras=refined)) == ()
