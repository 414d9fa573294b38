"""[A] 3.3, step 2 of four: the base's joints from the stations' frames into one frame.

Items of the base are its L joint centres and then D directions: the revolute joints' axes, or the
normal of a planar machine. A station sees directions with either sign; a common sign for all
stations is chosen first, by the nominal model (errata, A 9).

A *view* is a frame in which items are gathered: a station's camera frame, or one frame for all
stations that a calibration board on the base joins (3.3, last paragraph). The same images show legs
and board; where stations share too few legs, the board determines their relative poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import (
    apply,
    dot,
    inverse,
    nearest_rotation,
    perturb,
    pose_difference,
)
from pkmcal.identify.methods.leg_axes import Axes
from pkmcal.identify.methods.registration import (
    extent,
    fit_body,
    fixes_pose,
    points_by,
    poses_laying_items,
)
from pkmcal.identify.state import State
from pkmcal.measurements import Measurements, PoseSet
from pkmcal.mechanisms import Machine


class StationViews(NamedTuple):
    """Frames in which joints are gathered: one for each station, or one for all that a board joins.

    of_station : (S,) view of each station. T_camera_view : (S, 4, 4).
    """

    of_station: Integers
    T_camera_view: Array

    @property
    def n(self) -> int:
        """Number of views."""
        return int(self.of_station.max()) + 1


def stations_apart(n_stations: int) -> StationViews:
    """Views with every station on its own."""
    return StationViews(np.arange(n_stations), np.tile(np.eye(4), (n_stations, 1, 1)))


def stations_together(T_camera_base: Array) -> StationViews:
    """One view for all stations with given poses (S, 4, 4); the view is that base frame."""
    return StationViews(np.zeros(len(T_camera_base), dtype=int), np.asarray(T_camera_base))


def mean_pose(T: Array, whiten: Array, group: Integers, n_groups: int) -> Array:
    """Mean poses (G, 4, 4) of measured poses (N, 4, 4), weighted by their covariances.

    Least squares of whiten @ (left perturbation), by Gauss-Newton; every group must have a member.
    """
    first = np.searchsorted(np.sort(group), np.arange(n_groups))
    mean = T[np.argsort(group, kind="stable")[first]]
    information = whiten.mT @ whiten
    for _ in range(5):
        normal, right = np.zeros((n_groups, 6, 6)), np.zeros((n_groups, 6))
        difference = pose_difference(T, mean[group])
        np.add.at(normal, group, information)
        np.add.at(right, group, (information @ difference[..., None])[..., 0])
        mean = perturb(mean, np.linalg.solve(normal, right[..., None])[..., 0])
    return mean


def joined_by_boards(poses: PoseSet, on_base: Booleans, n_stations: int) -> StationViews:
    """Views of the stations that boards on the base join; other stations stay on their own.

    on_base : (M,) mounts that are fixed to the base; poses of other mounts are ignored. A station
    that sees two boards joins the stations of both.
    """
    used = poses.select(on_base[poses.mount])
    if not len(used):
        return stations_apart(n_stations)
    # mean pose of each board in each station's camera frame
    pair, group = np.unique(used.station * len(on_base) + used.mount, return_inverse=True)
    T_camera_mount = mean_pose(used.T_station_target, used.whiten, group, len(pair))
    in_view = list(zip(*np.divmod(pair, len(on_base)), T_camera_mount, strict=True))
    of_station, of_mount = np.full(n_stations, -1), np.full(len(on_base), -1)
    T_camera_view = np.tile(np.eye(4), (n_stations, 1, 1))
    T_view_mount = np.tile(np.eye(4), (len(on_base), 1, 1))
    # views: from a first station to its boards, to their stations, and so on
    for first in range(n_stations):
        if of_station[first] >= 0:
            continue
        of_station[first] = view = of_station.max() + 1
        for _ in range(n_stations):
            for s, m, T in in_view:
                if of_station[s] == view and of_mount[m] < 0:
                    of_mount[m] = view
                    T_view_mount[m] = inverse(T_camera_view[s]) @ T
                elif of_mount[m] == view and of_station[s] < 0:
                    of_station[s] = view
                    T_camera_view[s] = T @ inverse(T_view_mount[m])
    return StationViews(of_station, T_camera_view)


def gathered_points(points: Array, valid: Booleans, views: StationViews) -> tuple[Array, Booleans]:
    """Points of the stations (B, S, L, 3), valid (S, L), in the views' frames (B, V, L, 3).

    The mean where several stations of a view have a point.
    """
    back = apply(inverse(views.T_camera_view)[:, None], points)
    return _mean(np.where(valid[..., None], back, 0.0), valid, views)


def gathered_directions(v: Array, valid: Booleans, views: StationViews) -> tuple[Array, Booleans]:
    """Directions of either sign (B, S, D, 3) in the views' frames, unit (B, V, D, 3).

    The sign in each view is that of the first station with the direction.
    """
    rot = views.T_camera_view[:, None, :3, :3].mT
    back = np.where(valid[..., None], (rot @ v[..., None])[..., 0], 0.0)
    same = views.of_station == views.of_station[:, None]
    first = np.argmax(same[:, :, None] & valid[None], axis=1)
    reference = back[:, first, np.arange(v.shape[2])]
    mean, observed = _mean(
        back * np.where(dot(back, reference) < 0, -1.0, 1.0)[..., None], valid, views
    )
    size = np.sqrt(dot(mean, mean))[..., None]
    return mean / np.where(size > 0, size, 1.0), observed


def _mean(values: Array, valid: Booleans, views: StationViews) -> tuple[Array, Booleans]:
    member = (views.of_station == np.arange(views.n)[:, None]).astype(float)
    count = member @ valid
    total = np.einsum("vs,bsli->bvli", member, values)
    return total / np.maximum(count, 1)[..., None], count > 0


def with_boards(
    measurements: Measurements, theta: Array, T_camera_base: Array, T_base_platform: Array
) -> State:
    """Session state from an estimate of one of these methods, with the boards' mean poses.

    The pose of a board on the base or the platform is the mean over its images, weighted by their
    covariances; a board without an image is at the body's origin.
    """
    poses = measurements.poses
    mounts = np.tile(np.eye(4), (len(measurements.mounts), 1, 1))
    if len(poses):
        moving = measurements.on_platform[poses.mount, None, None]
        body = np.where(moving, T_base_platform[poses.configuration], np.eye(4))
        T_camera_body = T_camera_base[poses.station] @ body
        # the left perturbation of T_camera_board is that of T_body_board, rotated
        turn = np.zeros((len(poses), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = T_camera_body[:, :3, :3]
        names, group = np.unique(poses.mount, return_inverse=True)
        T_body_board = inverse(T_camera_body) @ poses.T_station_target
        mounts[names] = mean_pose(T_body_board, poses.whiten @ turn, group, len(names))
    return State(
        theta,
        T_camera_base,
        T_base_platform,
        T_mount=mounts,
        on_platform=measurements.on_platform,
    )


class Base(NamedTuple):
    """Joints of the base in its own frame, and the poses of the views.

    centres : (B, L, 3) m.
    directions : (B, D, 3) unit.
    T_view_base : (B, V, 4, 4).
    """

    centres: Array
    directions: Array
    T_view_base: Array


class Items(NamedTuple):
    """Items of the base in V views, and their nominal values.

    centres : (B, V, L, 3) m, visible (V, L).
    directions : (B, V, D, 3) unit, visible (V, D).
    drawn, drawn_directions : (L, 3) and (D, 3) of the nominal model.
    """

    centres: Array
    centres_visible: Booleans
    directions: Array
    directions_visible: Booleans
    drawn: Array
    drawn_directions: Array

    @property
    def lever(self) -> float:
        """Length (m) by which a direction has the weight of a centre: the base's own size."""
        return extent(self.drawn)

    @property
    def measured(self) -> Array:
        """All items, (B, V, L + D, 3) m."""
        return np.concatenate([self.centres, self.lever * self.directions], axis=2)

    @property
    def visible(self) -> Booleans:
        """Visible items, (V, L + D)."""
        return np.concatenate([self.centres_visible, self.directions_visible], axis=1)

    @property
    def nominal(self) -> Array:
        """All items of the nominal model, (L + D, 3) m."""
        return np.concatenate([self.drawn, self.lever * self.drawn_directions])

    @property
    def n_directions(self) -> int:
        """Number of directions, D."""
        return len(self.drawn_directions)

    def fixed(self) -> Booleans:
        """Views (V,) whose own items determine their pose."""
        return fixes_pose(self.nominal, self.visible, self.n_directions)

    def placed(self, items: Array) -> Array:
        """Poses (B, V, 4, 4) of the views that fit items (B, L + D, 3)."""
        weight = np.broadcast_to(self.visible, self.measured.shape[:-1]).astype(float)
        return poses_laying_items(items[:, None], self.measured, weight, self.n_directions)


def base_by_registration(items: Items, gauge: Array) -> Base:
    """Step 2 corrected, [A] 9: registration of the views, centres and axes together.

    min sum |R_v A_j + t_v - A_j^(v)|^2 + lever^2 |R_v n_i - n_i^(v)|^2 over A, n and the views'
    poses. gauge : (6, 3 (L + D)) rows that fix the base frame. Views without a determined pose are
    ignored.
    """
    use = items.fixed()
    measured, weight = items.measured, items.visible.astype(float)
    shape = measured[:, use].shape[:-1]
    weight = np.broadcast_to(weight[use], shape)
    body = fit_body(measured[:, use], weight, gauge, items.nominal, directions=items.n_directions)
    return _base(items, body.points)


def base_by_products(items: Items, gauge: Array) -> Base:
    """Step 2 as printed, [A] 8-9: scalar products of V, vectors between centres and axes.

    C_1 = sum (V_p . V_q |view - V_p . V_q |base)^2, p <= q: squares belong in the sum, as the
    paper's count of C(n, 2) products shows. The vectors of a view run from its first visible centre
    to its others; axes are scaled by a length, which the paper does not specify.
    """
    n = len(items.nominal)
    to_p, to_q, view = [np.zeros((0, n))], [np.zeros((0, n))], [np.zeros(0, dtype=int)]
    for v, in_view in enumerate(items.visible):
        vectors = np.eye(n)[in_view]  # rows that give the view's vectors from its items
        centres = int(items.centres_visible[v].sum())
        if centres:
            vectors[:centres] -= vectors[0].copy()
            vectors = vectors[1:]
        p, q = np.triu_indices(len(vectors))
        to_p, to_q = [*to_p, vectors[p]], [*to_q, vectors[q]]
        view.append(np.full(len(p), v))
    by_p, by_q = np.concatenate(to_p), np.concatenate(to_q)
    measured = items.measured[:, np.concatenate(view)]
    product = dot(*(np.einsum("kn,bknc->bkc", by, measured) for by in (by_p, by_q)))

    def products(points: Array, runs: Integers) -> tuple[Array, Array]:
        vp, vq = by_p @ points, by_q @ points
        jac = by_p[..., None] * vq[:, :, None] + by_q[..., None] * vp[:, :, None]
        return dot(vp, vq) - product[runs], jac

    return _base(items, points_by(products, items.nominal, gauge, len(product)))


def _base(items: Items, points: Array) -> Base:
    """Centres and unit directions from the fitted items, and the poses of the views."""
    n = len(items.drawn)
    directions = points[:, n:]
    size = np.sqrt(dot(directions, directions))[..., None]
    unit = directions / np.where(size > 0, size, 1.0)
    return Base(points[:, :n], unit, items.placed(points))


def with_signs(items: Items, rough: Array) -> Items:
    """Items with directions on the nominal model's side; rough : (B, V, 3, 3) rotations base to
    view.
    """
    drawn = (rough[:, :, None] @ items.drawn_directions[:, :, None])[..., 0]
    sign = np.where(dot(drawn, items.directions) < 0, -1.0, 1.0)
    return items._replace(directions=items.directions * sign[..., None])


def rough_rotations(machine: Machine, axes: Axes, items: Items, views: StationViews) -> Array:
    """Rotations (B, V, 3, 3) from base to view, as accurate as the nominal model.

    From the centres where three of them span a plane; else from the legs' directions that the
    nominal model predicts at the readings, for which one leg is enough.
    """
    alone = items._replace(
        directions=items.directions[:, :, :0],
        directions_visible=items.directions_visible[:, :0],
        drawn_directions=items.drawn_directions[:0],
    )
    by_centres = alone.placed(items.drawn[None])[..., :3, :3]
    enough = alone.fixed()
    if enough.all():
        return by_centres
    return np.where(enough[:, None, None], by_centres, _by_directions(machine, axes, views))


def _by_directions(machine: Machine, axes: Axes, views: StationViews) -> Array:
    """Rotations (B, V, 3, 3) that fit the nominal directions of the legs to the measured ones."""
    joints = axes.readings[..., machine.layout.actuated >= 0]
    drawn = machine.with_values(machine.parameters.nominal)
    poses = drawn.forward_result(joints, drawn.home()).T_base_platform
    b = poses[..., None, :3, :3] @ drawn.platform_centers()[:, :, None]
    d = b[..., 0] + poses[..., None, :3, 3] - drawn.base_centers()
    d = d / np.sqrt(dot(d, d))[..., None]
    back = views.T_camera_view[axes.station, None, :3, :3].mT
    u = np.where(axes.visible[..., None], (back @ axes.u[..., None])[..., 0], 0.0)
    member = (views.of_station[axes.station] == np.arange(views.n)[:, None]).astype(float)
    h = np.einsum("vc,bcli,bclj->bvij", member, u, d, optimize=True)
    return nearest_rotation(h)
