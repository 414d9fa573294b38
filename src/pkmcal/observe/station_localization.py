"""Localization of a station: a coarse search for the machine in its images.

Around a rough pose, poses are drawn at random, first a few with the usual error of a good prior.
Without a rough pose, they cover all directions round the machine
(:mod:`pkmcal.observe.pose_candidates`). The best are refined
(:mod:`pkmcal.observe.pose_likelihood`) on an increasing number of images, with decreasing distance
limits.

The result is then tested, for every image has a most likely pose, with or without a machine. The
pose is searched in some of the images and tested on the others: at this pose, do their own readings
fit better than the readings of other images of the session? Without the machine they do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import angle_between, inverse, pose, rotation
from pkmcal.levels import NEARLY_ALL
from pkmcal.observe.image_localization import PoseHypotheses
from pkmcal.observe.pose_candidates import CANDIDATE_OPTIONS, CandidateOptions, global_candidates
from pkmcal.observe.pose_likelihood import (
    StationView,
    by_image,
    correlation_length,
    distances_under,
    distinct_silhouettes,
    mixture_of,
    refine_lm,
    refine_ml,
    score,
)
from pkmcal.observe.shadows import (
    SHADOW_OPTIONS,
    ShadowOptions,
    lightness,
    without_shadows,
)
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS


@dataclass(frozen=True)
class SearchRadius:
    """Extent of the search around a rough pose.

    turn, shift : standard deviations of the poses that are drawn, rad and m.
    tried : number of poses drawn.
    descending : number of poses that are refined.
    enough : probability by chance, from some of the images, below which the others are not
        searched.
    """

    turn: float
    shift: float
    tried: int
    descending: int
    enough: float

    @property
    def spread(self) -> Array:
        """Standard deviations (6,), rad and m."""
        return np.repeat([self.turn, self.shift], 3)

    def reaches(self, T_camera_base: Array, other: Array) -> bool:
        """Whether two poses (4, 4) differ by less than the drawn poses do on average, rotation and
        shift together.
        """
        turn, shift = angle_between(T_camera_base, other), T_camera_base @ inverse(other)
        square = (turn / self.spread[0]) ** 2 + np.sum((shift[:3, 3] / self.spread[3:]) ** 2)
        return bool(square < len(self.spread))


@dataclass(frozen=True)
class LocalizationOptions:
    """Constants of the localization of a station; reaches in reduced pixels."""

    # wide search. The norm of the spread over three axes is 26 degrees and 26 cm; of poses that
    # are 30 degrees and 30 cm off, 97 of 100 lead to the correct one (measured). A rough pose that
    # is off by more than the search covers cannot be distinguished from a correct one: in clutter,
    # images confirm the pose that fits near it with a probability by chance down to one in ten
    # thousand
    far: SearchRadius = SearchRadius(np.radians(15.0), 0.15, 3200, 48, 1e-6)
    # narrow search, a third as wide, done first, and for each of some thirty hypotheses. If the
    # rough pose is off by more, a search rarely ends this close to it by chance
    near: SearchRadius = SearchRadius(np.radians(15.0) / 3, 0.15 / 3, 160, 8, 1e-3)
    # spread of the second draw of poses, about the best of the first, relative to the first
    narrowing: float = 0.45
    # reaches of the scores of the two draws
    draw_reaches: tuple[float, float] = (12, 10)
    # ratio of the poses drawn to those that are scored on four images instead of two, which
    # discriminate nearly as well (measured)
    rescored: int = 8
    # number of candidates without a prior that are refined: before the refinement the images
    # hardly distinguish poses that are near the correct one, least of all with three equal legs
    global_refined: int = 1200
    # number of these that are retained afterwards
    global_retained: int = 300
    # reaches of the steps of this refinement, falling from the distance at which an edge is
    # attracted
    global_reaches: tuple[float, ...] = (14, 12, 10, 10, 8, 8)
    # reaches of the next refinement
    reaches: tuple[float, ...] = (8, 8, 6, 6, 5, 5)
    # reaches of the refinement before perturbed poses are drawn
    candidate_reaches: tuple[float, ...] = (5, 4, 4, 3)
    # reaches of the robust refinement of the likeliest pose
    final_reaches: tuple[float, ...] = (5, 3, 2, 1.5)
    # number of candidates that are compared on eight images
    retained: int = 24
    # number of distinct candidates around which perturbed poses are drawn
    perturbed_about: int = 4
    # standard deviation of the perturbed poses' rotation, rad
    shaken_turn: float = np.radians(2.0)
    # standard deviation of their shift, m
    shaken_shift: float = 0.02
    # number of perturbed poses before the last refinement
    perturbed: int = 48
    # number of these that are retained after two steps
    perturbed_retained: int = 16
    # number of likeliest poses, if they are all the same, that are refined without perturbed ones
    likeliest: int = 4
    # number of distinct poses that one search returns
    returned: int = 3
    # number of candidates scored without a prior, for each of some thirty hypotheses
    few_global: int = 160
    # number of these that are retained
    few_retained: int = 16
    # number of poses refined for each of some thirty hypotheses
    nearby_refined: int = 8
    # number of hypotheses refined besides the first; three are searched completely
    hypotheses_refined: int = 8
    # fewest images from which a half is held out for the test: three images remain for a search
    # without a prior
    fewest_for_halves: int = 7
    # fewest images from which a third is held out; with fewer, each image is held out in turn
    fewest_for_thirds: int = 5
    # the same as for halves, with a prior: around a rough pose two images suffice for a search
    fewest_for_halves_with_prior: int = 4
    # probability of so large a likelihood by chance below which the machine is localized without a
    # prior (statistical)
    false_alarm: float = math.exp(-HYPOTHESIS_THRESHOLDS.act)
    # the same from some of the images, below which the others are not searched without a prior: by
    # the union bound it adds a tenth to the false alarms (statistical)
    early: float = false_alarm * (1 - NEARLY_ALL)
    # the same near a hand-placed pose, if nearly all of these are right: a false alarm is one near
    # a wrong pose only (statistical)
    false_alarm_with_prior: float = false_alarm / (1 - NEARLY_ALL)
    # probability of a second pose above which neither is accepted (statistical)
    rival: float = math.exp(-HYPOTHESIS_THRESHOLDS.report)
    # grid of candidates without a prior
    candidates: CandidateOptions = CANDIDATE_OPTIONS
    # detection of shadows among the poses
    shadows: ShadowOptions = SHADOW_OPTIONS

    @property
    def shaken_spread(self) -> Array:
        """Standard deviations (6,), rad and m, of perturbed poses around the best ones."""
        return np.repeat([self.shaken_turn, self.shaken_shift], 3)


LOCALIZATION_OPTIONS = LocalizationOptions()


class _PosePrior(NamedTuple):
    """A rough pose (4, 4), and the extent of the search around it."""

    T_camera_base: Array
    nearness: SearchRadius


@dataclass(frozen=True)
class LocalizedPose:
    """Localized pose of a station.

    T_camera_base : (4, 4).
    score : mean truncated distance to image edges, 0 perfect, 1 nothing fits.
    log_likelihood_ratio : against chance, by reduced pixels of silhouette.
    p_value : probability of so large a likelihood without the machine.
    second : probability that another pose is the correct one.
    has_prior : whether the search was around a rough pose.
    correlation_length : reduced pixels of silhouette that count as one measurement.
    options : of the localization.
    """

    T_camera_base: Array
    score: float
    log_likelihood_ratio: float
    p_value: float
    second: float = 0.0
    has_prior: bool = False
    correlation_length: float = 1.0
    options: LocalizationOptions = LOCALIZATION_OPTIONS

    @classmethod
    def of_image(cls, hypotheses: PoseHypotheses, has_prior: bool) -> LocalizedPose:
        """Likeliest pose of a single image, in which rivals take the place of chance matches: there
        are no other images to test it on.
        """
        return cls(
            hypotheses.T_camera_base[0],
            math.nan,
            float(hypotheses.log_likelihood_ratio[0]),
            hypotheses.rival_probability,
            has_prior=has_prior,
            correlation_length=hypotheses.unit,
        )

    def likelier(self, other: LocalizedPose) -> float:
        """Log odds of this explanation of the images against another one of the same images."""
        return (self.log_likelihood_ratio - other.log_likelihood_ratio) / self.correlation_length

    @property
    def limit(self) -> float:
        """Upper bound of ``p_value`` for acceptance."""
        return self.options.false_alarm_with_prior if self.has_prior else self.options.false_alarm

    @property
    def good(self) -> bool:
        """Whether the machine is localized, at one pose only."""
        return self.p_value < self.limit and self.second < self.options.rival

    @property
    def sure(self) -> bool:
        """Whether the machine would be localized without the prior."""
        return self.p_value < self.options.false_alarm and self.second < self.options.rival


def find_station(
    view: StationView,
    T_camera_base: Array | None,
    rng: np.random.Generator,
    near_prior: bool = False,
    options: LocalizationOptions = LOCALIZATION_OPTIONS,
) -> LocalizedPose:
    """Camera pose of a station near a rough pose, or anywhere.

    The pose is searched in half of the images or, with few, in all but one or two, and tested on
    the held-out ones; each part is held out in turn. Then the pose is refined on all images.

    T_camera_base : rough pose (4, 4); None searches everywhere.
    near_prior : also try perturbed poses where the likeliest are all the same, as in a search
        without a prior, and require the certainty of a wide search, for log-likelihoods that are to
        be compared.
    """
    if T_camera_base is None:
        return _localize(view, None, rng, near_prior, options)
    if len(view.configuration) > 1:  # a single image has no held-out test
        near = _localize(view, _PosePrior(T_camera_base, options.near), rng, near_prior, options)
        if near.sure and options.near.reaches(T_camera_base, near.T_camera_base):
            return near
    return _localize(view, _PosePrior(T_camera_base, options.far), rng, near_prior, options)


def _localize(
    view: StationView,
    prior: _PosePrior | None,
    rng: np.random.Generator,
    near_prior: bool,
    options: LocalizationOptions,
) -> LocalizedPose:
    """Result of one search, around a rough pose or anywhere."""
    count = len(view.configuration)
    number = np.arange(count)
    halves = options.fewest_for_halves_with_prior if prior else options.fewest_for_halves
    enough = (options.far if near_prior else prior.nearness).enough if prior else options.early
    folds = 2 if count >= halves else 3 if count >= options.fewest_for_thirds else count
    retained: list[Array] = []
    surely: list[Array] = []
    held_out = [number % folds == fold for fold in range(folds if count > 1 else 0)]
    parts = [
        (np.flatnonzero(~part), np.flatnonzero(part)) for part in held_out
    ]  # a single image has no folds
    for searched, other in parts:
        value = _search(view.select(searched), prior, rng, near_prior, options)
        retained.append(value)
        surely.append(_z_scores(view, value[0], searched, other, rng))
        if _by_chance(surely) < enough:
            break
    # refine the results of all folds on all images, and drop shadows
    candidates = (
        np.concatenate(retained) if retained else _search(view, prior, rng, near_prior, options)
    )
    every = view.few(count)
    candidates, log_likelihood_ratio = refine_ml(view, candidates, every, 8, 8)
    order = np.argsort(-log_likelihood_ratio)
    legs = view.legs(every).under(candidates[order])
    light = lightness(view.camera, view.tubes, legs, view.tables, options.shadows)
    order = order[without_shadows(candidates[order], light, options.shadows)]
    # probability by chance, from the folds that ended at the best pose
    first = np.cumsum([0, *(len(value) for value in retained)])[:-1]
    confirmed = _confirmed(view, candidates[order[0]], candidates[first], surely)
    if parts and not prior and confirmed >= options.false_alarm:
        confirmed = min(confirmed, _second_search(view, candidates[order], parts, rng, options))
    # distinct poses, and a robust refinement of the best
    order = order[distinct_silhouettes(view, candidates[order], every)]
    candidates, log_likelihood_ratio = candidates[order], log_likelihood_ratio[order]
    # the likeliest pose uses all edges; where hidden ones were matched by chance, the nearby edges
    # alone determine the pose better
    best = candidates[:1]
    nearer = refine_lm(view, best, every, 8, options.final_reaches)
    ends = np.concatenate([nearer, best])
    scores, each = (
        score(view, ends, every, view.options.last_reach),
        correlation_length(view, candidates[0]),
    )
    return LocalizedPose(
        T_camera_base=ends[scores.argmin()],
        score=float(scores.min()),
        log_likelihood_ratio=float(log_likelihood_ratio[0]),
        p_value=confirmed,
        second=_second(log_likelihood_ratio, each),
        has_prior=prior is not None,
        correlation_length=each,
    )


def _search(
    view: StationView,
    prior: _PosePrior | None,
    rng: np.random.Generator,
    near_prior: bool,
    options: LocalizationOptions,
) -> Array:
    """Up to three poses (H, 4, 4) from one search, the likeliest first."""
    few, more = view.few(4), view.few(8)
    if prior is None:
        # more candidates for fewer images, which discriminate less and cost less
        each = 4 // len(few)
        candidates = _anywhere(view, few, each * options.global_refined, options)
        candidates = refine_lm(view, candidates, few, 3, options.global_reaches)
        candidates = _best(view, candidates, few, reach=8, keep=each * options.global_retained)
    else:
        candidates = _random_search(view, prior, rng, options)
    # robust refinement, then the best on more images
    candidates = refine_lm(view, candidates, few, 5, options.reaches)
    if prior is None:
        # most are the same as a better one, and by their distances alone the correct pose is
        # often not among the best ten: distinct ones, which the likelihood then compares
        candidates = _best(view, candidates, more, reach=5, keep=len(candidates))
        distinct = distinct_silhouettes(view, candidates, more)[: options.retained]
        candidates = candidates[distinct]
    else:
        candidates = _best(view, candidates, more, reach=5, keep=options.retained)
    likelier = candidates[: len(candidates) // 2]
    # if all images took part in the refinement, none is left to disagree, unless the prior is
    # narrow
    near = prior is not None and prior.nearness == options.near
    near_prior = near_prior or prior is None or (not near and len(more) == len(few))
    if not near_prior and len(distinct_silhouettes(view, likelier, more)) == 1:
        others = distinct_silhouettes(view, candidates, more)[1:3]
        candidates = candidates[[*range(options.likeliest), *others]]
    else:
        candidates = _best_about(view, candidates, more, rng, options)
    # maximum likelihood
    candidates, log_likelihood_ratio = refine_ml(view, candidates, more, 5, 5)
    candidates = candidates[np.argsort(-log_likelihood_ratio)]
    return candidates[distinct_silhouettes(view, candidates, more)[: options.returned]]


def _best_about(
    view: StationView,
    candidates: Array,
    images: Integers,
    rng: np.random.Generator,
    options: LocalizationOptions,
) -> Array:
    """Likeliest poses (H, 4, 4) among refined candidates and perturbations of them."""
    candidates = refine_lm(view, candidates, images, 5, options.candidate_reaches)
    candidates, log_likelihood_ratio = refine_ml(view, candidates, images, 3, 2)
    candidates = candidates[np.argsort(-log_likelihood_ratio)]
    candidates = candidates[
        distinct_silhouettes(view, candidates, images)[: options.perturbed_about]
    ]
    # the likelihood has many local maxima: a pose beside a good one may be better
    beside = candidates[rng.integers(0, len(candidates), options.perturbed)]
    steps = rng.normal(size=(options.perturbed, 6)) * options.shaken_spread
    turned = inverse(inverse(beside) @ pose(rotation(steps[:, :3]), steps[:, 3:]))
    candidates, log_likelihood_ratio = refine_ml(
        view, np.concatenate([candidates, turned]), images, 3, 2
    )
    return candidates[np.argsort(-log_likelihood_ratio)[: options.perturbed_retained]]


def _anywhere(view: StationView, few: Integers, keep: int, options: LocalizationOptions) -> Array:
    """Candidates (keep, 4, 4) without a prior, all round the machine."""
    legs = view.legs(np.arange(len(view.configuration)))
    legs = legs if view.guessed is None else legs[0]
    radius = view.machine.values[view.tubes.radius]
    return global_candidates(
        view.camera, view.tubes, radius, legs, view.tables, few, keep, options.candidates
    )


def _random_search(
    view: StationView, prior: _PosePrior, rng: np.random.Generator, options: LocalizationOptions
) -> Array:
    """Candidates (``descending``, 4, 4) around a rough pose: a wide random draw, then a narrower
    one around the best of it.
    """
    T_base_camera, nearness = inverse(prior.T_camera_base), prior.nearness
    spread, tried, descending = nearness.spread, nearness.tried, nearness.descending

    def shifted(steps: Array) -> Array:
        return inverse(T_base_camera @ pose(rotation(steps[:, :3]), steps[:, 3:]))

    few = view.few(4)

    def likely(steps: Array, reach: float, keep: int) -> Array:
        # two images and few samples suffice to discard most poses
        first = np.argsort(score(view, shifted(steps), few[::2], reach, 3))
        steps = steps[first[: max(len(steps) // options.rescored, keep)]]
        return steps[np.argsort(score(view, shifted(steps), few, reach))[:keep]]

    steps = rng.normal(size=(tried, 6)) * spread
    steps[0] = 0.0
    first_reach, second_reach = options.draw_reaches
    best = likely(steps, first_reach, 4 * descending)
    again = best[rng.integers(0, len(best), tried // 2)]
    again = again + rng.normal(size=again.shape) * (options.narrowing * spread)
    return shifted(likely(np.concatenate([best, again]), second_reach, descending))


def _best(view: StationView, candidates: Array, images: Integers, reach: float, keep: int) -> Array:
    """The ``keep`` candidates with the smallest mean distance."""
    order = np.argsort(score(view, candidates, images, reach))
    return candidates[order[:keep]]


def likelihood_nearby(
    view: StationView,
    readings: Array,
    starts: Array,
    wide: bool,
    few: Integers,
    rng: np.random.Generator,
    options: LocalizationOptions = LOCALIZATION_OPTIONS,
) -> Array:
    """Log-likelihood ratios (N,) that a short search reaches for each of several sets of readings.

    With many sets, those far from the best, except the first, are minus infinity.

    readings : (N, K, m) of all images.
    starts : (S, 4, 4) poses; empty searches everywhere.
    wide : draw poses around the starts first, as around a hand-placed pose.
    few : numbers of the images that are used.
    """
    few_readings = readings if not len(starts) else readings[:, few]
    fk = view.machine.forward_result(
        few_readings.reshape(-1, few_readings.shape[-1])
    ).T_base_platform
    legs = view.legs_at(fk.reshape(*few_readings.shape[:2], 4, 4), few_readings)
    if len(starts):
        view, few = view.select(few), np.arange(len(few))
    each = np.broadcast_to(starts, (len(legs), *starts.shape))
    if wide or not len(starts):
        near = [_about(replace(view, guessed=legs[k : k + 1]), few, starts, rng, options)
                for k in range(len(legs))]  # fmt: skip
        each = np.stack(near)
    # all hypotheses side by side: robust refinement, then maximum likelihood for the best
    count = each.shape[1]
    view = replace(view, guessed=legs[np.repeat(np.arange(len(legs)), count)])
    ends = refine_lm(view, each.reshape(-1, 4, 4), few, 4, (12, 8, 5))
    scores = score(view, ends, few, 5).reshape(-1, count)
    best = np.argsort(scores.min(axis=1)[1:])[: options.hypotheses_refined] + 1
    best = np.concatenate([[0], best])
    order = np.argsort(scores[best], axis=1)[:, : options.nearby_refined]
    retained = (order + count * best[:, None]).ravel()
    settled = refine_ml(view.guess(retained), ends[retained], few, 5, 3)[1]
    log_likelihood_ratio = np.full(len(legs), -np.inf)
    log_likelihood_ratio[best] = settled.reshape(len(best), -1).max(axis=1)
    return log_likelihood_ratio


def _about(
    view: StationView,
    few: Integers,
    starts: Array,
    rng: np.random.Generator,
    options: LocalizationOptions,
) -> Array:
    """Poses (H, 4, 4) worth refining around poses (S, 4, 4), or anywhere, for one set of legs."""
    if not len(starts):
        places = _anywhere(view, few, options.few_global, options)
        return _best(view, places, few, reach=12, keep=options.few_retained)
    return np.concatenate(
        [_random_search(view, _PosePrior(T, options.near), rng, options) for T in starts]
    )


def _z_scores(
    view: StationView,
    T_camera_base: Array,
    searched: Integers,
    other: Integers,
    rng: np.random.Generator,
) -> Array:
    """Standard normal scores (K,) of held-out images for the machine at a pose (4, 4).

    Without the machine, an image's own readings fit no better than other readings. The difference
    in log likelihood, in units of the other readings' scatter, has Student's distribution, which is
    mapped to a standard normal score.

    searched : numbers of the images from which the pose was estimated.
    other : numbers of the held-out images.
    """
    from scipy.special import ndtri, stdtr

    # scatter of the machine's edges, from the images that were searched
    mine = distances_under(view, T_camera_base[None], searched, 8)
    mixture = mixture_of(mine, view.options)
    every = np.arange(len(view.configuration))
    guessed = view.legs(every)[None].joined(view.rivals(rng))
    places = np.broadcast_to(T_camera_base, (len(guessed), 4, 4))
    distances = distances_under(replace(view, guessed=guessed), places, other, 8)
    # own readings against the others
    own, *rivals = by_image(distances.log_likelihood(mixture), len(other))
    count, fits = len(rivals), np.stack(rivals)
    scatter = np.maximum(fits.std(axis=0, ddof=1), 1e-9) * np.sqrt(1 + 1 / count)
    away = (own - fits.mean(axis=0)) / scatter
    return -ndtri(np.maximum(stdtr(count - 1, -away), 1e-300))


def _second(log_likelihood_ratio: Array, correlation_length: float) -> float:
    """Probability that the second pose is the correct one, from log-likelihood ratios (H,)."""
    if len(log_likelihood_ratio) < 2:
        return 0.0
    return 1 / (
        1
        + math.exp(
            min(
                float(log_likelihood_ratio[0] - log_likelihood_ratio[1:].max())
                / correlation_length,
                500.0,
            )
        )
    )


def _confirmed(view: StationView, place: Array, others: Array, surely: list[Array]) -> float:
    """Probability by chance of a pose (4, 4), from the held-out tests of several poses.

    A test of another pose carries no information about this one and is left out. But this pose was
    chosen among several different ones, any of which may be confirmed by chance (Bonferroni).

    place : the pose, T_camera_base (4, 4).
    others : (F, 4, 4) poses that were tested.
    surely : scores (K,) of each test.
    """
    every = view.few(len(view.configuration))
    own = [
        len(distinct_silhouettes(view, np.stack([place, other]), every)) == 1 for other in others
    ]
    if not any(own):
        return _by_chance(surely)
    choices = len(distinct_silhouettes(view, others, every))
    about = [sure for sure, mine in zip(surely, own, strict=True) if mine]
    return min(choices * _by_chance(about), 1.0)


def _second_search(
    view: StationView,
    candidates: Array,
    parts: Sequence[tuple[Integers, Integers]],
    rng: np.random.Generator,
    options: LocalizationOptions,
) -> float:
    """Probability by chance of the first of some poses (H, 4, 4), by a second search that starts at
    it.

    Used where a search in a part of the images ended beside this pose, at one that the rest do not
    confirm. The pose is refined in each part alone and tested on the rest. It was chosen by all
    images among several poses, and this is a second attempt; the probability is multiplied by both.
    """
    surely: list[Array] = []
    for searched, other in parts:
        part = view.select(searched)
        few = part.few(8)
        near, log_likelihood_ratio = refine_ml(
            part, _best_about(part, candidates[:1], few, rng, options), few, 5, 5
        )
        surely.append(_z_scores(view, near[log_likelihood_ratio.argmax()], searched, other, rng))
    choices = len(distinct_silhouettes(view, candidates, view.few(len(view.configuration))))
    return min(2 * choices * _by_chance(surely), 1.0)


def _by_chance(parts: list[Array]) -> float:
    """Probability by chance of the sum of standard normal scores, (K,) from each part."""
    if not parts:
        return 1.0
    surely = np.concatenate(parts)
    return 0.5 * math.erfc(float(surely.sum()) / math.sqrt(2 * len(surely)))
