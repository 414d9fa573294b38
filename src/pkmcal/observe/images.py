"""Images from disk as grey levels, decoded by Pillow; errors name broken files and their fault.

Pillow decodes, not OpenCV: the levels are the same, but the decoders behind OpenCV report faults on
standard error instead of to their caller, and OpenCV reads no HEIF.

Six thousand images do not fit into memory, but those of an ordinary session should be decoded once,
not in each measurement pass. So the first images that fit into CACHED_IMAGE_BYTES bytes are cached,
and the others are decoded each time they are needed. Code that needs many images works in windows
(`pkmcal.observe.image_batches`).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from pkmcal.arrays import THREADS, Integers
from pkmcal.errors import InputError
from pkmcal.files import IMAGE_ERRORS, check_regular, open_image, read_exif, sensor_size

if TYPE_CHECKING:
    from PIL.ImageFile import ImageFile

CACHED_IMAGE_BYTES = 128 * 2**20
"""Size of the cache of decoded images: 160 of 1024x768 pixels, 10 of a telephone's."""
CAMERA_BIT_DEPTHS, UNSHIFTED_GREY_LEVEL = (8, 10, 12), 15
"""Bit depths of cameras whose levels some programs store in 16 bits without a shift, and the
highest grey level, of 256, of such an image with 12 bits."""
JPEG_MARKER = re.compile(rb"\xff+[\x01-\xfe]")
"""A marker in a JPEG file's image data; in the data themselves a byte 255 is followed by 0."""
MISSING_LEVEL = 128
"""Grey level to which decoders set missing blocks of a sequential JPEG file."""
MORE_SCAN_DATA = bytes(range(1, 255))
"""Bytes that a JPEG decoder reads as the continuation of an unfinished scan."""
UPRIGHT_TURNS = {3: 2, 6: 1, 8: 3}
"""Number of clockwise quarter turns that make an image upright, by its EXIF orientation."""


def decode(path: Path, image_size: tuple[int, int], label: str) -> Integers:
    """Grey levels (height, width), uint8, of one image file, as the sensor has them.

    image_size : (width, height) in the camera file. An image with the two exchanged was rotated by
        a quarter turn after it was taken, or its camera was calibrated from rotated images. It is
        rotated by its EXIF orientation; without EXIF, landscape images clockwise and portrait
        images anticlockwise, as if from an upright telephone.
    label : name of the file in messages.

    Raises InputError for a file that is absent, truncated, not an image, or of another size.
    """
    try:
        check_regular(path, label)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot be read ({error.strerror})", where=label, code="file.unreadable"
        ) from None
    image = open_image(BytesIO(data), label)
    size = sensor_size(image)  # before decoding, which takes memory for the header's size
    if tuple(image_size) not in (size, size[::-1]):
        raise InputError(
            "the image has another size than its camera",
            where=label,
            found=f"{size[0]}x{size[1]} pixels",
            expected=f"{image_size[0]}x{image_size[1]}, the camera file's image_size",
            next_step="Use the image as the camera gave it, neither scaled nor cropped",
        )
    exif = read_exif(image) if size != tuple(image_size) else None
    grey = _checked_grey(data, image, label)
    if exif is None:
        return grey
    clockwise = {6: True, 8: False}.get(exif.orientation, size[0] > size[1])
    return np.ascontiguousarray(np.rot90(grey, -1 if clockwise else 1))


def narrowed(image: Integers, width: int) -> tuple[Any, float]:
    """Image reduced to a width in px at most, and its scale, 1 for a narrower image."""
    import cv2

    scale = width / image.shape[1]
    if scale >= 1:
        return image, 1.0
    # a strip keeps one row; both scales are equal otherwise
    size = (width, 1) if scale * image.shape[0] < 1 else None
    return cv2.resize(image, size, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale


def upright_turns(path: Path, image_size: tuple[int, int]) -> int:
    """Number of clockwise quarter turns that make the image of :func:`decode` upright, by EXIF.

    0 for an image that was rotated when decoded, and for a file that cannot be read.
    """
    try:
        with path.open("rb") as stream:
            image = open_image(stream, path.name)
            turned = sensor_size(image) != tuple(image_size)
            return 0 if turned else UPRIGHT_TURNS.get(read_exif(image).orientation, 0)
    except (OSError, InputError):
        return 0


def _checked_grey(data: bytes, image: ImageFile, label: str) -> Integers:
    """Grey levels of an opened file. Raises InputError where any of its image data is damaged."""
    kind = image.format
    try:
        if kind == "PNG":
            image.verify()  # checksums of the chunks, which decoding does not check
            image = open_image(BytesIO(data), label)
        sixteen_bits = ";16" in str(image.tile[:1])  # Pillow's raw modes I;16B, RGB;16N, ...
        grey = _grey(image)
        whole = kind != "JPEG" or _scan_is_whole(data, grey, label)
    except IMAGE_ERRORS as error:
        early = "truncated" in str(error).lower()
        fault = "ends early" if early else f"is damaged ({error})"
        raise _undecodable(label, f"a {kind} file that {fault}") from None
    if not whole:
        raise _undecodable(label, "a JPEG file that is damaged (its scan ends early)")
    if sixteen_bits and grey.max() <= UNSHIFTED_GREY_LEVEL:
        raise _too_dark(label, (int(grey.max()) << 8) + 255)
    return grey


def _grey(image: ImageFile) -> Integers:
    """Grey levels (height, width), uint8, of an opened file, as the sensor has them."""
    from PIL import Image

    image.draft("L", None)  # a JPEG file's luminance as it is stored
    image.info.pop("transparency", None)
    if image.mode.startswith("I"):
        levels = np.asarray(image)
        if levels.min() < 0 or levels.max() >= 2**16:
            raise ValueError("levels of more than 16 bits")
        return (levels >> 8).astype(np.uint8)
    if image.mode == "F":
        raise ValueError("levels that are no whole numbers")
    grey = image if image.mode == "L" else image.convert("L")
    turn = {
        3: Image.Transpose.ROTATE_180,
        6: Image.Transpose.ROTATE_90,
        8: Image.Transpose.ROTATE_270,
    }.get(image.info.get("original_orientation", 1))
    return np.asarray(grey if turn is None else grey.transpose(turn))


def _scan_is_whole(data: bytes, grey: Integers, label: str) -> bool:
    """Whether a JPEG file's image data are complete.

    Decoders fill missing data up to the next marker without a report. So bytes are inserted before
    the marker: they are skipped if the data are complete, and change pixels if not.
    """
    stream = BytesIO(data)
    image = open_image(stream, label)  # which stops behind the header of the first scan
    if grey[-1, -1] != MISSING_LEVEL and "progressive" not in image.info:
        return True
    start = stream.tell()
    longer = data[:start] + JPEG_MARKER.sub(lambda mark: MORE_SCAN_DATA + mark[0], data[start:])
    return np.array_equal(_grey(open_image(BytesIO(longer), label)), grey)


def _undecodable(label: str, found: str) -> InputError:
    return InputError(
        "the image cannot be decoded",
        where=label,
        found=found,
        expected="a whole PNG or JPEG file",
        next_step="Copy it again from the camera, or remove it: an absent image is allowed",
        code="image.damaged",
    )


def _too_dark(label: str, highest: int) -> InputError:
    """Error about a 16-bit file whose levels use only its lowest bits, which the conversion to 8
    bits discards.
    """
    bits = next(bits for bits in CAMERA_BIT_DEPTHS if highest < 2**bits)
    return InputError(
        f"the image is nearly black: a 16-bit file whose grey levels fill {bits} bits",
        where=label,
        found=f"levels up to {highest}",
        expected="levels up to 65535, or an 8-bit file",
        next_step=f"If the camera measures {bits} bits, multiply by {2 ** (16 - bits)} when they"
        " are saved, or save 8 bits; if this image alone is dark, remove it",
    )


class LazyPictures(Sequence[Integers], ABC):
    """Images as grey levels (height, width), each made on first use."""

    @abstractmethod
    def image_of(self, number: int) -> Integers:
        """Image with a number."""

    @overload
    def __getitem__(self, index: int) -> Integers: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Integers]: ...
    def __getitem__(self, index: int | slice) -> Integers | Sequence[Integers]:
        """Image with an index, or those of a slice."""
        numbers = range(len(self))[index]
        return self.image_of(numbers) if isinstance(numbers, int) else Selected(self, numbers)


class Selected(LazyPictures):
    """Selection from a sequence of images."""

    def __init__(self, images: Sequence[Integers], numbers: Sequence[int] | Integers) -> None:
        self._images, self._numbers = images, [int(number) for number in numbers]

    def __len__(self) -> int:
        return len(self._numbers)

    def image_of(self, number: int) -> Integers:
        """Image with a number within the selection."""
        return self._images[self._numbers[number]]


class Pictures(LazyPictures):
    """Images of one camera, each decoded on first use.

    paths, labels : of all images.
    cache : decoded images that remain in memory, by number.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        image_size: tuple[int, int],
        labels: Sequence[str],
        cache: dict[int, Integers] | None = None,
    ) -> None:
        self._paths, self._labels, self._size = tuple(paths), tuple(labels), image_size
        self._cache = {} if cache is None else cache

    @classmethod
    def read(
        cls, paths: Sequence[Path], image_size: tuple[int, int], labels: Sequence[str], most: int
    ) -> Pictures:
        """Decode each image once, on a few threads, and cache the first ``most``.

        Raises InputError for the first image that cannot be decoded.
        """
        out = cls(paths, image_size, labels)

        def measure(number: int) -> Integers | None:
            image = out[number]  # faults of the images are raised here, before any work
            return image if number < most else None

        with ThreadPoolExecutor(THREADS) as pool:
            results = list(pool.map(measure, range(len(out))))
        out._cache = {number: image for number, image in enumerate(results) if image is not None}
        return out

    def __len__(self) -> int:
        return len(self._paths)

    def image_of(self, number: int) -> Integers:
        """Image with a number. Raises InputError as :func:`decode`."""
        if number in self._cache:
            return self._cache[number]
        return decode(self._paths[number], self._size, self._labels[number])


def fitting(image_size: tuple[int, int], room: int) -> int:
    """Number of decoded images that fit into ``room`` bytes."""
    return room // (image_size[0] * image_size[1])


def binned(image: Integers, count: int) -> Integers:
    """An image with ``count`` x ``count`` pixels averaged to one; see `Camera.binned`."""
    if count == 1:
        return image
    import cv2

    height, width = (size // count for size in image.shape)
    whole = image[: height * count, : width * count]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
