"""Corners of a board in images: detected pixels, and those that the calibrated machine predicts."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.boards.views import ONLY_BOARD_MOUNT, Boards
from pkmcal.geometry.rigid import apply
from pkmcal.identify.estimate import Estimate
from pkmcal.measurements.effects import BOARD_SIZE
from pkmcal.session.load import Session


@dataclass(frozen=True)
class BoardCorners:
    """Corners (N of them).

    station, configuration : (N,).
    image : (N,) index of the image in its station.
    name : (N,) number on the board.
    pixel : (N, 2) detected.
    off : (N, 2) px, detected minus predicted.
    used : (N,) False where the board's pose in this image is not used.
    """

    station: Integers
    configuration: Integers
    image: Integers
    name: Integers
    pixel: Array
    off: Array
    used: Booleans

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.station)

    def select(self, keep: Booleans) -> BoardCorners:
        """Corners of a mask."""
        return BoardCorners(*(getattr(self, f.name)[keep] for f in fields(self)))


def board_corners(session: Session, boards: Boards, estimate: Estimate) -> BoardCorners:
    """Corners of all images in which the platform's pose was estimated.

    Corners without a predicted pixel are left out.
    """
    none = np.zeros(0, dtype=int)
    parts = [
        BoardCorners(none, none, none, none, np.zeros((0, 2)), np.zeros((0, 2)), none.astype(bool))
    ]
    state = estimate.state
    size = 1 + float(state.columns.get(BOARD_SIZE, np.zeros(1))[0]) if boards.tolerance else 1.0
    for s, station in boards.stations.items():
        views, moves = station.views, boards.body == "platform"
        usable = dict(zip(views.numbers.tolist(), views.usable.tolist(), strict=True))
        for p, (k, item) in enumerate(
            zip(views.configuration.tolist(), views.detections, strict=True)
        ):
            if not item.success or not estimate.configurations[k]:
                continue
            # board in the camera's frame, by the estimate
            body = state.T_base_platform[k] if moves else np.eye(4)
            T_camera_board = state.T_camera_base[s] @ body @ state.T_mount[ONLY_BOARD_MOUNT]
            points = apply(T_camera_board, size * views.board.points[item.ids])
            off = item.pixels - session.stations[s].camera.project(points)
            n = len(off)
            whole = (np.full(n, s), np.full(n, k), np.full(n, p), np.asarray(item.ids))
            used = np.full(n, usable.get(p, False))
            here = BoardCorners(*whole, item.pixels, off, used)
            parts.append(here.select(np.asarray(np.isfinite(off).all(axis=-1))))
    return BoardCorners(
        *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(BoardCorners))
    )
