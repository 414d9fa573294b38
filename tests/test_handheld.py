"""Photographs by hand: the format, EXIF, and a session in which each has a place of its own."""

import cv2
import numpy as np
import pytest

from pkmcal.errors import InputError
from pkmcal.files import Exif, read_exif, with_exif
from pkmcal.observe.images import decode
from pkmcal.session.exif import camera_by_exif
from pkmcal.session.load import load_session

SESSION = """\
pkmcal: 1
mechanism: gough-stewart
joints: {file: joints.csv, noise: 3.0e-6}
stations:
  phone:
    camera: cameras/phone.yaml
    images: images/phone/{configuration}-{repeat}.jpg
    observe: legs
    handheld: true
"""
CAMERA = "model: pinhole\nimage_size: [8, 6]\nfocal: [9.0, 9.0]\ncenter: [3.5, 2.5]\n"
JOINTS = """\
configuration,leg1,leg2,leg3,leg4,leg5,leg6
0000,0.36,0.37,0.38,0.39,0.40,0.41
0001,0.46,0.45,0.44,0.43,0.42,0.40
"""
PICTURE = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5


def jpeg(path, exif=None, picture=PICTURE):
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(".jpg", picture)
    assert ok
    path.write_bytes(data.tobytes() if exif is None else with_exif(data.tobytes(), exif))
    return path


@pytest.fixture
def folder(tmp_path):
    """Two configurations, one of them photographed from two places."""
    (tmp_path / "cameras").mkdir()
    (tmp_path / "session.yaml").write_text(SESSION)
    (tmp_path / "cameras" / "phone.yaml").write_text(CAMERA)
    (tmp_path / "joints.csv").write_text(JOINTS)
    for name in ("0000-1", "0000-2", "0001-1"):
        jpeg(tmp_path / "images" / "phone" / f"{name}.jpg", Exif(6, 26.0))
    return tmp_path


def change(folder, old, new):
    path = folder / "session.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def fault(folder):
    with pytest.raises(InputError) as caught:
        load_session(folder)
    return str(caught.value)


# EXIF


def test_exif_is_read_as_it_was_written(tmp_path):
    data = jpeg(tmp_path / "a.jpg").read_bytes()
    assert read_exif(data) == Exif(1, None)
    assert read_exif(with_exif(data, Exif(8, 26.0))) == Exif(8, 26.0)
    assert read_exif(with_exif(data, Exif(3, None))) == Exif(3, None)


def test_exif_of_either_byte_order():
    """A segment as telephones write it in little-endian, built by hand from the standard."""

    def entry(tag, kind, value):
        return b"".join(
            n.to_bytes(size, "little") for n, size in ((tag, 2), (kind, 2), (1, 4), (value, 4))
        )

    first = (2).to_bytes(2, "little") + entry(0x0112, 3, 6) + entry(0x8769, 4, 38) + bytes(4)
    own = (1).to_bytes(2, "little") + entry(0xA405, 3, 28) + bytes(4)
    block = b"Exif\0\0II*\0" + (8).to_bytes(4, "little") + first + own
    data = b"\xff\xd8\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + b"\xff\xda"
    assert read_exif(data) == Exif(6, 28.0)


@pytest.mark.parametrize("cut", [0, 2, 12, 20, 30, 40])
def test_spoilt_exif_counts_as_not_said(tmp_path, cut):
    data = with_exif(jpeg(tmp_path / "a.jpg").read_bytes(), Exif(6, 26.0))
    assert read_exif(data[:cut]) in (Exif(1, None), Exif(6, None))


# the format


def test_each_photograph_by_hand_is_a_station(folder):
    session = load_session(folder)
    names = ["phone-0000-1", "phone-0000-2", "phone-0001-1"]
    assert [station.name for station in session.stations] == names
    for station in session.stations:
        assert station.entry == "phone"
        assert station.handheld
        assert len(station.photographs) == 1
        assert station.T_camera_base is None
        assert station.camera_file == "cameras/phone.yaml"
    written = session.document["stations"]["phone"]["photographs"]
    assert written == [f"images/phone/{name}.jpg" for name in ("0000-1", "0000-2", "0001-1")]


def test_a_pose_of_a_camera_by_hand(folder):
    change(folder, "handheld: true", "handheld: true\n    pose: {position: [1, 0, 0], look_at:"
           " [0, 0, 0]}")  # fmt: skip
    message = fault(folder)
    assert "stations.phone.pose: a camera that is held by hand has no one pose" in message


def test_a_board_alone_by_hand(folder):
    change(folder, "observe: legs", "observe: board")
    change(folder, "stations:", "board: cameras/phone.yaml\nstations:")
    assert "photographs by hand of a board alone tell nothing of the machine" in fault(folder)


def test_two_stations_of_one_name(folder):
    jpeg(folder / "other" / "0001.jpg")
    change(
        folder,
        "stations:",
        "stations:\n  phone-0001-1: {camera: cameras/phone.yaml,"
        ' images: "other/{configuration}.jpg", observe: legs}',
    )
    message = fault(folder)
    assert "two stations, or photographs by hand, have the same name; found phone-0001-1" in message


# cameras by EXIF, and turned photographs


def test_a_camera_by_exif(folder):
    change(folder, "cameras/phone.yaml", "exif")
    station = load_session(folder).stations[0]
    assert station.from_exif
    assert station.camera.image_size == (8, 6)
    # a 26 mm lens sees as much along its picture's diagonal as on film of 36 x 24 mm
    np.testing.assert_allclose(station.camera.parameters[:2], 26 * 10 / np.hypot(36, 24))
    np.testing.assert_allclose(station.camera.parameters[2:4], [3.5, 2.5])
    sigma = np.sqrt(np.diag(station.camera.covariance))
    assert 0.02 < sigma[0] / station.camera.parameters[0] < 0.05


def test_a_photograph_without_a_focal_length(folder):
    change(folder, "cameras/phone.yaml", "exif")
    jpeg(folder / "images/phone/0000-2.jpg", Exif(6, None))
    message = fault(folder)
    assert "0000-2.jpg: the photograph does not tell the focal length" in message


def test_photographs_by_different_lenses(folder):
    change(folder, "cameras/phone.yaml", "exif")
    jpeg(folder / "images/phone/0001-1.jpg", Exif(6, 52.0))
    message = fault(folder)
    assert "tell different focal lengths or sizes" in message
    assert "52 mm at 8x6, where images/phone/0000-1.jpg has 26 mm at 8x6" in message


def test_the_sensors_picture_is_the_size_of_most(tmp_path):
    files = [
        (jpeg(tmp_path / "a.jpg", Exif(1, 26.0)), "a.jpg"),
        (jpeg(tmp_path / "b.jpg", Exif(1, 26.0)), "b.jpg"),
        (jpeg(tmp_path / "c.jpg", Exif(1, 26.0), np.rot90(PICTURE)), "c.jpg"),
    ]
    assert camera_by_exif(files, "session.yaml").image_size == (8, 6)


@pytest.mark.parametrize(("orientation", "quarters"), [(None, 1), (6, -1), (8, 1)])
def test_a_turned_photograph_is_turned_back(tmp_path, orientation, quarters):
    """By its EXIF; without, a portrait picture of a landscape sensor was turned clockwise."""
    portrait = np.rot90(PICTURE, -1)
    exif = None if orientation is None else Exif(orientation, 26.0)
    path = jpeg(tmp_path / "a.jpg", exif, portrait)
    stored = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    np.testing.assert_array_equal(decode(path, (8, 6), "a.jpg"), np.rot90(stored, quarters))


def test_a_turned_photograph_is_told(folder):
    jpeg(folder / "images/phone/0000-2.jpg", Exif(1, 26.0), np.rot90(PICTURE))
    (warning,) = load_session(folder).warnings
    assert warning.startswith("images/phone/0000-2.jpg: turned by a quarter against its camera")
