"""Sizes of images, read without decoding them."""

import os
import struct
import sys
import zlib

import cv2
import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.files import read_text
from pkmcal.observe.images import decode, upright_turns
from pkmcal.session.image_files import image_header


def image(path, width, height):
    assert cv2.imwrite(str(path), np.full((height, width), 128, np.uint8))


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tiff", "pgm"])
def test_sizes_are_those_of_the_decoded_image(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"a.{suffix}"
    image(path, 37, 21)
    monkeypatch.setattr(cv2, "imread", lambda *_: pytest.fail("decoded"))
    assert image_header(path) == (37, 21)
    assert decode(path, (37, 21), path.name).shape == (21, 37)


@pytest.mark.parametrize("data", [
    b"P5\n" + b"# " * 400, b"P5\n" + b"#\n" * 400, b"P5" + b" " * 900, b"P5\n37 21",
    b"P537 21 255\n", b"P5\n37 " + b"2" * 10 + b" 255\n", b"P5\n-37 21 255\n",
])  # fmt: skip
def test_headers_without_a_size_are_refused_at_once(tmp_path, data):
    (tmp_path / "a.pgm").write_bytes(data)
    with raises(InputError, code="image.unreadable"):
        image_header(tmp_path / "a.pgm")


def test_sizes_of_headers_that_opencv_does_not_write(tmp_path):
    def size(data):
        (tmp_path / "a").write_bytes(data + b"\0" * 2000)
        return image_header(tmp_path / "a")

    assert size(b"P5 # a remark\n# and one more\n 37\n#x\n21 255\n") == (37, 21)
    assert size(b"BM" + b"\0" * 12 + struct.pack("<IHHHH", 12, 37, 21, 1, 8)) == (37, 21)
    downwards = struct.pack("<IiiHHI", 40, 37, -21, 1, 24, 0)
    assert size(b"BM" + b"\0" * 12 + downwards) == (37, 21)
    for start, order in ((b"II*\0", "<"), (b"MM\0*", ">")):
        entries = struct.pack(order + "HHIHH", 256, 3, 1, 37, 0)
        entries += struct.pack(order + "HHII", 257, 4, 1, 21)
        entries += struct.pack(order + "HHIHH", 262, 3, 1, 1, 0)  # black is zero
        entries += struct.pack(order + "HHII", 273, 4, 1, 100)  # where its one strip begins
        ifd = struct.pack(order + "IH", 8, 4) + entries
        assert size(start + ifd) == (37, 21)


def chunk(kind, data):
    """Chunk of a PNG file."""
    checksum = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)


@pytest.mark.parametrize("behind", [False, True])
def test_the_orientation_of_a_png_file_is_read_without_its_pixels(tmp_path, behind):
    """Its EXIF may stand before or behind the pixels, which here cannot be decoded."""
    path = tmp_path / "a.png"
    image(path, 40, 20)
    assert upright_turns(path, (40, 20)) == 0
    entry = struct.pack("<HHII", 0x0112, 3, 1, 6)
    exif = chunk(b"eXIf", b"II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0))
    data = path.read_bytes()
    header, pixels, end = data[:33], chunk(b"IDAT", b"none"), data[-12:]
    path.write_bytes(header + (pixels + exif if behind else exif + pixels) + end)
    assert upright_turns(path, (40, 20)) == 1
    assert upright_turns(path, (20, 40)) == 0  # turned when it is decoded
    for cut in range(33, len(path.read_bytes())):
        path.write_bytes(data[:33] + exif[: cut - 33])
        assert upright_turns(path, (40, 20)) in (0, 1)


@pytest.mark.parametrize("suffix", ["bmp", "tiff", "pgm"])
def test_no_more_memory_is_taken_than_a_file_can_fill(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    image(path, 37, 21)
    data = path.read_bytes()
    if suffix == "bmp":
        spoilt = data[:18] + 2 * struct.pack("<I", 30_000) + data[26:]
    elif suffix == "pgm":
        spoilt = data.replace(b"37 21", b"99999 99999")
    else:
        width = struct.pack("<HHII", 256, 4, 1, 2**31)
        spoilt = data.replace(struct.pack("<HHIHH", 256, 3, 1, 37, 0), width)
    assert spoilt != data
    path.write_bytes(spoilt)
    with raises(InputError, code="image.unreadable"):
        image_header(path)


def test_other_formats_are_not_read(tmp_path):
    image(tmp_path / "a.webp", 37, 21)
    with raises(InputError, code="image.unreadable"):
        image_header(tmp_path / "a.webp")


def test_heif_without_its_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)  # importing it fails
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    for read in (image_header, lambda path: decode(path, (4, 4), path.name)):
        with raises(InputError, code="package.missing") as caught:
            read(tmp_path / "a.heic")
        assert "pillow-heif" in caught.value.what
        assert "pip install '.[heic]'" in caught.value.next_step


def test_a_jpeg_turned_by_its_camera_keeps_the_sensors_size(tmp_path):
    path = tmp_path / "a.jpg"
    image(path, 37, 21)
    # an EXIF block that requests a quarter turn of the image (orientation 6)
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    block = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    # Fill bytes before a marker are allowed, and some cameras write them.
    path.write_bytes(path.read_bytes()[:2] + b"\xff\xff" + block + path.read_bytes()[2:])
    assert cv2.imread(str(path)).shape[:2] == (37, 21)
    assert image_header(path) == (37, 21)


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "image.empty"),
        (b"no image at all", "image.unreadable"),
        (b"\x89PNG\r\n\x1a\n\0\0", "image.unreadable"),
        (b"\xff\xd8\xff\xe0\0\x10JFIF", "image.unreadable"),
        (b"\xff\xd8 and no marker", "image.unreadable"),
    ],
)
def test_broken_images(tmp_path, content, code):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with raises(InputError, code=code, where="front/a.png"):
        image_header(path, "front/a.png")


def test_an_image_that_is_not_there(tmp_path):
    with raises(InputError, code="file.unreadable", where=str(tmp_path / "none.png")):
        image_header(tmp_path / "none.png")


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_size_that_a_file_of_this_length_cannot_hold(tmp_path, suffix, monkeypatch):
    path = tmp_path / f"a.{suffix}"
    image(path, 37, 21)
    data = bytearray(path.read_bytes())
    monkeypatch.setattr(cv2, "imread", lambda *_: pytest.fail("decoded"))
    if suffix == "png":
        data[16:24] = struct.pack(">II", 30000, 30000)
        path.write_bytes(data)  # first as a disk spoils it, with the old checksum
        with raises(InputError, code="image.unreadable"):
            image_header(path)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    else:
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", 30000, 30000)
    path.write_bytes(data)
    with raises(InputError, code="image.unreadable"):
        image_header(path)


def test_pictures_of_one_colour_are_not_too_small_for_their_size(tmp_path):
    for suffix in ("png", "jpg"):
        path = tmp_path / f"a.{suffix}"
        assert cv2.imwrite(str(path), np.zeros((3000, 4000), np.uint8))
        assert image_header(path) == (4000, 3000)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_what_is_no_file_is_named_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "device.png").symlink_to("/dev/zero")
    (tmp_path / "link.png").symlink_to("nowhere")
    for name in ("pipe", "folder", "device", "link"):
        found = "nowhere" if name == "link" else None
        for read in (image_header, lambda p, label: decode(p, (4, 4), label), read_text):
            with raises(InputError, code="file.irregular", where="a.png", found=found) as caught:
                read(tmp_path / f"{name}.png", "a.png")
            assert f"a {name}" in caught.value.what


RECORDINGS = {
    "a.mp4": (b"\0\0\0\x18ftypisom\0\0\2\0isommp42", "MP4", "ffmpeg"),
    "a.mov": (b"\0\0\0\x14ftypqt  \0\0\2\0qt  ", "MOV", "ffmpeg"),
    "a.avi": (b"RIFF\0\0\0\0AVI LIST", "AVI", "ffmpeg"),
    "a.mkv": (b"\x1aE\xdf\xa3\x01\0\0\0", "Matroska", "ffmpeg"),
    "a.bag": (b"#ROSBAG V2.0\nE\0\0\0\xff", "ROS bag", "rosbags"),
    "a.db3": (b"SQLite format 3\0\x10\0\1\1", "ROS 2 bag", "rosbags"),
    "a.mcap": (b"\x89MCAP0\r\n\x01\xff", "MCAP", "mcap"),
}


@pytest.mark.parametrize("read", [image_header, read_text])
@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings_are_named_in_place_of_images_and_tables(tmp_path, name, read):
    """By their content, whatever their size, with the program that takes images or tables out."""
    head, kind, program = RECORDINGS[name]
    (tmp_path / name).write_bytes(head + bytes(200))
    with pytest.raises(InputError) as caught:
        read(tmp_path / name)
    assert kind in caught.value.found
    assert program in caught.value.next_step
    assert name in caught.value.where
