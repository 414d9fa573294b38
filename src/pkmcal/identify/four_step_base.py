"""[A] 3.3, step 2 of four: the base's joints from the stations' frames into one frame.

Items of the base are its L joint centres and then D directions: the revolute joints' axes, or
the one normal of a planar machine. A station sees directions with either sign; one sign over
all stations is chosen first (errata, A 9), by the drawing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.geometry.rigid import dot
from pkmcal.identify.four_step_axes import Axes
from pkmcal.identify.four_step_boards import Views
from pkmcal.identify.registration import SCALE, fit_body, fixes_pose, laid, minimise_dense
from pkmcal.mechanisms import Machine

NO_DIRECTIONS = np.zeros((0, 3))


class Base(NamedTuple):
    """The base's joints in its own frame, and the poses of the views on it.

    centres (B, L, 3) m. directions (B, D, 3) unit. T_view_base (B, V, 4, 4).
    """

    centres: Array
    directions: Array
    T_view_base: Array


class Items(NamedTuple):
    """What each of V views saw: centres (B, V, L, 3) m, seen (V, L), directions (B, V, D, 3)
    unit and seen (V, D); as drawn on the base: (L, 3) and (D, 3).
    """

    centres: Array
    centres_seen: Booleans
    directions: Array
    directions_seen: Booleans
    drawn: Array
    drawn_directions: Array

    @property
    def lever(self) -> float:
        """Length (m) by which a direction weighs as a centre does: the base's own size."""
        away = self.drawn - self.drawn.mean(axis=0)
        return float(np.sqrt(np.mean(dot(away, away))))

    @property
    def measured(self) -> Array:
        """All items, (B, V, L + D, 3) m."""
        return np.concatenate([self.centres, self.lever * self.directions], axis=2)

    @property
    def seen(self) -> Booleans:
        """Which were seen, (V, L + D)."""
        return np.concatenate([self.centres_seen, self.directions_seen], axis=1)

    @property
    def drawing(self) -> Array:
        """All items as drawn, (L + D, 3) m."""
        return np.concatenate([self.drawn, self.lever * self.drawn_directions])

    @property
    def n_directions(self) -> int:
        """D."""
        return len(self.drawn_directions)

    def fixed(self) -> Booleans:
        """Views (V,) whose own items fix their pose."""
        return fixes_pose(self.drawing, self.seen, self.n_directions)

    def placed(self, items: Array) -> Array:
        """Poses (B, V, 4, 4) of the views on items (B, L + D, 3)."""
        weight = np.broadcast_to(self.seen, self.measured.shape[:-1]).astype(float)
        return laid(items[:, None], self.measured, weight, self.n_directions)


def base_by_registration(items: Items, gauge: Array) -> Base:
    """Step 2 corrected, [A] 9: the views laid over each other, centres and axes together.

    min sum |R_v A_j + t_v - A_j^(v)|^2 + lever^2 |R_v n_i - n_i^(v)|^2 over A, n and the
    views' poses. gauge : (6, 3 (L + D)) rows that hold the base frame. Views that fix no pose
    are left out.
    """
    use = items.fixed()
    measured, weight = items.measured, items.seen.astype(float)
    shape = measured[:, use].shape[:-1]
    weight = np.broadcast_to(weight[use], shape)
    body = fit_body(measured[:, use], weight, gauge, items.drawing, directions=items.n_directions)
    return _base(items, body.points)


def base_by_products(items: Items, gauge: Array) -> Base:
    """Step 2 as printed, [A] 8-9: scalar products of V, vectors between centres and axes.

    C_1 = sum (V_p . V_q |view - V_p . V_q |base)^2, p <= q: squares belong in the sum, as the
    paper's count of C(n, 2) products has it. The vectors of a view run from its first seen
    centre to its others; axes are scaled by a length, on which the paper is silent.
    """
    plus, minus, p, q, view = _products(items.seen, len(items.drawn))
    n = len(items.drawing)
    vectors = _ends(items.measured, plus, minus)
    known = dot(vectors[:, view, p], vectors[:, view, q])
    k = np.arange(len(p))
    ends_p, ends_q = (plus[view, p], minus[view, p]), (plus[view, q], minus[view, q])

    def rows(x: Array, runs: Integers) -> tuple[Array, Array]:
        points = np.concatenate([x.reshape(len(x), n, 3), np.zeros((len(x), 1, 3))], axis=1)
        vp, vq = (points[:, end[0]] - points[:, end[1]] for end in (ends_p, ends_q))
        jac = np.zeros((len(x), len(k), n + 1, 3))
        for end, slope in ((ends_p, vq), (ends_q, vp)):
            jac[:, k, end[0]] += slope
            jac[:, k, end[1]] -= slope
        held = (x - items.drawing.ravel()) @ gauge.T
        value = np.concatenate([dot(vp, vq) - known[runs], held], axis=1)
        gauge_rows = np.broadcast_to(gauge, (len(x), *gauge.shape))
        jac = jac[:, :, :n].reshape(len(x), len(k), -1)
        return value / SCALE, np.concatenate([jac, gauge_rows], axis=1) / SCALE

    start = np.broadcast_to(items.drawing.ravel(), (len(known), 3 * n)).copy()
    return _base(items, minimise_dense(rows, start).state.reshape(-1, n, 3))


def _products(
    seen: Booleans, n_centres: int
) -> tuple[Integers, Integers, Integers, Integers, Integers]:
    """The vectors of each view, from item ``minus`` to ``plus`` (V, w), and the pairs p <= q.

    The item after the last stands for zero: an axis runs from it to itself.
    """
    zero = seen.shape[1]
    plus, minus = np.full((2, *seen.shape), zero)
    p, q, view = [], [], []
    for v, row in enumerate(seen):
        items = np.flatnonzero(row)
        centres = items[items < n_centres]
        ends = np.concatenate([centres[1:], items[items >= n_centres]])
        plus[v, : len(ends)] = ends
        minus[v, : max(len(centres) - 1, 0)] = centres[:1]
        i, j = np.triu_indices(len(ends))
        p, q, view = [*p, *i], [*q, *j], [*view, *[v] * len(i)]
    return plus, minus, np.array(p, dtype=int), np.array(q, dtype=int), np.array(view, dtype=int)


def _ends(items: Array, plus: Integers, minus: Integers) -> Array:
    """The vectors (B, V, w, 3) between items (B, V, n, 3), one more of zeros."""
    items = np.concatenate([items, np.zeros_like(items[:, :, :1])], axis=2)
    v = np.arange(len(plus))[:, None]
    return items[:, v, plus] - items[:, v, minus]


def _base(items: Items, points: Array) -> Base:
    """Centres and unit directions from the fitted items, and where the views stand."""
    n = len(items.drawn)
    directions = points[:, n:]
    size = np.sqrt(dot(directions, directions))[..., None]
    unit = directions / np.where(size > 0, size, 1.0)
    return Base(points[:, :n], unit, items.placed(points))


def with_signs(items: Items, rough: Array) -> Items:
    """Directions turned to the drawing's side; rough (B, V, 3, 3) rotates base to view."""
    drawn = (rough[:, :, None] @ items.drawn_directions[:, :, None])[..., 0]
    sign = np.where(dot(drawn, items.directions) < 0, -1.0, 1.0)
    return items._replace(directions=items.directions * sign[..., None])


def rough_rotations(machine: Machine, axes: Axes, items: Items, views: Views) -> Array:
    """Rotations (B, V, 3, 3) from base to view, good to the drawing's own errors.

    By the centres where three of them span a plane; else by the legs' directions that the
    drawing predicts at the readings, which one leg is enough for.
    """
    alone = Items(
        *items[:2],
        items.directions[:, :, :0],
        items.directions_seen[:, :0],
        items.drawn,
        NO_DIRECTIONS,
    )
    by_centres = alone.placed(items.drawn[None])[..., :3, :3]
    enough = alone.fixed()
    if enough.all():
        return by_centres
    return np.where(enough[:, None, None], by_centres, _by_directions(machine, axes, views))


def _by_directions(machine: Machine, axes: Axes, views: Views) -> Array:
    """Rotations (B, V, 3, 3) that lay the drawn directions of the legs on the seen ones."""
    joints = axes.readings[..., machine.layout.actuated >= 0]
    drawn = machine.with_values(machine.parameters.drawing)
    poses = drawn.forward_result(joints, drawn.home()).T_base_platform
    b = poses[..., None, :3, :3] @ drawn.platform_centers()[:, :, None]
    d = b[..., 0] + poses[..., None, :3, 3] - drawn.base_centers()
    d = d / np.sqrt(dot(d, d))[..., None]
    back = np.swapaxes(views.T_camera_view[axes.station, None, :3, :3], -1, -2)
    u = np.where(axes.seen[..., None], (back @ axes.u[..., None])[..., 0], 0.0)
    member = (views.of_station[axes.station] == np.arange(views.n)[:, None]).astype(float)
    h = np.einsum("vc,bcli,bclj->bvij", member, u, d, optimize=True)
    left, _, right = np.linalg.svd(h)
    left = left.copy()
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right
