"""Detection of a session's calibration board in the images of its stations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pkmcal.arrays import Integers, evenly
from pkmcal.boards.board import Board, Detection, load_board
from pkmcal.boards.detect import check_boards
from pkmcal.boards.poses import board_views, detect_again, detect_in, standing_board
from pkmcal.boards.views import Boards, StationBoard
from pkmcal.errors import InputError
from pkmcal.session.image_files import label_of
from pkmcal.session.load import Session

SLOW_SEARCH_IMAGES = 4
"""Images in which a still chessboard is searched by the slow methods."""
OTHER_BOARD_TRIALS = 2
"""Images examined for another board."""


def find_boards(session: Session, images: Mapping[int, Sequence[Integers]]) -> Boards:
    """Detect the session's board in all stations that observe it.

    images : decoded images by station number.
    Raises `InputError` if a station's images do not show the board, or if a board on the base
    moved.
    """
    board = board_of(session)
    if board is None:
        return Boards()
    boards: dict[int, StationBoard] = {}
    by_hand: dict[str, list[tuple[Path, Detection]]] = {}
    for number, station in enumerate(session.stations):
        if "board" not in station.observe:
            continue
        if not station.handheld:
            boards[number] = station_board(session, board, number, images[number])
            continue
        # Hand-held images need not all show the board.
        detection, views = _board_by_hand(session, board, number, images[number])
        path = station.images[0].path
        by_hand.setdefault(station.entry, []).append((path, detection))
        if views is not None:
            boards[number] = views
    for entry, detected in by_hand.items():
        paths, detections = zip(*detected, strict=True)
        _check_another(board, entry, paths, detections)
        _check_visible(entry, board, detections)
    return Boards(boards, session.board_body, board.tolerance)


def board_of(session: Session) -> Board | None:
    """Board that stations of the session observe, read from its file; None if no station does."""
    if session.board is None or not any("board" in s.observe for s in session.stations):
        return None
    return load_board(session.board, label=label_of(session.folder, session.board))


def station_board(
    session: Session, board: Board, number: int, images: Sequence[Integers]
) -> StationBoard:
    """Board in the images of one fixed station."""
    station = session.stations[number]
    labels = [label_of(session.folder, image.path) for image in station.images]
    moves = session.board_body == "platform"
    detections = detect_in(images, board, labels)
    nowhere = not any(detection.success for detection in detections)
    _check_another(board, station.name, [p.path for p in station.images], detections)
    # Each image of a moving board is a new measurement; of a still one, a few are enough.
    most = len(images) if moves else SLOW_SEARCH_IMAGES if nowhere else 0
    detections = detect_again(images, board, detections, most)
    _check_visible(station.name, board, detections)
    rows = np.array([image.configuration for image in station.images])
    views = board_views(number, station.camera, rows, board, detections)
    stood = None if moves else standing_board(views)
    if not moves and stood is None:
        raise InputError(
            "no image shows the board well enough for its pose",
            where=f"session.yaml, stations.{station.name}",
            found=views.rejected[0].reason,
            expected="one at least in which the board is large, sharp and little hidden",
        )
    return StationBoard(views, stood)


def _check_visible(name: str, board: Board, detections: Sequence[Detection]) -> None:
    """Raise `InputError` if no image of a station shows the board."""
    if not any(detection.success for detection in detections):
        raise InputError(
            f"the board is in none of the images of station {name}",
            where=detections[0].name,
            found=detections[0].reason,
            expected=f"{board.described}, sharp, and not hidden by the machine",
            next_step="Check the board file, the light and the focus, or write observe: legs for"
            " this station",
            code="board.not_found",
        )


def _board_by_hand(
    session: Session, board: Board, number: int, images: Sequence[Integers]
) -> tuple[Detection, StationBoard | None]:
    """Detection in a hand-held image, and the board's pose if it is usable."""
    station = session.stations[number]
    labels = [label_of(session.folder, image.path) for image in station.images]
    detections = detect_again(images, board, detect_in(images, board, labels), len(images))
    if not detections[0].success:
        return detections[0], None
    rows = np.array([image.configuration for image in station.images])
    views = board_views(number, station.camera, rows, board, detections)
    if session.board_body == "platform":
        return detections[0], StationBoard(views, None)
    stood = standing_board(views)
    return detections[0], None if stood is None else StationBoard(views, stood)


def _check_another(
    board: Board, name: str, paths: Sequence[Path], detections: Sequence[Detection]
) -> None:
    """Raise `InputError` if images show another board, or a larger one than described."""
    visible = np.flatnonzero([detection.success for detection in detections])
    rows = visible if visible.size else np.arange(len(detections))
    few = rows[evenly(len(rows), OTHER_BOARD_TRIALS)]
    try:
        check_boards([paths[k] for k in few], [detections[k] for k in few], board)
    except InputError as error:
        raise error.located(f"session.yaml, stations.{name}") from None
