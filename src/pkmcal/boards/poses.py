"""Calibration board in a station's images: from corners to measured poses.

Each image that shows the board gives a maximum-likelihood pose from all its corners with their
noise. Corners are weighted robustly; a partly occluded board counts by its visible corners. A board
on the platform has another pose in each configuration, and the mean of the repeats of a
configuration is one measurement (:func:`one_a_configuration`). A board on the base has one pose,
and the means of its corners over all images are one measurement (:func:`standing_board`).

The uncertainty of a pose comes from its corners: their noise in the image, and residuals that
camera model and board leave unexplained. The uncertainty of the camera's calibration is not
included: this error is common to all images of a camera, and as independent noise of each pose it
would falsely average out. ``BoardPoses.by_intrinsics`` is the derivative of the poses by the
intrinsics.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import THREADS, Array, Booleans, Integers, evenly, rms
from pkmcal.boards.board import Board, Detection
from pkmcal.boards.find import BOARD_DETECTION_OPTIONS, detect_board
from pkmcal.boards.fit import (
    CAMERA_FIT_OPTIONS,
    BoardPoses,
    CameraFitOptions,
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
from pkmcal.levels import CONTRADICTION_SIGMAS, FEW
from pkmcal.measurements import Column, PoseSet, Rejection
from pkmcal.measurements.effects import by_board_size
from pkmcal.observe.repeats import REPEAT_OPTIONS, groups_of
from pkmcal.solver.kernels import INLIER_WEIGHT
from pkmcal.wording import count, listed


@dataclass(frozen=True)
class BoardPoseOptions:
    """Constants of a board's poses in the images of a station."""

    # least sum of the corners' weights of a usable pose: as many corners as a detection needs
    least_weight: float = BOARD_DETECTION_OPTIONS.least_corners
    # least difference of chi square between a pose and the board's other tilt, which from afar
    # looks the same: five standard deviations (statistical)
    tilt_chi2: float = CONTRADICTION_SIGMAS**2
    # difference between two images of a still board allowed beyond noise, px rms over the board. A
    # camera on a tripod keeps a tenth of a pixel; smaller movements hardly matter for edges of
    # legs, which are as uncertain. Not checked within a factor of two
    still: float = 0.2
    # standard deviations of the images' own noise allowed in addition
    moved: float = CONTRADICTION_SIGMAS
    # largest share of single images that disagree; with more, the board never stood still: one that
    # alternates between two places has half. Two consecutive ones are a movement in any case
    most_outlying: float = FEW
    # largest share of a pose's covariance that repeats have in common (numerical: keeps the rest
    # invertible)
    most_common: float = 0.99
    # distance of a repeat from the median repeat, in standard deviations (root mean square of six
    # numbers), above which it is rejected, as a repeat of an edge
    outlying: float = REPEAT_OPTIONS.far
    # fit of the poses, and the largest residual of a right board
    fit: CameraFitOptions = CAMERA_FIT_OPTIONS


BOARD_POSE_OPTIONS = BoardPoseOptions()

UNSURE_BOARD_REASON = "the board: too few corners agree on one pose, or its tilt is not sure"
"""Reason for the rejection of a pose."""
_EXPECTED = "a board fixed to the base, and a camera that stands still: all images of a " \
    "station show the board in one place"  # fmt: skip
ODD_BOARD_REASON = "the board lies {:.1f} standard deviations from where the repeats show it"


@dataclass(frozen=True)
class BoardViews:
    """A station's K images of a board, of which F show it.

    configuration : (K,) rows of the session's readings.
    detections : K.
    numbers : (F,) indices of the images that show the board.
    views, poses : of these F images.
    rms : (F,) px.
    usable : (F,) whether the pose is unambiguous and has enough corners.
    options : those of the poses, and of what follows from them.
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
    options: BoardPoseOptions = BOARD_POSE_OPTIONS

    @property
    def names(self) -> list[str]:
        """Names of the images that show the board."""
        return [self.detections[k].name for k in self.numbers]

    @property
    def rejected(self) -> tuple[Rejection, ...]:
        """Images without a pose, with the reason."""
        missed = [(k, f"the board: {d.reason}") for k, d in enumerate(self.detections) if d.reason]
        unsure = [(int(k), UNSURE_BOARD_REASON) for k in self.numbers[~self.usable]]
        return tuple(self.rejection(k, why) for k, why in sorted(missed + unsure))

    def rejection(self, image: int, reason: str) -> Rejection:
        """Rejection of the board in one image; image : index among the K images."""
        return Rejection(self.station, int(self.configuration[image]), -1, -1, -1, reason)


def detect_in(
    images: Sequence[Integers], board: Board, names: Sequence[str]
) -> tuple[Detection, ...]:
    """Corners of the board in images, by the fast method."""

    def detect(k: int) -> Detection:
        # Indexed in the thread, where a lazy sequence decodes the image.
        return detect_board(images[k], board, names[k], quick=True)

    with ThreadPoolExecutor(THREADS) as pool:
        return tuple(pool.map(detect, range(len(names))))


def detect_again(
    images: Sequence[Integers], board: Board, detections: Sequence[Detection], most: int
) -> tuple[Detection, ...]:
    """Detections with all methods tried on `most` of the images without the board, evenly spread.

    Only chessboards have slow methods, which take seconds.
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
    options: BoardPoseOptions = BOARD_POSE_OPTIONS,
) -> BoardViews:
    """Poses of the board in a station's images.

    detections : one for each image.
    Raises `InputError` if the corners contradict the board file or the camera file.
    """
    _check_sides(board, detections)
    with_board = np.flatnonzero([detection.success for detection in detections])
    views = views_of([detection for detection in detections if detection.success], board)
    poses = board_poses(camera, views, options.fit)
    squares = poses.weight * np.nan_to_num(np.sum(poses.residuals**2, axis=-1))
    used = poses.weight.sum(axis=1)
    rms = np.sqrt(squares.sum(axis=1) / (2 * np.maximum(used, 1e-9)))
    usable = (used >= options.least_weight) & _tilt_is_unique(camera, views, poses, options)
    station_views = BoardViews(
        station,
        camera,
        board,
        configuration,
        tuple(detections),
        with_board,
        views,
        poses,
        rms,
        usable,
        options,
    )
    _check_explained(station_views)
    return station_views


def pose_set(
    station: int, configuration: Integers, mount: int, T_camera_board: Array, covariance: Array
) -> PoseSet:
    """Measurements from poses (N, 4, 4) of one station with their covariances (N, 6, 6)."""
    n = len(configuration)
    return PoseSet(
        station=np.full(n, station),
        configuration=configuration,
        mount=np.full(n, mount),
        T_station_target=T_camera_board,
        whiten=np.linalg.inv(np.linalg.cholesky(covariance)),
    )


def _tilt_is_unique(
    camera: Camera, views: Views, poses: BoardPoses, options: BoardPoseOptions
) -> Booleans:
    """Whether the corners exclude the second local minimum of the pose, the board tilted the other
    way, (V,).
    """
    if not len(poses.T_camera_board):
        return np.zeros(0, dtype=bool)
    scale = np.sqrt(poses.weight / (views.sigma**2 + poses.noise**2))
    first, cost = fit_board_poses(camera, views, poses.T_camera_board, scale)
    second, other = fit_board_poses(camera, views, tilted_back(first, views.points), scale)
    # If both searches converge to one pose there is no second minimum.
    same = np.linalg.norm((second - first)[:, :3, :3], axis=(1, 2)) < 1e-3
    return same | (other > cost + options.tilt_chi2)


def _check_sides(board: Board, detections: Sequence[Detection]) -> None:
    """Raise `InputError` for a board with a rotational symmetry, and for mirrored images."""
    if board.turnable:
        raise InputError(
            "the board looks the same when rotated by half a turn, so its pose is ambiguous",
            where="board.yaml",
            found=board.described,
            expected="an odd and an even number of corners, or a board with markers (charuco)",
            code="board.ambiguous",
        )
    mirrored = [detection.name for detection in detections if detection.mirrored]
    others = sum(detection.success and not detection.mirrored for detection in detections)
    if mirrored and others:
        one = len(mirrored) == 1
        raise InputError(
            "this image is a mirror image" if one else "these images are mirror images",
            where=listed(mirrored, 3),
            found=f"the board's markers reversed, and not in {count(others, 'other image')}",
            next_step=f"Flip {'this image' if one else 'these images'} alone, or take"
            f" {'it' if one else 'them'} again",
            code="image.mirrored",
        )
    if mirrored:
        raise InputError(
            "the images are mirror images",
            where=listed(mirrored, 3),
            expected="images in which the board's markers are not reversed",
            next_step="Flip all images of this camera, and calibrate the camera from flipped ones",
            code="image.mirrored",
        )


def _check_explained(views: BoardViews) -> None:
    """Raise `InputError` if the corners contradict board and camera files."""
    fit = views.options.fit
    check_numbering(views.poses.residuals, views.views.pixels, views.board, "board.yaml", fit)
    limit = fit.residual_limit * views.camera.image_size[0]
    if not len(views.rms) or np.median(views.rms) <= limit:
        return
    worst = int(np.argmax(views.rms))
    raise InputError(
        "the board's corners contradict the board file or the camera file",
        where=views.names[worst],
        found=f"{np.median(views.rms):.2g} px rms off their places ({views.board.described})",
        expected=f"{limit:.2g} px at most, usually a hundredth of that",
        next_step="Look for a wrong board file, a bent board, or another camera's file",
        code="board.contradicted",
    )


@dataclass(frozen=True)
class Standing:
    """Pose of a board that stands still, from the images that agree.

    T_camera_board : (4, 4).
    covariance : (6, 6), left perturbation, from the corners alone.
    agreed : (F,) images used, of those that show the board.
    scatter : px, rms over the board and these images of the distance from the mean; nan for one
        image.
    noise : px rms beyond the corners' noise that the mean leaves unexplained.
    rejected : images that disagree.
    """

    T_camera_board: Array
    covariance: Array
    agreed: Booleans
    scatter: float
    noise: float
    rejected: tuple[Rejection, ...]

    def poses(self, views: BoardViews, mount: int) -> PoseSet:
        """Single measurement of the pose; its configuration is arbitrary because the board does not
        move.
        """
        row = views.configuration[views.numbers[self.agreed]][:1]
        poses = pose_set(
            views.station, row, mount, self.T_camera_board[None], self.covariance[None]
        )
        by = views.poses.by_intrinsics[self.agreed].mean(axis=0)[None]
        return replace(poses, by_intrinsics=by)


def standing_board(views: BoardViews) -> Standing | None:
    """Pose of a still board in a station's images; None if no image has a usable pose.

    Raises `InputError` if the board or the camera moved between images.
    """
    if not views.usable.any():
        return None
    there, noise = _projected_corners(views)
    # the largest set of images that agree with one of them
    limit = np.sqrt(
        views.options.still**2 + views.options.moved**2 * (noise[:, None] ** 2 + noise**2)
    )
    agree = (_rms_distance(there[:, None], there) <= limit) & views.usable & views.usable[:, None]
    agreed = agree[int(np.argmax(agree.sum(axis=1)))]
    odd = views.usable & ~agreed
    _check_still(views, there, agreed)
    T_camera_board, covariance, rest = _mean_pose(views, agreed)
    off = there[agreed] - there[agreed].mean(axis=0)
    scatter = rms(off) if agreed.sum() > 1 else float("nan")
    distance = _rms_distance(there, there[agreed].mean(axis=0))
    return Standing(
        T_camera_board,
        covariance,
        agreed,
        scatter,
        rest,
        tuple(
            views.rejection(
                int(views.numbers[k]),
                f"the board stands {distance[k]:.1f} px from where the other images show it",
            )
            for k in np.flatnonzero(odd)
        ),
    )


def _projected_corners(views: BoardViews) -> tuple[Array, Array]:
    """Projected corners (F, N, 2) px by each image's pose, and their standard deviation, rms over
    the board, (F,) px.
    """
    T = views.poses.T_camera_board[:, None]
    there = apply(T, views.board.points)
    by_point = views.camera.project_jacobians(there)[0]
    by_pose = np.concatenate([-by_point @ skew(there - T[..., :3, 3]), by_point], axis=-1)
    variance = np.einsum("fnip,fpq,fniq->fni", by_pose, views.poses.covariance, by_pose)
    return views.camera.project(there), np.sqrt(np.nanmean(variance, axis=(1, 2)))


def _rms_distance(there: Array, other: Array) -> Array:
    """Root mean square over the board of the distances of corners (..., N, 2) px."""
    return np.sqrt(np.nanmean(np.sum((there - other) ** 2, axis=-1), axis=-1))


def _check_still(views: BoardViews, there: Array, agreed: Booleans) -> None:
    """Raise `InputError` if consecutive images disagree with the rest, or too many others."""
    used = np.flatnonzero(views.usable)
    runs = [
        (bool(same), [int(k) for k in run]) for same, run in groupby(used, key=lambda k: agreed[k])
    ]
    long = next((n for n, (same, run) in enumerate(runs) if not same and len(run) > 1), None)
    if long is not None:
        # The movement ends a run at the beginning, and begins any other run.
        before, after = (runs[long][1], runs[long + 1][1]) if long == 0 else (
            runs[long - 1][1], runs[long][1]
        )  # fmt: skip
        raise _movement_error(views, there, before, after)
    odd = int((views.usable & ~agreed).sum())
    if odd > views.options.most_outlying * len(used) and odd > 1:
        raise InputError(
            "the board, or the camera, did not stand still",
            where=views.names[0].rpartition("/")[0] or views.names[0],
            found=f"{odd} of {len(used)} images show it in other places than the rest",
            expected=_EXPECTED,
            code="board.not_still",
        )


def _movement_error(
    views: BoardViews, there: Array, before: list[int], after: list[int]
) -> InputError:
    """Error with the names of the images between which the board moved, and the size of the
    movement.
    """
    names, poses = views.names, views.poses.T_camera_board
    pixels = float(_rms_distance(there[before[-1]], there[after[0]]))
    middle = views.board.points.mean(axis=0)
    metres = float(np.linalg.norm(np.diff(apply(poses[[before[-1], after[0]]], middle), axis=0)))
    turn = float(np.linalg.norm(pose_difference(poses[after[0]], poses[before[-1]])[:3]))
    return InputError(
        f"the board, or the camera, moved after {names[before[-1]]}",
        where=names[after[0]],
        found=f"the board {pixels:.1f} px away ({metres * 1e3:.1f} mm, {np.rad2deg(turn):.2f}"
        " degrees)",
        expected=_EXPECTED,
        next_step=f"Make the images from {names[after[0]]} on a station of their own, if only"
        " the camera was moved; take them again, if the board was",
        code="board.not_still",
    )


def _mean_pose(board_views: BoardViews, agreed: Booleans) -> tuple[Array, Array, float]:
    """Pose from the corners' means over images, its covariance (6, 6), and the noise px that the
    means leave unexplained.

    Errors that differ between images (pixel noise) average out; their size is estimated from the
    scatter. Errors common to all images (camera model, printing) remain in the residuals of the
    mean.
    """
    views, poses = board_views.views, board_views.poses
    # Means (N, 2) of the corners over the images.
    used = agreed[:, None] & (poses.weight > INLIER_WEIGHT)
    count = used.sum(axis=0)
    pixels = np.where(used[..., None], views.pixels, 0.0).sum(axis=0)
    pixels = np.where(count[:, None] > 0, pixels / np.maximum(count, 1)[:, None], np.nan)
    # Their noise, from the scatter over the images.
    off = np.where(used[..., None], views.pixels - pixels, 0.0)
    freedom = 2 * int(np.sum(np.maximum(count - 1, 0)))
    single = np.sqrt(np.where(used, views.sigma**2, 0.0).sum(axis=0) / np.maximum(count, 1))
    noise = np.sqrt(np.sum(off**2) / freedom) if freedom > 0 else single
    sigma = noise / np.sqrt(np.maximum(count, 1))
    mean = board_poses(
        board_views.camera, Views(views.points, pixels[None], sigma[None]), board_views.options.fit
    )
    covariance = mean.covariance[0] + _common_motion_covariance(
        board_views, agreed, mean.T_camera_board[0], noise
    )
    return mean.T_camera_board[0], covariance, mean.noise


def _common_motion_covariance(
    views: BoardViews, agreed: Booleans, T_camera_board: Array, noise: Array
) -> Array:
    """Covariance (6, 6) of the mean pose from movements of the whole board between images (a
    shaking floor), beyond the corners' noise; zero if there are none.
    """
    count = int(agreed.sum())
    if count < 2:
        return np.zeros((6, 6))
    sigma2 = np.mean(views.views.sigma[views.views.visible] ** 2) + views.poses.noise**2
    # Covariance of each pose with only the part of the noise that differs between images.
    each = views.poses.covariance[agreed] * (np.mean(np.square(noise)) / sigma2)
    # Excess scatter of the poses over this noise.
    off = pose_difference(views.poses.T_camera_board[agreed], T_camera_board)
    chi2 = np.einsum("fi,fij,fj->", off, np.linalg.inv(each), off)
    spread = chi2 / (6 * (count - 1))
    return max(spread - 1.0, 0.0) * each.mean(axis=0) / count


class MeanPoses(NamedTuple):
    """One pose for each of G configurations.

    first : (G,) row of the first repeat in use.
    pose : (G, 4, 4).
    covariance : (G, 6, 6).
    used : (N,) repeats in use.
    off : (N,) distance of each repeat from the median, in standard deviations.
    """

    first: Integers
    pose: Array
    covariance: Array
    used: Booleans
    off: Array


def mean_poses(
    configuration: Integers,
    T: Array,
    covariance: Array,
    common: float,
    options: BoardPoseOptions = BOARD_POSE_OPTIONS,
) -> MeanPoses:
    """Mean pose over the repeats of each configuration, with outliers rejected.

    configuration : (N,).
    T : (N, 4, 4).
    covariance : (N, 6, 6), left perturbation.
    common : share of the covariance that the repeats have in common.
    """
    # Reject repeats far from the median of their configuration.
    groups = groups_of(configuration)
    delta = pose_difference(T, T[groups.first[groups.member]])
    off = _deviation(delta - groups.median(delta)[groups.member], covariance)
    # With two repeats the outlier is unknown: both stay, and their scatter increases sigma.
    repeated = groups.count[groups.member] > 2
    usual = float(np.median(off[repeated])) if repeated.any() else 1.0
    used = (off < options.outlying * max(1.0, usual)) | ~repeated
    # Mean of the rest.
    groups_used = groups_of(configuration[used])
    delta, covariance_used = delta[used], covariance[used]
    mean, stated = groups_used.mean(delta), groups_used.mean(covariance_used)
    # The part of the covariance that averages out, scaled up if the repeats scatter by more.
    independent = (1 - common) * stated
    residual = delta - mean[groups_used.member]
    freedom = float(np.sum(groups_used.count - 1))
    spread = 1.0
    if freedom:
        size = np.sum(_deviation(residual, independent[groups_used.member]) ** 2)
        spread = max(float(size) / freedom, 1.0)
    total = common * stated + spread * independent / groups_used.count[:, None, None]
    first = np.flatnonzero(used)[groups_used.first]
    reference = T[groups.first[groups.member]][used][groups_used.first]
    return MeanPoses(first, perturb(reference, mean), total, used, off)


def _deviation(delta: Array, covariance: Array) -> Array:
    """Root mean square (N,) of six whitened numbers (N, 6)."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), delta[..., None])[..., 0]
    return np.sqrt(np.mean(white**2, axis=-1))


def one_a_configuration(views: BoardViews, mount: int) -> tuple[PoseSet, tuple[Rejection, ...]]:
    """Measurements of a board on the platform, one for each configuration, and rejections of
    outlying repeats.
    """
    usable = np.flatnonzero(views.usable)
    rows = views.configuration[views.numbers[usable]]
    if not len(usable):
        return PoseSet.empty(), ()
    sigma2 = float(np.median(views.views.sigma[views.views.visible]) ** 2)
    noise2 = views.poses.noise**2
    common = min(noise2 / (noise2 + sigma2), views.options.most_common)
    means = mean_poses(
        rows,
        views.poses.T_camera_board[usable],
        views.poses.covariance[usable],
        common,
        options=views.options,
    )
    odd = tuple(
        views.rejection(int(views.numbers[usable[k]]), ODD_BOARD_REASON.format(means.off[k]))
        for k in np.flatnonzero(~means.used)
    )
    poses = pose_set(views.station, rows[means.first], mount, means.pose, means.covariance)
    by = groups_of(rows[means.used]).mean(views.poses.by_intrinsics[usable[means.used]])
    return replace(poses, by_intrinsics=by), odd


def board_size_column(poses: PoseSet, mount: int, file: str) -> Column:
    """Model violation of a board whose size differs from its file beyond the prior sigma.

    mount : the board's number.

    The violation has no prior, so if the size is also an unknown with one, the estimate is the full
    difference from the file.
    """
    own, by = by_board_size(poses, mount)

    def facts(value: Array, sigma: Array) -> dict[str, Any]:
        return {"value": value[0], "sigma": sigma[0], "file": file, "factor": 1 + value[0]}

    return Column("board.size", file, "board size", poses=by, pose_rows=own, facts=facts)
