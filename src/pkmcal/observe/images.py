"""Photographs from disk to grey-level arrays; files that are not what they should be are named.

Six thousand photographs do not fit into memory, and an ordinary session's should not be decoded at
every look: so the first that fit into CACHED_IMAGE_BYTES bytes are kept, and the others decoded
when they are looked at and forgotten again. What looks at many does so in windows
(`pkmcal.observe.image_batches`).
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, overload

import numpy as np

from pkmcal.arrays import THREADS, Integers
from pkmcal.errors import InputError
from pkmcal.files import MOST_PIXELS, check_count, check_regular, read_exif, stated_size
from pkmcal.observe.codec_stderr import decoded_and_fault

CACHED_IMAGE_BYTES = 128 * 2**20
"""Bytes of decoded photographs that are kept: 160 of 1024x768, 10 of a telephone's."""
PNG_START = 8
"""Bytes before a PNG file's first chunk: length, kind, body and checksum of kind and body."""
CAMERA_BIT_DEPTHS, UNSHIFTED_GREY_LEVEL = (8, 10, 12), 15
"""Bits that cameras measure and programs put into 16 without shifting them up, and the highest of
256 grey levels that is left of them then."""
JPEG_END = b"\xff\xd9"


def decode(path: Path, image_size: tuple[int, int], label: str) -> Integers:
    """One photograph as grey levels (height, width), uint8.

    image_size : (width, height) that the camera file states. A photograph with the two exchanged
    was turned by a quarter after it was taken, or its camera was calibrated from turned ones: it is
    turned as EXIF asks viewers to, and where EXIF says nothing, as telephones that are held upright
    are: landscape clockwise, portrait the other way.
    Raises InputError for a file that is absent, cut short, no image, or of another size.
    """
    import cv2

    try:
        check_regular(path, label)
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=label) from None
    if data[:4] == b"\x89PNG":
        _check_png(data, label)
    if data[:2] == b"\xff\xd8" and not _jpeg_reaches_its_end(data):
        raise _broken(label, "a JPEG file that ends early")
    # before decoding, which takes the memory that the header asks for
    size = stated_size(BytesIO(data))
    if min(size) == 0:
        raise _broken(label, "no readable image")
    check_count(size[0] * size[1], MOST_PIXELS, "pixels", label)
    if tuple(image_size) not in (size, size[::-1]):
        raise _other_size(label, size, image_size)
    # a turned picture would no longer be its camera's: flags that ask for turning are ignored where
    # the size is the camera's
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image: Any = None
    fault = ""
    with suppress(cv2.error):  # a size beyond what OpenCV takes on: a spoilt header
        image, fault = decoded_and_fault(lambda: cv2.imdecode(np.frombuffer(data, np.uint8), flags))
    if fault:
        kind = "PNG" if data[:4] == b"\x89PNG" else "JPEG"
        raise _broken(label, f"a {kind} file that is damaged ({fault})")
    if image is None:
        raise _broken(label, "no readable image")
    if image.max() <= UNSHIFTED_GREY_LEVEL:
        _check_depth(data, label)
    if image.shape == tuple(image_size) and image_size[0] != image_size[1]:
        clockwise = {6: True, 8: False}.get(read_exif(data).orientation)
        if clockwise is None:
            clockwise = image.shape[1] > image.shape[0]
        direction = cv2.ROTATE_90_CLOCKWISE if clockwise else cv2.ROTATE_90_COUNTERCLOCKWISE
        return np.ascontiguousarray(cv2.rotate(image, direction), np.uint8)
    if (image.shape[1], image.shape[0]) != tuple(image_size):
        raise _other_size(label, (image.shape[1], image.shape[0]), image_size)
    return image.astype(np.uint8, copy=False)  # as it was decoded


def _check_depth(data: bytes, label: str) -> None:
    """Raise `InputError` for a 16-bit file whose levels fill its lowest bits alone: of the 8 bits
    that all else works on, next to nothing is left.
    """
    import cv2

    raw: Any = cv2.imdecode(
        np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE
    )
    if raw.dtype != np.uint16:
        return
    highest = int(raw.max())
    bits = next(bits for bits in CAMERA_BIT_DEPTHS if highest < 2**bits)
    raise InputError(
        f"the photograph is nearly black: a 16-bit file whose grey levels fill {bits} bits",
        where=label,
        found=f"levels up to {highest}",
        expected="levels up to 65535, or an 8-bit file",
        next_step=f"If the camera measures {bits} bits, multiply by {2 ** (16 - bits)} when they"
        " are saved, or save 8 bits; if this photograph alone is dark, remove it",
    )


def _check_png(data: bytes, label: str) -> None:
    """Raise `InputError` where a PNG file is cut short, or a byte of it is not what it was."""
    at, whole = PNG_START, memoryview(data)
    while (end := at + 12 + int.from_bytes(data[at : at + 4])) <= len(data):
        if zlib.crc32(whole[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            raise _broken(label, "a PNG file that is damaged")
        if data[at + 4 : at + 8] == b"IEND":
            return
        at = end
    raise _broken(label, "a PNG file that ends early")


def _other_size(label: str, value: tuple[int, int], image_size: tuple[int, int]) -> InputError:
    return InputError(
        "the photograph has another size than its camera",
        where=label,
        found=f"{value[0]}x{value[1]} pixels",
        expected=f"{image_size[0]}x{image_size[1]}, the camera file's image_size",
        next_step="Use the photograph as the camera gave it, neither scaled nor cropped",
    )


def _jpeg_reaches_its_end(data: bytes) -> bool:
    """Whether the end mark follows the picture's data: cameras put a preview, which has one too,
    before it, and phones append what they like behind.
    """
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:  # segments up to the start of the scan
        if data[at + 1] == 0xDA:
            return JPEG_END in data[at:]
        at += 1 if data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4])
    return at + 4 <= len(data)  # no JPEG as we know it: the decoder judges


def _broken(label: str, text: str) -> InputError:
    return InputError(
        "the photograph cannot be decoded",
        where=label,
        found=text,
        expected="a whole PNG or JPEG file",
        next_step="Copy it again from the camera, or remove it: an absent photograph is allowed",
    )


class LazyPictures(Sequence[Integers], ABC):
    """Photographs as grey levels (height, width), none of which is looked at before it is asked
    for.
    """

    @abstractmethod
    def image_of(self, number: int) -> Integers:
        """One of them."""

    @overload
    def __getitem__(self, index: int) -> Integers: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Integers]: ...
    def __getitem__(self, index: int | slice) -> Integers | Sequence[Integers]:
        """One photograph; of a slice, those that it picks."""
        numbers = range(len(self))[index]
        return self.image_of(numbers) if isinstance(numbers, int) else Selected(self, numbers)


class Selected(LazyPictures):
    """Some of a sequence of photographs."""

    def __init__(self, images: Sequence[Integers], numbers: Sequence[int] | Integers) -> None:
        self._images, self._numbers = images, [int(number) for number in numbers]

    def __len__(self) -> int:
        return len(self._numbers)

    def image_of(self, number: int) -> Integers:
        """One of them."""
        return self._images[self._numbers[number]]


class Pictures(LazyPictures):
    """Photographs of one camera, each decoded when it is looked at.

    paths, labels : of all of them. cache : those that stay decoded, by their number.
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
        """The photographs, each decoded once, of which the first ``most`` stay so; decoding runs
        beside Python on a few threads. Raises InputError for the first that cannot be decoded.
        """
        out = cls(paths, image_size, labels)

        def measure(number: int) -> Integers | None:
            image = out[number]  # a fault is told here, before any work
            return image if number < most else None

        with ThreadPoolExecutor(THREADS) as pool:
            results = list(pool.map(measure, range(len(out))))
        out._cache = {number: image for number, image in enumerate(results) if image is not None}
        return out

    def __len__(self) -> int:
        return len(self._paths)

    def image_of(self, number: int) -> Integers:
        """One of them. Raises InputError as :func:`decode`."""
        if number in self._cache:
            return self._cache[number]
        return decode(self._paths[number], self._size, self._labels[number])


def fitting(image_size: tuple[int, int], room: int) -> int:
    """How many decoded photographs fit into so many bytes."""
    return room // (image_size[0] * image_size[1])


def binned(image: Integers, count: int) -> Integers:
    """A photograph with ``count`` x ``count`` pixels averaged to one; see `Camera.binned`."""
    if count == 1:
        return image
    import cv2

    height, width = (size // count for size in image.shape)
    whole = image[: height * count, : width * count]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
