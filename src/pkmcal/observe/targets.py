"""A calibration board in a station's photographs: from its corners to measured poses.

Every photograph that shows the board gives a pose by maximum likelihood from all its corners with
their noise; corners far off lose their weight, and a board that is partly hidden counts by what
is seen of it. A board on the platform is somewhere else in every photograph, and each photograph
(each repeat too) is one measurement. A board on the base is always in the same place: its
photographs are one measurement, by the means of their corners (:mod:`pkmcal.observe.standing`).

A pose's uncertainty here is that of its corners: their noise in the picture, and what camera
model and board leave unexplained. What the camera's calibration may be wrong by is not in it.
That error is common to all photographs of a camera; as noise of each pose on its own it would
average out over the photographs, which it does not do. ``BoardPoses.by_intrinsics`` says how it
moves them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.cameras.fit import Views, fit_poses
from pkmcal.cameras.resection import BoardPoses, board_poses, tilted_back
from pkmcal.errors import InputError
from pkmcal.files import listed
from pkmcal.observe.boards import THREADS, Board, Detection, detect_board
from pkmcal.observe.edges import Rejection
from pkmcal.observe.poses import PoseSet

UNEXPLAINED = 0.004
"""Share of the image's width that corners lie off their prediction, rms, from which the board file
or the camera file is wrong; good ones leave a hundredth of it."""
LEAST_CORNERS = 6
"""Corners with weight below which a pose is not tested by any corner."""
TWO_TILTS = 25.0
"""Chi square by which a board must speak against its other tilt, which looks alike from afar."""
UNSURE = "the board: too few corners agree on one pose, or its tilt is not sure"


@dataclass(frozen=True)
class BoardViews:
    """One station's K photographs of a board, of which F show it.

    configuration : (K,) rows of the session's readings. detections : K. shown : (F,) the
    photographs that show it. views, poses : of these. rms : (F,) px. usable : (F,) True where the
    pose is sure.
    """

    station: int
    camera: Camera
    board: Board
    configuration: Integers
    detections: tuple[Detection, ...]
    shown: Integers
    views: Views
    poses: BoardPoses
    rms: Array
    usable: Booleans

    @property
    def names(self) -> list[str]:
        """Names of the photographs that show the board."""
        return [self.detections[k].name for k in self.shown]

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Photographs without a pose, with the reason."""
        missed = [(k, f"the board: {d.reason}") for k, d in enumerate(self.detections) if d.reason]
        unsure = [(int(k), UNSURE) for k in self.shown[~self.usable]]
        return tuple(self.rejection(k, why) for k, why in sorted(missed + unsure))

    def rejection(self, photograph: int, reason: str) -> Rejection:
        """One photograph's board left out; photograph : its number among the K."""
        return Rejection(self.station, int(self.configuration[photograph]), -1, -1, -1, reason)


def detect_in(
    images: Sequence[Integers], board: Board, names: Sequence[str]
) -> tuple[Detection, ...]:
    """The board's corners in photographs, by the first way of finding it."""

    def detect(k: int) -> Detection:
        # Taken in the thread, so that photographs may be decoded there.
        return detect_board(images[k], board, names[k], quick=True)

    with ThreadPoolExecutor(THREADS) as pool:
        return tuple(pool.map(detect, range(len(names))))


def detect_again(
    images: Sequence[Integers], board: Board, found: Sequence[Detection], most: int
) -> tuple[Detection, ...]:
    """Where the board was not found, every way is tried, on `most` photographs spread over these.

    Only a chessboard has more than one way, and it takes seconds.
    """
    missed = [k for k, detection in enumerate(found) if not detection.found]
    if board.type != "chessboard" or not missed or most < 1:
        return tuple(found)
    places = np.unique(np.linspace(0, len(missed) - 1, min(most, len(missed))).astype(int))
    chosen = [missed[k] for k in places]
    out = list(found)
    with ThreadPoolExecutor(THREADS) as pool:
        again = pool.map(lambda k: detect_board(images[k], board, found[k].name), chosen)
        for k, detection in zip(chosen, again, strict=True):
            out[k] = detection
    return tuple(out)


def board_views(
    station: int,
    camera: Camera,
    configuration: Integers,
    board: Board,
    detections: Sequence[Detection],
) -> BoardViews:
    """Poses of the board in one station's photographs.

    detections : one a photograph. Raises `InputError` where the corners cannot be this board's,
    or this camera's.
    """
    _check_sides(board, detections)
    shown = np.flatnonzero([detection.found for detection in detections])
    views = _views(board, [detection for detection in detections if detection.found])
    poses = board_poses(camera, views) if len(shown) else _no_poses(camera, views)
    squares = poses.weight * np.nan_to_num(np.sum(poses.residuals**2, axis=-1))
    used = poses.weight.sum(axis=1)
    rms = np.sqrt(squares.sum(axis=1) / (2 * np.maximum(used, 1e-9)))
    usable = (used >= LEAST_CORNERS) & _one_tilt(camera, views, poses)
    seen = BoardViews(
        station, camera, board, configuration, tuple(detections), shown, views, poses, rms, usable
    )
    _check_explained(seen)
    return seen


def moving_poses(seen: BoardViews, mount: int) -> PoseSet:
    """A board on the platform: one measurement a photograph, in the order of the photographs."""
    kept = seen.usable
    return pose_set(
        seen.station,
        seen.configuration[seen.shown[kept]],
        mount,
        seen.poses.T_camera_board[kept],
        seen.poses.covariance[kept],
    )


def pose_set(
    station: int, configuration: Integers, mount: int, T_camera_board: Array, covariance: Array
) -> PoseSet:
    """Poses (N, 4, 4) of one station with their covariances (N, 6, 6) as measurements."""
    n = len(configuration)
    return PoseSet(
        station=np.full(n, station),
        configuration=configuration,
        mount=np.full(n, mount),
        T_station_target=T_camera_board,
        whiten=np.linalg.inv(np.linalg.cholesky(covariance)),
    )


def _views(board: Board, detections: Sequence[Detection]) -> Views:
    """Corners as the fit wants them, NaN where not seen."""
    shape = (len(detections), len(board.points))
    pixels, sigma = np.full((*shape, 2), np.nan), np.zeros(shape)
    for k, detection in enumerate(detections):
        pixels[k, detection.ids], sigma[k, detection.ids] = detection.pixels, detection.sigma
    return Views(board.points, pixels, sigma)


def _no_poses(camera: Camera, views: Views) -> BoardPoses:
    n = len(camera.parameters)
    none = np.zeros((0, 4, 4)), np.zeros((0, 6, 6)), np.zeros((0, 6, n))
    return BoardPoses(*none, views.pixels, views.sigma, 0.0)


def _one_tilt(camera: Camera, views: Views, poses: BoardPoses) -> Booleans:
    """(V,) True where the corners tell the pose from the board tilted the other way."""
    if not len(poses.T_camera_board):
        return np.zeros(0, dtype=bool)
    scale = np.sqrt(poses.weight / (views.sigma**2 + poses.noise**2))
    first, cost = fit_poses(camera, views, poses.T_camera_board, scale)
    second, other = fit_poses(camera, views, tilted_back(first, views.points), scale)
    # Where both searches end in one place there is no other tilt.
    same = np.linalg.norm((second - first)[:, :3, :3], axis=(1, 2)) < 1e-3
    return same | (other > cost + TWO_TILTS)


def _check_sides(board: Board, detections: Sequence[Detection]) -> None:
    """Raise `InputError` for a board, or photographs, that leave the board's axes open."""
    if board.turnable:
        raise InputError(
            "the board cannot be told from itself turned by half a turn, so its pose is not known",
            where="board.yaml",
            found=board.described,
            expected="an odd and an even number of corners, or a board with markers (charuco)",
        )
    mirrored = [detection.name for detection in detections if detection.mirrored]
    if mirrored:
        raise InputError(
            "the photographs are mirror images",
            where=listed(mirrored, 3),
            expected="photographs in which the board's markers are not reversed",
            next_step="Flip all photographs of this camera, and calibrate the camera from flipped"
            " ones",
        )


def _check_explained(seen: BoardViews) -> None:
    """Raise `InputError` where the corners do not lie as board and camera files say."""
    limit = UNEXPLAINED * seen.camera.image_size[0]
    if not len(seen.rms) or np.median(seen.rms) <= limit:
        return
    worst = int(np.argmax(seen.rms))
    raise InputError(
        "the board's corners do not lie as the board file and the camera file say",
        where=seen.names[worst],
        found=f"{np.median(seen.rms):.2g} px rms off their places ({seen.board.described})",
        expected=f"{limit:.2g} px at most, usually a hundredth of that",
        next_step="Look for a wrong board file, a bent board, or another camera's file",
    )
