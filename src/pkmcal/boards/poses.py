"""A calibration board in a station's photographs: from its corners to measured poses.

Every photograph that shows the board gives a pose by maximum likelihood from all its corners with
their noise; corners far off lose their weight, and a board that is partly hidden counts by what
is seen of it. A board on the platform is somewhere else in every configuration, each of which is
one measurement, by the mean of its repeats (:func:`one_a_configuration`). A board on the base is
always in the same place: its photographs are one measurement, by the means of their corners
(:func:`standing_board`).

A pose's uncertainty here is that of its corners: their noise in the picture, and what camera
model and board leave unexplained. What the camera's calibration may be wrong by is not in it.
That error is common to all photographs of a camera; as noise of each pose on its own it would
average out over the photographs, which it does not do. ``BoardPoses.by_intrinsics`` says how it
moves them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans, Integers, evenly
from pkmcal.boards.board import Board, Detection
from pkmcal.boards.find import detect_board
from pkmcal.boards.fit import (
    BoardPoses,
    Views,
    board_poses,
    check_numbering,
    fit_board_poses,
    tilted_back,
    views_of,
)
from pkmcal.cameras import Camera
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, perturb, pose_difference, skew
from pkmcal.measurements import Column, PoseSet, Rejection
from pkmcal.measurements.effects import by_board_size
from pkmcal.observe.repeats import groups_of
from pkmcal.wording import count, listed

BOARD_RESIDUAL_LIMIT = 0.004
"""Share of the image's width that corners lie off their prediction, rms, from which the board file
or the camera file is wrong; good ones leave a hundredth of it."""
LEAST_CORNERS_WEIGHED = 6
"""Corners with weight below which a pose is not tested by any corner."""
TWO_TILTS = 25.0
"""Chi square by which a board must speak against its other tilt, which looks alike from afar."""
UNSURE_BOARD_REASON = "the board: too few corners agree on one pose, or its tilt is not sure"
STILL_BOARD_DIFFERENCE = 0.2
"""px, rms over the board, that two photographs may differ by beyond their noise. A camera on a
tripod keeps a tenth; less than this hardly shows in the edges of legs, which are as uncertain."""
MOVED_BOARD_DEVIATIONS = 4.0
"""Standard deviations of a photograph's own noise beyond that."""
MOST_ODD = 1 / 3
"""Share of the photographs that may disagree one by one; with more, the board was never still."""
_EXPECTED = "a board fixed to the base, and a camera that stands still: all photographs of a " \
    "station show the board in one place"  # fmt: skip
MOST_COMMON = 0.99
ODD_BOARD_REASON = "the board lies {:.1f} standard deviations from where the repeats show it"
ODD_BOARD_DEVIATIONS = 5.0
"""Standard deviations (of six numbers: root mean square) of a repeat from the middle one beyond
which it is not one of them."""


@dataclass(frozen=True)
class BoardViews:
    """One station's K photographs of a board, of which F show it.

    configuration : (K,) rows of the session's readings. detections : K. numbers : (F,) the
    photographs that show it. views, poses : of these. rms : (F,) px. usable : (F,) True where the
    pose is sure.
    """

    station: int
    camera: Camera
    board: Board
    configuration: Integers
    detections: tuple[Detection, ...]
    numbers: Integers
    views: Views
    poses: BoardPoses
    rms: Array
    usable: Booleans

    @property
    def names(self) -> list[str]:
        """Names of the photographs that show the board."""
        return [self.detections[k].name for k in self.numbers]

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Photographs without a pose, with the reason."""
        missed = [(k, f"the board: {d.reason}") for k, d in enumerate(self.detections) if d.reason]
        unsure = [(int(k), UNSURE_BOARD_REASON) for k in self.numbers[~self.usable]]
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
    images: Sequence[Integers], board: Board, detections: Sequence[Detection], most: int
) -> tuple[Detection, ...]:
    """Where the board was not found, every way is tried, on `most` photographs spread over these.

    Only a chessboard has more than one way, and it takes seconds.
    """
    missed = [k for k, detection in enumerate(detections) if not detection.success]
    if board.type != "chessboard" or not missed or most < 1:
        return tuple(detections)
    chosen = [missed[k] for k in evenly(len(missed), most)]
    out = list(detections)
    with ThreadPoolExecutor(THREADS) as pool:
        again = pool.map(lambda k: detect_board(images[k], board, detections[k].name), chosen)
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
    visible = np.flatnonzero([detection.success for detection in detections])
    views = views_of([detection for detection in detections if detection.success], board)
    poses = board_poses(camera, views)
    squares = poses.weight * np.nan_to_num(np.sum(poses.residuals**2, axis=-1))
    used = poses.weight.sum(axis=1)
    rms = np.sqrt(squares.sum(axis=1) / (2 * np.maximum(used, 1e-9)))
    usable = (used >= LEAST_CORNERS_WEIGHED) & _one_tilt(camera, views, poses)
    in_view = BoardViews(
        station, camera, board, configuration, tuple(detections), visible, views, poses, rms, usable
    )
    _check_explained(in_view)
    return in_view


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


def _one_tilt(camera: Camera, views: Views, poses: BoardPoses) -> Booleans:
    """(V,) True where the corners tell the pose from the board tilted the other way."""
    if not len(poses.T_camera_board):
        return np.zeros(0, dtype=bool)
    scale = np.sqrt(poses.weight / (views.sigma**2 + poses.noise**2))
    first, cost = fit_board_poses(camera, views, poses.T_camera_board, scale)
    second, other = fit_board_poses(camera, views, tilted_back(first, views.points), scale)
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
    others = sum(detection.success and not detection.mirrored for detection in detections)
    if mirrored and others:
        one = len(mirrored) == 1
        raise InputError(
            "this photograph is a mirror image" if one else "these photographs are mirror images",
            where=listed(mirrored, 3),
            found=f"the board's markers reversed, and not in {count(others, 'other photograph')}",
            next_step=f"Flip {'this photograph' if one else 'these photographs'} alone, or take"
            f" {'it' if one else 'them'} again",
        )
    if mirrored:
        raise InputError(
            "the photographs are mirror images",
            where=listed(mirrored, 3),
            expected="photographs in which the board's markers are not reversed",
            next_step="Flip all photographs of this camera, and calibrate the camera from flipped"
            " ones",
        )


def _check_explained(views: BoardViews) -> None:
    """Raise `InputError` where the corners do not lie as board and camera files say."""
    check_numbering(views.poses.residuals, views.views.pixels, views.board, "board.yaml")
    limit = BOARD_RESIDUAL_LIMIT * views.camera.image_size[0]
    if not len(views.rms) or np.median(views.rms) <= limit:
        return
    worst = int(np.argmax(views.rms))
    raise InputError(
        "the board's corners do not lie as the board file and the camera file say",
        where=views.names[worst],
        found=f"{np.median(views.rms):.2g} px rms off their places ({views.board.described})",
        expected=f"{limit:.2g} px at most, usually a hundredth of that",
        next_step="Look for a wrong board file, a bent board, or another camera's file",
    )


@dataclass(frozen=True)
class Standing:
    """Where a board stood, from the photographs that agree.

    T_camera_board : (4, 4). covariance : (6, 6), left perturbation, by the corners alone.
    agreed : (F,) photographs used, of those that show the board. scatter : px, rms over the board
    and these photographs of their distance from the mean; nan where there is only one.
    noise : px rms beyond the corners' noise that the mean leaves unexplained.
    rejected : photographs that disagree.
    """

    T_camera_board: Array
    covariance: Array
    agreed: Booleans
    scatter: float
    noise: float
    rejected: tuple[Rejection, ...]

    def poses(self, views: BoardViews, mount: int) -> PoseSet:
        """One measurement; the configuration of its row says nothing, for nothing moves."""
        row = views.configuration[views.numbers[self.agreed]][:1]
        actual_names = pose_set(
            views.station, row, mount, self.T_camera_board[None], self.covariance[None]
        )
        by = views.poses.by_intrinsics[self.agreed].mean(axis=0)[None]
        return replace(actual_names, by_intrinsics=by)


def standing_board(views: BoardViews) -> Standing | None:
    """The board's one pose in a station's photographs; None where none shows it surely.

    Raises `InputError` where the board or the camera was moved between photographs.
    """
    if not views.usable.any():
        return None
    there, noise = _places(views)
    agreed = _agreed(there, noise, views.usable)
    odd = views.usable & ~agreed
    _check_still(views, there, agreed)
    T_camera_board, covariance, rest = _mean_pose(views, agreed)
    off = there[agreed] - there[agreed].mean(axis=0)
    scatter = float(np.sqrt(np.mean(off**2))) if agreed.sum() > 1 else float("nan")
    distance = _distance(there, there[agreed].mean(axis=0))
    return Standing(
        T_camera_board,
        covariance,
        agreed,
        scatter,
        rest,
        tuple(
            views.rejection(
                int(views.numbers[k]),
                f"the board stands {distance[k]:.1f} px from where the other photographs show it",
            )
            for k in np.flatnonzero(odd)
        ),
    )


def _places(views: BoardViews) -> tuple[Array, Array]:
    """Where each photograph's pose puts the board's corners, (F, N, 2) px, and the standard
    deviation of that, rms over the board, (F,) px.
    """
    T = views.poses.T_camera_board[:, None]
    there = apply(T, views.board.points)
    by_point = views.camera.project_jacobians(there)[0]
    by_pose = np.concatenate([-by_point @ skew(there - T[..., :3, 3]), by_point], axis=-1)
    variance = np.einsum("fnip,fpq,fniq->fni", by_pose, views.poses.covariance, by_pose)
    return views.camera.project(there), np.sqrt(np.nanmean(variance, axis=(1, 2)))


def _agreed(there: Array, noise: Array, usable: Booleans) -> Booleans:
    """(F,) the photographs that agree with the one that agrees with the most others."""
    limit = np.sqrt(
        STILL_BOARD_DIFFERENCE**2 + MOVED_BOARD_DEVIATIONS**2 * (noise[:, None] ** 2 + noise**2)
    )
    agree = (_distance(there[:, None], there) <= limit) & usable & usable[:, None]
    return agree[int(np.argmax(agree.sum(axis=1)))]


def _distance(there: Array, other: Array) -> Array:
    """Root mean square over the board of the distance of its corners; (..., N, 2) px."""
    return np.sqrt(np.nanmean(np.sum((there - other) ** 2, axis=-1), axis=-1))


def _check_still(views: BoardViews, there: Array, agreed: Booleans) -> None:
    """Raise `InputError` where photographs disagree that follow one another, or too many do."""
    used = np.flatnonzero(views.usable)
    runs = [
        (bool(same), [int(k) for k in run]) for same, run in groupby(used, key=lambda k: agreed[k])
    ]
    long = next((n for n, (same, run) in enumerate(runs) if not same and len(run) > 1), None)
    if long is not None:
        # A run at the beginning ends with the movement, any other begins with it.
        before, after = (runs[long][1], runs[long + 1][1]) if long == 0 else (
            runs[long - 1][1], runs[long][1]
        )  # fmt: skip
        raise _movement_error(views, there, before, after)
    odd = int((views.usable & ~agreed).sum())
    if odd > MOST_ODD * len(used) and odd > 1:
        raise InputError(
            "the board, or the camera, did not stand still",
            where=views.names[0].rpartition("/")[0] or views.names[0],
            found=f"{odd} of {len(used)} photographs show it in other places than the rest",
            expected=_EXPECTED,
        )


def _movement_error(
    views: BoardViews, there: Array, before: list[int], after: list[int]
) -> InputError:
    """The error that names the photographs between which the board moved."""
    names, poses = views.names, views.poses.T_camera_board
    pixels = float(_distance(there[before[-1]], there[after[0]]))
    middle = views.board.points.mean(axis=0)
    metres = float(np.linalg.norm(np.diff(apply(poses[[before[-1], after[0]]], middle), axis=0)))
    turn = float(np.linalg.norm(pose_difference(poses[after[0]], poses[before[-1]])[:3]))
    return InputError(
        f"the board, or the camera, moved after {names[before[-1]]}",
        where=names[after[0]],
        found=f"the board {pixels:.1f} px away ({metres * 1e3:.1f} mm, {np.rad2deg(turn):.2f}"
        " degrees)",
        expected=_EXPECTED,
        next_step=f"Make the photographs from {names[after[0]]} on a station of their own, if only"
        " the camera was moved; take them again, if the board was",
    )


def _mean_pose(board_views: BoardViews, agreed: Booleans) -> tuple[Array, Array, float]:
    """The pose by the means of the corners over photographs, its covariance (6, 6), and the
    noise px that the means leave unexplained.

    What the photographs do not share (pixel noise) averages out, and its size is told by their
    scatter; what they share (the camera model, the board's print) remains, and does not.
    """
    views, poses = board_views.views, board_views.poses
    used = agreed[:, None] & (poses.weight > 0.5)
    count = used.sum(axis=0)
    pixels = np.where(used[..., None], views.pixels, 0.0).sum(axis=0)
    pixels = np.where(count[:, None] > 0, pixels / np.maximum(count, 1)[:, None], np.nan)
    off = np.where(used[..., None], views.pixels - pixels, 0.0)
    freedom = 2 * int(np.sum(np.maximum(count - 1, 0)))
    single = np.sqrt(np.where(used, views.sigma**2, 0.0).sum(axis=0) / np.maximum(count, 1))
    noise = np.sqrt(np.sum(off**2) / freedom) if freedom > 0 else single
    sigma = noise / np.sqrt(np.maximum(count, 1))
    mean = board_poses(board_views.camera, Views(views.points, pixels[None], sigma[None]))
    covariance = mean.covariance[0] + _wandering(board_views, agreed, mean.T_camera_board[0], noise)
    return mean.T_camera_board[0], covariance, mean.noise


def _wandering(views: BoardViews, agreed: Booleans, T_camera_board: Array, noise: Array) -> Array:
    """Covariance (6, 6) of the mean by what moves the whole board from photograph to photograph
    (a floor that shakes), beyond what the corners' noise does; zero where there is no more.
    """
    count = int(agreed.sum())
    if count < 2:
        return np.zeros((6, 6))
    sigma2 = np.mean(views.views.sigma[views.views.visible] ** 2) + views.poses.noise**2
    # each pose's covariance, had its corners only the noise that differs between photographs
    each = views.poses.covariance[agreed] * (np.mean(np.square(noise)) / sigma2)
    off = pose_difference(views.poses.T_camera_board[agreed], T_camera_board)
    chi2 = np.einsum("fi,fij,fj->", off, np.linalg.inv(each), off)
    spread = chi2 / (6 * (count - 1))
    return max(spread - 1.0, 0.0) * each.mean(axis=0) / count


class MeanPoses(NamedTuple):
    """One pose a configuration, (G,); which repeats took part (N,), and how far each lies off (N,),
    in standard deviations.
    """

    first: Integers
    pose: Array
    covariance: Array
    used: Booleans
    off: Array


def mean_poses(configuration: Integers, T: Array, covariance: Array, common: float) -> MeanPoses:
    """The mean pose of each configuration's repeats.

    configuration : (N,). T : (N, 4, 4). covariance : (N, 6, 6), left perturbation. common : share
    of it that the repeats have in common.
    """
    groups = groups_of(configuration)
    delta = pose_difference(T, T[groups.first[groups.member]])
    off = _deviation(delta - groups.median(delta)[groups.member], covariance)
    # Of two that differ nobody knows which is wrong, so both stay and their scatter tells.
    several = groups.count[groups.member] > 2
    usual = float(np.median(off[several])) if several.any() else 1.0
    used = (off < ODD_BOARD_DEVIATIONS * max(1.0, usual)) | ~several
    retained = groups_of(configuration[used])
    delta, covariance_used = delta[used], covariance[used]
    mean, stated = retained.mean(delta), retained.mean(covariance_used)
    alone = (1 - common) * stated
    rest = delta - mean[retained.member]
    freedom = float(np.sum(retained.count - 1))
    spread = 1.0
    if freedom:
        size = np.sum(_deviation(rest, alone[retained.member]) ** 2)
        spread = max(float(size) / freedom, 1.0)
    total = common * stated + spread * alone / retained.count[:, None, None]
    first = np.flatnonzero(used)[retained.first]
    reference = T[groups.first[groups.member]][used][retained.first]
    return MeanPoses(first, perturb(reference, mean), total, used, off)


def _deviation(delta: Array, covariance: Array) -> Array:
    """Root mean square (N,) of six numbers (N, 6) in standard deviations."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), delta[..., None])[..., 0]
    return np.sqrt(np.mean(white**2, axis=-1))


def one_a_configuration(views: BoardViews, mount: int) -> tuple[PoseSet, tuple[Rejection, ...]]:
    """A board on the platform: one measurement a configuration, and the repeats that are odd."""
    retained_rows = np.flatnonzero(views.usable)
    rows = views.configuration[views.numbers[retained_rows]]
    if not len(retained_rows):
        return PoseSet.empty(), ()
    sigma2 = float(np.median(views.views.sigma[views.views.visible]) ** 2)
    noise2 = views.poses.noise**2
    common = min(noise2 / (noise2 + sigma2), MOST_COMMON)
    value = mean_poses(
        rows,
        views.poses.T_camera_board[retained_rows],
        views.poses.covariance[retained_rows],
        common,
    )
    odd = tuple(
        views.rejection(int(views.numbers[retained_rows[k]]), ODD_BOARD_REASON.format(value.off[k]))
        for k in np.flatnonzero(~value.used)
    )
    poses = pose_set(views.station, rows[value.first], mount, value.pose, value.covariance)
    by = groups_of(rows[value.used]).mean(views.poses.by_intrinsics[retained_rows[value.used]])
    return replace(poses, by_intrinsics=by), odd


def board_size_column(poses: PoseSet, mount: int, file: str) -> Column:
    """A board whose squares are not as large as its file says, by more than its tolerance.

    mount : the board's number. Where the size is an unknown with a tolerance, freeing it takes the
    unknown back to what the file says: the value that fits is the whole difference.
    """
    own, by = by_board_size(poses, mount)

    def facts(value: Array, sigma: Array) -> dict[str, Any]:
        return {"value": value[0], "sigma": sigma[0], "file": file, "factor": 1 + value[0]}

    return Column("board.size", file, "board size", poses=by, pose_rows=own, facts=facts)
