"""[A] 3.3, last paragraph: stations joined by a calibration board that is fixed to the base.

The same photographs show legs and board. Where stations share too few legs, the board says how
they stand to each other; legs need then be seen by one station each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import apply, dot, inverse, perturb, pose_difference
from pkmcal.identify.problem import State
from pkmcal.measurements import Measurements, PoseSet


class Views(NamedTuple):
    """Frames in which joints are gathered: one a station, or one for all that a board joins.

    of_station : (S,) view of each station. T_camera_view : (S, 4, 4).
    of_mount : (M,) view of each board, -1 where none saw it. T_view_mount : (M, 4, 4).
    """

    of_station: Integers
    T_camera_view: Array
    of_mount: Integers
    T_view_mount: Array

    @property
    def n(self) -> int:
        """Number of views."""
        return int(self.of_station.max()) + 1


def apart(n_stations: int, n_mounts: int = 0) -> Views:
    """Every station a view of its own."""
    return Views(
        np.arange(n_stations),
        np.broadcast_to(np.eye(4), (n_stations, 4, 4)),
        np.full(n_mounts, -1),
        np.broadcast_to(np.eye(4), (n_mounts, 4, 4)),
    )


def together(T_camera_base: Array, n_mounts: int = 0) -> Views:
    """All stations in one view, their poses (S, 4, 4) given: the view is that base frame."""
    views = apart(len(T_camera_base), n_mounts)
    none = np.zeros(len(T_camera_base), dtype=int)
    return views._replace(of_station=none, T_camera_view=np.asarray(T_camera_base))


def mean_pose(T: Array, whiten: Array, group: Integers, n_groups: int) -> Array:
    """Poses (G, 4, 4) nearest to measured ones (N, 4, 4), by their covariances.

    Least squares of whiten @ (left perturbation), Gauss-Newton; every group has a member.
    """
    first = np.searchsorted(np.sort(group), np.arange(n_groups))
    mean = T[np.argsort(group, kind="stable")[first]]
    information = np.swapaxes(whiten, -1, -2) @ whiten
    for _ in range(5):
        normal, right = np.zeros((n_groups, 6, 6)), np.zeros((n_groups, 6))
        difference = pose_difference(T, mean[group])
        np.add.at(normal, group, information)
        np.add.at(right, group, (information @ difference[..., None])[..., 0])
        mean = perturb(mean, np.linalg.solve(normal, right[..., None])[..., 0])
    return mean


def joined_by_boards(poses: PoseSet, on_base: Booleans, n_stations: int) -> Views:
    """Views of the stations that boards on the base join; the others stay apart.

    on_base : (M,) mounts that are fixed to the base; poses on others are left out. A station
    that sees two boards joins the stations of both.
    """
    views = apart(n_stations, len(on_base))
    used = poses.select(on_base[poses.mount])
    if not len(used):
        return views
    pair, group = np.unique(used.station * len(on_base) + used.mount, return_inverse=True)
    T_camera_mount = mean_pose(used.T_station_target, used.whiten, group, len(pair))
    station, mount = np.divmod(pair, len(on_base))
    of_station, of_mount = np.full(n_stations, -1), np.full(len(on_base), -1)
    T_camera_view = np.tile(np.eye(4), (n_stations, 1, 1))
    T_view_mount = np.tile(np.eye(4), (len(on_base), 1, 1))
    for view, first in enumerate(_components(station, mount, n_stations, len(on_base))):
        of_station[first] = view
        for _ in range(n_stations):  # from the first station to its boards, to their stations
            for k, (s, m) in enumerate(zip(station, mount, strict=True)):
                if of_station[s] == view and of_mount[m] < 0:
                    of_mount[m] = view
                    T_view_mount[m] = inverse(T_camera_view[s]) @ T_camera_mount[k]
                elif of_mount[m] == view and of_station[s] < 0:
                    of_station[s] = view
                    T_camera_view[s] = T_camera_mount[k] @ inverse(T_view_mount[m])
    return Views(of_station, T_camera_view, of_mount, T_view_mount)


def _components(station: Integers, mount: Integers, n_stations: int, n_mounts: int) -> list[int]:
    """The first station of each set that boards join, in order."""
    label, board = np.arange(n_stations), np.full(n_mounts, n_stations)
    for _ in range(n_stations):
        np.minimum.at(board, mount, label[station])
        np.minimum.at(label, station, board[mount])
    return [int(s) for s in np.unique(label)]


def gathered_points(points: Array, found: Booleans, views: Views) -> tuple[Array, Booleans]:
    """Points of the stations (B, S, L, 3), found (S, L), as the views have them (B, V, L, 3).

    The mean, where several stations of a view know a point.
    """
    back = apply(inverse(views.T_camera_view)[:, None], points)
    return _mean(np.where(found[..., None], back, 0.0), found, views)


def gathered_directions(v: Array, found: Booleans, views: Views) -> tuple[Array, Booleans]:
    """Directions of either sign, (B, S, D, 3), as the views have them: unit (B, V, D, 3).

    One sign in each view: that of the first station that knows the direction.
    """
    rot = np.swapaxes(views.T_camera_view[:, None, :3, :3], -1, -2)
    back = np.where(found[..., None], (rot @ v[..., None])[..., 0], 0.0)
    same = views.of_station == views.of_station[:, None]
    first = np.argmax(same[:, :, None] & found[None], axis=1)
    reference = back[:, first, np.arange(v.shape[2])]
    mean, known = _mean(
        back * np.where(dot(back, reference) < 0, -1.0, 1.0)[..., None], found, views
    )
    size = np.sqrt(dot(mean, mean))[..., None]
    return mean / np.where(size > 0, size, 1.0), known


def _mean(values: Array, found: Booleans, views: Views) -> tuple[Array, Booleans]:
    member = (views.of_station == np.arange(views.n)[:, None]).astype(float)
    count = member @ found
    total = np.einsum("vs,bsli->bvli", member, values)
    return total / np.maximum(count, 1)[..., None], count > 0


def mount_poses(measurements: Measurements, state: State) -> Array:
    """Where the boards sit, (M, 4, 4): on the base or the platform, from the state's poses.

    Their mean over the photographs, by the covariances; a board that none shows is at the
    body's origin.
    """
    poses = measurements.poses
    out = np.tile(np.eye(4), (len(measurements.mounts), 1, 1))
    if not len(poses):
        return out
    moving = measurements.on_platform[poses.mount, None, None]
    body = np.where(moving, state.T_base_platform[poses.configuration], np.eye(4))
    T_camera_body = state.T_camera_base[poses.station] @ body
    T_body_board = inverse(T_camera_body) @ poses.T_station_target
    # the left perturbation of T_camera_board is that of T_body_board, turned
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = T_camera_body[:, :3, :3]
    names, group = np.unique(poses.mount, return_inverse=True)
    out[names] = mean_pose(T_body_board, poses.whiten @ turn, group, len(names))
    return out
