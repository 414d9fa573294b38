"""Difference of two cameras: what chance does, rotations of the frame, the command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import pkmcal
from conftest import run
from document_keys import assert_keys
from page_documents import page_document
from pkmcal.boards.fit import covariance_of, fit_camera, views_of
from pkmcal.camera_calibration.model_selection import positions
from pkmcal.cameras.files import camera_text, foreign_text
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import rotation, rotation_vector
from pkmcal.judge.camera_difference import best_rotation, camera_difference
from test_camera_calibration import BOARD, SIZE, TERMS, TRUE, camera_of, detections, poses_for

CAMERA = TRUE["pinhole"]


def calibrated(true, poses, seed):
    """A camera from noisy corners, with its covariance."""
    views = views_of(detections(true, poses, seed), BOARD)
    fit = fit_camera(CAMERA, positions(CAMERA, TERMS["pinhole"]), views, poses)
    return replace(fit.camera, covariance=covariance_of(fit, views)[0])


@pytest.fixture(scope="module")
def poses():
    return poses_for(CAMERA, 10, 1), poses_for(CAMERA, 10, 2)


def test_chance_and_change(poses):
    """Calibrations of one camera differ by as much as stated; one zoomed by 0.3 % by more."""
    a = [calibrated(CAMERA, poses[0], seed) for seed in range(40)]
    b = [calibrated(CAMERA, poses[1], 100 + seed) for seed in range(40)]
    differences = [camera_difference(*pair) for pair in zip(a, b, strict=True)]
    chances = np.array([one.chance for one in differences])
    # Twice the smaller of two probabilities, which is above that of one.
    assert np.mean(chances < 0.5) == pytest.approx(0.4, abs=0.25)
    assert np.sum(chances < 0.01) <= 3
    scaled = np.array([one.lengths / one.sigma for one in differences])
    assert np.mean(scaled**2) < 2  # two dimensions, of which sigma is the worse
    assert np.mean(scaled**2) > 0.7
    zoomed = replace(CAMERA, parameters=CAMERA.parameters + CAMERA.focal_part * 0.003)
    changed = camera_difference(a[0], calibrated(zoomed, poses[1], 0))
    assert changed.changed
    assert "difference.cameras" in changed.verdict.codes
    # most of it at the border, where the shift is f tan(angle) 0.3 %
    assert np.nanmax(changed.lengths) == pytest.approx(0.003 * 640, rel=0.25)


@pytest.mark.parametrize("name", ["k1", "k2", "p1"])
def test_a_change_that_is_small_over_the_image(poses, name):
    """Eight standard deviations of one coefficient, where all others are known: a tenth of a
    pixel in the middle, no more than chance does there.
    """
    a, b = calibrated(CAMERA, poses[0], 7), calibrated(CAMERA, poses[1], 107)
    free = positions(CAMERA, TERMS["pinhole"])
    information = np.linalg.inv((a.covariance + b.covariance)[np.ix_(free, free)])
    k = CAMERA.parameter_names.index(name)
    parameters = b.parameters.copy()
    parameters[k] += 8 / np.sqrt(information[list(free).index(k), list(free).index(k)])
    changed = camera_difference(a, replace(b, parameters=parameters))
    assert changed.changed
    assert np.nanmedian(changed.lengths / changed.sigma) < 2


def test_a_rotation_is_no_difference():
    """Rays of a rotated pinhole camera without distortion are those of a camera that turned."""
    true = camera_of("fisheye", 320, 320, 508, 390)
    R = rotation(np.array([0.01, -0.02, 0.03]))
    rays = true.ray(np.random.default_rng(0).uniform([100, 100], [900, 700], (200, 2)))
    fitted = best_rotation(true, rays, true.project(rays @ R.T), np.ones(200))
    np.testing.assert_allclose(rotation_vector(fitted @ R.T), 0, atol=1e-9)


def test_a_centre_that_moves_is_mostly_a_rotation():
    """2 px on the principal point leave 0.2 px or less of a lens of f = 1050 px."""
    true = camera_of("pinhole", 1050, 1050, 511.5, 383.5)
    difference = camera_difference(true, true.shifted(np.array([2.0, 0.0])))
    assert np.nanmedian(difference.lengths) < 0.2
    angle = np.linalg.norm(rotation_vector(difference.rotation))
    assert angle == pytest.approx(2 / 1050, rel=0.1)
    assert difference.chance is None
    assert difference.sigma is None
    assert difference.verdict.codes == ("difference.cameras", "difference.no_covariance")


def test_equal_cameras_and_other_sizes():
    same = pkmcal.diff(CAMERA, CAMERA)
    assert not same.changed
    assert same.exit_code == 0
    with pytest.raises(InputError) as error:
        camera_difference(CAMERA, replace(CAMERA, image_size=(SIZE[0] // 2, SIZE[1] // 2)))
    assert error.value.code == "difference.image_sizes"


def test_the_command(poses, tmp_path):
    """Camera files of pkmcal and another program."""
    a, b = tmp_path / "a.yaml", tmp_path / "b.xml"
    a.write_text(camera_text(calibrated(CAMERA, poses[0], 0)))
    b.write_text(foreign_text(CAMERA, b, "opencv"))
    done = run("diff", a, b, "-o", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    assert_keys("diff of cameras --json", done.json)
    assert np.shape(done.json["difference"]) == (24, 32, 2)
    document = page_document((tmp_path / "out" / "diff.html").read_text())
    assert {part["title"] for part in document["sections"]} >= {"Difference of projections"}
    mixed = run("diff", a, "gough-stewart", "-o", tmp_path / "mixed", "--json")
    assert (mixed.code, mixed.json["code"]) == (2, "difference.kinds")
