"""A board fixed to the base: whether it stood still in a station's photographs, and where.

Camera and board both stand, so all photographs show the board in the same pixels. Where they do
not, the board or the camera was moved, and everything that the station saw is in doubt.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.cameras.fit import Views
from pkmcal.cameras.resection import board_poses
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import apply, pose_difference, skew
from pkmcal.observe.edges import Rejection
from pkmcal.observe.poses import PoseSet
from pkmcal.observe.targets import BoardViews, pose_set

STILL = 0.2
"""px, rms over the board, that two photographs may differ by beyond their noise. A camera on a
tripod keeps a tenth; less than this hardly shows in the edges of legs, which are as uncertain."""
SURE = 4.0
"""Standard deviations of a photograph's own noise beyond that."""
MOST_ODD = 1 / 3
"""Share of the photographs that may disagree one by one; with more, the board was never still."""


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

    def poses(self, seen: BoardViews, mount: int) -> PoseSet:
        """One measurement; the configuration of its row says nothing, for nothing moves."""
        row = seen.configuration[seen.shown[self.agreed]][:1]
        return pose_set(seen.station, row, mount, self.T_camera_board[None], self.covariance[None])


def standing(seen: BoardViews) -> Standing | None:
    """The board's one pose in a station's photographs; None where none shows it surely.

    Raises `InputError` where the board or the camera was moved between photographs.
    """
    if not seen.usable.any():
        return None
    there, noise = _places(seen)
    agreed = _agreed(there, noise, seen.usable)
    odd = seen.usable & ~agreed
    _check_still(seen, there, agreed)
    T_camera_board, covariance, rest = _mean_pose(seen, agreed)
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
            seen.rejection(
                int(seen.shown[k]),
                f"the board stands {distance[k]:.1f} px from where the other photographs show it",
            )
            for k in np.flatnonzero(odd)
        ),
    )


def _places(seen: BoardViews) -> tuple[Array, Array]:
    """Where each photograph's pose puts the board's corners, (F, N, 2) px, and the standard
    deviation of that, rms over the board, (F,) px.
    """
    T = seen.poses.T_camera_board[:, None]
    there = apply(T, seen.board.points)
    by_point = seen.camera.project_jacobians(there)[0]
    by_pose = np.concatenate([-by_point @ skew(there - T[..., :3, 3]), by_point], axis=-1)
    variance = np.einsum("fnip,fpq,fniq->fni", by_pose, seen.poses.covariance, by_pose)
    return seen.camera.project(there), np.sqrt(np.nanmean(variance, axis=(1, 2)))


def _agreed(there: Array, noise: Array, usable: Booleans) -> Booleans:
    """(F,) the photographs that agree with the one that agrees with the most others."""
    limit = np.sqrt(STILL**2 + SURE**2 * (noise[:, None] ** 2 + noise**2))
    agree = (_distance(there[:, None], there) <= limit) & usable & usable[:, None]
    return agree[int(np.argmax(agree.sum(axis=1)))]


def _distance(there: Array, other: Array) -> Array:
    """Root mean square over the board of the distance of its corners; (..., N, 2) px."""
    return np.sqrt(np.nanmean(np.sum((there - other) ** 2, axis=-1), axis=-1))


def _check_still(seen: BoardViews, there: Array, agreed: Booleans) -> None:
    """Raise `InputError` where photographs disagree that follow one another, or too many do."""
    used = np.flatnonzero(seen.usable)
    runs = [
        (bool(same), [int(k) for k in run]) for same, run in groupby(used, key=lambda k: agreed[k])
    ]
    long = next((n for n, (same, run) in enumerate(runs) if not same and len(run) > 1), None)
    if long is not None:
        # A run at the beginning ends with the movement, any other begins with it.
        before, after = (runs[long][1], runs[long + 1][1]) if long == 0 else (
            runs[long - 1][1], runs[long][1]
        )  # fmt: skip
        raise _moved(seen, there, before, after)
    odd = int((seen.usable & ~agreed).sum())
    if odd > MOST_ODD * len(used) and odd > 1:
        raise InputError(
            "the board, or the camera, did not stand still",
            where=_folder(seen),
            found=f"{odd} of {len(used)} photographs show it in other places than the rest",
            expected=_EXPECTED,
        )


_EXPECTED = "a board fixed to the base, and a camera that stands still: all photographs of a " \
    "station show the board in one place"  # fmt: skip


def _moved(seen: BoardViews, there: Array, before: list[int], after: list[int]) -> InputError:
    """The error that names the photographs between which the board moved."""
    names, poses = seen.names, seen.poses.T_camera_board
    pixels = float(_distance(there[before[-1]], there[after[0]]))
    middle = seen.board.points.mean(axis=0)
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


def _folder(seen: BoardViews) -> str:
    return seen.names[0].rpartition("/")[0] or seen.names[0]


def _mean_pose(seen: BoardViews, agreed: Booleans) -> tuple[Array, Array, float]:
    """The pose by the means of the corners over photographs, its covariance (6, 6), and the
    noise px that the means leave unexplained.

    What the photographs do not share (pixel noise) averages out, and its size is told by their
    scatter; what they share (the camera model, the board's print) remains, and does not.
    """
    views, poses = seen.views, seen.poses
    used = agreed[:, None] & (poses.weight > 0.5)
    count = used.sum(axis=0)
    pixels = np.where(used[..., None], views.pixels, 0.0).sum(axis=0)
    pixels = np.where(count[:, None] > 0, pixels / np.maximum(count, 1)[:, None], np.nan)
    off = np.where(used[..., None], views.pixels - pixels, 0.0)
    freedom = 2 * int(np.sum(np.maximum(count - 1, 0)))
    single = np.sqrt(np.where(used, views.sigma**2, 0.0).sum(axis=0) / np.maximum(count, 1))
    noise = np.sqrt(np.sum(off**2) / freedom) if freedom > 0 else single
    sigma = noise / np.sqrt(np.maximum(count, 1))
    mean = board_poses(seen.camera, Views(views.points, pixels[None], sigma[None]))
    covariance = mean.covariance[0] + _wandering(seen, agreed, mean.T_camera_board[0], noise)
    return mean.T_camera_board[0], covariance, mean.noise


def _wandering(seen: BoardViews, agreed: Booleans, T_camera_board: Array, noise: Array) -> Array:
    """Covariance (6, 6) of the mean by what moves the whole board from photograph to photograph
    (a floor that shakes), beyond what the corners' noise does; zero where there is no more.
    """
    count = int(agreed.sum())
    if count < 2:
        return np.zeros((6, 6))
    sigma2 = np.mean(seen.views.sigma[seen.views.seen] ** 2) + seen.poses.noise**2
    # each pose's covariance, had its corners only the noise that differs between photographs
    each = seen.poses.covariance[agreed] * (np.mean(np.square(noise)) / sigma2)
    off = pose_difference(seen.poses.T_camera_board[agreed], T_camera_board)
    chi2 = np.einsum("fi,fij,fj->", off, np.linalg.inv(each), off)
    spread = chi2 / (6 * (count - 1))
    return max(spread - 1.0, 0.0) * each.mean(axis=0) / count
