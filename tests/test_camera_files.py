"""Camera files of other programs, and the two wide models against OpenCV's mathematics."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from faults import raises
from pkmcal.cameras import camera_models, load_camera
from pkmcal.cameras.files import camera_text, foreign_text
from pkmcal.errors import InputError

VALUES = {
    "pinhole": [1056.0033333333333, 1057.4, 515.5, 378.1, -0.17, 0.07, 4e-4, -3e-4, 0.0],
    "fisheye": [350.1, 351.2, 510.3, 388.8, 0.01, -0.002, 0.003, -1 / 3e3],
    "unified": [260.1, 259.9, 514.2, 383.3, 0.9777777777777777, -0.1, 0.02, 3e-4, -1e-4],
    "rational": [
        *(1056.0033333333333, 1057.4, 515.5, 378.1, 0.5, 0.1, 4e-4, -3e-4, 0.01, 0.7, 0.15, 1 / 3),
        *np.zeros(6),
    ],
    "double_sphere": [280.1, 281.3, 510.3, 388.8, -0.2, 0.58 + 1e-13],
    "extended_unified": [280.1, 281.3, 510.3, 388.8, 0.6, 1.1 + 1e-13],
}
FORMS = {
    "pinhole": ("opencv", "ros", "kalibr"),
    "fisheye": ("opencv", "ros", "kalibr"),
    "unified": ("opencv", "kalibr"),
    "rational": ("opencv", "ros"),
    "double_sphere": ("kalibr",),
    "extended_unified": ("kalibr",),
}
"""Formats that have each camera model."""


def camera_of(model):
    return camera_models()[model]((1024, 768), np.array(VALUES[model]))


@pytest.mark.parametrize(
    ("model", "form", "ending"),
    [
        (model, form, ending)
        for model, forms in FORMS.items()
        for form in forms
        for ending in (("yaml", "xml") if form == "opencv" else ("yaml",))
    ],
)
def test_a_written_camera_is_read_back_the_same(model, form, ending, tmp_path):
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
  distortion_model: equidistant
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
    ("text", "old", "new", "facts"),
    [
        (ROS, "[500, 0,", "[500, 2,",
         {"where": "c.yaml, line 4, camera_matrix", "found": "2"}),
        (ROS, "plumb_bob", "field_of_view",
         {"where": "c.yaml, line 5, distortion_model", "found": "field_of_view",
          "expected": "plumb_bob, rational_polynomial, equidistant and fisheye"}),
        (ROS, "0.3]", "0.3, 0.1]",
         {"where": "c.yaml, line 6, distortion_coefficients", "found": "6 terms",
          "expected": "0, 4, 5, 8, 12 and 14"}),
        (ROS, "[500, 0, 320, 0, 501,", "[5, 0, 320, 0, 5,",
         {"where": "c.yaml, line 4, camera_matrix, focal", "found": "[5.0, 5.0]",
          "expected": "pixels, which is millimetres divided by the size of a pixel in mm"}),
        (ROS, "image_width: 640\n", "",
         {"where": "c.yaml, image_width"}),
        (ROS, "camera_matrix", "matrix",
         {"where": "c.yaml, model",
          "expected": "double_sphere or extended_unified or fisheye or pinhole or rational "
                      "or unified"}),
        (KALIBR, "", "", {"code": "camera.several", "where": "c.yaml", "found": "cam0 and cam1"}),
    ],
)  # fmt: skip
def test_faults_of_others_files(tmp_path, text, old, new, facts):
    assert old in text
    with raises(InputError, **facts):
        read_text(tmp_path, text.replace(old, new) if old else text)


def test_kalibr_faults(tmp_path):
    one = KALIBR.partition("cam1")[0]
    with pytest.raises(InputError) as error:
        read_text(tmp_path, one.replace("[1.2,", "[-1.2,"))
    assert error.value.where.endswith("xi")
    assert error.value.found == "-1.2"
    with pytest.raises(InputError) as error:
        read_text(tmp_path, one.replace("radtan", "fov"))
    assert error.value.found == "omni-fov"
    with pytest.raises(InputError) as error:
        read_text(tmp_path, one.replace("omni", "ds").replace("radtan", "none"))
    assert error.value.expected == "6 numbers"
    with raises(InputError, where="c.yaml", found="cam7", expected="cam0"):
        read_text(tmp_path, one, "cam7")


def test_what_a_format_cannot_hold_is_refused():
    assert set(FORMS) == set(VALUES) == set(camera_models())
    for model, forms in FORMS.items():
        for form in {"opencv", "ros", "kalibr"} - set(forms):
            with pytest.raises(InputError):
                foreign_text(camera_of(model), "a.yaml", form)
    prism = replace(
        camera_of("rational"), parameters=np.array([*VALUES["rational"][:12], 1e-3, *np.zeros(5)])
    )
    for other in (prism, camera_of("unified")):
        with pytest.raises(InputError) as error:
            foreign_text(other, "a.yaml", "ros")
        assert error.value.code == "camera.not_in_format"
    camera = camera_of("pinhole")
    parameters = camera.parameters.copy()
    parameters[8] = 0.25
    with raises(InputError, code="camera.not_in_format", found="k3 = 0.25"):
        foreign_text(replace(camera, parameters=parameters), "a.yaml", "kalibr")
    with raises(InputError, found="rso", expected="ros"):
        foreign_text(camera, "a.yaml", "rso")


def test_matrices_of_ros_that_contradict(tmp_path):
    """Without distortion and rectification both matrices hold the same numbers."""
    text = ROS.partition("distortion_coefficients")[0] + (
        "distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}\n"
        "rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
        "projection_matrix: {rows: 3, cols: 4,"
        " data: [500, 0, 320, 0, 0, 501, 240, 0, 0, 0, 1, 0]}\n"
    )
    assert read_text(tmp_path, text).focal[0] == 500
    with pytest.raises(InputError) as error:
        read_text(tmp_path, text.replace("data: [500, 0, 320, 0, 0", "data: [250, 0, 160, 0, 0"))
    assert error.value.where.endswith("projection_matrix")
    assert error.value.found.startswith("[250")
    assert error.value.expected.startswith("[500")
    # A calibrated lens has another matrix for rectified images.
    lens = text.replace("data: [0, 0, 0, 0, 0]", "data: [0.1, 0, 0, 0, 0]")
    read_text(tmp_path, lens.replace("data: [500, 0, 320, 0, 0", "data: [480, 0, 310, 0, 0"))


@pytest.mark.parametrize(
    ("line", "facts"),
    [
        ("xi: -0.1", {"where": "a.yaml, line 5, xi", "found": "-0.1",
                      "expected": "a number of 0 or more"}),
        ("focal: [2.8, 2.8]",
         {"where": "a.yaml, line 3, focal", "found": "[2.8, 2.8]",
          "expected": "pixels, which is millimetres divided by the size of a pixel in mm"}),
        ("xii: 1.0", {"where": "a.yaml, line 5, xii", "found": "xii",
                      "expected": "xi (known here: center, covariance, distortion, focal, "
                                  "image_size, model, xi)"}),
    ],
)  # fmt: skip
def test_faults_of_own_files(tmp_path, line, facts):
    lines = ["model: unified", "image_size: [640, 480]", "focal: [200, 200]", "center: [320, 240]"]
    lines = [old for old in lines if old.split(":")[0] != line.split(":")[0]]
    place = 2 if line.startswith("focal") else len(lines)
    lines[place:place] = [line]
    if "xi" not in line:
        lines.append("xi: 1.0")
    (tmp_path / "a.yaml").write_text("\n".join(lines) + "\n")
    with raises(InputError, **facts):
        load_camera(tmp_path / "a.yaml")


ROS_CAMERA = """\
image_width: 640
image_height: 480
camera_name: cam
camera_matrix: {rows: 3, cols: 3, data: [560, 0, 319.5, 0, 560, 239.5, 0, 0, 1]}
"""


@pytest.mark.parametrize(
    ("word", "coefficients"),
    [
        ("''", []),
        ("", []),
        ("none", [0, 0, 0, 0, 0]),
        ("inverse_brown_conrady", [0, 0, 0, 0, 0]),
        ("plumb_bob", [0.1, -0.2, 4e-4, -2e-4, 0.05, 0, 0, 0]),
        ("rational_polynomial", [0.1, -0.2, 4e-4, -2e-4, 0.05, 0, 0, 0]),
        ("rational_polynomial", [0.1, -0.2, 4e-4, -2e-4, 0.05, 0.3, 0.2, 0.1]),
    ],
)
def test_ros_cameras_of_every_distortion_model(tmp_path, word, coefficients):
    """No distortion, a tail of zeros, and the whole rational model."""
    lens = f"distortion_coefficients: {{rows: 1, cols: 1, data: {coefficients}}}\n"
    camera = read_text(tmp_path, f"{ROS_CAMERA}distortion_model: {word}\n{lens}")
    assert camera.model == ("rational" if any(coefficients[5:]) else "pinhole")
    lens = np.zeros(14 if any(coefficients[5:]) else 5)
    lens[: len(coefficients)] = coefficients[: len(lens)]
    np.testing.assert_array_equal(camera.parameters, [560, 560, 319.5, 239.5, *lens])


def test_a_ros_model_of_other_mathematics_is_refused_with_distortion(tmp_path):
    lens = "distortion_coefficients: {rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}\n"
    for word in ("none", "inverse_brown_conrady"):
        with pytest.raises(InputError) as caught:
            read_text(tmp_path, f"{ROS_CAMERA}distortion_model: {word}\n{lens}")
        assert word in caught.value.found


def test_opencv_files_of_all_coefficients(tmp_path):
    lens = [0.3, 0.1, 1e-3, -2e-3, 0.01, 0.5, 0.1, 0.02, 1e-3, 5e-4, -1e-3, 2e-4, 0.06, -0.09]
    for count in (4, 5, 8, 12, 14):
        storage = cv2.FileStorage(str(tmp_path / "c.yaml"), cv2.FileStorage_WRITE)
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
        storage.write("distortion_coefficients", np.array(lens[:count]))
        storage.release()
        camera = load_camera(tmp_path / "c.yaml")
        assert camera.model == ("pinhole" if count <= 5 else "rational")
        full = np.zeros(5 if count <= 5 else 14)
        full[:count] = lens[:count]
        np.testing.assert_array_equal(camera.parameters, [500, 501, 320, 240, *full])


def kalibr_projection(model, own, point):
    """Kalibr's DoubleSphereProjection and ExtendedUnifiedProjection, without the camera matrix."""
    x, y, z = point
    if model == "ds":
        xi, alpha = own
        k = xi * np.sqrt(x * x + y * y + z * z) + z
        norm = alpha * np.sqrt(x * x + y * y + k * k) + (1 - alpha) * k
    else:
        alpha, beta = own
        norm = alpha * np.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
    return x / norm, y / norm


@pytest.mark.parametrize(("word", "own"), [("ds", (-0.2, 0.58)), ("eucm", (0.6, 1.1))])
def test_kalibr_wide_cameras(tmp_path, word, own):
    """intrinsics: xi alpha, or alpha beta, before the focal lengths."""
    text = (
        f"cam0:\n  camera_model: {word}\n  intrinsics: [{own[0]}, {own[1]}, 280, 281, 320, 240]\n"
        "  distortion_model: none\n  distortion_coeffs: []\n  resolution: [640, 480]\n"
    )
    camera = read_text(tmp_path, text)
    point = np.array([0.7, -0.4, 0.3])
    x, y = kalibr_projection(word, own, point)
    np.testing.assert_allclose(camera.project(point), [280 * x + 320, 281 * y + 240], rtol=1e-12)


MRCAL = """\
# generated on 2026-11-29 with   mrcal-calibrate-cameras
{
    'lensmodel':  'LENSMODEL_OPENCV8',
    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 500., 501., 320., 240., 0.5, 0.1, 1e-3, -2e-3, 0.01, 0.7, 0.15, 0.01,],
    'valid_intrinsics_region': [],
    # extrinsics are rt_fromref
    'extrinsics': [ 0., 0., 0., 0., 0., 0.,],
    'imagersize': [ 640, 480,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'P4#a{',
}
"""
MRCAL_LENS = [0.5, 0.1, 1e-3, -2e-3, 0.01, 0.7, 0.15, 0.01, 1e-3, 5e-4, -1e-3, 2e-4]


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12])
def test_mrcal_cameras(tmp_path, count):
    numbers = [500.0, 501.0, 320.0, 240.0, *MRCAL_LENS[:count]]
    text = MRCAL.replace("OPENCV8", f"OPENCV{count}" if count else "PINHOLE")
    text = re.sub(r"'intrinsics': \[[^]]*\]", f"'intrinsics': {numbers}", text)
    camera = read_text(tmp_path, text)
    matrix = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
    points, zero = half_field(camera, 3), np.zeros(3)
    lens = np.array(MRCAL_LENS[:count]) if count else None
    theirs = cv2.projectPoints(points, zero, zero, matrix, lens)[0].reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), theirs, atol=1e-9)
    assert camera.image_size == (640, 480)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("LENSMODEL_OPENCV8", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=170",
         "found"),
        ("LENSMODEL_OPENCV8", "LENSMODEL_CAHVOR", "found"),
        ("0.15, 0.01,]", "0.15]", "expected"),
        ("'imagersize': [ 640, 480,]", "'imagersize': [ 640 ]", "expected"),
        ("'imagersize'", "imagersize", "expected"),
    ],
)  # fmt: skip
def test_faults_of_mrcal_files(tmp_path, old, new, field):
    assert old in MRCAL
    with pytest.raises(InputError) as caught:
        read_text(tmp_path, MRCAL.replace(old, new))
    assert getattr(caught.value, field)
    if "SPLINED" in new:
        assert "mrcal-convert-lensmodel" in caught.value.next_step
        assert "SPLINED" in caught.value.found


def test_a_name_where_cameras_have_none(tmp_path):
    for text in (MRCAL, ROS):
        with pytest.raises(InputError) as caught:
            read_text(tmp_path, text, "cam0")
        assert (caught.value.code, caught.value.found) == ("camera.unnamed", "cam0")


COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 9
1 SIMPLE_PINHOLE 640 480 500 320.5 240.5
2 PINHOLE 640 480 500 501 320.5 240.5
3 SIMPLE_RADIAL 640 480 500 320.5 240.5 0.1
4 RADIAL 640 480 500 320.5 240.5 0.1 0.2
5 OPENCV 640 480 500 501 320.5 240.5 0.1 0.2 0.003 0.004
6 FULL_OPENCV 640 480 500 501 320.5 240.5 0.1 0.2 0.003 0.004 0.05 0.3 0.2 0.1
7 OPENCV_FISHEYE 640 480 500 501 320.5 240.5 0.1 0.2 0.003 0.004
8 SIMPLE_RADIAL_FISHEYE 640 480 500 320.5 240.5 0.1
9 RADIAL_FISHEYE 640 480 500 320.5 240.5 0.1 0.2
10 FOV 640 480 500 501 320.5 240.5 0.9
"""


@pytest.mark.parametrize(
    ("name", "model", "fy", "lens"),
    [
        ("1", "pinhole", 500, []),
        ("2", "pinhole", 501, []),
        ("3", "pinhole", 500, [0.1]),
        ("4", "pinhole", 500, [0.1, 0.2]),
        ("5", "pinhole", 501, [0.1, 0.2, 0.003, 0.004]),
        ("6", "rational", 501, [0.1, 0.2, 0.003, 0.004, 0.05, 0.3, 0.2, 0.1]),
        ("7", "fisheye", 501, [0.1, 0.2, 0.003, 0.004]),
        ("8", "fisheye", 500, [0.1]),
        ("9", "fisheye", 500, [0.1, 0.2]),
    ],
)
def test_colmap_cameras(tmp_path, name, model, fy, lens):
    """COLMAP's first pixel has its centre at (0.5, 0.5)."""
    camera = read_text(tmp_path, COLMAP, name)
    assert camera.model == model
    full = np.zeros(len(camera.parameters) - 4)
    full[: len(lens)] = lens
    np.testing.assert_array_equal(camera.parameters, [500, fy, 320, 240, *full])
    alone_in_file = next(line for line in COLMAP.splitlines() if line.startswith(f"{name} "))
    assert read_text(tmp_path, alone_in_file).model == model


@pytest.mark.parametrize(
    ("text", "name", "field", "value"),
    [
        (COLMAP, None, "what", "several cameras"),
        (COLMAP, "11", "found", "11"),
        (COLMAP, "10", "found", "FOV"),
        (COLMAP.replace("320.5 240.5 0.9", "320.5"), "10", "found", "FOV"),
        (COLMAP.replace("500 320.5 240.5 0.1 0.2", "500 320.5"), "4", "expected", "5 numbers"),
        (COLMAP.replace("SIMPLE_PINHOLE 640 480 500", "SIMPLE_PINHOLE 640 480 nan"), "1",
         "expected", "3 numbers"),
    ],
)  # fmt: skip
def test_faults_of_colmap_files(tmp_path, text, name, field, value):
    with pytest.raises(InputError) as caught:
        read_text(tmp_path, text, name)
    assert value in str(getattr(caught.value, field, None) or caught.value)


VISP = """\
<?xml version="1.0"?>
<root>
  <!--This file stores intrinsic camera parameters-->
  <camera>
    <name>Camera</name>
    <image_width>640</image_width>
    <image_height>480</image_height>
    <model>
      <type>perspectiveProjWithoutDistortion</type>
      <px>1129.0</px>
      <py>1130.6</py>
      <u0>317.9</u0>
      <v0>229.1</v0>
    </model>
    <model>
      <type>perspectiveProjWithDistortion</type>
      <px>1089.9</px>
      <py>1090.1</py>
      <u0>326.1</u0>
      <v0>230.5</v0>
      <kud>-0.196</kud>
      <kdu>0.204</kdu>
    </model>
  </camera>
</root>
"""


def test_visp_cameras(tmp_path):
    """The model with distortion if there is one; u = u0 + px x (1 + kud r^2)."""
    camera = read_text(tmp_path, VISP)
    x, y = 0.2, -0.1
    factor = 1 - 0.196 * (x * x + y * y)
    expected = [326.1 + 1089.9 * x * factor, 230.5 + 1090.1 * y * factor]
    np.testing.assert_allclose(camera.project(np.array([x, y, 1.0])), expected, rtol=1e-12)
    plain = read_text(tmp_path, VISP.replace("WithDistortion", "WithKannalaBrandt"), "Camera")
    np.testing.assert_array_equal(plain.parameters, [1129, 1130.6, 317.9, 229.1, *np.zeros(5)])


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        ("</root>", "", None),
        ("<root>", "<!DOCTYPE a [<!ENTITY b 'c'>]>\n<root>", None),
        ("<px>1089.9</px>", "<px>nan</px>", None),
        ("<px>1089.9</px>", "", None),
        ("<kud>-0.196</kud>", "", None),
        ("<image_width>640</image_width>", "", None),
        ("out", "Kannala", None),
        ("  <camera>", "  <camera><name>b</name></camera>\n  <camera>", None),
        ("Camera<", "Front<", "Camera"),
    ],
)
def test_faults_of_visp_files(tmp_path, old, new, name):
    assert old in VISP
    text = VISP.replace(old, new)
    if new == "Kannala":
        text = text.replace("WithDistortion", "WithKannala")
    with pytest.raises(InputError) as caught:
        read_text(tmp_path, text, name)
    assert str(caught.value).startswith("c.yaml")


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


EVERY_FORM = {
    "c.yaml": ROS,
    "kalibr.yaml": KALIBR[: KALIBR.index("cam1")],
    "opencv.yaml": OPENCV,
    "c.cameramodel": MRCAL,
    "c.txt": "1 PINHOLE 640 480 500 501 320.5 240.5\n",
    "c.xml": VISP.replace("1089.9", "500").replace("1090.1", "501").replace("326.1", "320"),
    "own.yaml": "model: pinhole\nimage_size: [640, 480]\nfocal: [500, 501]\ncenter: [320, 240]\n",
}
"""The same camera in every format."""
CONTRADICTIONS = {
    "centre": ("320", "1280"),
    "millimetres": ("500", "5"),
    "focal length": ("500", "500000"),
    "aspect": ("501", "1600"),
    "no width": ("640", "0"),
    "negative width": ("640", "-640"),
    "part of a pixel": ("640", "640.5"),
}


@pytest.mark.parametrize("name", CONTRADICTIONS)
@pytest.mark.parametrize("file", EVERY_FORM)
def test_numbers_that_no_camera_has(tmp_path, file, name):
    """Whatever program wrote them."""
    path, (old, new) = tmp_path / file, CONTRADICTIONS[name]
    path.write_text(EVERY_FORM[file])
    assert load_camera(path).image_size == (640, 480)
    assert old in EVERY_FORM[file]
    path.write_text(EVERY_FORM[file].replace(old, new))
    with pytest.raises(InputError) as caught:
        load_camera(path)
    assert caught.value.where


def test_a_transposed_matrix(tmp_path):
    """The centre is in the last row, as in Matlab."""
    with pytest.raises(InputError) as error:
        read_text(
            tmp_path, ROS.replace("0, 320, 0, 501, 240, 0, 0, 1", "0, 0, 0, 501, 0, 320, 240, 1")
        )
    assert error.value.found == "[500.0, 0.0, 0.0, 0.0, 501.0, 0.0, 320.0, 240.0, 1.0]"


MESSAGE = (
    "header:\n  seq: 5\n  frame_id: camera\nheight: 480\nwidth: 640\n"
    "distortion_model: plumb_bob\nD: [0.1, -0.2, 0.001, 0.002, 0.0]\n"
    "K: [610.5, 0.0, 320.1, 0.0, 610.2, 240.7, 0.0, 0.0, 1.0]\n"
    "R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]\n"
    "P: [610.5, 0.0, 320.1, 0.0, 0.0, 610.2, 240.7, 0.0, 0.0, 0.0, 1.0, 0.0]\n"
    "binning_x: 0\nbinning_y: 0\n"
    "roi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: False\n"
)
"""Message of ROS 1, as ``rostopic echo`` prints it."""


@pytest.mark.parametrize("ros2", [False, True])
@pytest.mark.parametrize("messages", [1, 2])
def test_printed_messages_of_ros(tmp_path, ros2, messages):
    text = re.sub(r"^([DKRP]):", lambda m: m[0].lower(), MESSAGE, flags=re.MULTILINE)
    path = tmp_path / "info.yaml"
    path.write_text(((text if ros2 else MESSAGE) + "---\n") * messages)
    camera = load_camera(path)
    assert camera.image_size == (640, 480)
    expected = [610.5, 610.2, 320.1, 240.7, 0.1, -0.2, 0.001, 0.002, 0.0]
    np.testing.assert_array_equal(camera.parameters, expected)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("x_offset: 0", "x_offset: 64"),
        ("  height: 0\n  width: 0", "  height: 240\n  width: 320"),
        ("binning_y: 0", "binning_y: 2"),
    ],
)
def test_a_ros_message_about_a_part_of_the_sensor(tmp_path, old, new):
    (tmp_path / "info.yaml").write_text(MESSAGE.replace(old, new))
    with raises(InputError, code="camera.region"):
        load_camera(tmp_path / "info.yaml")


@pytest.mark.parametrize("before", ["", "---\n", "# a comment\n---\n"])
def test_a_ros_message_of_the_whole_sensor(tmp_path, before):
    whole = MESSAGE.replace("  height: 0\n  width: 0", "  height: 480\n  width: 640")
    (tmp_path / "info.yaml").write_text(before + whole)
    assert load_camera(tmp_path / "info.yaml").parameters[4] == 0.1


@pytest.mark.parametrize(
    ("field", "line"), [("D", None), ("K", 8), ("width", 5), ("distortion_model", 6)]
)
def test_a_fault_of_a_ros_message_has_its_line(tmp_path, field, line):
    """Of a message without coefficients too, which is not taken for a lens without distortion."""
    new = f"{field}: -1\n" if line else ""
    text = re.sub(rf"^{field}: .*\n", new, MESSAGE, flags=re.MULTILINE)
    (tmp_path / "info.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        load_camera(tmp_path / "info.yaml")
    where = str(caught.value.where)
    assert f"line {line}," in where if line else where.endswith("distortion_coefficients.data")


@pytest.mark.parametrize(
    "text",
    [
        "gyroscope_noise_density: 1.87e-04\nrostopic: /imu0\nupdate_rate: 200.0\n",
        "imu0:\n  gyroscope_noise_density: 1.87e-04\n  update_rate: 200.0\n",
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n",
    ],
)
def test_other_files_of_kalibr(tmp_path, text):
    (tmp_path / "file.yaml").write_text(text)
    with raises(InputError, code="camera.other_file"):
        load_camera(tmp_path / "file.yaml")


def test_an_mrcal_file_with_a_list_for_a_key(tmp_path):
    (tmp_path / "a.cameramodel").write_text("{'lensmodel': 'LENSMODEL_PINHOLE', [1]: 2}\n")
    with raises(InputError, where="a.cameramodel"):
        load_camera(tmp_path / "a.cameramodel")


@pytest.mark.parametrize("without", ["camera_model", "intrinsics", "resolution"])
def test_a_camera_of_kalibr_without_a_field(tmp_path, without):
    camera = camera_of("extended_unified")
    text = foreign_text(camera, tmp_path / "chain.yaml", "kalibr")
    rest = re.sub(rf"^  {without}:.*?(?=^  \w|\Z)", "", text, flags=re.MULTILINE | re.DOTALL)
    (tmp_path / "chain.yaml").write_text(rest)
    with pytest.raises(InputError) as caught:
        load_camera(tmp_path / "chain.yaml")
    assert f"cam0.{without}" in str(caught.value.where)


def test_an_opencv_file_without_known_distortion(tmp_path):
    """Coefficients under another name are not taken for a lens without any."""
    text = foreign_text(camera_of("pinhole"), tmp_path / "camera.yaml", "opencv")
    (tmp_path / "camera.yaml").write_text(text.replace("distortion_coefficients", "dist"))
    with raises(InputError, expected="distortion_coefficients"):
        load_camera(tmp_path / "camera.yaml")


def test_a_camera_that_was_never_calibrated(tmp_path):
    """ROS publishes zeros for it."""
    with raises(InputError, where="c.yaml, line 4, camera_matrix"):
        read_text(tmp_path, ROS.replace("500, 0, 320, 0, 501, 240, 0, 0, 1", "0, " * 8 + "0"))


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("rows: 5", "rows: 8", "distortion_coefficients"),
        ("data: [ 0.1", "data: [ .Nan", "distortion_coefficients"),
        ("data: [ 500.", "data: [ .Inf", "camera_matrix"),
        ("data: [ 500., 0.", "data: [ 500., 1.", "camera_matrix"),
    ],
)
def test_a_fault_in_a_matrix_of_opencv(tmp_path, old, new, field):
    assert old in OPENCV
    with raises(InputError, where=f"c.yaml, {field}"):
        read_text(tmp_path, OPENCV.replace(old, new, 1))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n1 1 0 0 0 1 2 3 1 a.jpg\n",
         "'1 1 0 0 0 1 2 3 1 a.jpg'"),
        ("#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n", None),
    ],
)  # fmt: skip
def test_files_of_colmap_without_cameras(tmp_path, text, found):
    with raises(InputError, found=found, where="c.yaml"):
        read_text(tmp_path, text)


def test_an_inertial_sensor_where_a_camera_is_named(tmp_path):
    with raises(InputError, code="camera.other_file"):
        read_text(tmp_path, "imu0:\n  gyroscope_noise_density: 1.87e-04\n", "cam0")
