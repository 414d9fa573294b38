"""The board in a session's photographs, as `pkmcal check` reports it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pkmcal.arrays import Integers
from pkmcal.boards.views import Boards, StationBoard, board_of, station_board
from pkmcal.errors import InputError
from pkmcal.outcome import Finding, Level, wrong
from pkmcal.session.load import Session

POOR = 0.5
"""px rms from which the corners are worse than any sharp photograph of a flat board has them."""


@dataclass(frozen=True)
class BoardCheck:
    """The board in one station's photographs.

    found : photographs that show it. corners : mean number in these, of ``corners_of``. rms : px
    off their predicted places. scatter : px by which a board on the base wanders from photograph
    to photograph; nan where it need not stand still, or is seen once. distance : m. unseen : an
    outer row or column that no photograph shows though it shows all others, in words.
    """

    found: int
    corners: float
    corners_of: int
    rms: float
    scatter: float
    distance: float
    unseen: str = ""


@dataclass(frozen=True)
class BoardsCheck:
    """All stations' boards, by the station's number, and what is to be said of them."""

    boards: Boards = field(default_factory=Boards)
    checks: Mapping[int, BoardCheck] = field(default_factory=dict[int, BoardCheck])
    findings: tuple[Finding, ...] = ()


def check_boards(session: Session, images: Mapping[int, Sequence[Integers]]) -> BoardsCheck:
    """Look for the board in every station that observes it, nothing raised.

    images : all decoded photographs by the station's number.
    """
    findings: list[Finding] = []
    try:
        board = board_of(session)
    except InputError as error:
        return BoardsCheck(findings=(wrong(error),))
    if board is None:
        return BoardsCheck()
    found: dict[int, StationBoard] = {}
    for number, station in enumerate(session.stations):
        if "board" not in station.observe:
            continue
        try:
            found[number] = station_board(session, board, number, images[number])
        except InputError as error:
            findings.append(wrong(error, station.name))
    checks = {number: _summary(one) for number, one in found.items()}
    for number, check in checks.items():
        findings += _doubts(session, number, check)
    return BoardsCheck(Boards(found, session.board_body), checks, tuple(findings))


def _unseen(one: StationBoard) -> str:
    """The outer row or column that is never seen though all others are."""
    board = one.seen.board
    if board.type == "aruco_grid":
        return ""
    seen = one.seen.views.seen.any(axis=0).reshape(board.counts[::-1])
    for name, axis, at in (("row", 0, 0), ("row", 0, -1), ("column", 1, 0), ("column", 1, -1)):
        if not np.take(seen, at, axis).any() and np.delete(seen, at, axis).all():
            return f"the {'first' if at == 0 else 'last'} {name}"
    return ""


def _summary(one: StationBoard) -> BoardCheck:
    seen, stood = one.seen, one.stood
    return BoardCheck(
        found=len(seen.shown),
        corners=float(seen.views.seen.sum(axis=1).mean()),
        corners_of=len(seen.board.points),
        rms=float(np.median(seen.rms)),
        scatter=stood.scatter if stood else float("nan"),
        distance=float(np.median(np.linalg.norm(seen.poses.T_camera_board[:, :3, 3], axis=-1))),
        unseen=_unseen(one),
    )


def _doubts(session: Session, number: int, check: BoardCheck) -> list[Finding]:
    station = session.stations[number]
    texts: list[tuple[Level, str]] = []
    if check.rms > POOR:
        text = (
            f"The board's corners lie {check.rms:.2g} px off their places, rms; a flat board, a"
            " sharp photograph and the right camera file leave a tenth of a pixel."
        )
        texts.append((Level.DOUBTFUL, text))
    if check.unseen:
        text = (
            f"{check.unseen.capitalize()} of the board's corners is in no photograph: does the"
            " board have as many squares as its file says?"
        )
        texts.append((Level.DOUBTFUL, text))
    if session.board_body == "base" and check.found == 1 and len(station.photographs) > 1:
        text = (
            "Only one photograph shows the board on the base, so nobody can tell whether it, or"
            " the camera, stood still."
        )
        texts.append((Level.NOTE, text))
    return [Finding(level, f"{station.name}: {text}", station.name) for level, text in texts]
