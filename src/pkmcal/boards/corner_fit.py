"""Sub-pixel fit of a board's corners.

Around a corner two edges cross. With e1 and e2 the signed distances of a pixel from them and s
the blur, the picture of a chessboard's corner is ``c + a g(e1 / s) g(e2 / s)`` with
``g = erf(. / sqrt 2)``, and that of a marker's corner the same with ``(1 + g) / 2``. Place, both
directions, blur and grey levels are fitted to all pixels of a window that follows the board's
local scale, so that it stays short where a lens or mirror makes the board small and bends its
lines. This is the maximum-likelihood place of the corner, and measures the same on a slanted
board as on a straight one. All corners of an image are fitted at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.boards.circles import LEAST_WINDOW_RADIUS
from pkmcal.solver.marquardt import Damping


@dataclass(frozen=True)
class CornerFitOptions:
    """Constants of the fit of corners.

    A corner is accepted if its fit has more pixels than unknowns, explains most of the
    window's variance, and keeps the corner, its standard deviation and its blur within the window.
    """

    # most steps of a corner's fit
    steps: int = 12
    # step at which a corner has settled, px: a thirtieth of what the noise of a good image does
    settled: float = 1e-3
    # smallest radius of a window, px
    least_radius: float = LEAST_WINDOW_RADIUS
    # largest radius of a window, px: lines bend in a larger one
    most_radius: int = 14
    # share of the window's variance that a corner explains; with 0.5, measured, some corners beside
    # clutter are accepted that are wrong by pixels
    least_explained: float = 0.6
    # longest step of each unknown: a pixel, a sixth of a right angle, half a natural unit of blur
    longest_step: tuple[float, ...] = (1.0, 1.0, 0.3, 0.3, 0.5, 1e3, 1e3)
    # squares around a corner that its fit uses, and by which it may move the corner: longer edges
    # contribute little more, and begin to bend
    reach: float = 0.25


CORNER_FIT_OPTIONS = CornerFitOptions()


class Window(NamedTuple):
    """Pixels around a corner that are fitted, in squares of the board from the corner.

    reach : extent along the edges.
    margin : extent across them (a ChArUco board's markers begin behind it); equal to ``reach``
        where nothing is printed inside the squares.
    saddle : two dark squares meet at the corner, not one.
    """

    reach: float
    margin: float
    saddle: bool


class Corners(NamedTuple):
    """Fitted corners: places (n, 2) px, where the fit holds (n,), sigma (n,) px a coordinate, and
    the seven unknowns of the fit around those places (n, 7).
    """

    pixels: Array
    good: Booleans
    sigma: Array
    unknowns: Array


def refine(
    image: Integers,
    start: Array,
    axes: Array,
    window: Window,
    bends: Array | None = None,
    before: Corners | None = None,
    options: CornerFitOptions = CORNER_FIT_OPTIONS,
) -> Corners:
    """Fit corners near `start`.

    image : (height, width) grey levels. start : (n, 2) px.
    axes : (n, 2, 2) px; axes[:, k] is the picture of one square along the board's axis k; of a
        marker's corner, of its side, away from the corner.
    bends : (n, 2, 2) px; second differences of the picture along the same axes, by which a lens
        or mirror bends the edges; none for straight ones.
    before : an earlier fit, whose places are `start`, from where this one goes on.
    """
    if len(start) == 0:
        return Corners(start, np.zeros(0, dtype=bool), np.zeros(0), np.zeros((0, 7)))
    scale = np.sqrt(np.abs(np.linalg.det(axes)))
    widened = np.maximum(1.0, options.least_radius / np.maximum(window.reach * scale, 1e-6))
    places, weight = _window(image, start, axes, window, widened, options)
    grey = image[places[:, 1], places[:, 0]].astype(float)
    first = _first(grey, weight, axes, window.saddle)
    if before is not None:
        first[before.good] = before.unknowns[before.good]
    shape = _Shape(places - start[..., None], _curvature(first, axes, bends), window.saddle)
    return _judged(start, _fit(grey, weight, shape, first, options), grey, weight, scale, options)


def _window(
    image: Integers,
    start: Array,
    axes: Array,
    window: Window,
    widened: Array,
    options: CornerFitOptions,
) -> tuple[Integers, Array]:
    """Pixels x, y (n, 2, m) that count around every corner, and their weights (n, m).

    As wide as the largest window: a smaller one's pixels come first, then some of no weight.
    """
    reach, margin = window.reach * widened[:, None], window.margin * widened[:, None]
    longest = float(np.max(reach * np.abs(axes).sum(axis=1), initial=0.0))
    radius = int(np.clip(np.ceil(longest), 3, options.most_radius))
    around = np.mgrid[-radius : radius + 1, -radius : radius + 1][::-1].reshape(2, -1)
    places = np.rint(start).astype(int)[..., None] + around
    offsets = places - start[..., None]
    last = np.array(image.shape[::-1])[:, None] - 1
    inside = ((places >= 0) & (places <= last)).all(axis=1)
    board = np.abs(np.linalg.inv(axes.mT) @ offsets)
    along, across = board.max(axis=1), board.min(axis=1)
    # 1, falling to 0 over the last fifth of the reach
    taper = np.clip((reach - along) / (0.2 * reach), 0, 1)
    near = np.abs(offsets).max(axis=1) <= options.most_radius
    weight = taper * (across < margin) * near * inside
    most = max(int(np.count_nonzero(weight, axis=1).max()), 1)
    order = np.argsort(weight == 0, axis=1, kind="stable")[:, :most]
    packed = np.take_along_axis(places, order[:, None], axis=2)
    return np.clip(packed, 0, last), np.take_along_axis(weight, order, axis=1)


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
    """Model of the image of a corner: offsets x, y of its pixels from the predicted corner (n, 2,
    m) px, curvatures (n, 2) 1/px of its two edges towards their positive sides, and whether two
    dark squares meet.
    """

    offsets: Array
    curvature: Array
    saddle: bool

    @property
    def bent(self) -> bool:
        """Whether any edge is."""
        return bool(self.curvature.any())

    def select(self, keep: Booleans) -> _Shape:
        """Some of the corners."""
        return _Shape(self.offsets[keep], self.curvature[keep], self.saddle)


def _curvature(first: Array, axes: Array, bends: Array | None) -> Array:
    """Curvatures of the edges, (n, 2): the part of the second difference across the edge."""
    if bends is None:
        return np.zeros((len(first), 2))
    across = np.sum(_normals(first[:, 2:4]) * bends, axis=-1)
    return across / np.maximum(np.sum(axes**2, axis=-1), 1e-9)


class _Fitted(NamedTuple):
    """A fit that has ended: unknowns (n, 7), what is left of the grey levels (n, m), and the normal
    matrix (n, 7, 7) there.
    """

    unknowns: Array
    residual: Array
    normal: Array


class _Fit(NamedTuple):
    """A fit on its way: numbers (k,) of the corners that have not settled, their unknowns (k, 7)
    and pixels (k, m), what is left of the grey levels, and the model's derivatives (k, 7, m) there.
    """

    number: Integers
    p: Array
    grey: Array
    weight: Array
    shape: _Shape
    residual: Array
    by: Array
    cost: Array
    damping: Damping

    @classmethod
    def begun(cls, grey: Array, weight: Array, shape: _Shape, p: Array) -> _Fit:
        """Before the first step, with level and amplitude fitted: these two are linear."""
        by = _model(np.concatenate([p[:, :6], np.ones((len(p), 1))], axis=1), shape)[1]
        form = by[:, 6]
        total = np.maximum(weight.sum(axis=1), 1e-9)
        mean = np.sum(weight * form, axis=1) / total
        off = form - mean[:, None]
        variance = np.maximum(np.sum(weight * off * off, axis=1), 1e-9)
        amplitude = np.sum(weight * off * grey, axis=1) / variance
        level = np.sum(weight * grey, axis=1) / total - amplitude * mean
        # the derivatives by place, directions and blur are in proportion to the amplitude
        by[:, :5] *= amplitude[:, None, None]
        p = np.concatenate([p[:, :5], level[:, None], amplitude[:, None]], axis=1)
        residual = grey - level[:, None] - amplitude[:, None] * form
        cost = np.sum(weight * residual**2, axis=1)
        return cls(
            np.arange(len(p)), p, grey, weight, shape, residual, by, cost, Damping.first(len(p))
        )

    @property
    def normal(self) -> Array:
        """Normal matrix (k, 7, 7)."""
        return (self.by * self.weight[:, None]) @ self.by.mT

    def stepped(self, longest: Array) -> tuple[_Fit, Array]:
        """After a damped step, where it is better, and that step (k, 7); longest : (7,)."""
        right = (self.by @ (self.weight * self.residual)[..., None])[..., 0]
        step = np.clip(self.damping.step(self.normal, right), -longest, longest)
        value, by = _model(self.p + step, self.shape)
        residual = self.grey - value
        cost = np.sum(self.weight * residual**2, axis=1)
        better = cost < self.cost
        after = self._replace(
            p=_taken(better, self.p + step, self.p),
            residual=_taken(better, residual, self.residual),
            by=_taken(better, by, self.by),
            cost=np.where(better, cost, self.cost),
            damping=self.damping.after(better),
        )
        return after, step

    def select(self, keep: Booleans) -> _Fit:
        """Fit of some of the corners."""
        if keep.all():
            return self
        parts = self._asdict().items()
        return _Fit(
            **{n: v.select(keep) if n in ("shape", "damping") else v[keep] for n, v in parts}
        )


def _fit(grey: Array, weight: Array, shape: _Shape, p: Array, options: CornerFitOptions) -> _Fitted:
    """Weighted Levenberg-Marquardt of all corners at once.

    Corners that have settled are not looked at again: a few bad ones never do.
    """
    fit = _Fit.begun(grey, weight, shape, p)
    out = _Fitted(np.empty_like(p), np.empty_like(grey), np.empty((len(p), 7, 7)))
    for more in reversed(range(options.steps)):
        fit, step = fit.stepped(np.array(options.longest_step))
        on = (np.abs(step[:, :2]).max(axis=1) >= options.settled) & (more > 0)
        settled = fit.select(~on)
        for all_of_them, these in zip(
            out, (settled.p, settled.residual, settled.normal), strict=True
        ):
            all_of_them[settled.number] = these
        if not on.any():
            break
        fit = fit.select(on)
    return out


def _taken(better: Booleans, trial: Array, before: Array) -> Array:
    """Rows of the trial (n, ...) where it is better (n,), else those before."""
    if better.all():
        return trial
    return np.where(better.reshape(-1, *[1] * (trial.ndim - 1)), trial, before)


def _model(p: Array, shape: _Shape) -> tuple[Array, Array]:
    """Grey levels (n, m) and their derivatives by the seven unknowns, (n, 7, m).

    Of both edges at once (n, 2, m): how far along and across them a pixel lies, px, how far off
    in blurs times sqrt 2, z, and how light they make it, form.
    """
    from scipy.special import erf

    angle = p[:, 2:4]
    directions, normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1), _normals(angle)
    blur, level, amplitude = np.sqrt(2) * np.exp(p[:, 4:5]), p[:, 5:6], p[:, 6:7]
    offsets = shape.offsets - p[:, :2, None]
    along, across = directions @ offsets, normals @ offsets
    turned = shape.curvature[..., None] * along if shape.bent else None
    off = across if turned is None else across - 0.5 * turned * along
    z = off / blur[..., None]
    half = 1.0 if shape.saddle else 0.5
    form = half * erf(z) + (1 - half)
    # by the signed distance from the edge, px
    slope = np.exp(-z * z) * form[:, ::-1]
    slope *= (amplitude * half * 2 / np.sqrt(np.pi) / blur)[..., None]
    by = np.empty((len(p), 7, z.shape[-1]))
    by[:, :2] = -normals.mT @ slope
    by[:, 2:4] = -slope * along
    by[:, 4] = -np.sum(slope * off, axis=1)
    if turned is not None:
        turning = slope * turned
        by[:, :2] += directions.mT @ turning
        by[:, 2:4] -= turning * across
    by[:, 5] = 1.0
    by[:, 6] = form[:, 0] * form[:, 1]
    return level + amplitude * by[:, 6], by


def _judged(
    start: Array,
    fitted: _Fitted,
    grey: Array,
    weight: Array,
    scale: Array,
    options: CornerFitOptions,
) -> Corners:
    """Corners that the fit accepts, with standard deviations by its residuals."""
    p = fitted.unknowns
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean = np.sum(weight * grey, axis=1) / total
    variance = np.sum(weight * (grey - mean[:, None]) ** 2, axis=1) / total
    remainder = np.sum(weight * fitted.residual**2, axis=1) / total
    # A grey level is rounded to whole numbers, so it is never better than 1 / sqrt 12.
    noise = np.maximum(remainder, 1 / 12)
    covariance = np.linalg.inv(fitted.normal + 1e-9 * np.eye(7)) * noise[:, None, None]
    sigma = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0) / 2)
    # A wider blur shows no edge in the window, and a corner outside it is another one; without blur
    # grey levels do not depend on the place, which is then unknown within the window.
    radius = np.clip(options.reach * scale, options.least_radius, options.most_radius)
    good = (
        (remainder < (1 - options.least_explained) * variance)
        & (np.exp(p[:, 4]) < radius)
        & (np.hypot(p[:, 0], p[:, 1]) < radius)
        & (sigma < radius)
        & (weight.sum(axis=1) > p.shape[1])
        & np.isfinite(p).all(axis=1)
    )
    pixels = start + np.where(good[:, None], p[:, :2], 0.0)
    return Corners(pixels, good, sigma, np.concatenate([0 * p[:, :2], p[:, 2:]], axis=1))
