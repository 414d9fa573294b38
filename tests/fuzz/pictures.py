"""Damaged images: as bytes, by their chunks with right checksums, as other kinds of image."""

from __future__ import annotations

import struct
import zlib
from random import Random

PNG = b"\x89PNG\r\n\x1a\n"


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    out, at = [], 8
    while at + 12 <= len(data):
        n = int.from_bytes(data[at : at + 4])
        out.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + n]))
        at += 12 + n
    return out


def png(parts) -> bytes:
    return PNG + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in parts
    )


def segments(data: bytes) -> list[bytes]:
    """A JPEG file's segments up to the scan, and then all the rest."""
    out, at = [data[:2]], 2
    while data[at : at + 1] == b"\xff" and data[at + 1] != 0xDA:
        n = 2 + int.from_bytes(data[at + 2 : at + 4])
        out.append(data[at : at + n])
        at += n
    return [*out, data[at:]]


def spoil_picture(data: bytes, others: dict[str, bytes], rng: Random) -> tuple[str, bytes]:
    """(kind, bytes); others : whole images of other kinds by name, made beforehand."""
    kinds = [*COMMON, *(PNG_KINDS if data.startswith(PNG) else JPEG_KINDS)]
    kind = rng.choice(kinds)
    at = rng.randrange(len(data))
    if kind == "cut":
        return kind, data[:at]
    if kind == "bits":
        out = bytearray(data)
        for _ in range(rng.choice([1, 1, 3, 20])):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
        return kind, bytes(out)
    if kind == "zeros":
        n = rng.choice([1, 16, 512])
        return kind, data[:at] + b"\0" * n + data[at + n :]
    if kind == "put in":
        return kind, data[:at] + rng.randbytes(rng.choice([1, 4, 300])) + data[at:]
    if kind == "appended":
        return kind, data + rng.choice([b"\0" * 100, data, b"\xff\xd9", rng.randbytes(50)])
    if kind == "something":
        return kind, rng.choice([b"", b"text", b"\0" * 1000, PNG, b"\xff\xd8", b"\xff\xd8\xff\xd9",
                                 b"BM", b"II*\0", b"P5\n9 9\n255\n", b"GIF89a"])  # fmt: skip
    if kind == "another":
        name = rng.choice(sorted(others))
        out = others[name]
        if rng.random() < 0.3:
            how, out = spoil_other(out, rng)
            name += f", {how}"
        return f"{kind}: {name}", out
    spoil = _spoil_png if data.startswith(PNG) else _spoil_jpeg
    return kind, spoil(data, kind, rng)


def spoil_other(data: bytes, rng: Random) -> tuple[str, bytes]:
    """For any kind of file: cut, bits flipped, or numbers of its beginning made large."""
    kind = rng.choice(["cut", "bits", "large"])
    if kind == "cut":
        return kind, data[: rng.randrange(len(data))]
    out = bytearray(data)
    if kind == "bits":
        for _ in range(3):
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    else:
        at = rng.randrange(min(len(out), 60))
        out[at : at + 2] = b"\xff\x7f"
    return kind, bytes(out)


COMMON = ("cut", "bits", "bits", "zeros", "put in", "appended", "something", "another", "another")
PNG_KINDS = (
    "size", "depth", "scan", "scan cut", "scan long", "chunk lost", "chunk twice", "chunks mixed",
    "odd chunk", "bomb",
)  # fmt: skip
JPEG_KINDS = ("size", "depth", "scan", "scan", "segment lost", "segment", "exif", "ends early")
SIZES = (0, 1, 2, 119, 160, 161, 1000, 20_000, 65_535, 2**31 - 1, 2**31, 2**32 - 1)


def _spoil_png(data, kind, rng):
    parts = chunks(data)
    head = bytearray(parts[0][1])
    held = b"".join(body for name, body in parts if name == b"IDAT")
    if kind == "size":
        at = rng.choice([0, 4])
        head[at : at + 4] = struct.pack(">I", rng.choice(SIZES))
        parts[0] = (b"IHDR", bytes(head))
    elif kind == "depth":
        at = rng.choice([8, 9, 10, 11, 12])
        head[at] = rng.choice([0, 1, 2, 3, 4, 6, 8, 16, 255])
        parts[0] = (b"IHDR", bytes(head))
    elif kind == "scan":
        raw = bytearray(zlib.decompress(held))
        for _ in range(20):  # among these are kinds of filter that do not exist
            raw[rng.randrange(len(raw))] = rng.randrange(256)
        raw[0] = rng.choice([0, 5, 255])
        parts = [parts[0], (b"IDAT", zlib.compress(bytes(raw))), parts[-1]]
    elif kind == "scan cut":
        raw = zlib.decompress(held)
        short = zlib.compress(raw[: rng.randrange(len(raw))])
        parts = [parts[0], (b"IDAT", rng.choice([short, held[: len(held) // 2], b""])), parts[-1]]
    elif kind == "scan long":
        raw = zlib.decompress(held) + b"\0" * rng.choice([1, 1000, 10**6])
        parts = [parts[0], (b"IDAT", zlib.compress(raw)), parts[-1]]
    elif kind == "bomb":
        parts.insert(1, (b"zTXt", b"k\0\0" + zlib.compress(b"\0" * 20_000_000)))
    elif kind == "chunk lost":
        del parts[rng.randrange(len(parts))]
    elif kind == "chunk twice":
        at = rng.randrange(len(parts))
        parts.insert(at, parts[at])
    elif kind == "chunks mixed":
        rng.shuffle(parts)
    else:
        parts.insert(rng.randrange(len(parts) + 1), rng.choice(ODD))
    return png(parts)


ODD = (
    (b"gAMA", b"\0\0"), (b"gAMA", b"\0\0\0\0"), (b"iCCP", b"name\0\0garbage"), (b"iCCP", b""),
    (b"tRNS", b"\0\1\2\3\4\5\6\7"), (b"PLTE", b"\1\2\3\4"), (b"PLTE", b""), (b"cHRM", b"\0" * 31),
    (b"sRGB", b"\x09"), (b"zTXt", b"k\0\1x"), (b"iTXt", b"\0\0\0"), (b"tEXt", b"\0" * 100),
    (b"XXXX", b"critical"), (b"xxxx", b"ancillary"), (b"pHYs", b"\0"), (b"tIME", b"\xff" * 7),
    (b"hIST", b"\0\1"), (b"sBIT", b"\xff"), (b"bKGD", b"\0"), (b"acTL", b"\0\0\0\2\0\0\0\0"),
    (b"eXIf", b"II*\0\x08\0\0\0\xff\xff"), (b"IHDR", b"\0" * 13), (b"IEND", b""), (b"IDAT", b""),
    (b"fcTL", b"\0" * 26), (b"cICP", b"\1"), (b"\xff\xff\xff\xff", b""),
)  # fmt: skip


def _spoil_jpeg(data, kind, rng):
    parts = segments(data)
    frame = next(k for k, part in enumerate(parts) if part[:2] in (b"\xff\xc0", b"\xff\xc2"))
    if kind == "size":
        at = rng.choice([5, 7])
        size = struct.pack(">H", rng.choice([0, 1, 119, 160, 161, 1000, 65_535]))
        parts[frame] = parts[frame][:at] + size + parts[frame][at + 2 :]
    elif kind == "depth":
        out = bytearray(parts[frame])
        out[rng.choice([1, 2, 3, 4, 9, 10, 11])] = rng.choice(
            [0, 1, 2, 3, 4, 12, 16, 0xC3, 0xC9, 255]
        )
        parts[frame] = bytes(out)
    elif kind == "scan":
        out = bytearray(parts[-1])
        for _ in range(rng.choice([1, 5, 50])):
            out[rng.randrange(10, len(out))] = rng.choice([0, 0xFF, 0xD0, 0xD9, rng.randrange(256)])
        parts[-1] = bytes(out)
    elif kind == "segment lost":
        del parts[rng.randrange(1, len(parts))]
    elif kind == "segment":
        at = rng.randrange(1, len(parts))
        out = bytearray(parts[at])
        out[rng.randrange(2, len(out))] = rng.randrange(256)
        parts[at] = bytes(out)
    elif kind == "exif":
        entries = b"".join(
            struct.pack(">HHII", rng.choice([0x112, 0x8769, 0xA405, 1]), rng.randrange(14),
                        rng.choice([0, 1, 2**31]), rng.choice([0, 6, 8, 8 << 16, 2**32 - 1]))
            for _ in range(rng.randrange(4))
        )  # fmt: skip
        body = b"Exif\0\0MM\0*" + struct.pack(">IH", rng.choice([8, 0, 4, 2**31]),
                                               rng.choice([1, 3, 65_535])) + entries  # fmt: skip
        parts.insert(1, b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body)
    else:
        cut = parts[-1][: rng.randrange(12, len(parts[-1]))]
        parts[-1] = cut + b"\xff\xd9"
    return b"".join(parts)


def cmyk(grey: bytes) -> bytes:
    """A JPEG file of four components, each with a grey one's image in a scan of its own."""
    parts = segments(grey)
    frame = next(k for k, part in enumerate(parts) if part[:2] == b"\xff\xc0")
    start = parts[frame]
    own = b"".join(bytes([number, 0x11, 0]) for number in (1, 2, 3, 4))
    parts[frame] = b"\xff\xc0" + struct.pack(">H", 20) + start[4:9] + b"\4" + own
    body = parts[-1][10:-2]
    scans = b"".join(
        b"\xff\xda\0\x08\1" + bytes([number]) + b"\0\0\x3f\0" + body for number in (1, 2, 3, 4)
    )
    return b"".join(parts[:-1]) + scans + b"\xff\xd9"


def palette(width: int, height: int) -> bytes:
    """A PNG file of sixteen colours."""
    head = struct.pack(">IIBBBBB", width, height, 4, 3, 0, 0, 0)
    rows = b"".join(b"\0" + bytes((x * 7) % 256 for x in range(width // 2)) for _ in range(height))
    colours = bytes(range(48))
    return png(
        [(b"IHDR", head), (b"PLTE", colours), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    )


def animated(whole: bytes) -> bytes:
    """A PNG file of two images, one after the other."""
    head, *body, end = chunks(whole)
    size = head[1][:8]
    control = [
        (b"fcTL", struct.pack(">I", k) + size + bytes(8) + b"\0\1\0\x0a\0\0") for k in (0, 1)
    ]
    held = b"".join(part for kind, part in body if kind == b"IDAT")
    return png([head, (b"acTL", struct.pack(">II", 2, 0)), control[0], (b"IDAT", held), control[1],
                (b"fdAT", struct.pack(">I", 2) + held), end])  # fmt: skip
