"""Image files opened by Pillow: their size, their EXIF, and what Pillow raises for broken ones.

The classes of Pillow's formats are called directly, not `PIL.Image.open`: that one warns above 89
megapixels and refuses 179 by a limit of the whole process, and `MOST_PIXELS` is ours.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from math import inf
from typing import TYPE_CHECKING, BinaryIO

from pkmcal.errors import InputError
from pkmcal.files.limits import MOST_PIXELS, check_count
from pkmcal.files.recordings import recording_error
from pkmcal.wording import install_step

if TYPE_CHECKING:
    from PIL.Image import Exif as Entries
    from PIL.ImageFile import ImageFile

IMAGE_FILE_ENDINGS = frozenset(
    {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".heic", ".heif"}
)
"""Endings of image files' names, in lower case."""
IMAGE_ERRORS = (
    OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError,
    EOFError, RuntimeError, struct.error, zlib.error, Warning,
)  # fmt: skip
"""Exceptions that Pillow raises for broken files; warnings, where they are errors."""
MOST_PIXELS_PER_BYTE = 8 * 1032
"""Pixels that one byte of a file stands for at most: 1 bit each, behind PNG's compression (RFC
1951: 258 bytes in two bits). Other formats reach less."""
_HEAD_BYTES = 1000
"""Bytes in which the size of a PNM file stands, comments before it included."""
_PNG_SIGNATURE_BYTES, _PNG_CHECKSUM_BYTES = 8, 4
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
_ORIENTATION, _EXIF_DIRECTORY, _FOCAL_35MM = 0x0112, 0x8769, 0xA405
_FOCAL_LENGTH, _PIXEL_DIMENSIONS = 0x920A, (0xA002, 0xA003)
_FOCAL_PLANE_RESOLUTION, _FOCAL_PLANE_UNIT = 0xA20E, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Millimetres of FocalPlaneResolutionUnit: inch, centimetre; millimetre and micrometre as some
makers write them."""
_TRANSPOSING_ORIENTATIONS = range(5, 9)


@dataclass(frozen=True)
class Exif:
    """Settings of an image's capture (CIPA DC-008).

    orientation : 1 to 8, as in the standard; 1 where the file has none.
    focal_35mm : focal length (mm) of the lens with the same field of view on film of 36 x 24 mm;
        None where unknown.
    focal_mm : focal length of the lens (FocalLength), mm. pixels_per_mm : of the sensor
        (FocalPlaneXResolution), for images of ``recorded_size``. recorded_size : (width, height)
        of the image when it was captured (PixelXDimension, PixelYDimension), px. None where
        unknown.
    """

    orientation: int = 1
    focal_35mm: float | None = None
    focal_mm: float | None = None
    pixels_per_mm: float | None = None
    recorded_size: tuple[int, int] | None = None


def open_image(stream: BinaryIO, label: str) -> ImageFile:
    """Open an image file (PNG, JPEG, BMP, TIFF, PNM, HEIF) and read its header, no pixels.

    label : the file's name in messages. Raises InputError for a file of another format, a broken
    header, more pixels than MOST_PIXELS or than the file's bytes can stand for (memory is taken
    by the header's size), and for HEIF without the extra.
    """
    head = stream.read(_HEAD_BYTES)
    length = stream.seek(0, 2)
    stream.seek(0)
    if not _is_heif(head) and (error := recording_error(head, label, "a PNG or JPEG file")):
        raise error
    try:
        image_class = _image_class(head, label)
        if head.startswith(b"P"):  # Pillow reads a comment byte by byte, however long it is
            image_class(BytesIO(head))
        image = image_class(stream)
    except IMAGE_ERRORS:
        raise _unreadable(length, label) from None
    width, height = image.size
    if not 0 < width * height <= MOST_PIXELS_PER_BYTE * length:
        raise _unreadable(length, label)
    check_count(width * height, MOST_PIXELS, "pixels", label)
    return image


def _image_class(head: bytes, label: str) -> Callable[[BinaryIO], ImageFile]:
    """Pillow's class for a file that begins with these bytes; imports of a format take 20 ms."""
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        from PIL.PngImagePlugin import PngImageFile as ImageClass
    elif head.startswith(b"\xff\xd8"):
        from PIL.JpegImagePlugin import JpegImageFile as ImageClass
    elif head.startswith(b"BM"):
        from PIL.BmpImagePlugin import BmpImageFile as ImageClass
    elif head.startswith((b"II*\0", b"MM\0*")):
        from PIL.TiffImagePlugin import TiffImageFile as ImageClass
    elif head.startswith((b"P2", b"P3", b"P5", b"P6")):
        from PIL.PpmImagePlugin import PpmImageFile as ImageClass
    elif _is_heif(head):
        try:
            ImageClass = import_module("pillow_heif").HeifImageFile  # an extra
        except ImportError:
            raise InputError(
                "HEIF images need the package pillow-heif, which is not installed",
                where=label,
                expected="a PNG or JPEG file",
                next_step=f"{install_step('heic')}; or set the camera to JPEG ('most compatible'),"
                " or convert the images to JPEG, keeping their EXIF",
                code="package.missing",
            ) from None
    else:
        raise ValueError("a format that is not read")
    return ImageClass


def _is_heif(head: bytes) -> bool:
    """Whether a file that begins with these bytes is a HEIF image (HEIC of telephones)."""
    return head[4:8] == b"ftyp" and head[8:12] in _HEIF_BRANDS


def _unreadable(length: int, label: str) -> InputError:
    return InputError(
        "the file is not an image that can be read" if length else "the image file is empty",
        where=label,
        expected="a PNG or JPEG file",
        next_step="Copy it from the camera again, or remove it",
        code="image.unreadable" if length else "image.empty",
    )


def sensor_size(image: ImageFile) -> tuple[int, int]:
    """(width, height) in pixels as the sensor has them, before EXIF's orientation.

    Decoders of HEIF apply the orientation, those of other formats do not.
    """
    turned = image.info.get("original_orientation") in _TRANSPOSING_ORIENTATIONS
    return image.size[::-1] if turned else image.size


def read_exif(image: ImageFile) -> Exif:
    """EXIF of an opened image, whose pixels are not decoded; entries that are absent or broken have
    their defaults.
    """
    try:
        exif = _png_exif(image) if image.format == "PNG" else image.getexif()
        orientation = image.info.get("original_orientation") or exif.get(_ORIENTATION, 1)
        capture = exif.get_ifd(_EXIF_DIRECTORY)
    except IMAGE_ERRORS:
        return Exif()
    density = _positive(capture.get(_FOCAL_PLANE_RESOLUTION))
    unit_mm = _UNIT_MM.get(int(_positive(capture.get(_FOCAL_PLANE_UNIT, 2)) or 0))
    width, height = (_positive(capture.get(tag)) for tag in _PIXEL_DIMENSIONS)
    return Exif(
        orientation=orientation if orientation in range(1, 9) else 1,
        focal_35mm=_positive(capture.get(_FOCAL_35MM)),
        focal_mm=_positive(capture.get(_FOCAL_LENGTH)),
        pixels_per_mm=density / unit_mm if density and unit_mm else None,
        recorded_size=(round(width), round(height)) if width and height else None,
    )


def _positive(value: object) -> float | None:
    """Positive finite number of an EXIF entry; None for others, since 0 is the standard's value
    for unknown.
    """
    try:
        number = float(value)  # pyrefly: ignore  # any type may stand in a file
    except IMAGE_ERRORS:
        return None
    return number if 0 < number < inf else None


def _png_exif(image: ImageFile) -> Entries:
    """EXIF entries of a PNG file, from its chunks.

    The entries may stand behind the pixels, all of which Pillow's own method decodes to look there.
    """
    from PIL.Image import Image

    stream = image.fp
    if stream is not None and "exif" not in image.info:
        start = stream.tell()
        stream.seek(_PNG_SIGNATURE_BYTES)
        while len(head := stream.read(8)) == 8 and head[4:] != b"IEND":
            length = int.from_bytes(head[:4], "big")
            if head[4:] == b"eXIf":
                image.info["exif"] = stream.read(length)
                break
            stream.seek(length + _PNG_CHECKSUM_BYTES, 1)
        stream.seek(start)
    return Image.getexif(image)


def with_exif(data: bytes, exif: Exif) -> bytes:
    """A JPEG file's bytes with an EXIF segment before all others, as the standard requires."""
    from PIL.Image import Exif as Entries

    entries = Entries()
    entries[_ORIENTATION] = exif.orientation
    entries.get_ifd(_EXIF_DIRECTORY)[_FOCAL_35MM] = round(exif.focal_35mm or 0)
    body = entries.tobytes()
    return data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2) + body + data[2:]
