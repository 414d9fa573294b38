"""Sub-pixel edge positions from grey-level profiles, without the bias of shading.

A profile across a silhouette is not a step: a cylinder's shading changes fastest just inside its
limb. At a depth d px inside, the surface has turned by an angle e from the limb with
cos e = 1 - d / w (w: half the leg's width in px), and diffuse light on it is a sum of 1, cos e and
sin e: brightness c0 + c1 d + c2 sqrt(d (2 w - d)). Outside, the background is b0 + b1 d. The
strongest gradient of such an edge, blurred by lens and pixel, lies up to a pixel off the edge
itself; this model, blurred alike, does not. For a given edge position it is linear in its five
brightnesses, so every trial position is one projection, the same for all profiles of a width: the
residual over a grid of positions is a matrix product, and its minimum is the edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly
from pkmcal.geometry.cylinders import tangent_basis
from pkmcal.geometry.rigid import dot
from pkmcal.measurements import EdgeSet
from pkmcal.observe.predict import EdgePoints, TubeList

PROFILE_REACH_INSIDE, PROFILE_REACH_OUTSIDE = 3.0, 3.0
"""Extent (px) of the modelled profile: less is ill-conditioned, more has other features of the leg
and neighbours."""
SAMPLED_INSIDE = 6.0
"""Pixels inside to which profiles are sampled: highlights end beyond the modelled part."""
MODELLED_LIMB_SHARE = 0.45
"""Share of a leg's half width, from its limb inwards, that is modelled: highlights of bare metal
begin further in. On slim legs this is less than PROFILE_REACH_INSIDE."""
LEAST_INSIDE = 1.25
"""Least extent (px) inside: less would not contain the limb's own brightness."""
CLEAR_OUTSIDE = 1.0
"""Distance (px) outward of the predicted edge from which samples give the background's level."""
HIGHLIGHT_DEVIATIONS = 3.0
"""Standard deviations by which the brightness has to recede further inside, for a highlight."""
PROFILE_STEP = 0.5
EDGE_SHIFTS = np.arange(-1.5, 1.55, 0.1)
"""Trial positions of the edge about the predicted one, px."""
PROFILE_MODEL_PITCH = 0.05
"""Pitch (px) at which the model is tabulated: steps and shifts are multiples of it, so that all
samples of all trial positions are tabulated."""
BRIGHTNESS_UNKNOWNS = 5
"""Linear unknowns of the model: three inside the limb, two outside."""
HALF_WIDTHS = np.geomspace(3.0, 60.0, 16)
"""Half widths w (px) of legs for which the model is tabulated; the nearest is used."""
_BETWEEN_HALF_WIDTHS = np.sqrt(HALF_WIDTHS[1:] * HALF_WIDTHS[:-1])
"""Half widths (px) from which the next one is nearer, by ratio."""
BLURS_TRIED = np.arange(0.45, 1.5, 0.1)
"""Trial blurs (px, standard deviation of lens, pixel and interpolation together)."""
USUAL_BLUR = 0.7
"""Blur (px) that is tried first, and assumed where no profile determines it: lens 0.6, pixel 0.3.
"""
BLURS_BESIDE = 2
"""Blurs to both sides of the best that are tried: the next ones are needed for interpolation and
for each profile's least residual. Further ones move the result by less than its standard deviation;
of a hundred poor profiles the next ones alone may give a local minimum."""
ENOUGH_FOR_BLUR = 500
"""Profiles that determine the blur to a hundredth of a pixel; more only take time."""
FEWEST_FOR_BLUR = 100
"""Least number of profiles for a blur: where fewer are complete, as those of one wide leg among
slim ones, incomplete ones are used with them."""
GREY_NOISE = 0.6
"""Least standard deviation (grey levels) of a profile's samples: 8-bit rounding and model errors;
limits the weight of a fit that is perfect by chance."""
PROFILE_MODEL_ERROR = 0.01
"""Share of the contrast by which real profiles differ from the model; scales the two priors."""
SHADING_SLOPE, SHADING_ROOT = 0.3, 1.0
"""Prior sigma (in contrasts) of the shading's linear part per pixel, and of its root part at a
pixel's depth. It hardly affects complete profiles; where the leg is overexposed, and only the flank
of the limb remains, it bounds the shading there, so that the position's sigma contains it."""
SATURATED_GREY_LEVEL = 250
"""Grey level from which a sample is clipped."""
MOST_CUT = -0.25
"""Position (px) beyond which a profile must not be saturated: the edge itself."""
OWN_EDGE_WINDOW = 0.5
"""Half width (px) of the search for a profile's edge about the position of the whole leg: further
off are highlights, which all points of an edge may have in common."""
FAINT_EDGE_SIGMA = 0.5
"""Standard deviation (px) of a position above which a profile has no edge: half of the window."""
EDGE_SIGMA_FLOOR = 0.02
"""Least standard deviation (px) of a position, however sharp the profile."""
MEASUREMENTS_AN_EDGE = 2.0
"""Effective sample size of an edge, whatever its length. Errors by shading and paint are correlated
along an edge and do not average out: an edge is one line measured once in each of two halves, not
three hundred points."""
FEWEST_PLACES_FOR_TILT = 3
"""Least number of points along an edge that determine its tilt."""


BlurByStation = Mapping[int, float]
"""Blur of the edges in a station's images, px, standard deviation."""


@dataclass(frozen=True)
class ProfileEdges:
    """Edge positions in profiles: position (...) px outward from the predicted edge, its standard
    deviation sigma (...) px by grey-level noise, and whether it is valid (...).
    """

    position: Array
    sigma: Array
    valid: Booleans


def sampled_offsets() -> Array:
    """Positions of the samples of a profile, px outward from the predicted edge."""
    return np.arange(-SAMPLED_INSIDE, PROFILE_REACH_OUTSIDE + PROFILE_STEP / 2, PROFILE_STEP)


def profile_offsets() -> Array:
    """Positions of the modelled samples of a profile, the outermost ones."""
    return np.arange(-PROFILE_REACH_INSIDE, PROFILE_REACH_OUTSIDE + PROFILE_STEP / 2, PROFILE_STEP)


@lru_cache(maxsize=512)
def _blurred_model(blur: float, half_width: float) -> tuple[Array, Array]:
    """Positions x (n,), px outward of the edge, and the five blurred brightnesses there, (n, 5)."""
    place = np.arange(-PROFILE_REACH_INSIDE - 8, PROFILE_REACH_OUTSIDE + 8, PROFILE_MODEL_PITCH)
    inside = (place < 0).astype(float)
    inside[np.abs(place) < PROFILE_MODEL_PITCH / 2] = 0.5
    depth = np.clip(-place, 0.0, 2 * half_width)
    root = np.sqrt(depth * (2 * half_width - depth))
    columns = [inside, depth, root, 1 - inside, np.maximum(place, 0.0)]
    # an odd count: np.convolve centres an even one half a pitch aside, and the edge with it
    half = int(np.ceil(5 * blur / PROFILE_MODEL_PITCH))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * PROFILE_MODEL_PITCH / blur) ** 2)
    smooth = [np.convolve(c, kernel / kernel.sum(), mode="same") for c in columns]
    return place, np.stack(smooth, axis=1)


@lru_cache(maxsize=2048)
def _projections(blur: float, half_width: float, cut: int) -> Array:
    """Orthonormal bases of the model's profiles at each trial position, (samples, 5 x shifts):
    the first basis of all positions, then the second.

    cut : samples at the inner end that are not used; their rows are zero. The weak priors on the
    shading are rows below the samples, with zero data; only the samples' rows are returned, which
    suffice for the projection of such data.
    """
    place, model = _blurred_model(blur, half_width)
    at = profile_offsets() - EDGE_SHIFTS[:, None]
    values = model[np.rint((at - place[0]) / PROFILE_MODEL_PITCH).astype(int)]
    values[:, :cut] = 0.0
    beliefs = np.zeros((len(EDGE_SHIFTS), 2, BRIGHTNESS_UNKNOWNS))
    beliefs[:, 0, 1] = PROFILE_MODEL_ERROR / SHADING_SLOPE
    beliefs[:, 1, 2] = PROFILE_MODEL_ERROR / SHADING_ROOT * np.sqrt(2 * half_width)
    bases = np.linalg.qr(np.concatenate([values, beliefs], axis=1))[0][:, : at.shape[1]]
    return bases.transpose(1, 2, 0).reshape(at.shape[1], -1)


class _Kinds(NamedTuple):
    """Profiles grouped by station, half width and cut: a few dozen kinds a station.

    scaled : (N, samples) in contrasts, less the outermost, in the order of the kinds. square : (N,)
    sums of their squares. order : (N,) index of each profile. parts : begin and end of each kind,
    its station, half width (px) and cut.
    """

    scaled: Array
    square: Array
    order: Integers
    parts: list[tuple[tuple[int, int], int, float, int]]


@dataclass(frozen=True)
class Profiles:
    """Averaged profiles across edges, N of them.

    grey : (N, samples) at :func:`profile_offsets`. count : (N,) number of averaged profiles.
    half_width : (N,) of the legs there, px. cut : (N,) samples at the inner end that
    are not used: clipped at the camera's brightest level, or too deep inside a slim leg.
    station : (N,) whose blur each has. strip, bright : (N,), see :func:`strips`.
    """

    grey: Array
    count: Array
    half_width: Array
    cut: Integers
    station: Integers
    strip: Integers
    bright: Booleans

    @classmethod
    def of(
        cls, grey: Array, clipped: Booleans, count: Array, half_width: Array, station: Integers
    ) -> Profiles:
        """Profiles from grey levels (N, samples) at :func:`sampled_offsets`, and the mask of
        clipped ones at :func:`profile_offsets`.
        """
        explained, cut = grey[:, -clipped.shape[1] :], cut_of(clipped, half_width)
        strip = strips(grey, count, half_width)
        return cls(explained, count, half_width, cut, station, *strip)

    def select(self, keep: Booleans | Integers) -> Profiles:
        """The profiles at a mask or at positions."""
        return replace(self, **{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    @cached_property
    def contrast(self) -> Array:
        """Largest grey-level difference in each profile, (N,)."""
        return _contrast(self.grey)

    @cached_property
    def by_kind(self) -> _Kinds:
        """The profiles grouped by kind, for one projection a kind."""
        # what a good fit leaves is a millionth of the profile: too little for single precision
        scaled = (self.grey - self.grey[:, -1:]).astype(float)
        scaled /= self.contrast[:, None]
        samples = scaled.shape[1]
        scaled[np.arange(samples) < self.cut[:, None]] = 0.0
        width = np.searchsorted(_BETWEEN_HALF_WIDTHS, self.half_width)
        kind = np.minimum(self.cut, samples - 1) + samples * (
            width + len(HALF_WIDTHS) * self.station
        )
        order = np.argsort(kind, kind="stable")
        kind = kind[order]
        first = np.flatnonzero(np.diff(kind, prepend=-1))
        widths, cuts = divmod(kind[first], samples)
        stations, widths = divmod(widths, len(HALF_WIDTHS))
        columns = (v.tolist() for v in (stations, HALF_WIDTHS[widths], cuts))
        parts = zip(pairwise([*first.tolist(), len(kind)]), *columns, strict=True)
        scaled = scaled[order]
        return _Kinds(scaled, np.einsum("ni,ni->n", scaled, scaled), order, list(parts))


def cut_of(saturated: Booleans, half_width: Array) -> Integers:
    """Number (N,) of samples to omit at the inner end of profiles.

    Up to the outermost one of ``saturated`` (N, samples), and those deeper than the limb of a leg
    of ``half_width`` (N,) px.
    """
    count = saturated.shape[-1]
    last = count - np.argmax(saturated[..., ::-1], axis=-1)
    depth = np.maximum(MODELLED_LIMB_SHARE * half_width, LEAST_INSIDE)
    beyond = np.searchsorted(profile_offsets(), -depth - 1e-9)
    return np.maximum(np.where(saturated.any(axis=-1), last, 0), beyond)


def strips(grey: Array, count: Array, half_width: Array) -> tuple[Integers, Booleans]:
    """Number (N,) of samples inward of the middle of a strip within the limb, 0 where there is
    none, and whether the strip is brighter than the background (N,).

    grey : (N, samples) at :func:`sampled_offsets`. count, half_width : (N,), as of `Profiles`. A
    strip is where the difference from the background decreases again further in, by more than noise
    and by more than diffuse light as a rule allows, whose cosine changes by MODELLED_LIMB_SHARE
    down to that depth.
    """
    offsets = sampled_offsets()
    background = np.median(grey[:, offsets >= CLEAR_OUTSIDE], axis=1, keepdims=True)
    inside = np.flatnonzero(offsets <= -PROFILE_STEP)[::-1]  # from the limb inwards
    violation = grey[:, inside] - background
    away = np.abs(violation)
    most = np.maximum.accumulate(away, axis=1)
    contrast = _contrast(grey[:, offsets >= -PROFILE_REACH_INSIDE])
    noise = (np.hypot(_noise(contrast, count), PROFILE_MODEL_ERROR) * contrast)[:, None]
    less = most - away > np.maximum(HIGHLIGHT_DEVIATIONS * noise, MODELLED_LIMB_SHARE * most)
    depth = np.maximum(MODELLED_LIMB_SHARE * half_width, PROFILE_REACH_INSIDE)
    less &= -offsets[inside] <= depth[:, None]
    # the last place that was its own largest before it was less
    before = np.arange(len(inside)) < np.argmax(less, axis=1)[:, None]
    largest = len(inside) - 1 - np.argmax(((away == most) & before)[:, ::-1], axis=1)
    there, which = less.any(axis=1), np.arange(len(grey))
    middle = np.minimum(offsets[inside[largest]], -LEAST_INSIDE)
    cut = np.searchsorted(profile_offsets(), middle - 1e-9)
    return np.where(there, cut, 0), there & (violation[which, largest] > 0)


def without_highlights(profiles: Profiles, blur: BlurByStation) -> tuple[Profiles, Booleans]:
    """Profiles without the samples deeper than a strip's middle, and mask (N,) of those with a
    highlight in place of the limb.

    The reflection of a lamp in polished metal, some way inside the limb, is not modelled, and with
    its far side in the profile its near border is the likelier edge. Between that and the limb the
    metal is as dark as the background: the edge itself is invisible. Paint lit from behind has a
    bright strip as well, but one that the model explains to its usual error; a highlight it does
    not.
    """
    bright, odd = np.flatnonzero(profiles.bright), np.zeros(len(profiles.cut), dtype=bool)
    if bright.size:
        whole = profiles.select(bright)
        residual = residual_curves(whole, blur).min(axis=-1) * PROFILE_STEP
        expected = _noise(whole.contrast, whole.count) ** 2 + PROFILE_MODEL_ERROR**2
        odd[bright] = residual > expected * _freedom(whole)
    return replace(profiles, cut=np.maximum(profiles.cut, profiles.strip)), odd


def residual_curves(profiles: Profiles, blur: BlurByStation) -> Array:
    """Sum of squared residuals (N, shifts) at every trial position, in squares of the contrast."""
    kinds, shifts = profiles.by_kind, len(EDGE_SHIFTS)
    explained = np.empty((len(kinds.scaled), shifts))
    for (first, end), station, half_width, cut in kinds.parts:
        bases = _projections(round(float(blur[station]), 3), half_width, cut)
        along = (kinds.scaled[first:end] @ bases).reshape(-1, BRIGHTNESS_UNKNOWNS, shifts)
        np.einsum("nbs,nbs->ns", along, along, out=explained[first:end])
    out = np.empty_like(explained)
    out[kinds.order] = kinds.square[:, None] - explained
    return np.maximum(out, 0.0, out=out)


def shift_log_likelihoods(profiles: Profiles, curves: Array) -> Array:
    """Log-likelihood (N, shifts) of every trial position with noise of unknown size, less its
    largest value; 0 for profiles that are clipped up to their edge.

    curves : of :func:`residual_curves`.
    """
    samples = np.maximum(profiles.grey.shape[-1] - profiles.cut, 1)
    floor = samples * (_noise(profiles.contrast, profiles.count) ** 2 + PROFILE_MODEL_ERROR**2)
    out = -_freedom(profiles)[:, None] / 2 * np.log(curves + floor[:, None])
    out -= out.max(axis=-1, keepdims=True)
    return np.where(_shows_its_edge(profiles)[:, None], out, 0.0)


def locate(profiles: Profiles, curves: Array, about: Array) -> ProfileEdges:
    """Edge positions of profiles, each within OWN_EDGE_WINDOW of its leg's position ``about`` (N,),
    px.

    curves : of :func:`residual_curves`.
    """
    step = EDGE_SHIFTS[1] - EDGE_SHIFTS[0]
    half = round(OWN_EDGE_WINDOW / step)
    middle = np.rint((about - EDGE_SHIFTS[0]) / step).astype(int)
    middle = np.clip(middle, half, len(EDGE_SHIFTS) - 1 - half)
    near = middle[:, None] + np.arange(-half, half + 1)
    lowest = np.argmin(np.take_along_axis(curves, near, axis=-1), axis=-1)
    best = middle - half + np.clip(lowest, 1, 2 * half - 1)
    left, here, right = (
        np.take_along_axis(curves, (best + d)[..., None], -1)[..., 0] for d in (-1, 0, 1)
    )
    bend = np.maximum(left - 2 * here + right, 1e-12)
    position = EDGE_SHIFTS[best] + step * np.clip((left - right) / (2 * bend), -1, 1)
    noise = _noise(profiles.contrast, profiles.count)
    variance = here * PROFILE_STEP / _freedom(profiles) + noise**2
    # cost(x) = residual / (variance / PROFILE_STEP): its second derivative is 2 / sigma^2
    sigma = np.sqrt(2 * (variance / PROFILE_STEP) / (bend / step**2))
    inside = (lowest > 0) & (lowest < 2 * half)
    return ProfileEdges(
        position, sigma, inside & _shows_its_edge(profiles) & (sigma < FAINT_EDGE_SIGMA)
    )


def _contrast(grey: Array) -> Array:
    return np.maximum(np.ptp(grey, axis=-1), 1e-3)


def _noise(contrast: Array, count: Array) -> Array:
    """Least noise (N,) of a sample, in contrasts."""
    return GREY_NOISE / contrast / np.sqrt(np.maximum(count, 1))


def _freedom(profiles: Profiles) -> Array:
    """Degrees of freedom (N,) of the residuals. Neighbouring samples at half a pixel have
    correlated noise: two count as one.
    """
    samples = profiles.grey.shape[-1] - profiles.cut
    return np.maximum(samples * PROFILE_STEP - BRIGHTNESS_UNKNOWNS, 1.0)


def _shows_its_edge(profiles: Profiles) -> Booleans:
    """Profiles (N,) that are not clipped up to their edge."""
    return profiles.cut < np.searchsorted(profile_offsets(), MOST_CUT)


def estimate_blur(profiles: Profiles) -> float:
    """Blur (px) with the least residuals over the profiles of one station.

    Contrast differs by edge, so each profile's residual is relative to its least; the median over
    profiles is minimized, so that half of them may be outliers. The most complete profiles are
    used. The search goes from the usual blur to its neighbours, towards the minimum.
    """
    few = min(FEWEST_FOR_BLUR, len(profiles.cut))
    whole = np.flatnonzero(profiles.cut <= np.sort(profiles.cut)[few - 1]) if few else np.array([])
    if whole.size:
        profiles = profiles.select(whole[evenly(whole.size, ENOUGH_FOR_BLUR)])
    floor = (GREY_NOISE / profiles.contrast) ** 2
    costs = np.full((len(profiles.cut), len(BLURS_TRIED)), np.inf)  # until they are tried
    k = int(np.argmin(np.abs(BLURS_TRIED - USUAL_BLUR)))
    while True:
        for near in range(max(k - BLURS_BESIDE, 0), min(k + BLURS_BESIDE + 1, len(BLURS_TRIED))):
            if np.isinf(costs[0, near]):
                tried = dict.fromkeys(profiles.station.tolist(), BLURS_TRIED[near])
                costs[:, near] = residual_curves(profiles, tried).min(axis=-1)
        total = np.median(costs / (costs.min(axis=-1) + floor)[:, None], axis=0)
        best = int(np.argmin(total))
        if best == k:
            break
        k = best
    k = int(np.clip(k, 1, len(BLURS_TRIED) - 2))
    left, here, right = total[k - 1 : k + 2]
    bend = max(left - 2 * here + right, 1e-12)
    return float(
        BLURS_TRIED[k]
        + (BLURS_TRIED[1] - BLURS_TRIED[0]) * np.clip((left - right) / (2 * bend), -1, 1)
    )


@dataclass(frozen=True)
class EdgeFits:
    """Planes fitted to positions along edges; all (K, E, ...).

    turn : (2,) of the normal in ``basis`` (3, 2). covariance : (2, 2). operator : (2, n) turn by
    the positions at the n samples, with the final weights. used : inliers. good : whether there are
    enough.
    """

    turn: Array
    basis: Array
    covariance: Array
    operator: Array
    used: Booleans
    good: Booleans


def fit_edges(
    points: EdgePoints, position: Array, sigma: Array, valid: Booleans, rounds: int = 8
) -> EdgeFits:
    """Robust weighted line through positions (K, E, n) px outward, in the plane's two turns.

    Cauchy weights against positions on highlights and neighbours. The scatter about the fit,
    where it exceeds the stated sigmas, enlarges the covariance.
    """
    middle = _middle_ray(points)
    basis = tangent_basis(points.normal, middle)
    rows = np.where(valid[..., None], np.nan_to_num(points.by_normal() @ basis), 0.0)
    value = np.where(valid, position, 0.0)
    base = np.where(valid, 1 / (sigma**2 + EDGE_SIGMA_FLOOR**2), 0.0)
    # all edges side by side, place after place: what is added up then lies in one piece
    one, two, at, sure = (
        np.ascontiguousarray(v.reshape(-1, v.shape[-1]).T)
        for v in (rows[..., 0], rows[..., 1], value, base)
    )
    squares = np.stack([one * one, one * two, two * two, one * at, two * at])

    def fitted(weight: Array) -> tuple[Array, Array, Array]:
        inverse, turn = _solved(squares, weight)
        return inverse, turn, (at - one * turn[0] - two * turn[1]) ** 2 * sure

    weight = sure
    inverse, turn, off2 = fitted(weight)
    for _ in range(rounds):
        weight = sure / (1 + off2 / 4.0)  # Cauchy, two sigmas
        inverse, turn, off2 = fitted(weight)
    shape = valid.shape[:-1]
    off2, weight = (v.T.reshape(valid.shape) for v in (off2, weight))
    used = valid & (off2 < 9.0)
    count = used.sum(axis=-1)
    scatter = np.sum(used * off2, axis=-1) / np.maximum(count - 2, 1)
    factor = np.maximum(scatter, 1.0) * np.maximum(count / MEASUREMENTS_AN_EDGE, 1.0)
    inverse = np.moveaxis(inverse.reshape(2, 2, *shape), (0, 1), (-2, -1))
    operator = inverse @ (rows * weight[..., None]).mT
    good = (count >= FEWEST_PLACES_FOR_TILT) & (count >= 0.5 * valid.sum(axis=-1))
    covariance = inverse * factor[..., None, None]
    good &= np.isfinite(covariance).all(axis=(-1, -2))
    return EdgeFits(turn.T.reshape(*shape, 2), basis, covariance, operator, used, good)


def _middle_ray(points: EdgePoints) -> Array:
    ray = points.point[..., points.point.shape[-2] // 2, :]
    return ray / np.sqrt(dot(ray, ray))[..., None]


def _solved(squares: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares of n values on two unknowns each, N times over: the inverses (2, 2, N)
    of the normal matrices, and the unknowns (2, N).

    squares : (5, n, N) products of the rows' entries, then of these with the values. weight :
    (n, N).
    """
    a, b, c, p, q = np.einsum("pnx,nx->px", squares, weight)
    ridge = 1e-12 * (a + c) + 1e-30
    a, c = a + ridge, c + ridge
    inverse = np.stack([c, -b, -b, a]).reshape(2, 2, -1) / (a * c - b * b)
    return inverse, inverse[0] * p + inverse[1] * q


def edge_set(
    points: EdgePoints,
    fits: EdgeFits,
    tubes: TubeList,
    station: Integers,
    configuration: Integers,
    keep: Booleans,
    by_parameters: Array | None = None,
) -> EdgeSet:
    """The fits at ``keep`` (K, E) as measurements; station, configuration : (K,) of the
    photographs.

    by_parameters : (K, E, n, 2, p) motion of the predicted pixels by the camera's parameters,
    where the intrinsics are to be refined: the measured places then move the other way.
    """
    k, e = np.nonzero(keep)
    basis = fits.basis[k, e]
    normal = points.normal[k, e] + (basis @ fits.turn[k, e, :, None])[..., 0]
    normal /= np.sqrt(dot(normal, normal))[:, None]
    middle = _middle_ray(points)[k, e]
    along = np.where(fits.used[k, e], points.along[k, e], np.nan)
    return EdgeSet(
        station=station[k],
        configuration=configuration[k],
        leg=tubes.leg[e],
        tube=tubes.tube[e],
        side=tubes.side[e],
        normal=normal,
        # the turn is a few milliradians: the same two coordinates serve at the turned normal
        basis=tangent_basis(normal, middle),
        covariance=fits.covariance[k, e],
        shift=fits.operator[k, e].sum(axis=-1),
        span=np.stack([np.nanmin(along, axis=1), np.nanmax(along, axis=1)], axis=1),
        by_intrinsics=_by_intrinsics(points, fits, by_parameters)[k, e],
    )


def _by_intrinsics(points: EdgePoints, fits: EdgeFits, by_parameters: Array | None) -> Array:
    """Turn of the fitted planes by the camera's parameters, the pixels held; (K, E, 2, p)."""
    if by_parameters is None:
        return np.zeros((*fits.turn.shape, 0))
    outward = (points.outward[..., None, :] @ by_parameters)[..., 0, :]
    used = fits.used[..., None] & np.isfinite(outward)
    return -fits.operator @ np.where(used, outward, 0.0)
