"""What a camera is worth on views that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array
from pkmcal.cameras.fit import Fit, Views, fit_poses, inverted, refit
from pkmcal.cameras.resection import line_offsets
from pkmcal.geometry.rigid import apply
from pkmcal.solver import eliminate, transposed

FOLDS = 10
"""Parts that the views are dealt into; each is predicted by a camera fitted to the others."""
CHANCE = 1.5
"""Disagreement of views (square) that chance alone explains, with ten views or so."""


@dataclass(frozen=True)
class HeldOut:
    """Errors on held-out views.

    residuals : (V, N, 2) px; each view's pose is fitted, the camera is that of other views.
    rms : px, of the residuals' lengths. by_view : (V,) the same by view.
    straightness : px, root mean square distance of corners from the great circle of their board
        line, in rays of the camera of other views; no pose takes part in it.
    """

    residuals: Array
    rms: float
    by_view: Array
    straightness: float


def held_out(fit: Fit, views: Views, lines: tuple[tuple[int, ...], ...]) -> HeldOut:
    """Refit without each part of the views, and predict that part."""
    count = len(fit.T_camera_board)
    kept = (fit.weight >= 0.5) & views.seen
    residuals = np.full(views.pixels.shape, np.nan)
    bends: list[Array] = []
    part_of = np.arange(count) % min(FOLDS, count)
    for part in range(part_of.max() + 1):
        out = np.flatnonzero(part_of == part)
        camera = refit(fit, views, np.flatnonzero(part_of != part)).camera
        mine = views.take(out)
        scale = np.where(kept[out], 1 / np.sqrt(mine.sigma**2 + fit.tau**2), 0.0)
        poses, _ = fit_poses(camera, mine, fit.T_camera_board[out], scale)
        predicted = camera.project(apply(poses[:, None], views.points))
        residuals[out] = np.where(kept[out][..., None], predicted - mine.pixels, np.nan)
        for v in out:
            pixels = np.where(kept[v][:, None], views.pixels[v], np.nan)
            bends.append(line_offsets(camera, pixels, lines))
    squares = np.sum(residuals**2, axis=-1)
    bend = np.concatenate(bends)
    return HeldOut(
        residuals,
        float(np.sqrt(np.nanmean(squares))),
        np.sqrt(np.nanmean(squares, axis=1)),
        float(np.sqrt(np.mean(bend**2))) if bend.size else float("nan"),
    )


def left_out_residuals(fit: Fit, views: Views) -> Array:
    """Residuals (V, N, 2) px of each view under the camera of the others, to first order."""
    moved, rows, _ = _without_each(fit, views)
    change = (rows @ moved[..., None])[..., 0].reshape(*views.seen.shape, 2)
    scale = fit.problem(views).scale[0][..., None]
    return fit.residuals + np.where(scale > 0, change / np.where(scale > 0, scale, 1.0), 0.0)


def spread_of_views(fit: Fit, views: Views) -> float:
    """Factor by which the intrinsics scatter over the views more than the corners' noise says.

    The jackknife over views, whose covariance is (V - 1) / V of the sum of squares of what each
    view's absence changes, against that of the noise; 1 where chance explains the difference.
    """
    moved, _, normal = _without_each(fit, views)
    off = moved - moved.mean(axis=0)
    count = len(moved)
    jackknife = (count - 1) / count * off.T @ off
    ratio = float(np.trace(normal @ jackknife)) / max(len(fit.free), 1)
    return float(np.sqrt(ratio)) if ratio > CHANCE else 1.0


def _without_each(fit: Fit, views: Views) -> tuple[Array, Array, Array]:
    """How leaving out each view moves the free intrinsics (V, k), to first order; the rows with
    poses eliminated (V, r, k); the normal matrix of all (k, k).

    With rows A_v and residuals r_v of view v, that is (N - N_v)^-1 A_v^T r_v, since all views
    together are in balance.
    """
    linear = fit.problem(views).linearize(fit.state)
    rows = eliminate(linear, np.zeros(1)).rows[0]
    normals = transposed(rows) @ rows
    whole = normals.sum(axis=0)
    right = transposed(rows) @ linear.value[0][..., None]
    moved = np.stack([inverted(whole - part) for part in normals]) @ right
    return moved[..., 0], rows, whole
