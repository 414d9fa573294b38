"""Sizes of photographs, read without decoding them."""

import struct

import cv2
import numpy as np
import pytest

from pkmcal.errors import InputError
from pkmcal.session.photographs import photograph_header


def image(path, width, height):
    assert cv2.imwrite(str(path), np.full((height, width), 128, np.uint8))


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tiff"])
def test_sizes_are_those_of_the_decoded_image(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    image(path, 37, 21)
    assert photograph_header(path) == (37, 21)


def test_a_jpeg_turned_by_its_camera_keeps_the_sensors_size(tmp_path):
    path = tmp_path / "a.jpg"
    image(path, 37, 21)
    # An EXIF block that asks viewers to turn the image by a quarter (orientation 6).
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    block = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    # Fill bytes before a marker are allowed, and some cameras write them.
    path.write_bytes(path.read_bytes()[:2] + b"\xff\xff" + block + path.read_bytes()[2:])
    assert cv2.imread(str(path)).shape[:2] == (37, 21)
    assert photograph_header(path) == (37, 21)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "image file is empty"),
        (b"no image at all", "file is not an image that can be read"),
        (b"\x89PNG\r\n\x1a\n\0\0", "file is not an image that can be read"),
        (b"\xff\xd8\xff\xe0\0\x10JFIF", "file is not an image that can be read"),
        (b"\xff\xd8 and no marker", "file is not an image that can be read"),
    ],
)
def test_broken_images(tmp_path, content, sentence):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        photograph_header(path, "front/a.png")
    assert str(caught.value).startswith(f"front/a.png: the {sentence}")


def test_an_image_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        photograph_header(tmp_path / "none.png")
