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


def refine(
    image: Integers, start: Array, axes: Array, window: Window, bends: Array | None = None
) -> Corners:
    """Fit corners near `start`.

    image : (height, width) grey levels. start : (n, 2) px.
    axes : (n, 2, 2) px; axes[:, k] is the picture of one square along the board's axis k; of a
        marker's corner, of its side, away from the corner.
    bends : (n, 2, 2) px; second differences of the picture along the same axes, by which a lens
        or mirror bends the edges; none for straight ones.
    """
    if len(start) == 0:
        return Corners(start, np.zeros(0, dtype=bool), np.zeros(0))
    scale = np.sqrt(np.abs(np.linalg.det(axes)))
    widened = np.maximum(1.0, LEAST_RADIUS / np.maximum(window.reach * scale, 1e-6))
    offsets, grey, inside = _pixels(image, start, axes, window.reach * widened)
    weight = _weights(offsets, axes, window, widened) * inside
    offsets, grey, weight = _packed(offsets, grey, weight)
    first = _first(grey, weight, axes, window.saddle)
    shape = _Shape(offsets, _curvature(first, axes, bends), window.saddle)
    p, residual = _fit(grey, weight, shape, first)
    return _judged(start, p, residual, grey, weight, scale, shape)


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


def _first(grey: Array, weight: Array, axes: Array, saddle: bool) -> Array:
    """Start of the fit: x, y, two directions, log blur, level, amplitude; (n, 7).

    Of a marker's corner both edges are directed so that the marker is on their positive side.
    """
    angle = np.arctan2(axes[..., 1], axes[..., 0])
    if not saddle:
        inward = np.sum(_normals(angle) * axes[:, ::-1], axis=-1)
        angle = angle + np.where(inward < 0, np.pi, 0.0)
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    spread = np.sqrt(np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total)
    zero = np.zeros(len(grey))
    return np.stack([zero, zero, angle[:, 0], angle[:, 1], zero, mean, spread], axis=-1)


def _normals(angle: Array) -> Array:
    """Positive sides (..., 2) of edges with these directions."""
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)


class _Shape(NamedTuple):
    """What a corner's picture is made of: pixels' offsets (n, m, 2), curvatures (n, 2) 1/px of its
    two edges towards their positive sides, and whether two dark squares meet.
    """

    offsets: Array
    curvature: Array
    saddle: bool


def _curvature(first: Array, axes: Array, bends: Array | None) -> Array:
    """Curvatures of the edges, (n, 2): the part of the second difference across the edge."""
    if bends is None:
        return np.zeros((len(first), 2))
    across = np.sum(_normals(first[:, 2:4]) * bends, axis=-1)
    return across / np.maximum(np.sum(axes**2, axis=-1), 1e-9)


def _fit(grey: Array, weight: Array, shape: _Shape, p: Array) -> tuple[Array, Array]:
    """Weighted Levenberg-Marquardt of all corners at once; parameters (n, 7), residuals (n, m)."""
    p = _levelled(grey, weight, shape, p)
    value, by = _model(p, shape)
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
        trial_value, trial_by = _model(trial, shape)
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


def _levelled(grey: Array, weight: Array, shape: _Shape, p: Array) -> Array:
    """The start with level and amplitude fitted: these two are linear."""
    bare = p.copy()
    bare[:, 5], bare[:, 6] = 0.0, 1.0
    form = _model(bare, shape)[0]
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * form, axis=1) / total
    off = form - mean[:, None]
    variance = np.maximum(np.sum(weight * off * off, axis=1), 1e-9)
    bare[:, 6] = np.sum(weight * off * grey, axis=1) / variance
    bare[:, 5] = np.sum(weight * grey, axis=1) / total - bare[:, 6] * mean
    return bare


def _model(p: Array, shape: _Shape) -> tuple[Array, Array]:
    """Grey levels (n, m) and their derivatives by the seven unknowns (n, m, 7)."""
    from scipy.special import erf

    d = shape.offsets - p[:, None, :2]
    blur = np.exp(p[:, 4])[:, None]
    half = 1.0 if shape.saddle else 0.5
    forms: list[Array] = []
    chains: list[Array] = []
    for k in (0, 1):
        cos, sin = np.cos(p[:, 2 + k])[:, None], np.sin(p[:, 2 + k])[:, None]
        bend = shape.curvature[:, k, None]
        along, across = d[..., 0] * cos + d[..., 1] * sin, d[..., 1] * cos - d[..., 0] * sin
        z = (across - 0.5 * bend * along**2) / blur
        forms.append(half * erf(z / np.sqrt(2)) + (1 - half))
        slope = half * np.sqrt(2 / np.pi) * np.exp(-0.5 * z * z) / blur
        by_angle = -along - bend * along * across
        parts = (sin + bend * along * cos, bend * along * sin - cos, by_angle, -z * blur)
        chains.append(slope[..., None] * np.stack(np.broadcast_arrays(*parts), axis=-1))
    level, amplitude = p[:, 5:6], p[:, 6:7]
    by = np.empty((*d.shape[:-1], 7))
    first = (amplitude * forms[1])[..., None] * chains[0]
    second = (amplitude * forms[0])[..., None] * chains[1]
    by[..., :2] = first[..., :2] + second[..., :2]
    by[..., 2], by[..., 3] = first[..., 2], second[..., 2]
    by[..., 4] = first[..., 3] + second[..., 3]
    by[..., 5], by[..., 6] = 1.0, forms[0] * forms[1]
    return level + amplitude * by[..., 6], by


def _judged(
    start: Array, p: Array, residual: Array, grey: Array, weight: Array, scale: Array, shape: _Shape
) -> Corners:
    """Where the fit is a corner, and how sure its place is by what it leaves unexplained."""
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    variance = np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total
    left = np.sum(weight * residual**2, axis=1) / total
    blur, moved = np.exp(p[:, 4]), np.hypot(p[:, 0], p[:, 1])
    good = (
        (left < (1 - LEAST_SHARE) * variance)
        & (blur > BLURS[0] / 2)
        & (blur < np.maximum(BLURS[1], 0.2 * scale))
        & (moved < np.maximum(1.5, FARTHEST * scale))
        & (weight.sum(axis=1) > 12)
        & np.isfinite(p).all(axis=1)
    )
    by = _model(p, shape)[1]
    normal = np.swapaxes(by, 1, 2) @ (by * weight[..., None]) + 1e-9 * np.eye(7)
    # A grey level is rounded to whole numbers, so it is never better than 1 / sqrt 12.
    noise = np.maximum(left, 1 / 12)
    covariance = np.linalg.inv(normal) * noise[:, None, None]
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0) / 2)
    return Corners(start + np.where(good[:, None], p[:, :2], 0.0), good, sigma)
