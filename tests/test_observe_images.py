"""Decoded images: complete ones as the camera wrote them; faulty ones named with their fault."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from faults import raises
from pkmcal.errors import InputError
from pkmcal.observe.images import Pictures, Selected, decode

SIZE = (64, 48)
GREY = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)


def encoded(kind, image=GREY):
    return cv2.imencode(kind, image)[1].tobytes()


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_of(width, height):
    """PNG of well-formed chunks that states a size and contains no such image."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = [(b"IHDR", header), (b"IDAT", zlib.compress(b"0" * 100)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


def with_preview(jpeg):
    """The same JPEG with a whole small one in a segment before it, as cameras write it."""
    small = encoded(".jpg", GREY[:8, :8])
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(small)) + small + jpeg[2:]


def decoded(tmp_path, data, size=SIZE):
    path = tmp_path / "a.png"
    path.write_bytes(data)
    return decode(path, size, "images/front/a.png")


def sentence(tmp_path, data, size=SIZE):
    with pytest.raises(InputError) as caught:
        decoded(tmp_path, data, size)
    return str(caught.value)


def test_grey_levels_come_as_they_are(tmp_path):
    np.testing.assert_array_equal(decoded(tmp_path, encoded(".png")), GREY)


def test_colour_and_sixteen_bits_become_grey(tmp_path):
    colour = encoded(".png", np.dstack([GREY] * 3))
    deep = encoded(".png", GREY.astype(np.uint16) * 257)
    np.testing.assert_array_equal(decoded(tmp_path, colour), GREY)
    np.testing.assert_allclose(decoded(tmp_path, deep).astype(int), GREY, atol=1)


@pytest.mark.parametrize(
    ("suffix", "bits", "times"), [("png", 12, 16), ("tiff", 12, 16), ("pgm", 12, 16),
                                  ("png", 10, 64), ("png", 8, 256)],
)  # fmt: skip
def test_twelve_bits_in_sixteen_are_reported_as_such(tmp_path, suffix, bits, times):
    levels = np.linspace(0, 2**bits - 1, 48).astype(np.uint16).reshape(6, 8)
    path = tmp_path / f"a.{suffix}"
    assert cv2.imwrite(str(path), levels)
    with raises(InputError, where=path.name, found=f"levels up to {2**bits - 1}") as caught:
        decode(path, (8, 6), path.name)
    assert f"multiply by {times} " in caught.value.next_step
    assert cv2.imwrite(str(path), levels * times)  # as in the sentence
    assert decode(path, (8, 6), path.name).max() > 250


def test_twelve_bits_of_each_colour_in_sixteen(tmp_path):
    levels = np.linspace(0, 2**12 - 1, 48).astype(np.uint16).reshape(6, 8)
    assert cv2.imwrite(str(tmp_path / "a.png"), np.dstack([levels] * 3))
    with raises(InputError, found=f"levels up to {2**12 - 1}"):
        decode(tmp_path / "a.png", (8, 6), "a.png")


def test_a_dark_image_of_eight_bits_is_no_fault_of_its_file(tmp_path):
    path = tmp_path / "a.png"
    assert cv2.imwrite(str(path), np.full((6, 8), 3, np.uint8))
    assert decode(path, (8, 6), path.name).max() == 3


def test_a_turned_jpeg_stays_as_the_sensor_gave_it(tmp_path):
    """EXIF orientation 6 requests a quarter turn from viewers; the camera model ignores it."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + struct.pack("<I", 0)
    plain = encoded(".jpg")
    turned = plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:]
    np.testing.assert_array_equal(decoded(tmp_path, turned), decoded(tmp_path, plain))


@pytest.mark.parametrize("kind", [".png", ".jpg"])
def test_what_phones_append_does_no_harm(tmp_path, kind):
    whole = encoded(kind)
    expected = decoded(tmp_path, whole)
    np.testing.assert_array_equal(decoded(tmp_path, whole + b"\0trailer" * 40), expected)


CUT = (
    "images/front/a.png: the image cannot be decoded; found {found}, expected a whole PNG or "
    "JPEG file. Copy it again from the camera, or remove it: an absent image is allowed."
)
PNG, JPEG = encoded(".png"), encoded(".jpg")


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        pytest.param(PNG[: len(PNG) // 2], "a PNG file that ends early", id="half a PNG"),
        pytest.param(PNG[:-12], "a PNG file that ends early", id="PNG without its end"),
        pytest.param(
            PNG[:90] + b"!" + PNG[91:],
            "a PNG file that is damaged (broken PNG file (bad header checksum in b'IDAT'))",
            id="PNG with another byte",
        ),
        pytest.param(JPEG[: len(JPEG) // 2], "a JPEG file that ends early", id="half a JPEG"),
        pytest.param(
            with_preview(JPEG)[:-200], "a JPEG file that ends early", id="JPEG with whole preview"
        ),
    ],
)
def test_files_that_cannot_be_decoded(tmp_path, data, reason):
    assert sentence(tmp_path, data) == CUT.format(found=reason)


@pytest.mark.parametrize("data", [
    b"joints.csv\n1,2,3\n", JPEG[:3], png_of(0, 0), png_of(100_000, 100_000),
], ids=["text", "three bytes of a JPEG", "no pixels", "ten billion pixels"])  # fmt: skip
def test_files_without_a_readable_header(tmp_path, data):
    assert "the file is not an image that can be read" in sentence(tmp_path, data)


def with_chunk(kind, body, data=PNG):
    return data[:33] + chunk(kind, body) + data[33:]


def test_messages_of_decoders_become_one_sentence(tmp_path, capfd):
    rows = zlib.decompress(png_rows(PNG))
    odd, cut = (
        png_of(64, 48).replace(chunk(b"IDAT", zlib.compress(b"0" * 100)), chunk(b"IDAT", held))
        for held in (zlib.compress(b"\x09" + rows[1:]), zlib.compress(rows[:100]))
    )
    at = len(JPEG) * 2 // 3
    short = JPEG[:at] + b"\xff\xd9"
    for data, item in (
        (
            odd,
            "a PNG file that is damaged (unrecognized data stream contents when reading image"
            " file)",
        ),
        (cut, "a PNG file that ends early"),
        (short, "a JPEG file that is damaged (its scan ends early)"),
    ):
        assert sentence(tmp_path, data) == CUT.format(found=item)
    assert capfd.readouterr() == ("", "")


def png_rows(data):
    at = data.index(b"IDAT")
    return data[at + 4 : at + 4 + int.from_bytes(data[at - 4 : at])]


def test_what_is_wrong_beside_the_picture_is_nobodys_business(tmp_path, capfd):
    for data in (
        with_chunk(b"iCCP", b"name\0\0garbage"),
        with_chunk(b"zTXt", b"k\0\0garbage"),
    ):
        np.testing.assert_array_equal(decoded(tmp_path, data), GREY)
    padded = JPEG[:-2] + b"\0\0\0" + JPEG[-2:]  # as webcams write it
    np.testing.assert_array_equal(decoded(tmp_path, padded), decoded(tmp_path, JPEG))
    assert capfd.readouterr() == ("", "")


def test_nobody_is_blamed_for_what_another_thread_decodes(tmp_path, capfd):
    paths = [tmp_path / f"{k}.jpg" for k in range(12)]
    for k, path in enumerate(paths):
        path.write_bytes(JPEG if k != 7 else JPEG[: len(JPEG) * 2 // 3] + b"\xff\xd9")
    with raises(InputError, code="image.damaged", where="7.jpg"):
        Pictures.read(paths, SIZE, [path.name for path in paths], most=12)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("options", [
    [], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 3],
], ids=["plain", "progressive", "restarts"])  # fmt: skip
def test_a_jpeg_whose_last_pixel_is_as_grey_as_a_missing_one(tmp_path, options):
    """Whole, it is read; cut anywhere in its scan, with an end mark, it is refused."""
    grey = np.full((48, 64), 128, np.uint8)
    grey[:40] = GREY[:40]
    whole = cv2.imencode(".jpg", grey, options)[1].tobytes()
    assert decoded(tmp_path, whole)[-1, -1] == 128
    start = whole.rindex(b"\xff\xda") + 20
    for at in range(start, start + (len(whole) - start) * 3 // 4, 97):
        assert "scan ends early" in sentence(tmp_path, whole[:at] + b"\xff\xd9")


def test_a_whole_jpeg_with_a_preview_is_read(tmp_path):
    np.testing.assert_array_equal(decoded(tmp_path, with_preview(JPEG)), decoded(tmp_path, JPEG))


def test_an_image_of_another_size(tmp_path):
    assert sentence(tmp_path, PNG, (640, 480)) == (
        "images/front/a.png: the image has another size than its camera; found 64x48 pixels, "
        "expected 640x480, the camera file's image_size. Use the image as the camera gave "
        "it, neither scaled nor cropped."
    )


def test_an_image_that_is_not_there(tmp_path):
    with raises(InputError, code="file.unreadable", where="images/front/b.png"):
        decode(tmp_path / "b.png", SIZE, "images/front/b.png")


def several(tmp_path, count=4):
    paths = [tmp_path / f"{k}.png" for k in range(count)]
    for k, path in enumerate(paths):
        path.write_bytes(encoded(".png", np.full((48, 64), 10 * k, np.uint8)))
    return paths, [path.name for path in paths]


def test_several_keep_their_order_and_the_first_fault_is_reported(tmp_path):
    paths, labels = several(tmp_path)
    images = Pictures.read(paths, SIZE, labels, 2)
    assert [int(image[0, 0]) for image in images] == [0, 10, 20, 30]
    assert [int(image[0, 0]) for image in images[-1:0:-2]] == [30, 10]
    paths[1].write_bytes(b"")
    with raises(InputError, code="image.empty", where="1.png"):
        Pictures.read(paths, SIZE, labels, 0)


def test_so_many_stay_decoded_and_the_others_are_decoded_again(tmp_path):
    paths, labels = several(tmp_path)
    images = Pictures.read(paths, SIZE, labels, 2)
    assert [images[k] is images[k] for k in range(4)] == [True, True, False, False]


def test_of_some_images_no_other_is_decoded(tmp_path):
    paths, labels = several(tmp_path)
    images = Pictures(paths, SIZE, labels)
    for path in paths[:3]:
        path.write_bytes(b"")
    some = Selected(images, np.array([2, 3, 0]))
    assert [int(some[1][0, 0]), int(some[1:2][0][0, 0]), len(some)] == [30, 30, 3]
    with raises(InputError, code="image.empty", where="0.png"):
        _ = some[-1]
