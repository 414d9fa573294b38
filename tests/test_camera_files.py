"""Camera files of other programs, and the two wide models against OpenCV's mathematics."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pkmcal.cameras import camera_models, load_camera
from pkmcal.cameras.files import camera_text, foreign_text
from pkmcal.errors import InputError

VALUES = {
    "pinhole": [1056.0033333333333, 1057.4, 515.5, 378.1, -0.17, 0.07, 4e-4, -3e-4, 0.0],
    "fisheye": [350.1, 351.2, 510.3, 388.8, 0.01, -0.002, 0.003, -1 / 3e3],
    "unified": [260.1, 259.9, 514.2, 383.3, 0.9777777777777777, -0.1, 0.02, 3e-4, -1e-4],
}


def camera_of(model):
    return camera_models()[model]((1024, 768), np.array(VALUES[model]))


@pytest.mark.parametrize("model", VALUES)
@pytest.mark.parametrize("form", ["opencv", "ros", "kalibr"])
@pytest.mark.parametrize("ending", ["yaml", "xml"])
def test_a_written_camera_is_read_back_the_same(model, form, ending, tmp_path):
    if (ending == "xml" and form != "opencv") or (model, form) == ("unified", "ros"):
        pytest.skip("no such file")
    path = tmp_path / f"camera.{ending}"
    path.write_text(foreign_text(camera_of(model), path, form))
    again = load_camera(path)
    assert again.model == model
    assert again.image_size == (1024, 768)
    np.testing.assert_allclose(again.parameters, VALUES[model], rtol=1e-12)


def test_opencv_itself_reads_what_was_written(tmp_path):
    path = tmp_path / "camera.yml"
    path.write_text(foreign_text(camera_of("pinhole"), path, "opencv"))
    storage = cv2.FileStorage(str(path), cv2.FileStorage_READ)
    matrix = storage.getNode("camera_matrix").mat()
    assert matrix[0, 0] == VALUES["pinhole"][0]
    assert matrix[1, 2] == VALUES["pinhole"][3]
    assert storage.getNode("distortion_coefficients").mat().ravel()[0] == -0.17
    assert storage.getNode("image_width").real() == 1024


def test_own_files_are_read_too(tmp_path):
    (tmp_path / "a.yaml").write_text(camera_text(camera_of("unified")))
    assert load_camera(tmp_path / "a.yaml").model == "unified"


ROS = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.3]}
"""
KALIBR = """\
cam0:
  camera_model: omni
  intrinsics: [1.2, 500, 501, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [0.1, 0.2, 0.003, 0.004]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  camera_model: pinhole
  intrinsics: [500, 501, 320, 240]
  distortion_model: equi
  distortion_coeffs: [0.1, 0.2, 0.003, 0.004]
  T_cn_cnm1:
  - [1, 0, 0, 0.1]
  - [0, 1, 0, 0]
  - [0, 0, 1, 0]
  - [0, 0, 0, 1]
  resolution: [640, 480]
"""
OPENCV = """\
%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 501., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.1, 0.2, 0.003, 0.004, 0. ]
"""


def read_text(tmp_path, text, camera=None):
    (tmp_path / "c.yaml").write_text(text)
    return load_camera(tmp_path / (f"c.yaml#{camera}" if camera else "c.yaml"))


def test_files_as_others_write_them(tmp_path):
    ros = read_text(tmp_path, ROS)
    assert ros.model == "pinhole"
    np.testing.assert_array_equal(
        ros.parameters, [500, 501, 320, 240, 0.1, -0.2, 0.001, 0.002, 0.3]
    )
    mirror = read_text(tmp_path, KALIBR, "cam0")
    np.testing.assert_array_equal(
        mirror.parameters, [500, 501, 320, 240, 1.2, 0.1, 0.2, 0.003, 0.004]
    )
    assert read_text(tmp_path, KALIBR, "cam1").model == "fisheye"
    assert read_text(tmp_path, OPENCV).model == "pinhole"
    assert (
        read_text(
            tmp_path,
            OPENCV.replace("rows: 5", "rows: 4").replace(", 0. ]\n", " ]\n") + "fisheye_model: 1\n",
        ).model
        == "fisheye"
    )
    mirror = OPENCV + "xi: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1.5 ]\n"
    assert read_text(tmp_path, mirror).parameters[4] == 1.5


@pytest.mark.parametrize(
    ("text", "old", "new", "sentence"),
    [
        (ROS, "[500, 0,", "[500, 2,", "c.yaml, line 4, camera_matrix: the camera has skew, which "
         "no model here has; found 2."),
        (ROS, "plumb_bob", "rational_polynomial", "c.yaml, line 5, distortion_model: this camera "
         "or lens model is not supported; found rational_polynomial, expected plumb_bob, "
         "equidistant and fisheye. Calibrate again from images of a board: pkmcal camera."),
        (ROS, "0.3]", "0.3, 0.1]", "c.yaml, line 4, camera_matrix: the camera has distortion "
         "beyond the model's 5 terms; found 6 terms."),
        (ROS, "[500, 0, 320, 0, 501,", "[5, 0, 320, 0, 5,", "c.yaml, line 4, camera_matrix: the "
         "camera has a focal length that looks like millimetres; it is wanted in pixels; found 5 "
         "at a width of 640."),
        (ROS, "image_width: 640\n", "", "c.yaml, image_width: this is missing."),
        (ROS, "camera_matrix", "matrix", "c.yaml, model: the camera's model is missing; expected "
         "fisheye or pinhole or unified. OpenCV's files have camera_matrix, image_width and "
         "image_height; ROS's camera_matrix; Kalibr's camera_model under cam0."),
        (KALIBR, "", "", "c.yaml: the file holds several cameras; found cam0 and cam1. Name one "
         "behind a #, such as c.yaml#cam1."),
    ],
)  # fmt: skip
def test_faults_of_others_files(tmp_path, text, old, new, sentence):
    assert old in text
    with pytest.raises(InputError) as caught:
        read_text(tmp_path, text.replace(old, new) if old else text)
    assert str(caught.value) == sentence


def test_kalibr_faults(tmp_path):
    one = KALIBR.partition("cam1")[0]
    with pytest.raises(InputError, match="negative xi"):
        read_text(tmp_path, one.replace("[1.2,", "[-1.2,"))
    with pytest.raises(InputError, match="found ds-none"):
        read_text(tmp_path, one.replace("omni", "ds").replace("radtan", "none"))
    with pytest.raises(InputError, match="no such camera; found cam7, expected cam0"):
        read_text(tmp_path, one, "cam7")


def test_what_a_format_cannot_hold_is_refused():
    with pytest.raises(InputError, match="no distortion model for a unified camera"):
        foreign_text(camera_of("unified"), "a.yaml", "ros")
    camera = camera_of("pinhole")
    parameters = camera.parameters.copy()
    parameters[8] = 0.25
    with pytest.raises(InputError, match=r"no third radial term; found k3 = 0\.25"):
        foreign_text(replace(camera, parameters=parameters), "a.yaml", "kalibr")
    with pytest.raises(InputError, match="no such format of camera files; found rso"):
        foreign_text(camera, "a.yaml", "rso")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("xi: -0.1", "a.yaml, line 5, xi: this value cannot be used; found -0.1, expected a number "
         "of 0 or more."),
        ("focal: [2.8, 2.8]", "a.yaml, line 3, focal: the focal length [2.8, 2.8] looks like "
         "millimetres; it is wanted in pixels, which is millimetres divided by the size of a pixel "
         "in mm."),
        ("xii: 1.0", "a.yaml, line 5, xii: this key is not known; found xii, expected xi"),
    ],
)  # fmt: skip
def test_faults_of_own_files(tmp_path, line, sentence):
    lines = ["model: unified", "image_size: [640, 480]", "focal: [200, 200]", "center: [320, 240]"]
    lines = [old for old in lines if old.split(":")[0] != line.split(":")[0]]
    place = 2 if line.startswith("focal") else len(lines)
    lines[place:place] = [line]
    if "xi" not in line:
        lines.append("xi: 1.0")
    (tmp_path / "a.yaml").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError) as caught:
        load_camera(tmp_path / "a.yaml")
    assert str(caught.value).startswith(sentence)


# cv2's own mathematics, in the half of the field where it has them


def half_field(camera, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(4000, 3))
    points[:, 2] = np.abs(points[:, 2]) + 0.05
    return points[camera.in_image(camera.project(points))][:300]


def test_opencv_fisheye_agrees():
    camera = camera_of("fisheye")
    fx, fy, cx, cy, *k = camera.parameters
    matrix, zero = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros((1, 1, 3))
    points = half_field(camera, 1)
    theirs = cv2.fisheye.projectPoints(points[None], zero, zero, matrix, np.array(k))[0]
    np.testing.assert_allclose(camera.project(points), theirs.reshape(-1, 2), atol=1e-9)


def test_opencv_omnidir_agrees():
    camera = camera_of("unified")
    fx, fy, cx, cy, xi, *k = camera.parameters
    matrix, zero = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    points = half_field(camera, 2)
    theirs = cv2.omnidir.projectPoints(points[:, None], zero, zero, matrix, xi, np.array([k]))[0]
    np.testing.assert_allclose(camera.project(points), theirs.reshape(-1, 2), atol=1e-9)
