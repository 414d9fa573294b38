"""Calibration boards: their description and their corners in an image.

Board frame: x along the first count, y along the second, z into the board, as in OpenCV; m. A
corner's id is its row in :attr:`Board.points`, row by row. ChArUco: inner corners, with the origin
at the outer corner of the first square. Chessboard: inner corners, with the origin at the first
one. Grid of markers: four corners per marker, clockwise as printed, with the origin at the outer
corner of the marker at the upper left. Grid of circles: their centres, with the origin at the
first one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from pkmcal.arrays import Array, Integers
from pkmcal.boards.kalibr import board_fields, is_kalibr_target
from pkmcal.errors import InputError
from pkmcal.files import (
    Document,
    FieldError,
    Metres,
    Schema,
    Share,
    closest,
    quoted,
    read_yaml,
    validated_document,
)

Count = Annotated[int, Field(ge=3, le=100)]
Counts = tuple[Count, Count]
BoardSizeTolerance = Annotated[
    Share, Field(ge=0, le=0.05, description="standard deviation of the board's size, relative")
]
PRINTED_SIZE_TOLERANCE = 1e-3
"""Default prior sigma of a printed board's size, relative. Paper expands by as much with humidity,
and printers' feeds differ by more. A board's own is the key ``tolerance`` of its file, which
``Boards.tolerance`` and :class:`~pkmcal.measurements.Mount` hand on to the unknown ``board.size``
(:func:`pkmcal.measurements.effects.board_sizes`)."""
LONGEST_SQUARE_SIDE = 5.0
"""Longest side of a square or marker, m; a larger value was written in millimetres."""


def _metres(length: float) -> float:
    """Length if plausible in metres; raises FieldError beyond LONGEST_SQUARE_SIDE."""
    if length > LONGEST_SQUARE_SIDE:
        raise FieldError(
            "this looks like millimetres",
            found=f"{length:g}",
            expected=f"{length * 1e-3:g}, or {length:g} mm",
        )
    return length


Length = Annotated[Metres, Field(gt=0), AfterValidator(_metres)]


class _Dictionary(Schema):
    """Field of boards with markers."""

    dictionary: str = Field(description="a dictionary's name in OpenCV, such as DICT_5X5_100")

    @field_validator("dictionary")
    @classmethod
    def _check_dictionary(cls, name: str) -> str:
        if name in dictionaries():
            return name
        raise FieldError(
            "OpenCV has no such dictionary of markers",
            found=quoted(name),
            expected=closest(name, dictionaries()) or "a name such as DICT_4X4_50",
        )


class CharucoSchema(_Dictionary):
    """ChArUco board, ``type: charuco``; ``legacy: true`` is OpenCV's pattern before 4.6 with even
    rows.
    """

    type: Literal["charuco"]
    squares: Counts = Field(description="[columns, rows] of squares, for example [9, 7]")
    square: Length = Field(description="the length of a square's side in metres")
    marker: Length = Field(description="the length of a marker's side in metres")
    legacy: bool = False
    tolerance: BoardSizeTolerance = PRINTED_SIZE_TOLERANCE

    @field_validator("marker")
    @classmethod
    def _fits(cls, length: float, info: ValidationInfo) -> float:
        square = info.data.get("square")
        if square is not None and length >= square:
            raise FieldError(
                "a marker does not fit into its square",
                found=f"{length:g} m",
                expected=f"less than the square's {square:g} m",
            )
        return length


class ChessboardSchema(Schema):
    """Chessboard, ``type: chessboard``, with either ``corners`` (inner ones) or ``squares``."""

    type: Literal["chessboard"]
    corners: Counts | None = None
    squares: Counts | None = Field(default=None, validate_default=True)
    square: Length = Field(description="the length of a square's side in metres")
    tolerance: BoardSizeTolerance = PRINTED_SIZE_TOLERANCE

    @field_validator("squares")
    @classmethod
    def _one_of_two(cls, squares: Counts | None, info: ValidationInfo) -> Counts | None:
        corners = info.data.get("corners")
        if (corners is None) == (squares is None):
            raise FieldError(
                "a chessboard needs its corners or its squares",
                found="neither corners nor squares" if squares is None else "corners and squares",
                expected="either corners, the inner ones, such as [7, 6], or squares, one more each"
                " way",
            )
        return squares


class GridSchema(_Dictionary):
    """Grid of ArUco or AprilTag markers, ``type: aruco_grid``; the first one has ``first_id``."""

    type: Literal["aruco_grid"]
    markers: tuple[Annotated[int, Field(ge=1, le=100)], Annotated[int, Field(ge=1, le=100)]] = (
        Field(description="[columns, rows] of markers, for example [6, 5]")
    )
    marker: Length = Field(description="the length of a marker's side in metres")
    gap: Length = Field(description="the distance between two markers in metres")
    first_id: Annotated[int, Field(ge=0)] = 0
    border: Annotated[
        int, Field(ge=1, le=2, description="modules of a marker's black border, 2 in Kalibr's")
    ] = 1
    leftward: Annotated[
        bool, Field(description="ids go on from right to left, as in Kalibr's grids")
    ] = False
    tolerance: BoardSizeTolerance = PRINTED_SIZE_TOLERANCE


class CircleGridSchema(Schema):
    """Grid of circles, ``type: circle_grid``, as OpenCV has it: symmetric, or asymmetric with every
    second row shifted by half the distance between circles of a row.
    """

    type: Literal["circle_grid"]
    circles: Counts = Field(description="[columns, rows] of circles; asymmetric, such as [4, 11]")
    spacing: Length = Field(
        description="the distance between the centres of neighbouring rows in metres, and of"
        " columns; in a row of an asymmetric grid, centres are twice as far apart"
    )
    asymmetric: bool = False
    tolerance: BoardSizeTolerance = PRINTED_SIZE_TOLERANCE


BOARD_SCHEMAS: dict[str, type[Schema]] = {
    "charuco": CharucoSchema, "chessboard": ChessboardSchema, "aruco_grid": GridSchema,
    "circle_grid": CircleGridSchema,
}  # fmt: skip
"""Schemas of board files by ``type``."""


@dataclass(frozen=True)
class Board:
    """Calibration board.

    type : charuco, chessboard, aruco_grid or circle_grid.
    counts : columns and rows of inner corners, of markers or of circles.
    points : (N, 3) corners, or circles' centres, in the board frame by id, m.
    lines : ids of corners on one straight line, at least three each.
    document : fields of board.yaml.
    """

    type: str
    counts: tuple[int, int]
    points: Array
    lines: tuple[tuple[int, ...], ...]
    document: dict[str, Any]

    @property
    def tolerance(self) -> float:
        """Prior sigma of the board's size, relative; it scales all squares equally."""
        return self.document.get("tolerance", PRINTED_SIZE_TOLERANCE)

    @property
    def described(self) -> str:
        """Description of the board for messages."""
        columns, rows = self.counts
        if self.type == "aruco_grid":
            return f"a grid of {columns}x{rows} markers"
        if self.type == "charuco":
            return f"a ChArUco board of {columns + 1}x{rows + 1} squares"
        if self.type == "circle_grid":
            kind = "an asymmetric" if self.document["asymmetric"] else "a symmetric"
            return f"{kind} grid of {columns}x{rows} circles"
        return f"a chessboard of {columns}x{rows} inner corners"

    @property
    def turnable(self) -> bool:
        """Whether the board looks the same rotated by 180 degrees."""
        if self.type == "circle_grid":
            return not self.document["asymmetric"] or self.counts[1] % 2 == 0
        return self.type == "chessboard" and sum(self.counts) % 2 == 0


@dataclass(frozen=True)
class Detection:
    """Board corners detected in one image.

    ids : (n,) corners detected.
    pixels : (n, 2).
    sigma : (n,) px, standard deviation of a coordinate from noise and sharpness of the image; 0 if
        unknown.
    reason : why no corner is used; empty if the board was detected.
    weak : ids of corners located but not fitted: half occluded, in shadow or at the image's border.
    mirrored : whether the image is mirrored; only boards with markers show this.
    """

    name: str
    image_size: tuple[int, int]
    ids: Integers
    pixels: Array
    sigma: Array
    reason: str = ""
    weak: tuple[int, ...] = ()
    mirrored: bool = False

    @property
    def success(self) -> bool:
        """Whether the board was detected."""
        return not self.reason


def load_board(path: Path | str, label: str | None = None) -> Board:
    """Read a board file; raises InputError with the line of the fault."""
    return board_from_document(read_yaml(path, label))


def board_from_document(document: Document) -> Board:
    """Board from a file's fields, validated; raises InputError."""
    if is_kalibr_target(document):
        document = replace(document, data=board_fields(document), lines={})
    kind = document.data.get("type")
    if not isinstance(kind, str) or kind not in BOARD_SCHEMAS:
        guess = closest(str(kind), BOARD_SCHEMAS)
        raise InputError(
            "no such type of board" if kind is not None else "the board's type is missing",
            where=document.where("type"),
            found=kind,
            expected=guess or " or ".join(BOARD_SCHEMAS),
        )
    fields: Any = validated_document(document, BOARD_SCHEMAS[kind])
    data = fields.model_dump(mode="json", exclude_none=True)
    if kind == "aruco_grid":
        return _marker_grid(fields, data)
    if kind == "circle_grid":
        return _circle_grid(fields, data)
    if kind == "charuco":
        columns, rows = (n - 1 for n in fields.squares)
        return _grid(kind, (columns, rows), fields.square, (fields.square,) * 2, data)
    corners = fields.corners or tuple(n - 1 for n in fields.squares)
    return _grid(kind, corners, fields.square, (0.0, 0.0), data)


def chessboard(corners: tuple[int, int], square: float) -> Board:
    """Chessboard of (columns, rows) inner corners; square : m."""
    document = {"type": "chessboard", "corners": list(corners), "square": square}
    return _grid("chessboard", corners, square, (0.0, 0.0), document)


def _grid(
    kind: str, counts: tuple[int, int], square: float, first: tuple[float, float], data: Any
) -> Board:
    """Board with a rectangular grid of corners. first : (x, y) of corner 0, m."""
    columns, rows = counts
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    points = np.stack([first[0] + square * x, first[1] + square * y, 0.0 * x], axis=-1)
    ids = np.arange(rows * columns).reshape(rows, columns)
    lines = [tuple(line) for grid in (ids, ids.T) for line in grid.tolist() if len(line) > 2]
    return Board(kind, counts, points, tuple(lines), data)


def _marker_grid(fields: GridSchema, data: dict[str, Any]) -> Board:
    """Board with the corners of a grid of markers."""
    columns, rows = fields.markers
    row, column = np.mgrid[:rows, :columns].reshape(2, -1)
    side, step = fields.marker, fields.marker + fields.gap
    column = columns - 1 - column if fields.leftward else column
    around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side
    xy = (np.stack([column, row], axis=-1) * step)[:, None] + around
    points = np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=-1).reshape(-1, 3)
    return Board("aruco_grid", fields.markers, points, _lines(points), data)


def _circle_grid(fields: CircleGridSchema, data: dict[str, Any]) -> Board:
    """Board with the centres of a grid of circles."""
    columns, rows = fields.circles
    row, column = np.mgrid[:rows, :columns].reshape(2, -1)
    x = 2 * column + row % 2 if fields.asymmetric else column
    points = np.stack([x, row, 0 * row], axis=-1) * fields.spacing
    return Board("circle_grid", fields.circles, points, _lines(points), data)


def _lines(points: Array) -> tuple[tuple[int, ...], ...]:
    """Ids of points (N, 3) with equal y, and with equal x, three or more."""
    lines = (
        tuple(np.flatnonzero(points[:, axis] == value).tolist())
        for axis in (1, 0)
        for value in np.unique(points[:, axis])
    )
    return tuple(line for line in lines if len(line) > 2)


def dictionaries() -> tuple[str, ...]:
    """Names of OpenCV's marker dictionaries."""
    import cv2

    return tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
