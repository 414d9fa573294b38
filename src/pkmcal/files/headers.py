"""Sizes of photographs, read from the headers of PNG (RFC 2083) and JPEG (ITU T.81) files."""

from __future__ import annotations

import zlib
from typing import BinaryIO

_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START = b"\xff\xd8"
# Start-of-frame markers: FFC0 to FFCF without tables (C4), arithmetic tables (CC), JPG (C8).
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Markers that carry no length: TEM, restarts, start and end of image.
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xDA)})
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""By PNG's kinds of colour."""
DEFLATED = 1032
"""Bytes that one byte of PNG's compression can stand for at most (RFC 1951: 258 in two bits)."""
JPEG_BLOCK = 64
"""Pixels of a block, for which a JPEG file has one bit at least."""


def stated_size(stream: BinaryIO) -> tuple[int, int] | None:
    """(width, height) in pixels as a PNG or JPEG file's header has it, None for another format.

    (0, 0) where the header is spoilt, or states more than a file of this length can hold: memory is
    taken by what the header says.
    """
    start = stream.read(33)
    if not start:
        return 0, 0
    length = stream.seek(0, 2)
    if start.startswith(_PNG_START):
        header, check = start[12:29], start[29:33]
        if not header.startswith(b"IHDR") or zlib.crc32(header) != int.from_bytes(check):
            return 0, 0
        size = _pair(header[4:8], header[8:12])
        bits = header[12] * _PNG_CHANNELS.get(header[13], 1)
        held = size[0] * size[1] * bits <= 8 * DEFLATED * length
    elif start.startswith(_JPEG_START):
        stream.seek(2)
        size = _jpeg_size(stream)
        held = size[0] * size[1] <= 8 * JPEG_BLOCK * length
    else:
        return None
    return size if held else (0, 0)


def _jpeg_size(stream: BinaryIO) -> tuple[int, int]:
    """Walk the segments to the start of frame; (0, 0) where there is none."""
    while byte := stream.read(1):
        if byte != b"\xff":
            return 0, 0
        while (marker := stream.read(1)) == b"\xff":
            pass  # fill bytes
        if not marker or marker[0] in _JPEG_BARE:
            continue
        length = int.from_bytes(stream.read(2))
        if marker[0] in _JPEG_FRAMES:
            frame = stream.read(5)
            return _pair(frame[3:5], frame[1:3])
        stream.seek(max(length - 2, 0), 1)
    return 0, 0


def _pair(width: bytes, height: bytes) -> tuple[int, int]:
    return int.from_bytes(width), int.from_bytes(height)
