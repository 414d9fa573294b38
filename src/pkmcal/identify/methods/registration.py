"""Registration of points of one rigid body in many frames: the body and its poses together.

The corrected form of [A] 9 (base centres in the stations' frames) and of [A] 16 (platform centres
in the images' frames): ``min sum w |T_k p_j - m_kj|^2`` over points p and poses T_k. Products of
distances between coplanar points, as printed, determine the third coordinate to second order only;
the registration determines it to first order.

Items of a body are points, and after them directions (joint axes), which rotate but do not shift;
directions are scaled to metres by a length, so that both kinds can be weighted together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import dot, nearest_rotation, perturb, pose, register, rotation, skew
from pkmcal.levels import NEGLIGIBLE
from pkmcal.solver.elimination import Linear
from pkmcal.solver.search import Solution, Values, minimise

REGISTRATION_UNIT_SIGMA = 1e-4
"""Standard deviation, in metres, of all rows; it only determines when the search stops."""
LOOSE_ITEMS_EIGENVALUE = NEGLIGIBLE**2
"""Eigenvalue, relative to 1 for an item that one frame determines, below which a motion of items is
unidentifiable: a shape error then appears with a hundredth of its size."""
ANY_MOTION = np.eye(6)
"""Motion (6, d) of a free body; columns as in :data:`pkmcal.mechanisms.document.MOTION_DIRECTIONS`.
"""


class RegisteredBody(NamedTuple):
    """Items (B, n, 3) of a body, and poses (B, K, 4, 4) from the body to the frames."""

    points: Array
    poses: Array


@dataclass(frozen=True)
class BodyProblem:
    """solver.LeastSquares for a rigid body; measured (B, K, n, 3), weight (B, K, n).

    gauge : (c, 3 n) rows that fix the body's frame.
    nominal : (n, 3) their reference.
    shifts : (n,) 1 for points, 0 for directions.
    motion : (6, d) of the body.

    Jacobian of frame k (own columns are eliminated by the Schur complement):

                     items   | own (pose k)
        frame k    [   X     |     X       ]
        gauge      [   X     |             ]
    """

    measured: Array
    weight: Array
    gauge: Array
    nominal: Array
    shifts: Array
    motion: Array

    def residuals(self, state: RegisteredBody) -> Values:
        """Weighted differences, (B, K, 3 n), and the gauge's rows."""
        rot, shift = state.poses[..., None, :3, :3], state.poses[..., None, :3, 3]
        turned = (rot @ state.points[:, None, :, :, None])[..., 0]
        w = np.sqrt(self.weight)[..., None] / REGISTRATION_UNIT_SIGMA
        value = (turned + self.shifts[:, None] * shift - self.measured) * w
        value = np.where(w > 0, value, 0.0).reshape(*value.shape[:2], -1)
        held = (state.points - self.nominal).reshape(len(value), -1) @ self.gauge.T
        return Values(value, held / REGISTRATION_UNIT_SIGMA)

    def linearize(self, state: RegisteredBody) -> Linear:
        """Residuals and exact Jacobian."""
        shape, n = self.measured.shape, self.measured.shape[2]
        rot = state.poses[..., None, :3, :3]
        turned = (rot @ state.points[:, None, :, :, None])[..., 0]
        w = np.sqrt(self.weight)[..., None] / REGISTRATION_UNIT_SIGMA
        by_shared = np.zeros((*shape, n, 3))
        j = np.arange(n)
        by_shared[:, :, j, :, j, :] = np.moveaxis(
            np.broadcast_to(rot, (*shape, 3)) * w[..., None], 2, 0
        )
        by_own = np.zeros((*shape, 6))
        by_own[..., :3] = -skew(turned) * w[..., None]
        by_own[..., 3:] = np.eye(3) * (self.shifts[:, None] * w)[..., None]
        values = self.residuals(state)
        rows = values.value.shape
        return Linear(
            values.value,
            by_shared.reshape(*rows, 3 * n),
            by_own.reshape(*rows, 6) @ self.motion,
            np.ones(rows, dtype=bool),
            values.shared_value,
            self.gauge / REGISTRATION_UNIT_SIGMA,
        )

    def retract(self, state: RegisteredBody, shared: Array, own: Array) -> RegisteredBody:
        """Retract the body along a step."""
        poses = perturb(state.poses, own @ self.motion.T)
        return RegisteredBody(state.points + shared.reshape(state.points.shape), poses)

    def select(self, runs: Integers) -> BodyProblem:
        """Problem of some runs."""
        return replace(self, measured=self.measured[runs], weight=self.weight[runs])


def fit_body(
    measured: Array,
    weight: Array,
    gauge: Array,
    nominal: Array,
    *,
    directions: int = 0,
    motion: Array = ANY_MOTION,
) -> RegisteredBody:
    """Body and its poses by registration; [A] 9 and 16 corrected.

    measured : (B, K, n, 3) m.
    weight : (B, K, n), 0 where not visible; frames that leave their pose undetermined (fewer than
        three points of a spatial body) must be removed.
    gauge : (c, 3 n) rows on the items.
    nominal : (n, 3) m, the start.
    directions : number of the last items that are directions.
    motion : (6, d) of the body in its frames.
    """
    measured = np.where(weight[..., None] > 0, measured, 0.0)
    points = np.broadcast_to(nominal, (measured.shape[0], *nominal.shape)).copy()
    shifts = (np.arange(len(nominal)) < len(nominal) - directions).astype(float)
    start = RegisteredBody(
        points, poses_laying_items(points[:, None], measured, weight, directions, motion)
    )
    return minimise(BodyProblem(measured, weight, gauge, nominal, shifts, motion), start).state


def poses_laying_items(
    items: Array, measured: Array, weight: Array, directions: int = 0, motion: Array = ANY_MOTION
) -> Array:
    """Poses (..., 4, 4) within ``motion`` that fit items (..., n, 3) to measured ones.

    Least squares over the points, and over the last ``directions`` items without their shift: the
    rotation that maximizes tr(R^T H), H = sum w m p^T about the points' means (Kabsch; the angle
    for a motion in the plane, the identity for a translation).
    """
    w = np.maximum(weight, 1e-12)  # a frame without visible items gets some pose, not NaN
    n = items.shape[-2] - directions
    if motion.shape[1] == 6 and directions == 0:
        return register(items, measured, w)
    share = w[..., :n] / w[..., :n].sum(axis=-1, keepdims=True)
    mean, visible = (np.sum(share[..., None] * p[..., :n, :], axis=-2) for p in (items, measured))
    centred = items.copy() * np.ones(measured.shape)
    target = measured * np.ones(centred.shape)
    centred[..., :n, :] -= mean[..., None, :]
    target[..., :n, :] -= visible[..., None, :]
    h = target.mT @ (w[..., None] * centred)
    if motion.shape[1] == 6:
        rot = nearest_rotation(h)
    else:
        omega = np.zeros(h.shape[:-1])
        if motion[2].any():  # about z
            omega[..., 2] = np.arctan2(h[..., 1, 0] - h[..., 0, 1], h[..., 0, 0] + h[..., 1, 1])
        rot = rotation(omega)
    shift = visible - (rot @ mean[..., None])[..., 0]
    return pose(rot, shift @ motion[3:] @ motion[3:].T)


def extent(points: Array) -> float:
    """RMS distance (m) of points (n, 3) from their mean."""
    away = points - points.mean(axis=0)
    return float(np.sqrt(np.mean(dot(away, away))))


def loose(
    items: Array, visible: Booleans, directions: int = 0, motion: Array = ANY_MOTION
) -> Array:
    """Unidentifiable directions (n, 3, f) of a body's items in all frames together.

    The null space of the registration's Jacobian at ``items`` (n, 3), without the body's own rigid
    motions, for frames with ``visible`` (K, n) items. f = 0 if all items are determined. Every item
    should be visible in some frame.
    """
    own = _own_motions(items, directions, motion)
    mask = np.repeat(visible, 3, axis=1)[:, :, None]
    # orthonormal basis of each frame's motions, without motions that its items do not show
    u, s, _ = np.linalg.svd(own * mask, full_matrices=False)
    u = u * (s > LOOSE_ITEMS_EIGENVALUE * np.sqrt(len(items)))[:, None, :]
    # rows left by the frames' poses (Schur complement), with the rigid motions added
    normal = np.sum(np.eye(len(own)) * mask - u @ u.mT, axis=0)
    rigid = np.linalg.qr(own)[0]
    values, vectors = np.linalg.eigh(normal + rigid @ rigid.T)
    return vectors[:, values < LOOSE_ITEMS_EIGENVALUE].reshape(len(items), 3, -1)


def parts_of(
    items: Array, visible: Booleans, free: Array, directions: int = 0, motion: Array = ANY_MOTION
) -> tuple[Booleans, Booleans]:
    """Two sets of items (n,) that ``free`` (n, 3, f), from :func:`loose`, moves against each other.

    The first set moves while the items of one frame are at rest, the second while another frame's
    are. Items of both sets, such as two joints about whose line the rest rotates, are in neither.
    Distances are no criterion: out of a plane of joints they change to second order only.
    """
    own = _own_motions(items, directions, motion)
    flat = free.reshape(len(own), -1)
    stay = []
    for frame in visible:
        mask = np.repeat(frame, 3)
        held = own @ np.linalg.lstsq(own[mask], flat[mask], rcond=LOOSE_ITEMS_EIGENVALUE)[0]
        rate = np.linalg.norm((flat - held).reshape(len(items), -1), axis=1)
        stay.append(rate < NEGLIGIBLE * rate.max())
    first = next((s for s in stay if not s.all()), np.zeros(len(items), dtype=bool))
    # if one frame has nearly all items, the other frame need not see beyond it
    beyond = (s for s, frame in zip(stay, visible, strict=True) if (frame & ~first).any())
    other = next(beyond, ~first)
    return first & ~other, other & ~first


def fixes_pose(
    items: Array, visible: Booleans, directions: int = 0, motion: Array = ANY_MOTION
) -> Booleans:
    """Frames (K,) whose visible items (K, n) determine their pose of the body."""
    own = _own_motions(items, directions, motion)
    s = np.linalg.svd(own * np.repeat(visible, 3, axis=1)[:, :, None], compute_uv=False)
    return s[:, -1] > LOOSE_ITEMS_EIGENVALUE * np.sqrt(len(items))


def _own_motions(items: Array, directions: int, motion: Array) -> Array:
    """Motions (3 n, d) of the items with their body, rotations scaled by the body's size."""
    n = len(items) - directions
    p = items.copy()
    p[:n] -= items[:n].mean(axis=0)
    own = np.zeros((len(items), 3, 6))
    size = np.sqrt(np.mean(dot(p, p))) or 1.0  # a single point has none
    own[..., :3], own[:n, :, 3:] = -skew(p / size), np.eye(3)
    return (own @ motion).reshape(-1, motion.shape[1])


@dataclass(frozen=True)
class Dense:
    """Batched dense least-squares problem on vectors (B, n), for the papers' criteria.

    rows : function of x (b, n) and the runs' indices (b,), with values (b, r) and Jacobian
    (b, r, n).
    """

    rows: Callable[[Array, Integers], tuple[Array, Array]]
    runs: Integers

    def residuals(self, state: Array) -> Values:
        """Values only."""
        value, _ = self.rows(state, self.runs)
        return Values(value[:, None], np.zeros((len(value), 0)))

    def linearize(self, state: Array) -> Linear:
        """Values and Jacobian, without own unknowns."""
        value, jac = self.rows(state, self.runs)
        usable: Booleans = np.ones((len(value), 1, value.shape[-1]), dtype=bool)
        own = np.zeros((*usable.shape, 0))
        n = state.shape[-1]
        return Linear(
            value[:, None], jac[:, None], own, usable, np.zeros((len(value), 0)), np.zeros((0, n))
        )

    @staticmethod
    def retract(state: Array, shared: Array, own: Array) -> Array:
        """Retract the vector along a step."""
        return state + shared + 0 * own.sum()

    def select(self, runs: Integers) -> Dense:
        """Problem of some runs."""
        return replace(self, runs=self.runs[runs])


def minimise_dense(
    rows: Callable[[Array, Integers], tuple[Array, Array]], start: Array
) -> Solution:
    """Batched Levenberg-Marquardt on plain vectors (B, n)."""
    return minimise(Dense(rows, np.arange(len(start))), start)


def points_by(
    criterion: Callable[[Array, Integers], tuple[Array, Array]],
    nominal: Array,
    gauge: Array,
    n_runs: int,
) -> Array:
    """Points (B, n, 3) that minimize a criterion.

    gauge : (c, 3 n) rows that fix the points' frame.
    criterion : function of points (b, n, 3) and the runs' indices (b,), with values (b, r) in m (or
        m^2) and their derivatives (b, r, n, 3).
    nominal : (n, 3), the start.
    """

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        value, jac = criterion(x.reshape(len(x), *nominal.shape), runs)
        held = (x - nominal.ravel()) @ gauge.T
        by_gauge = np.broadcast_to(gauge, (len(x), *gauge.shape))
        jac = np.concatenate([jac.reshape(*value.shape, nominal.size), by_gauge], axis=1)
        return np.concatenate(
            [value, held], axis=1
        ) / REGISTRATION_UNIT_SIGMA, jac / REGISTRATION_UNIT_SIGMA

    start = np.broadcast_to(nominal.ravel(), (n_runs, nominal.size)).copy()
    return minimise_dense(rows, start).state.reshape(-1, *nominal.shape)
