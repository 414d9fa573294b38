"""Printed pattern of a board: its black cells down to single modules, or its circles, and a PDF
page with them.

The page consists of plain rectangles and circles in true size, which printers reproduce to a tenth
of a millimetre unless "fit to page" is active; rulers of known length beside the board reveal this.
"""

from __future__ import annotations

import re
import textwrap
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.boards.board import Board
from pkmcal.boards.find import dictionary, marker_bits
from pkmcal.errors import InputError
from pkmcal.files import closest, json_text

PDF_POINT = 0.0254 / 72
"""PDF's unit of length, m."""
PAPER_SIZES = {
    "a4": (0.210, 0.297), "letter": (0.2159, 0.2794), "a3": (0.297, 0.420),
    "tabloid": (0.2794, 0.4318), "a2": (0.420, 0.594), "a1": (0.594, 0.841), "a0": (0.841, 1.189),
}  # fmt: skip
"""Width and height in portrait format, m."""

CIRCLE_RADIUS = 1 / 3
"""Radius of printed circles, in units of the grid's spacing."""


@dataclass(frozen=True)
class SheetOptions:
    """Measures of the page around a board, m."""

    # white margin of printers, at every side; a board also needs a white border
    margin: float = 0.008
    # strips at the left and below for axes, rulers and text, the margin included
    left: float = 0.026
    below: float = 0.046
    # distances from the board: of the axes' arrows, of the rulers, of their numbers, of the text
    axes: float = 0.004
    ruler: float = 0.009
    numbers: float = 0.0145
    text: float = 0.0215
    arrow: float = 0.012
    # lengths of rulers; the longest that is not longer than the board is used
    rulers: tuple[float, ...] = (0.2, 0.1, 0.05)
    # sizes of numbers and text, and distance of lines, in points
    number_points: int = 8
    text_points: int = 11
    line_points: int = 13
    # width of a board below which the text begins at the page's margin
    narrow: float = 0.18
    # mean width of a letter, in sizes of the text
    letter: float = 0.5


SHEET = SheetOptions()


@dataclass(frozen=True)
class Print:
    """Printed pattern: cells with edges x (nx + 1,) and y (ny + 1,), m, board frame; dark :
    (ny, nx); circles : (k, 3), x, y and radius of black circles, m.
    """

    x: Array
    y: Array
    dark: Booleans
    circles: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def of(cls, board: Board) -> Print:
        """Pattern of a board: squares, with the modules of the markers inside."""
        data = board.document
        if board.type == "chessboard":
            columns, rows = (n + 1 for n in board.counts)
            i, j = np.mgrid[:rows, :columns]
            edges = [data["square"] * (np.arange(n + 1) - 1.0) for n in (columns, rows)]
            return cls(edges[0], edges[1], (i + j) % 2 == 0)
        if board.type == "circle_grid":
            return _circles(board)
        return _charuco(data) if board.type == "charuco" else _markers(data)

    def dark_at(self, x: Array, y: Array) -> Booleans:
        """Whether points (n,) of the board's plane are black; white outside the pattern."""
        i, j = np.searchsorted(self.y, y) - 1, np.searchsorted(self.x, x) - 1
        inside = (i >= 0) & (j >= 0) & (i < len(self.y) - 1) & (j < len(self.x) - 1)
        dark = self.dark[i * inside, j * inside] & inside
        for circle in self.circles:
            dark |= np.hypot(x - circle[0], y - circle[1]) < circle[2]
        return dark


def _charuco(data: dict[str, Any]) -> Print:
    """Pattern of a ChArUco board."""
    columns, rows = data["squares"]
    square, marker, bits = data["square"], data["marker"], marker_bits(data["dictionary"]) + 2
    margin = (square - marker) / 2
    cells = np.array([0.0, *(margin + marker * np.arange(bits + 1) / bits)])
    parity = int(bool(data.get("legacy")) and rows % 2 == 0)
    dark = np.zeros((rows, bits + 2, columns, bits + 2), dtype=bool)
    number = 0
    for i, j in np.ndindex(rows, columns):
        if (i + j) % 2 == parity:
            dark[i, :, j] = True
        else:
            dark[i, 1:-1, j, 1:-1] = _modules(data["dictionary"], number)
            number += 1
    x, y = (
        np.append((np.arange(n)[:, None] * square + cells).ravel(), n * square)
        for n in (columns, rows)
    )
    return Print(x, y, dark.reshape(rows * (bits + 2), -1))


def _markers(data: dict[str, Any]) -> Print:
    """Pattern of a grid of markers; Kalibr's also has black squares between the markers' corners,
    and around the grid.
    """
    columns, rows = data["markers"]
    border, kalibr = data.get("border", 1), data.get("leftward", False)
    bits = marker_bits(data["dictionary"]) + 2 * border
    cells = data["marker"] * np.arange(bits + 1) / bits
    dark = np.zeros((rows, bits + 1, columns, bits + 1), dtype=bool)
    dark[:, -1, :, -1] = kalibr
    for k, (i, j) in enumerate(np.ndindex(rows, columns)):
        column = columns - 1 - j if kalibr else j
        number = data.get("first_id", 0) + k
        dark[i, :-1, column, :-1] = _modules(data["dictionary"], number, border)
    step = data["marker"] + data["gap"]
    x, y = (
        np.append((np.arange(n)[:, None] * step + cells).ravel(), n * step) for n in (columns, rows)
    )
    cells_dark = dark.reshape(rows * (bits + 1), -1)
    if not kalibr:
        return Print(x, y, cells_dark)
    # The squares before the first row and the first column are those behind the last.
    around = np.pad(cells_dark, ((1, 0), (1, 0)), mode="wrap")
    return Print(np.append(-data["gap"], x), np.append(-data["gap"], y), around)


def _circles(board: Board) -> Print:
    """Pattern of a grid of circles."""
    spacing = board.document["spacing"]
    low, high = board.points[:, :2].min(axis=0) - spacing, board.points[:, :2].max(axis=0) + spacing
    radius = np.full((len(board.points), 1), CIRCLE_RADIUS * spacing)
    circles = np.concatenate([board.points[:, :2], radius], axis=1)
    edges = np.stack([low, high])
    return Print(edges[:, 0], edges[:, 1], np.zeros((1, 1), dtype=bool), circles)


def _modules(name: str, number: int, border: int = 1) -> Booleans:
    """Modules of a marker with its black border of `border` modules, (bits + 2 border,) * 2."""
    import cv2

    bits = marker_bits(name)
    image = cv2.aruco.generateImageMarker(dictionary(name), number, bits + 2)
    return np.pad(np.asarray(image)[1:-1, 1:-1] < 128, border, constant_values=True)


def sheet_pdf(
    board: Board, paper: str | None = None, file: str = "board.yaml", sheet: SheetOptions = SHEET
) -> tuple[bytes, str]:
    """PDF page with the board in true size, its axes, two rulers and a description, and the name
    of the paper.

    paper : one of PAPER_SIZES, by default the smallest ISO size that holds the board.
    file : name of the board's file, for the page.
    Raises InputError if the paper is too small or unknown.
    """
    printed = Print.of(board)
    size = np.array([printed.x[-1] - printed.x[0], printed.y[-1] - printed.y[0]])
    name, page = _paper_for(size, paper, sheet)
    before, after = np.array([sheet.left, sheet.margin]), np.array([sheet.margin, sheet.below])
    corner = before + (page - size - before - after) / 2
    # corner of the board at the lower left, and its origin
    low = np.array([corner[0], corner[1] + size[1]])
    origin = corner - np.array([printed.x[0], printed.y[0]])

    def on_page(x: float, y: float) -> str:
        """Point in PDF coordinates, from m right of and below the page's upper left corner."""
        return f"{x / PDF_POINT:.4f} {(page[1] - y) / PDF_POINT:.4f}"

    def lettering(x: float, y: float, points: int, *lines: str) -> str:
        """Lines of text from a point on."""
        escaped = (re.sub(r"([\\()])", r"\\\1", line) for line in lines)
        rows = " ".join(f"({line}) Tj T*" for line in escaped)
        return f"BT /F {points} Tf {on_page(x, y)} Td {sheet.line_points} TL {rows} ET"

    rectangles = [
        f"{on_page(x0, y1)} {(x1 - x0) / PDF_POINT:.4f} {(y1 - y0) / PDF_POINT:.4f} re"
        for x0, y0, x1, y1 in _rectangles(printed, corner)
    ]
    discs = [
        _disc(corner + circle[:2] - [printed.x[0], printed.y[0]], float(circle[2]), on_page)
        for circle in printed.circles
    ]
    ruler = next((one for one in sheet.rulers if one <= size.min()), sheet.rulers[-1])
    across = np.array([low[0], low[1] + sheet.ruler])
    upward = np.array([low[0] - sheet.ruler, low[1]])
    x_axis, y_axis = (origin[0], low[1] + sheet.axes), (corner[0] - sheet.axes, origin[1])
    lines = [
        *_ruler(across, np.array([ruler, 0.0]), on_page),
        *_ruler(upward, np.array([0.0, -ruler]), on_page),
        *_arrow(np.array(x_axis), np.array([sheet.arrow, 0.0]), on_page),
        *_arrow(np.array(y_axis), np.array([0.0, sheet.arrow]), on_page),
    ]
    letters = [
        lettering(x_axis[0] + 1.15 * sheet.arrow, x_axis[1] + 0.001, sheet.number_points, "x"),
        lettering(y_axis[0] - 0.001, y_axis[1] + 1.4 * sheet.arrow, sheet.number_points, "y"),
    ]
    half = 0.25 * sheet.number_points * PDF_POINT  # of a digit's width and of its height
    for k in range(0, 11, 2):
        at, digits = ruler * k / 10, f"{1e2 * ruler * k:.0f}"
        right = across[0] + at - len(digits) * half
        letters += [
            lettering(right, low[1] + sheet.numbers, sheet.number_points, digits),
            lettering(
                corner[0] - sheet.numbers - 2 * len(digits) * half, upward[1] - at + half,
                sheet.number_points, digits,
            ),
        ]  # fmt: skip
    captions = [
        f"{file}, digest {board_digest(board)}: {_description(board)}.",
        f"Print in actual size (100 %): both rulers are {1e3 * ruler:.0f} mm. The arrows x and y"
        " begin at the board's origin.",
        f"Over all {1e3 * size[0]:.2f} x {1e3 * size[1]:.2f} mm: measure it, correct the file by"
        " it, and fix it to something stiff and flat.",
    ]
    # The text begins at the board's edge, or left of a board that is narrower than a line.
    start = float(corner[0]) if size[0] > sheet.narrow else sheet.margin
    room = int((page[0] - start - sheet.margin) / (sheet.letter * sheet.text_points * PDF_POINT))
    wrapped = [line for one in captions for line in textwrap.wrap(one, room)]
    letters.append(lettering(start, low[1] + sheet.text, sheet.text_points, *wrapped))
    # One path for all rectangles: antialiasing viewers draw seams between separate ones.
    content = "\n".join(["0 g", *rectangles, *discs, "f", "0.4 w", *lines, "S", *letters])
    return _document(page / PDF_POINT, content), name


def board_digest(board: Board) -> str:
    """Short digest of a board's description, by which two prints are distinguished."""
    text = json_text(board.document).encode("utf-8")
    return blake2b(text, digest_size=4).hexdigest()


def _paper_for(size: Array, paper: str | None, sheet: SheetOptions) -> tuple[str, Array]:
    """Name of the paper and its width and height, m, in portrait or landscape format."""
    if paper is not None and paper.lower() not in PAPER_SIZES:
        raise InputError(
            "no such paper",
            where="--paper",
            found=paper,
            expected=closest(paper, PAPER_SIZES) or ", ".join(PAPER_SIZES),
        )
    names = [paper.lower()] if paper else [name for name in PAPER_SIZES if name.startswith("a")]
    border = np.array([sheet.left, sheet.below]) + sheet.margin
    need = size + border
    for name in names:
        short, long = PAPER_SIZES[name]
        for page in (np.array([short, long]), np.array([long, short])):
            if (page >= need).all():
                return name, page
    raise InputError(
        "the board is larger than the paper",
        where="--paper" if paper else None,
        found=f"{1e3 * size[0]:.0f} x {1e3 * size[1]:.0f} mm, and borders of"
        f" {1e3 * border[0]:.0f} and {1e3 * border[1]:.0f} mm",
        expected=f"at most {names[-1]}",
        next_step="Take a larger paper" if paper else "Choose smaller or fewer squares",
    )


def _rectangles(printed: Print, corner: Array) -> Iterator[tuple[float, float, float, float]]:
    """Black rectangles (x0, y0, x1, y1), m: runs of dark cells in a row."""
    x, y = printed.x - printed.x[0] + corner[0], printed.y - printed.y[0] + corner[1]
    edges = np.diff(np.pad(printed.dark, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    starts, stops = np.argwhere(edges > 0), np.argwhere(edges < 0)
    for (row, start), (_, stop) in zip(starts.tolist(), stops.tolist(), strict=True):
        yield x[start], y[row], x[stop], y[row + 1]


def _disc(middle: Array, radius: float, on_page: Any) -> str:
    """Circle of four Bezier curves, to 0.03 % of its radius, as PDF operators."""
    quarter = 4 / 3 * np.tan(np.pi / 8)
    out = [f"{on_page(middle[0] + radius, middle[1])} m"]
    for k in range(4):
        (c, s), (d, e) = np.rint([[np.cos(a), np.sin(a)] for a in np.pi / 2 * np.array([k, k + 1])])
        points = np.array(
            [[c - quarter * s, s + quarter * c], [d + quarter * e, e - quarter * d], [d, e]]
        )
        out.append(" ".join(on_page(*(middle + radius * p)) for p in points) + " c")
    return " ".join([*out, "h"])


def _ruler(start: Array, along: Array, on_page: Any) -> list[str]:
    """Line with ticks at both ends and each tenth, as PDF operators."""
    across = np.array([along[1], -along[0]]) / np.abs(along).max()
    out = [f"{on_page(*start)} m {on_page(*(start + along))} l"]
    for k in range(11):
        at = start + along * k / 10
        tick = (0.003 if k in (0, 10) else 0.0015) * np.abs(across)
        out.append(f"{on_page(*(at - tick))} m {on_page(*(at + tick))} l")
    return out


def _arrow(start: Array, along: Array, on_page: Any) -> list[str]:
    """Arrow with a bar across its start, as PDF operators."""
    across = np.array([along[1], -along[0]])
    end = start + along
    pieces = [
        (start, end),
        (start - 0.12 * across, start + 0.12 * across),
        (end, end - 0.2 * along + 0.1 * across),
        (end, end - 0.2 * along - 0.1 * across),
    ]
    return [f"{on_page(*a)} m {on_page(*b)} l" for a, b in pieces]


def _description(board: Board) -> str:
    """Description of the board for the printed page."""
    data = board.document
    lengths = [
        f"{key} {1e3 * data[key]:.6g} mm"
        for key in ("square", "marker", "gap", "spacing")
        if key in data
    ]
    lettering = [data["dictionary"]] if "dictionary" in data else []
    return f"{board.described}, {', '.join(lengths + lettering)}"


def _document(size: Array, content: str) -> bytes:
    """PDF 1.7 file (ISO 32000-1, 7.5) of one page of `size` points, with print scaling off."""
    stream = zlib.compress(content.encode("latin-1", "replace"))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size[0]:.4f} {size[1]:.4f}]"
        " /Resources << /Font << /F 4 0 R >> >> /Contents 5 0 R >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        f"<< /Length {len(stream)} /Filter /FlateDecode >>\nstream\n".encode()
        + stream
        + b"\nendstream",
        b"<< /Producer (pkmcal) >>",
    ]
    out, places = b"%PDF-1.7\n", list[int]()
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    count = len(objects) + 1
    return (
        out
        + (
            f"xref\n0 {count}\n0000000000 65535 f \n{table}"
            f"trailer\n<< /Size {count} /Root 1 0 R /Info {count - 1} 0 R >>\n"
            f"startxref\n{len(out)}\n%%EOF\n"
        ).encode()
    )
