"""Sizes of photographs, read from the headers of PNG (RFC 2083), JPEG (ITU T.81), TIFF (revision
6.0), BMP and PGM files.
"""

from __future__ import annotations

import zlib
from typing import BinaryIO, Literal

IMAGE_FILE_ENDINGS = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"})
"""Of these files' names, in lower case."""
_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START = b"\xff\xd8"
# Start-of-frame markers: FFC0 to FFCF without tables (C4), arithmetic tables (CC), JPG (C8).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers that carry no length: TEM, restarts, start and end of image.
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xDA)})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""By PNG's kinds of colour."""
_TIFF_STARTS: dict[bytes, Literal["little", "big"]] = {b"II*\0": "little", b"MM\0*": "big"}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_SHORT = 256, 257, 3
_PNM_STARTS = (b"P2", b"P3", b"P5", b"P6")
_MOST_PNM_DIGITS = 9
_LONGEST_PNM = 1000
"""Bytes in which a PGM file's size stands, remarks before it included."""
MOST_DEFLATE_EXPANSION = 1032
"""Bytes that one byte of PNG's compression can stand for at most (RFC 1951: 258 in two bits); those
of TIFF reach less."""
JPEG_BLOCK = 64
"""Pixels of a block, for which a JPEG file has one bit at least."""
BMP_RUN = 255
"""Pixels of one run in a BMP file, which has two bytes."""

_Stated = tuple[int, int, float]
"""Width, height, and pixels that one byte of such a file can stand for at most."""


def stated_size(stream: BinaryIO) -> tuple[int, int]:
    """(width, height) in pixels as a photograph's header has it.

    (0, 0) where the file is of no format that is known here, its header is spoilt, or it states
    more than a file of this length can hold: memory is taken by what the header says.
    """
    start = stream.read(_LONGEST_PNM)
    length = stream.seek(0, 2)
    if start.startswith(_PNG_START):
        width, height, most = _png(start)
    elif start.startswith(_JPEG_START):
        width, height, most = _jpeg(stream)
    elif start.startswith(b"BM"):
        width, height, most = _bmp(start)
    elif start[:4] in _TIFF_STARTS:
        width, height, most = _tiff(stream, _TIFF_STARTS[start[:4]])
    elif start[:2] in _PNM_STARTS:
        width, height, most = _pnm(start)
    else:
        return 0, 0
    return (width, height) if 0 < width * height <= most * length else (0, 0)


def _png(start: bytes) -> _Stated:
    header, check = start[12:29], start[29:33]
    if not header.startswith(b"IHDR") or zlib.crc32(header) != int.from_bytes(check):
        return 0, 0, 0.0
    bits = header[12] * _PNG_CHANNELS.get(header[13], 1)
    return *_pair(header[4:8], header[8:12]), 8 * MOST_DEFLATE_EXPANSION / max(bits, 1)


def _jpeg(stream: BinaryIO) -> _Stated:
    """Walk the segments to the start of frame."""
    stream.seek(2)
    while stream.read(1) == b"\xff":
        while (marker := stream.read(1)) == b"\xff":
            pass  # fill bytes
        if not marker or marker[0] in _JPEG_BARE:
            continue
        length = int.from_bytes(stream.read(2))
        if marker[0] in _JPEG_FRAMES:
            frame = stream.read(5)
            return *_pair(frame[3:5], frame[1:3]), 8.0 * JPEG_BLOCK
        stream.seek(max(length - 2, 0), 1)
    return 0, 0, 0.0


def _pnm(start: bytes) -> _Stated:
    """The first two words behind the format's, remarks left out: # to the end of its line."""
    plain = b" ".join(line.partition(b"#")[0] for line in start[2:].splitlines())
    words = plain.split()[:3]  # behind the second one a third begins, or it may be cut short
    whole = len(words) == 3 and start[2:3].isspace()
    if not whole or not all(w.isdigit() and len(w) <= _MOST_PNM_DIGITS for w in words[:2]):
        return 0, 0, 0.0
    return int(words[0]), int(words[1]), 1.0


def _bmp(start: bytes) -> _Stated:
    def number(at: int, size: int) -> int:
        # rows that run downwards are told by a negative height
        return abs(int.from_bytes(start[at : at + size], "little", signed=size == 4))

    if number(14, 4) == 12:  # the header of OS/2
        return number(18, 2), number(20, 2), 8.0
    return number(18, 4), number(22, 4), BMP_RUN / 2 if number(30, 4) else 8.0


def _tiff(stream: BinaryIO, order: Literal["little", "big"]) -> _Stated:
    """Of the first picture, from its directory."""

    def number(data: bytes) -> int:
        return int.from_bytes(data, order)

    stream.seek(4)
    stream.seek(number(stream.read(4)))
    results: dict[int, int] = {}
    for _ in range(number(stream.read(2))):
        entry = stream.read(12)
        if len(entry) < 12:
            break
        size = 2 if number(entry[2:4]) == _TIFF_SHORT else 4
        results[number(entry[:2])] = number(entry[8 : 8 + size])
    return results.get(_TIFF_WIDTH, 0), results.get(_TIFF_HEIGHT, 0), 8.0 * MOST_DEFLATE_EXPANSION


def _pair(width: bytes, height: bytes) -> tuple[int, int]:
    return int.from_bytes(width), int.from_bytes(height)
