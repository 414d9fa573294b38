"""What a JPEG file's EXIF segment says of how its photograph was taken (CIPA DC-008)."""

from __future__ import annotations

from dataclasses import dataclass

_START = b"Exif\x00\x00"
_ORIENTATION, _SUB_DIRECTORY, _FOCAL_35MM = 0x0112, 0x8769, 0xA405
_SHORT, _LONG = 3, 4


@dataclass(frozen=True)
class Exif:
    """orientation : 1 to 8, as the standard has it, 1 where the file does not say. focal_35mm : mm,
    focal length of the lens that sees as much on a film of 36 x 24 mm; None where the file does not
    say.
    """

    orientation: int = 1
    focal_35mm: float | None = None


def read_exif(data: bytes) -> Exif:
    """Of a JPEG file's bytes, or its beginning; what is absent or spoilt counts as not said."""
    block = _segment(data)
    if block[:2] not in (b"II", b"MM"):
        return Exif()

    def number(at: int, size: int) -> int:
        return int.from_bytes(block[at : at + size], "little" if block[:1] == b"I" else "big")

    def directory(at: int) -> dict[int, int]:
        """Whole numbers by tag."""
        out: dict[int, int] = {}
        for k in range(number(at, 2) if at else 0):
            entry = at + 2 + 12 * k
            if entry + 12 > len(block):
                break
            size = {_SHORT: 2, _LONG: 4}.get(number(entry + 2, 2))
            if size is not None:
                out[number(entry, 2)] = number(entry + 8, size)
        return out

    first = directory(number(4, 4))
    own = directory(first.get(_SUB_DIRECTORY, 0))
    orientation = first.get(_ORIENTATION, 1)
    focal = own.get(_FOCAL_35MM, 0)  # 0 is the standard's word for not known
    return Exif(orientation if 1 <= orientation <= 8 else 1, float(focal) if focal else None)


def with_exif(data: bytes, exif: Exif) -> bytes:
    """A JPEG file's bytes with an EXIF segment, put in first as the standard wants it."""

    def entries(*pairs: tuple[int, int, int]) -> bytes:
        out = len(pairs).to_bytes(2)
        for tag, kind, value in pairs:
            field = value.to_bytes(2) + b"\x00\x00" if kind == _SHORT else value.to_bytes(4)
            out += tag.to_bytes(2) + kind.to_bytes(2) + (1).to_bytes(4) + field
        return out + (0).to_bytes(4)

    after = 8 + 2 + 2 * 12 + 4  # behind the header and two entries
    block = b"MM\x00\x2a" + (8).to_bytes(4)
    block += entries((_ORIENTATION, _SHORT, exif.orientation), (_SUB_DIRECTORY, _LONG, after))
    focal = round(exif.focal_35mm or 0)
    block += entries((_FOCAL_35MM, _SHORT, focal))
    body = _START + block
    return data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2) + body + data[2:]


def _segment(data: bytes) -> bytes:
    """The EXIF segment's content; nothing where there is none."""
    if data[:2] != b"\xff\xd8":
        return b""
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        if data[at + 1] == 0xFF:  # a fill byte
            at += 1
            continue
        length = int.from_bytes(data[at + 2 : at + 4])
        body = data[at + 4 : at + 2 + length]
        if data[at + 1] == 0xE1 and body.startswith(_START):
            return body[len(_START) :]
        at += 2 + length
    return b""
