"""Sub-pixel edge positions from grey-level profiles, without the bias of shading.

A profile across a silhouette is not a step: a cylinder's shading changes fastest just inside its
limb. At a depth d px inside, the surface normal is rotated by an angle e from the limb's, with cos
e = 1 - d / w (w: half the leg's width in px), and diffuse light on it is a sum of 1, cos e and sin
e, so the brightness is c0 + c1 d + c2 sqrt(d (2 w - d)). Outside, the background is b0 + b1 d. The
steepest gradient of such an edge, blurred by lens and pixel, is up to a pixel off the edge itself;
this model, with the same blur, is unbiased. For a given edge position it is linear in its five
brightnesses (variable projection), so a trial position is one projection, the same for all profiles
of a width: the residual over a grid of positions is a matrix product, and its minimum is the edge.
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
from pkmcal.levels import CONTRADICTION_SIGMAS, MAJORITY, OUTLIER_SIGMAS
from pkmcal.measurements import EdgeSet
from pkmcal.observe.predict import EdgePoints, TubeList
from pkmcal.solver.kernels import cauchy_weights


@dataclass(frozen=True)
class ProfileOptions:
    """Constants of the profile model; lengths in pixels of the image that is measured."""

    # extent inside the edge that the model explains: with less the fit of five brightnesses is
    # ill-conditioned, with more it meets other features of the leg
    reach_inside: float = 3.0
    # extent outside the edge, likewise; with more it meets neighbours
    reach_outside: float = 3.0
    # extent inside to which profiles are sampled: highlights end beyond the modelled part
    sampled_inside: float = 6.0
    # share of a leg's half width, inwards from its limb, that the model explains: highlights of
    # bare metal begin further inside; on slim legs this is less than the reach
    limb_share: float = 0.45
    # smallest depth that is used, between two samples: up to the first one at which a step, blurred
    # by the usual 0.7 px, has nearly all of its height, the one at 1 px (nine tenths at 1.28
    # standard deviations, 0.9 px); any depth from 1 to less than 1.5 px has the same samples
    least_inside: float = 1.25
    # distance outward of the predicted edge from which samples belong to the background: more than
    # its blur
    clear_outside: float = 1.0
    # standard deviations by which the brightness returns towards the background behind a strip
    # (statistical: 3 in 1000 samples by chance)
    highlight_deviations: float = OUTLIER_SIGMAS
    # spacing of the samples: half of the pixel that limits the image's resolution
    step: float = 0.5
    # largest trial shift of the edge from its prediction, which is correct to a pixel
    shift_reach: float = 1.5
    # spacing of the trial shifts; a parabola interpolates between them
    shift_step: float = 0.1
    # spacing at which the model is tabulated; it divides both steps, so that all samples of all
    # trial shifts are on the grid
    model_pitch: float = 0.05
    # smallest and largest half width of legs for which the model is tabulated
    half_width_range: tuple[float, float] = (3.0, 60.0)
    # number of half widths, in geometric progression (ratio 1.22); the nearest one is used
    half_width_count: int = 16
    # smallest and largest trial blur, standard deviation of lens, pixel and interpolation
    # together: below, pixels alias; above, images are binned
    blur_range: tuple[float, float] = (0.45, 1.45)
    # spacing of the trial blurs; a parabola interpolates between them
    blur_step: float = 0.1
    # blur that is tried first, and the default where no profile determines it: lens 0.6, pixel 0.3
    usual_blur: float = 0.7
    # trial blurs on both sides of the best one: further values move the estimate by less than its
    # uncertainty; with the nearest neighbours alone, a local minimum of a hundred poor profiles
    # may be mistaken for the best (measured)
    blurs_beside: int = 2
    # number of profiles that determine the blur to a hundredth of a pixel; more only take time
    enough_for_blur: int = 500
    # fewest profiles for an estimate of the blur: if fewer are uncut, as those of a single wide
    # leg among slim ones, the profiles with the next larger cuts are added
    fewest_for_blur: int = 100
    # lower bound of the standard deviation of a sample, grey levels: 8-bit rounding (0.3) and
    # model errors. It limits the weight of a fit that is perfect by chance
    grey_noise: float = 0.6
    # share of the contrast by which real profiles differ from the model; the scale of
    # the two shading priors
    model_error: float = 0.01
    # prior sigma of the shading's linear part, contrasts per pixel. Complete profiles are hardly
    # affected; where a leg is overexposed and only the flank of the limb is left, the two priors
    # bound the hidden shading, so that the position's sigma grows realistically
    shading_slope: float = 0.3
    # prior sigma of the shading's root part at a depth of a pixel, contrasts
    shading_root: float = 1.0
    # smallest grey level of a clipped sample: interpolation and compression blur 255, by less than
    # five times the noise of one level
    saturated: int = 255 - int(CONTRADICTION_SIGMAS)
    # position up to which a profile may be clipped: the edge itself, half a sample inside
    most_cut: float = -step / 2
    # largest distance of a profile's edge from that of its leg as a whole: further away are
    # highlights, which all points of an edge may show consistently
    own_edge: float = 0.5

    @property
    def faint_sigma(self) -> float:
        """Standard deviation of a position, px, from which a profile has no edge: the window."""
        return self.own_edge

    @cached_property
    def shifts(self) -> Array:
        """Trial shifts of the edge from its prediction, px."""
        return np.arange(-self.shift_reach, self.shift_reach + self.shift_step / 2, self.shift_step)

    @cached_property
    def blurs(self) -> Array:
        """Trial values of the blur, px."""
        first, last = self.blur_range
        return np.arange(first, last + self.blur_step / 2, self.blur_step)

    @cached_property
    def half_widths(self) -> Array:
        """Tabulated half widths, px."""
        return np.geomspace(*self.half_width_range, self.half_width_count)

    @cached_property
    def sampled_offsets(self) -> Array:
        """Sample positions of a profile, px outward from the predicted edge."""
        return np.arange(-self.sampled_inside, self.reach_outside + self.step / 2, self.step)

    @cached_property
    def profile_offsets(self) -> Array:
        """Sample positions that the model explains, the outermost of :attr:`sampled_offsets`."""
        return np.arange(-self.reach_inside, self.reach_outside + self.step / 2, self.step)


PROFILE_OPTIONS = ProfileOptions()


BRIGHTNESS_UNKNOWNS = 5
"""Number of linear unknowns of the model: three inside the limb, two outside."""


BlurByStation = Mapping[int, float]
"""Blur (px, standard deviation) of the edges in the images of each station."""


@dataclass(frozen=True)
class ProfileEdges:
    """Edge positions in profiles.

    position : (...) px outward from the predicted edge.
    sigma : (...) standard deviation, px, from grey-level noise.
    valid : (...) whether the profile shows an edge.
    """

    position: Array
    sigma: Array
    valid: Booleans


@lru_cache(maxsize=512)
def _blurred_model(blur: float, half_width: float, options: ProfileOptions) -> tuple[Array, Array]:
    """Positions x (px outward of the edge), (n,), and the five blurred basis functions there, (n,
    5).
    """
    place = np.arange(-options.reach_inside - 8, options.reach_outside + 8, options.model_pitch)
    inside = (place < 0).astype(float)
    inside[np.abs(place) < options.model_pitch / 2] = 0.5
    depth = np.clip(-place, 0.0, 2 * half_width)
    root = np.sqrt(depth * (2 * half_width - depth))
    columns = [inside, depth, root, 1 - inside, np.maximum(place, 0.0)]
    # odd length: np.convolve shifts an even kernel, and the edge with it, by half a pitch
    half = int(np.ceil(5 * blur / options.model_pitch))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * options.model_pitch / blur) ** 2)
    smooth = [np.convolve(c, kernel / kernel.sum(), mode="same") for c in columns]
    return place, np.stack(smooth, axis=1)


@lru_cache(maxsize=2048)
def _projections(blur: float, half_width: float, cut: int, options: ProfileOptions) -> Array:
    """Orthonormal bases of the model at each trial position, (samples, 5 x shifts).

    The first basis vectors of all positions come first, then the second ones. The priors of the
    shading are two rows below the samples, with zero data; only the rows of the samples are
    returned, which suffices for the projection of such data.

        [ samples         ]
        [ prior of slope  ]  =  Q R,   of Q the rows of the samples
        [ prior of root   ]

    cut : samples at the inner end that are not used; their rows are zero.
    """
    place, model = _blurred_model(blur, half_width, options)
    at = options.profile_offsets - options.shifts[:, None]
    values = model[np.rint((at - place[0]) / options.model_pitch).astype(int)]
    values[:, :cut] = 0.0
    beliefs = np.zeros((len(options.shifts), 2, BRIGHTNESS_UNKNOWNS))
    beliefs[:, 0, 1] = options.model_error / options.shading_slope
    beliefs[:, 1, 2] = options.model_error / options.shading_root * np.sqrt(2 * half_width)
    bases = np.linalg.qr(np.concatenate([values, beliefs], axis=1))[0][:, : at.shape[1]]
    return bases.transpose(1, 2, 0).reshape(at.shape[1], -1)


class _Kinds(NamedTuple):
    """Profiles sorted by kind, a combination of station, half width and cut; a station has a few
    dozen.

    scaled : (N, samples) divided by the contrast, less the outermost sample, sorted by kind.
    square : (N,) sums of squares.
    order : (N,) index of each sorted profile.
    parts : for each kind its first and end row, station, half width (px) and cut.
    """

    scaled: Array
    square: Array
    order: Integers
    parts: list[tuple[tuple[int, int], int, float, int]]


@dataclass(frozen=True)
class Profiles:
    """N averaged profiles across edges.

    grey : (N, samples) at :attr:`ProfileOptions.profile_offsets`.
    count : (N,) number of image profiles in each average.
    half_width : (N,) of the leg there, px.
    cut : (N,) samples at the inner end that are not used: clipped at the camera's brightest level,
        or too deep inside a slim leg.
    station : (N,) station, which determines the blur.
    strip, bright : (N,), see :func:`strips`.
    options : of the model, which fix the sample positions.
    """

    grey: Array
    count: Array
    half_width: Array
    cut: Integers
    station: Integers
    strip: Integers
    bright: Booleans
    options: ProfileOptions = PROFILE_OPTIONS

    @classmethod
    def of(
        cls,
        grey: Array,
        clipped: Booleans,
        count: Array,
        half_width: Array,
        station: Integers,
        options: ProfileOptions = PROFILE_OPTIONS,
    ) -> Profiles:
        """Profiles from grey levels and clipping.

        grey : (N, samples) at :attr:`ProfileOptions.sampled_offsets`.
        clipped : (N, samples) at :attr:`ProfileOptions.profile_offsets`.
        """
        explained, cut = grey[:, -clipped.shape[1] :], cut_of(clipped, half_width, options=options)
        strip = strips(grey, count, half_width, options=options)
        return cls(explained, count, half_width, cut, station, *strip, options)

    def select(self, keep: Booleans | Integers) -> Profiles:
        """The profiles at a mask or at indices."""
        arrays = (f.name for f in fields(self) if f.name != "options")
        return replace(self, **{name: getattr(self, name)[keep] for name in arrays})

    @cached_property
    def contrast(self) -> Array:
        """Largest grey-level difference of each profile, (N,)."""
        return _contrast(self.grey)

    @cached_property
    def by_kind(self) -> _Kinds:
        """Profiles sorted such that each kind takes one projection."""
        # double precision: the residual of a good fit is a millionth of the profile
        scaled = (self.grey - self.grey[:, -1:]).astype(float)
        scaled /= self.contrast[:, None]
        samples = scaled.shape[1]
        scaled[np.arange(samples) < self.cut[:, None]] = 0.0
        half_widths = self.options.half_widths
        # the nearest tabulated width: their geometric means are the boundaries
        boundaries = np.sqrt(half_widths[1:] * half_widths[:-1])
        width = np.searchsorted(boundaries, self.half_width)
        kind = np.minimum(self.cut, samples - 1) + samples * (
            width + len(half_widths) * self.station
        )
        order = np.argsort(kind, kind="stable")
        kind = kind[order]
        first = np.flatnonzero(np.diff(kind, prepend=-1))
        widths, cuts = divmod(kind[first], samples)
        stations, widths = divmod(widths, len(half_widths))
        columns = (v.tolist() for v in (stations, half_widths[widths], cuts))
        parts = zip(pairwise([*first.tolist(), len(kind)]), *columns, strict=True)
        scaled = scaled[order]
        return _Kinds(scaled, np.einsum("ni,ni->n", scaled, scaled), order, list(parts))


def cut_of(
    saturated: Booleans, half_width: Array, options: ProfileOptions = PROFILE_OPTIONS
) -> Integers:
    """Number (N,) of samples that are not used at the inner end of profiles.

    These are the samples up to the outermost saturated one, and those deeper than the modelled
    limb.

    saturated : (N, samples).
    half_width : (N,) of the leg, px.
    """
    count = saturated.shape[-1]
    last = count - np.argmax(saturated[..., ::-1], axis=-1)
    depth = np.maximum(options.limb_share * half_width, options.least_inside)
    beyond = np.searchsorted(options.profile_offsets, -depth - 1e-9)
    return np.maximum(np.where(saturated.any(axis=-1), last, 0), beyond)


def strips(
    grey: Array, count: Array, half_width: Array, options: ProfileOptions = PROFILE_OPTIONS
) -> tuple[Integers, Booleans]:
    """Bright or dark strips within the limb of profiles.

    Returns the number of samples (N,) of :attr:`ProfileOptions.profile_offsets` inward of the
    middle of a strip, 0 without one, and whether the strip is brighter than the background (N,).

    A strip is detected where, further inside, the deviation from the background decreases by more
    than diffuse light usually allows, whose cosine changes by ``options.limb_share`` down to that
    depth, and by more than noise.

    grey : (N, samples) at :attr:`ProfileOptions.sampled_offsets`.
    count, half_width : (N,), as in `Profiles`.
    """
    offsets = options.sampled_offsets
    background = np.median(grey[:, offsets >= options.clear_outside], axis=1, keepdims=True)
    inside = np.flatnonzero(offsets <= -options.step)[::-1]  # from the limb inwards
    violation = grey[:, inside] - background
    away = np.abs(violation)
    # decrease of the deviation from its running maximum
    most = np.maximum.accumulate(away, axis=1)
    contrast = _contrast(grey[:, offsets >= -options.reach_inside])
    noise = (np.hypot(_noise(contrast, count, options), options.model_error) * contrast)[:, None]
    less = most - away > np.maximum(options.highlight_deviations * noise, options.limb_share * most)
    depth = np.maximum(options.limb_share * half_width, options.reach_inside)
    less &= -offsets[inside] <= depth[:, None]
    # last running maximum before the decrease
    before = np.arange(len(inside)) < np.argmax(less, axis=1)[:, None]
    largest = len(inside) - 1 - np.argmax(((away == most) & before)[:, ::-1], axis=1)
    there, which = less.any(axis=1), np.arange(len(grey))
    middle = np.minimum(offsets[inside[largest]], -options.least_inside)
    cut = np.searchsorted(options.profile_offsets, middle - 1e-9)
    return np.where(there, cut, 0), there & (violation[which, largest] > 0)


def without_highlights(profiles: Profiles, blur: BlurByStation) -> tuple[Profiles, Booleans]:
    """Profiles cut to exclude samples deeper than a strip, and mask (N,) of those with a highlight.

    The reflection of a lamp in polished metal, at some depth inside the limb, is not in the model;
    if the profile contains its far side, its near side is the likelier edge. Between highlight and
    limb the metal is as dark as the background, so the edge itself is invisible. Paint lit from
    behind has a bright strip as well, but one that the model explains to its usual error; a
    highlight it does not.
    """
    options = profiles.options
    bright, odd = np.flatnonzero(profiles.bright), np.zeros(len(profiles.cut), dtype=bool)
    if bright.size:
        whole = profiles.select(bright)
        residual = residual_curves(whole, blur).min(axis=-1) * options.step
        expected = _noise(whole.contrast, whole.count, options) ** 2 + options.model_error**2
        odd[bright] = residual > expected * _freedom(whole)
    return replace(profiles, cut=np.maximum(profiles.cut, profiles.strip)), odd


def residual_curves(profiles: Profiles, blur: BlurByStation) -> Array:
    """Sum of squared residuals (N, shifts) at every trial position, in squared contrasts."""
    options = profiles.options
    kinds, shifts = profiles.by_kind, len(options.shifts)
    explained = np.empty((len(kinds.scaled), shifts))
    for (first, end), station, half_width, cut in kinds.parts:
        # explained = sum of squares of the projections on the five basis vectors
        bases = _projections(round(float(blur[station]), 3), half_width, cut, options)
        along = (kinds.scaled[first:end] @ bases).reshape(-1, BRIGHTNESS_UNKNOWNS, shifts)
        np.einsum("nbs,nbs->ns", along, along, out=explained[first:end])
    out = np.empty_like(explained)
    out[kinds.order] = kinds.square[:, None] - explained
    return np.maximum(out, 0.0, out=out)


def shift_log_likelihoods(profiles: Profiles, curves: Array) -> Array:
    """Log-likelihood (N, shifts) of every trial position with unknown noise, less its maximum.

    Zero for profiles that are clipped up to their edge.

    curves : (N, shifts), :func:`residual_curves`.
    """
    options = profiles.options
    samples = np.maximum(profiles.grey.shape[-1] - profiles.cut, 1)
    floor = samples * (
        _noise(profiles.contrast, profiles.count, options) ** 2 + options.model_error**2
    )
    out = -_freedom(profiles)[:, None] / 2 * np.log(curves + floor[:, None])
    out -= out.max(axis=-1, keepdims=True)
    return np.where(_shows_its_edge(profiles)[:, None], out, 0.0)


def locate(profiles: Profiles, curves: Array, about: Array) -> ProfileEdges:
    """Edge positions of profiles, each within the window about its leg's edge.

    curves : (N, shifts), :func:`residual_curves`.
    about : (N,) position of the leg's edge, px outward.
    """
    # lowest trial position within the window
    options = profiles.options
    step = options.shifts[1] - options.shifts[0]
    half = round(options.own_edge / step)
    middle = np.rint((about - options.shifts[0]) / step).astype(int)
    middle = np.clip(middle, half, len(options.shifts) - 1 - half)
    near = middle[:, None] + np.arange(-half, half + 1)
    lowest = np.argmin(np.take_along_axis(curves, near, axis=-1), axis=-1)
    best = middle - half + np.clip(lowest, 1, 2 * half - 1)
    # parabola through the minimum and its neighbours
    left, here, right = (
        np.take_along_axis(curves, (best + d)[..., None], -1)[..., 0] for d in (-1, 0, 1)
    )
    bend = np.maximum(left - 2 * here + right, 1e-12)
    position = options.shifts[best] + step * np.clip((left - right) / (2 * bend), -1, 1)
    noise = _noise(profiles.contrast, profiles.count, options)
    variance = here * options.step / _freedom(profiles) + noise**2
    # cost(x) = residual / (variance / options.step): its second derivative is 2 / sigma^2
    sigma = np.sqrt(2 * (variance / options.step) / (bend / step**2))
    inside = (lowest > 0) & (lowest < 2 * half)
    return ProfileEdges(
        position, sigma, inside & _shows_its_edge(profiles) & (sigma < options.faint_sigma)
    )


def _contrast(grey: Array) -> Array:
    """Largest difference of grey levels (N,), at least 1e-3."""
    return np.maximum(np.ptp(grey, axis=-1), 1e-3)


def _noise(contrast: Array, count: Array, options: ProfileOptions) -> Array:
    """Lower bound (N,) of a sample's noise, in contrasts."""
    return options.grey_noise / contrast / np.sqrt(np.maximum(count, 1))


def _freedom(profiles: Profiles) -> Array:
    """Degrees of freedom (N,) of the residuals.

    Neighbouring samples at half a pixel have correlated noise: two count as one.
    """
    options = profiles.options
    samples = profiles.grey.shape[-1] - profiles.cut
    return np.maximum(samples * options.step - BRIGHTNESS_UNKNOWNS, 1.0)


def _shows_its_edge(profiles: Profiles) -> Booleans:
    """Mask (N,) of the profiles that are not clipped up to their edge."""
    options = profiles.options
    return profiles.cut < np.searchsorted(options.profile_offsets, options.most_cut)


def estimate_blur(profiles: Profiles) -> float:
    """Blur (px) that minimizes the residuals of the model over the profiles of one station.

    Contrast differs between edges, so each profile's residual is divided by its smallest one; the
    median over profiles is minimized, so up to half of them may be outliers. The profiles with the
    smallest cuts are used. The search starts at the usual blur and moves towards the minimum.
    """
    options = profiles.options
    few = min(options.fewest_for_blur, len(profiles.cut))
    whole = np.flatnonzero(profiles.cut <= np.sort(profiles.cut)[few - 1]) if few else np.array([])
    if whole.size:
        profiles = profiles.select(whole[evenly(whole.size, options.enough_for_blur)])
    # walk to the minimum, evaluating its neighbours only
    floor = (options.grey_noise / profiles.contrast) ** 2
    costs = np.full((len(profiles.cut), len(options.blurs)), np.inf)  # inf: not evaluated
    k = int(np.argmin(np.abs(options.blurs - options.usual_blur)))
    while True:
        for near in range(
            max(k - options.blurs_beside, 0), min(k + options.blurs_beside + 1, len(options.blurs))
        ):
            if np.isinf(costs[0, near]):
                tried = dict.fromkeys(profiles.station.tolist(), options.blurs[near])
                costs[:, near] = residual_curves(profiles, tried).min(axis=-1)
        total = np.median(costs / (costs.min(axis=-1) + floor)[:, None], axis=0)
        best = int(np.argmin(total))
        if best == k:
            break
        k = best
    # parabola through the minimum and its neighbours
    k = int(np.clip(k, 1, len(options.blurs) - 2))
    left, here, right = total[k - 1 : k + 2]
    bend = max(left - 2 * here + right, 1e-12)
    return float(
        options.blurs[k]
        + (options.blurs[1] - options.blurs[0]) * np.clip((left - right) / (2 * bend), -1, 1)
    )


@dataclass(frozen=True)
class EdgeFitOptions:
    """Constants of the fit of an edge's plane to positions along the edge."""

    # lower bound of a position's standard deviation, px, however sharp the profile
    sigma_floor: float = 0.02
    # effective sample size of an edge, whatever its length. Shading and paint shift all positions
    # along an edge together, so they do not average out: an edge is one line measured once at each
    # of two halves, not three hundred points
    effective: float = 2.0
    # fewest positions along an edge: two determine shift and tilt, a third tests them
    fewest: int = 3
    # reweighting steps
    rounds: int = 8
    # squared distance from the fit, in variances, below which a position is an inlier: three
    # sigmas (statistical: 3 in 1000 rejected by chance)
    inlier_square: float = OUTLIER_SIGMAS**2
    # smallest share of an edge's positions that are inliers: a minority may lie on another line
    majority: float = MAJORITY


EDGE_FIT_OPTIONS = EdgeFitOptions()


@dataclass(frozen=True)
class EdgeFits:
    """Planes fitted to positions along edges; all arrays (K, E, ...).

    turn : (2,) rotation of the normal in ``basis``, rad.
    basis : (3, 2) tangent basis of the predicted normal.
    covariance : (2, 2) of the rotation.
    operator : (2, n) derivative of the rotation by the positions at the n samples, with the final
        weights.
    used : (n,) inliers.
    good : whether there are enough inliers.
    """

    turn: Array
    basis: Array
    covariance: Array
    operator: Array
    used: Booleans
    good: Booleans


def fit_edges(
    points: EdgePoints,
    position: Array,
    sigma: Array,
    valid: Booleans,
    options: EdgeFitOptions = EDGE_FIT_OPTIONS,
) -> EdgeFits:
    """Robust weighted fit of edge planes, two rotations each, to positions along the edges.

    IRLS with Cauchy weights, against positions on highlights and neighbours. A scatter about the
    fit above the stated sigmas enlarges the covariance.

    position, sigma : (K, E, n) px outward, and standard deviations.
    valid : (K, E, n).
    """
    middle = _middle_ray(points)
    basis = tangent_basis(points.normal, middle)
    rows = np.where(valid[..., None], np.nan_to_num(points.by_normal() @ basis), 0.0)
    value = np.where(valid, position, 0.0)
    base = np.where(valid, 1 / (sigma**2 + options.sigma_floor**2), 0.0)
    # sample by sample for all edges, so that sums run over contiguous memory
    one, two, at, sure = (
        np.ascontiguousarray(v.reshape(-1, v.shape[-1]).T)
        for v in (rows[..., 0], rows[..., 1], value, base)
    )
    squares = np.stack([one * one, one * two, two * two, one * at, two * at])

    def fitted(weight: Array) -> tuple[Array, Array, Array]:
        # N least-squares problems in two unknowns: inverses (2, 2, N) of the normal matrices
        a, b, c, p, q = np.einsum("pnx,nx->px", squares, weight)
        ridge = 1e-12 * (a + c) + 1e-30
        a, c = a + ridge, c + ridge
        inverse = np.stack([c, -b, -b, a]).reshape(2, 2, -1) / (a * c - b * b)
        turn = inverse[0] * p + inverse[1] * q
        return inverse, turn, (at - one * turn[0] - two * turn[1]) ** 2 * sure

    weight = sure
    inverse, turn, off2 = fitted(weight)
    for _ in range(options.rounds):
        weight = sure * cauchy_weights(off2)
        inverse, turn, off2 = fitted(weight)
    shape = valid.shape[:-1]
    off2, weight = (v.T.reshape(valid.shape) for v in (off2, weight))
    # inliers; scatter and correlation enlarge the covariance
    used = valid & (off2 < options.inlier_square)
    count = used.sum(axis=-1)
    scatter = np.sum(used * off2, axis=-1) / np.maximum(count - 2, 1)
    factor = np.maximum(scatter, 1.0) * np.maximum(count / options.effective, 1.0)
    inverse = np.moveaxis(inverse.reshape(2, 2, *shape), (0, 1), (-2, -1))
    operator = inverse @ (rows * weight[..., None]).mT
    good = (count >= options.fewest) & (count >= options.majority * valid.sum(axis=-1))
    covariance = inverse * factor[..., None, None]
    good &= np.isfinite(covariance).all(axis=(-1, -2))
    return EdgeFits(turn.T.reshape(*shape, 2), basis, covariance, operator, used, good)


def _middle_ray(points: EdgePoints) -> Array:
    """Unit ray (..., E, 3) to the middle sample of each edge."""
    ray = points.point[..., points.point.shape[-2] // 2, :]
    return ray / np.sqrt(dot(ray, ray))[..., None]


def edge_set(
    points: EdgePoints,
    fits: EdgeFits,
    tubes: TubeList,
    station: Integers,
    configuration: Integers,
    keep: Booleans,
    by_parameters: Array | None = None,
) -> EdgeSet:
    """Measurements from the fits at ``keep`` (K, E).

    station, configuration : (K,) of the images.
    by_parameters : (K, E, n, 2, p) derivative of the predicted pixels by the camera's parameters,
        where the intrinsics are refined; the measured positions then move in the opposite
        direction.
    """
    k, e = np.nonzero(keep)
    basis = fits.basis[k, e]
    normal = points.normal[k, e] + (basis @ fits.turn[k, e, :, None])[..., 0]
    normal /= np.sqrt(dot(normal, normal))[:, None]
    middle = _middle_ray(points)[k, e]
    along = np.where(fits.used[k, e], points.along[k, e], np.nan)
    # derivative (K, E, 2, p) of the planes' rotation by the camera's parameters, pixels fixed
    by_intrinsics = np.zeros((*fits.turn.shape, 0))
    if by_parameters is not None:
        outward = (points.outward[..., None, :] @ by_parameters)[..., 0, :]
        used = fits.used[..., None] & np.isfinite(outward)
        by_intrinsics = -fits.operator @ np.where(used, outward, 0.0)
    return EdgeSet(
        station=station[k],
        configuration=configuration[k],
        leg=tubes.leg[e],
        tube=tubes.tube[e],
        side=tubes.side[e],
        normal=normal,
        # the rotation is a few milliradians: the same two coordinates serve at the rotated normal
        basis=tangent_basis(normal, middle),
        covariance=fits.covariance[k, e],
        shift=fits.operator[k, e].sum(axis=-1),
        span=np.stack([np.nanmin(along, axis=1), np.nanmax(along, axis=1)], axis=1),
        by_intrinsics=by_intrinsics[k, e],
    )
