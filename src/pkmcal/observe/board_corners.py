"""Board corners to sub-pixel: a model of the corner fitted to the grey levels around it.

Around a corner two edges cross. With e1 and e2 the signed distances of a pixel from them and s
the blur, the picture of a chessboard's corner is ``c + a g(e1 / s) g(e2 / s)`` with
``g = erf(. / sqrt 2)``, and that of a marker's corner the same with ``(1 + g) / 2``. Place, both
directions, blur and grey levels are fitted to all pixels of a window that follows the board's
local scale, so that it stays short where a lens or mirror makes the board small and bends its
lines. This is the maximum-likelihood place of the corner, and measures the same on a slanted
board as on a straight one. All corners of a photograph are fitted at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers

STEPS = 12
SETTLED = 1e-3
"""px; a thirtieth of what the noise of a good photograph does."""
FARTHEST = 0.25
"""Squares by which the fit may move a corner that a detector has found."""
LEAST_RADIUS, MOST_RADIUS = 2.5, 14
"""px; below, the window holds too few pixels for seven unknowns, above, lines bend."""
BLURS = (0.25, 4.0)
"""px; outside, the window shows something other than a corner."""
LEAST_SHARE = 0.6
"""Share of the window's variance that a corner explains; shadows and fingers leave less."""


class Window(NamedTuple):
    """Which pixels around a corner count, in squares of the board from the corner.

    reach : as far along the edges. margin : as far across them (a ChArUco board's markers begin
    behind it); reach again where nothing is printed inside the squares.
    saddle : two dark squares meet at the corner, not one.
    """

    reach: float
    margin: float
    saddle: bool


class Corners(NamedTuple):
    """Fitted corners: places (n, 2) px, where the fit holds (n,), sigma (n,) px a coordinate."""

    pixels: Array
    good: Booleans
    sigma: Array


def refine(image: Integers, start: Array, axes: Array, window: Window) -> Corners:
    """Fit corners near `start`.

    image : (height, width) grey levels. start : (n, 2) px.
    axes : (n, 2, 2) px; axes[:, k] is the picture of one square along the board's axis k.
    """
    if len(start) == 0:
        return Corners(start, np.zeros(0, dtype=bool), np.zeros(0))
    scale = np.sqrt(np.abs(np.linalg.det(axes)))
    widened = np.maximum(1.0, LEAST_RADIUS / np.maximum(window.reach * scale, 1e-6))
    offsets, grey, inside = _pixels(image, start, axes, window.reach * widened)
    weight = _weights(offsets, axes, window, widened) * inside
    offsets, grey, weight = _packed(offsets, grey, weight)
    first = _first(grey, weight, axes)
    p, residual = _fit(grey, weight, offsets, first, window.saddle)
    return _judged(start, p, residual, grey, weight, scale, window.saddle, offsets)


def _pixels(
    image: Integers, start: Array, axes: Array, reach: Array
) -> tuple[Array, Array, Booleans]:
    """Pixels around every corner: offsets from it (n, m, 2), grey (n, m), inside the picture."""
    longest = float(np.max(reach * np.abs(axes).sum(axis=1).max(axis=-1), initial=0.0))
    radius = int(np.clip(np.ceil(longest), 3, MOST_RADIUS))
    dy, dx = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    base = np.rint(start).astype(int)
    x, y = base[:, :1] + dx.ravel(), base[:, 1:] + dy.ravel()
    height, width = image.shape
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    grey = image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(float)
    offsets = np.stack([x - start[:, :1], y - start[:, 1:]], axis=-1)
    return offsets, grey, inside


def _weights(offsets: Array, axes: Array, window: Window, widened: Array) -> Array:
    """1 for pixels of the window, falling to 0 over the last fifth of its reach; (n, m)."""
    board = np.abs(np.linalg.solve(np.swapaxes(axes, -1, -2), np.swapaxes(offsets, -1, -2)))
    along, across = board.max(axis=1), board.min(axis=1)
    reach, margin = window.reach * widened[:, None], window.margin * widened[:, None]
    taper = np.clip((reach - along) / (0.2 * reach), 0, 1)
    return taper * (across < margin) * (np.abs(offsets).max(axis=-1) <= MOST_RADIUS)


def _packed(offsets: Array, grey: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Only the pixels that count, each corner's to the left, as wide as the largest window."""
    most = max(int(np.count_nonzero(weight, axis=1).max()), 1)
    order = np.argsort(weight == 0, axis=1, kind="stable")[:, :most]
    rows = np.arange(len(order))[:, None]
    return offsets[rows, order], grey[rows, order], weight[rows, order]


def _first(grey: Array, weight: Array, axes: Array) -> Array:
    """Start of the fit: x, y, two directions, log blur, level, amplitude; (n, 7)."""
    angle = np.arctan2(axes[..., 1], axes[..., 0])
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    spread = np.sqrt(np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total)
    zero = np.zeros(len(grey))
    return np.stack([zero, zero, angle[:, 0], angle[:, 1], zero, mean, spread], axis=-1)


def _fit(grey: Array, weight: Array, offsets: Array, p: Array, saddle: bool) -> tuple[Array, Array]:
    """Weighted Levenberg-Marquardt of all corners at once; parameters (n, 7), residuals (n, m)."""
    p = _levelled(grey, weight, offsets, p, saddle)
    value, by = _model(p, offsets, saddle)
    cost = np.sum(weight * (grey - value) ** 2, axis=1)
    damping = np.full(len(p), 1e-3)
    for _ in range(STEPS):
        weighted = by * weight[..., None]
        normal = np.swapaxes(by, 1, 2) @ weighted
        right = (np.swapaxes(weighted, 1, 2) @ (grey - value)[..., None])[..., 0]
        diagonal = np.einsum("nii->ni", normal)
        normal = normal + (damping[:, None] * diagonal + 1e-9)[..., None] * np.eye(7)
        step = np.clip(np.linalg.solve(normal, right[..., None])[..., 0], -_MOST, _MOST)
        trial = p + step
        trial_value, trial_by = _model(trial, offsets, saddle)
        trial_cost = np.sum(weight * (grey - trial_value) ** 2, axis=1)
        better = trial_cost < cost
        p = np.where(better[:, None], trial, p)
        value = np.where(better[:, None], trial_value, value)
        by = np.where(better[:, None, None], trial_by, by)
        cost = np.where(better, trial_cost, cost)
        damping = np.where(better, damping * 0.1, damping * 10)
        if np.abs(step[:, :2]).max() < SETTLED:
            break
    return p, grey - value


_MOST = np.array([1.0, 1.0, 0.3, 0.3, 0.5, 1e3, 1e3])
"""Longest step of each unknown: a pixel, a sixth of a right angle, half a natural unit of blur."""


def _levelled(grey: Array, weight: Array, offsets: Array, p: Array, saddle: bool) -> Array:
    """The start with level and amplitude fitted: these two are linear."""
    shape = _model(
        np.concatenate([p[:, :5], 0 * p[:, :1], 0 * p[:, :1] + 1], axis=1), offsets, saddle
    )[0]
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * shape, axis=1) / total
    grey_mean = np.sum(weight * grey, axis=1) / total
    off = shape - mean[:, None]
    variance = np.maximum(np.sum(weight * off * off, axis=1), 1e-9)
    amplitude = np.sum(weight * off * grey, axis=1) / variance
    return np.concatenate(
        [p[:, :5], (grey_mean - amplitude * mean)[:, None], amplitude[:, None]], axis=1
    )


def _model(p: Array, offsets: Array, saddle: bool) -> tuple[Array, Array]:
    """Grey levels (n, m) and their derivatives by the seven unknowns (n, m, 7)."""
    from scipy.special import erf

    d = offsets - p[:, None, :2]
    blur = np.exp(p[:, 4])[:, None]
    level, amplitude = p[:, 5:6], p[:, 6:7]
    shapes: list[Array] = []
    slopes: list[Array] = []
    parts: list[tuple[Array, Array, Array, Array]] = []
    half = 1.0 if saddle else 0.5
    for k in (2, 3):
        cos, sin = np.cos(p[:, k])[:, None], np.sin(p[:, k])[:, None]
        z = (d[..., 1] * cos - d[..., 0] * sin) / blur
        shapes.append(half * erf(z / np.sqrt(2)) + (1 - half))
        slopes.append(half * np.sqrt(2 / np.pi) * np.exp(-0.5 * z * z) / blur)
        parts.append((cos, sin, z, d[..., 0] * cos + d[..., 1] * sin))
    by = np.empty((*d.shape[:-1], 7))
    first, second = amplitude * slopes[0] * shapes[1], amplitude * slopes[1] * shapes[0]
    (c1, s1, z1, t1), (c2, s2, z2, t2) = parts
    by[..., 0] = first * s1 + second * s2
    by[..., 1] = -(first * c1 + second * c2)
    by[..., 2], by[..., 3] = -first * t1, -second * t2
    by[..., 4] = -(first * z1 + second * z2) * blur
    by[..., 5] = 1.0
    by[..., 6] = shapes[0] * shapes[1]
    return level + amplitude * by[..., 6], by


def _judged(
    start: Array,
    p: Array,
    residual: Array,
    grey: Array,
    weight: Array,
    scale: Array,
    saddle: bool,
    offsets: Array,
) -> Corners:
    """Where the fit is a corner, and how sure its place is by what it leaves unexplained."""
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    variance = np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total
    left = np.sum(weight * residual**2, axis=1) / total
    blur = np.exp(p[:, 4])
    moved = np.hypot(p[:, 0], p[:, 1])
    good = (
        (left < (1 - LEAST_SHARE) * variance)
        & (blur > BLURS[0] / 2)
        & (blur < np.maximum(BLURS[1], 0.2 * scale))
        & (moved < np.maximum(1.5, FARTHEST * scale))
        & (weight.sum(axis=1) > 12)
        & np.isfinite(p).all(axis=1)
    )
    by = _model(p, offsets, saddle)[1]
    normal = np.swapaxes(by, 1, 2) @ (by * weight[..., None]) + 1e-9 * np.eye(7)
    # A grey level is rounded to whole numbers, so it is never better than 1 / sqrt 12.
    noise = np.maximum(left, 1 / 12)
    covariance = np.linalg.inv(normal) * noise[:, None, None]
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0) / 2)
    return Corners(start + np.where(good[:, None], p[:, :2], 0.0), good, sigma)
