"""Poses of a board from its corners, for any central camera: linear from rays, then refined."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.contract import Camera
from pkmcal.cameras.fit import Views, covariance_of, fit_camera, fit_poses
from pkmcal.geometry.rigid import dot, pose, rotation


class BoardPoses(NamedTuple):
    """Where a board was in each of V views.

    T_camera_board : (V, 4, 4). covariance : (V, 6, 6) of (omega, tau), left perturbation, by the
    corners' noise alone. by_intrinsics : (V, 6, n) derivative by the camera's parameters; with
    their covariance C a pose's whole covariance is covariance + by_intrinsics C by_intrinsics^T.
    residuals : (V, N, 2) px. weight : (V, N). noise : px beyond the corners' own.
    """

    T_camera_board: Array
    covariance: Array
    by_intrinsics: Array
    residuals: Array
    weight: Array
    noise: float


def board_poses(camera: Camera, views: Views) -> BoardPoses:
    """The board's pose in every view, by maximum likelihood with a known camera."""
    start = settled_poses(camera, views)
    fit = fit_camera(camera, np.zeros(0, dtype=int), views, start)
    # The derivative by all intrinsics, though none of them is estimated here.
    as_if_free = replace(fit, free=np.arange(len(camera.parameters)))
    return BoardPoses(
        fit.T_camera_board,
        covariance_of(fit, views)[1],
        covariance_of(as_if_free, views)[2],
        fit.residuals,
        fit.weight,
        fit.tau,
    )


def settled_poses(camera: Camera, views: Views, start: Array | None = None) -> Array:
    """Poses (V, 4, 4) by least squares, the better of each view's two tilts."""
    start = linear_poses(camera.ray(views.pixels), views.points) if start is None else start
    scale = views.seen.astype(float)
    first, cost = fit_poses(camera, views, start, scale)
    second, other = fit_poses(camera, views, tilted_back(first, views.points), scale)
    return np.where((other < cost)[:, None, None], second, first)


def tilted_back(T_camera_board: Array, points: Array) -> Array:
    """The pose that looks almost the same from far away: the board tilted the other way.

    Half a turn about the line of sight through the board's middle undoes, in the picture, half a
    turn of the board about its own normal.
    """
    middle = points.mean(axis=0)
    rot = T_camera_board[..., :3, :3]
    centre = rot @ middle + T_camera_board[..., :3, 3]
    sight = centre / np.linalg.norm(centre, axis=-1, keepdims=True)
    turned = rotation(np.pi * sight) @ rot @ np.diag([-1.0, -1.0, 1.0])
    return pose(turned, centre - turned @ middle)


def linear_poses(rays: Array, points: Array) -> Array:
    """Poses (..., 4, 4) with rays (..., N, 3) parallel to T points (N, 3), points on a plane z = 0.

    ray x (r1 X + r2 Y + t) = 0 is linear in r1, r2 and t, for rays to all sides; r1 and r2 are
    made orthonormal afterwards. NaN rays are left out.
    """
    known = np.asarray(np.isfinite(rays).all(axis=-1))
    s = np.where(known[..., None], rays, 0.0)
    middle, spread = points[:, :2].mean(axis=0), points[:, :2].std() + 1e-12
    plane = np.concatenate([(points[:, :2] - middle) / spread, np.ones((len(points), 1))], axis=-1)
    # sum over corners of kron(X X^T, I - s s^T), the normal matrix of the cross products
    across = known[..., None, None] * np.eye(3) - s[..., :, None] * s[..., None, :]
    normal = np.einsum("na,nb,...nij->...aibj", plane, plane, across, optimize=True)
    normal = normal.reshape(*rays.shape[:-2], 9, 9)
    vector = np.linalg.eigh(normal)[1][..., 0].reshape(*rays.shape[:-2], 3, 3)
    m1, m2, m0 = vector[..., 0, :] / spread, vector[..., 1, :] / spread, vector[..., 2, :]
    m0 = m0 - m1 * middle[0] - m2 * middle[1]
    size = np.sqrt(np.linalg.norm(m1, axis=-1) * np.linalg.norm(m2, axis=-1))
    size = np.maximum(size, 1e-300)[..., None]
    ahead = np.einsum("...ni,...ni->...", s, _planar(m1, m2, m0, points))
    size = size * np.where(ahead < 0, -1.0, 1.0)[..., None]
    m1, m2, t = m1 / size, m2 / size, m0 / size
    u, _, vt = np.linalg.svd(np.stack([m1, m2], axis=-1), full_matrices=False)
    r12 = u @ vt
    rot = np.concatenate([r12, np.cross(r12[..., 0], r12[..., 1])[..., None]], axis=-1)
    return pose(rot, t)


def _planar(m1: Array, m2: Array, m0: Array, points: Array) -> Array:
    x, y = points[:, :1], points[:, 1:2]
    return m1[..., None, :] * x + m2[..., None, :] * y + m0[..., None, :]


def line_offsets(camera: Camera, pixels: Array, lines: tuple[tuple[int, ...], ...]) -> Array:
    """Distances (n,) px of corners from the great circle through their line's rays.

    pixels : (N, 2) of one view, NaN where not seen. lines : ids of corners on a straight line.
    A line's plane is fitted to its rays, weighted so that pixels count, not angles.
    """
    rays = camera.ray(pixels)
    by_pixel = camera.ray_jacobians(pixels)[0]
    good = np.asarray(np.isfinite(rays).all(axis=-1))
    out: list[Array] = []
    for line in lines:
        ids = np.array(line)[good[list(line)]]
        if len(ids) < 3:
            continue
        s, turn = rays[ids], by_pixel[ids]
        weight, normal = np.ones(len(ids)), np.zeros(3)
        for _ in range(3):
            normal = np.linalg.eigh((s * weight[:, None]).T @ s)[1][:, 0]
            slope = np.linalg.norm(np.einsum("nik,i->nk", turn, normal), axis=-1)
            weight = 1 / np.maximum(slope, 1e-12) ** 2
        out.append(dot(s, normal) * np.sqrt(weight))
    return np.concatenate(out) if out else np.zeros(0)
