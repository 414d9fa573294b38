"""Localization of a station: the camera's pose by a coarse search for the machine in its images.

Candidate poses are drawn at random about a rough pose, first a few as near as the right one is as a
rule; for a station without a pose they are all round the machine
(:mod:`pkmcal.observe.pose_candidates`). The best are refined on more and more images, with ever
smaller distances at which residuals are cut off (:mod:`pkmcal.observe.pose_likelihood`).

The result is tested. Some pose has the largest likelihood in any image, with or without a machine.
So the pose is searched in some of the images, and the others confirm it: at that pose, do their own
readings fit better than those of other images of the session? Without the machine they do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.geometry.rigid import angle_between, inverse, pose, rotation
from pkmcal.observe.pose_candidates import global_candidates
from pkmcal.observe.pose_likelihood import (
    LAST_REACH,
    StationView,
    by_photograph,
    correlation_length,
    distances_under,
    distinct_silhouettes,
    first_mixture,
    refine_lm,
    refine_ml,
    score,
)
from pkmcal.observe.shadows import lightness, without_shadows


class _SearchRadius(NamedTuple):
    """Extent of the search about a pose by hand.

    spread : (6,) standard deviations, rad and m, of the poses that are drawn; tried : their number;
    descending : number of them that are refined. enough : p-value of some of the images from which
    the others need not be searched.
    """

    spread: Array
    tried: int
    descending: int
    enough: float

    def reaches(self, T_camera_base: Array, other: Array) -> bool:
        """Whether two poses (4, 4) are no further apart than those drawn are on average, turn and
        shift together.
        """
        turn, shift = angle_between(T_camera_base, other), T_camera_base @ inverse(other)
        square = (turn / self.spread[0]) ** 2 + np.sum((shift[:3, 3] / self.spread[3:]) ** 2)
        return bool(square < len(self.spread))


FAR = _SearchRadius(np.repeat([np.radians(15.0), 0.15], 3), 3200, 48, 1e-6)
"""The spread's norm over three axes is 26 degrees and 26 cm; of poses that are 30 degrees and 30 cm
off, 97 of 100 lead to the right pose. Where the pose by hand is wrong by more than was searched, a
wrong pose that fits cannot be distinguished: before clutter its images confirm it to one in ten
thousand."""
NEAR = _SearchRadius(FAR.spread / 3, 160, 8, 1e-3)
"""Searched first, and for each of many hypotheses. Where a pose is wrong by more, a search does not
end so near to it by chance."""


class _PosePrior(NamedTuple):
    """A rough pose (4, 4), and the extent of the search about it."""

    T_camera_base: Array
    nearness: _SearchRadius


POSES_FOR_RESCORING = 8
"""One in so many of the poses tried is scored again: two images are enough to drop the others."""
GLOBAL_CANDIDATES_REFINED, GLOBAL_CANDIDATES_RETAINED = 1200, 300
"""Poses from all round the machine that are refined, and how many of them go on: before refinement
their scores hardly show which is near, least of all with three equal legs."""
SHAKEN_SPREAD = np.repeat([np.radians(2.0), 0.02], 3)
PERTURBED_POSES_TRIED, PERTURBED_POSES_RETAINED = 48, 16
"""Poses beside the best ones that are tried before the last refinement, their spread (rad and m),
and the number that is retained after two steps."""
LIKELIEST_PLACES_SETTLED = 4
"""Number of the likeliest poses, where all are one pose, that are refined without others beside."""
FEW_GLOBAL_CANDIDATES, FEW_CANDIDATES_RETAINED = 160, 16
"""The same for each of many hypotheses."""
NEARBY_PLACES_SETTLED, HYPOTHESES_SETTLED = 8, 8
"""Poses of each of many hypotheses that are refined to the largest likelihood, and the number of
such hypotheses beside the first."""
FEWEST_FOR_HALVES, FEWEST_FOR_THIRDS, FEWEST_FOR_HALVES_WITH_PRIOR = 7, 5, 4
"""Images from which half of them, or a third, are held out of the search for confirmation; with
fewer, each in turn. About a known pose two are enough for the search."""
EARLY_DECISION = 1e-4
"""p-value of some of the images from which the others need not be searched, without a pose."""
BY_CHANCE, BY_CHANCE_WITH_PRIOR = 1e-3, 1e-2
"""p-value below which the machine is recognised: anywhere, and about a pose by hand, which is
evidence by itself."""
RIVAL_POSE_PROBABILITY = 0.05
"""Posterior probability of a second pose above which neither is accepted."""


@dataclass(frozen=True)
class LocalizedPose:
    """A localized pose T_camera_base (4, 4) and its score: 0 perfect, 1 nothing fits.

    log_likelihood_ratio : against chance, in reduced pixels of silhouette. by_chance : p-value of
    the confirmation by held-out images. second : posterior probability of another pose. has_prior :
    whether the search was about a known pose. correlation_length : reduced pixels of silhouette
    that count as one measurement.
    """

    T_camera_base: Array
    score: float
    log_likelihood_ratio: float
    by_chance: float
    second: float = 0.0
    has_prior: bool = False
    correlation_length: float = 1.0

    def likelier(self, other: LocalizedPose) -> float:
        """Log-likelihood ratio (nats) of this pose against another one for the same images."""
        return (self.log_likelihood_ratio - other.log_likelihood_ratio) / self.correlation_length

    @property
    def limit(self) -> float:
        """Limit of ``by_chance``."""
        return BY_CHANCE_WITH_PRIOR if self.has_prior else BY_CHANCE

    @property
    def good(self) -> bool:
        """Whether the machine was recognised, and at one pose only."""
        return self.by_chance < self.limit and self.second < RIVAL_POSE_PROBABILITY

    @property
    def sure(self) -> bool:
        """Whether it was recognised without the pose by hand as evidence."""
        return self.by_chance < BY_CHANCE and self.second < RIVAL_POSE_PROBABILITY


def find_station(
    view: StationView,
    T_camera_base: Array | None,
    rng: np.random.Generator,
    near_prior: bool = False,
) -> LocalizedPose:
    """Localize a station near a rough pose, or anywhere.

    The pose is searched in half of the images, or all but one or two of few, and the others decide
    on it, each part in turn. Then all images take part.

    near_prior : try poses beside the likeliest ones even where all are one pose, and require the
    p-value of a wide search, for likelihoods that are to be compared.
    """
    if T_camera_base is None:
        return _localize(view, None, rng, near_prior)
    if len(view.configuration) > 1:  # one alone confirms nothing
        near = _localize(view, _PosePrior(T_camera_base, NEAR), rng, near_prior)
        if near.sure and NEAR.reaches(T_camera_base, near.T_camera_base):
            return near
    return _localize(view, _PosePrior(T_camera_base, FAR), rng, near_prior)


def _localize(
    view: StationView, prior: _PosePrior | None, rng: np.random.Generator, near_prior: bool
) -> LocalizedPose:
    """One search: about a pose by hand, as far as its extent, or anywhere."""
    count = len(view.configuration)
    number = np.arange(count)
    halves = FEWEST_FOR_HALVES_WITH_PRIOR if prior else FEWEST_FOR_HALVES
    enough = (FAR if near_prior else prior.nearness).enough if prior else EARLY_DECISION
    folds = 2 if count >= halves else 3 if count >= FEWEST_FOR_THIRDS else count
    retained: list[Array] = []
    surely: list[Array] = []
    held_out = [number % folds == fold for fold in range(folds if count > 1 else 0)]
    parts = [
        (np.flatnonzero(~part), np.flatnonzero(part)) for part in held_out
    ]  # one alone has none
    for searched, other in parts:
        value = _search(view.select(searched), prior, rng, near_prior)
        retained.append(value)
        surely.append(_z_scores(view, value[0], searched, other, rng))
        if _by_chance(surely) < enough:
            break
    candidates = np.concatenate(retained) if retained else _search(view, prior, rng, near_prior)
    every = view.few(count)
    candidates, log_likelihood_ratio = refine_ml(view, candidates, every, 8, 8)
    order = np.argsort(-log_likelihood_ratio)
    legs = view.legs(every).under(candidates[order])
    light = lightness(view.camera, view.tubes, legs, view.tables)
    order = order[without_shadows(candidates[order], light)]
    first = np.cumsum([0, *(len(value) for value in retained)])[:-1]
    confirmed = _confirmed(view, candidates[order[0]], candidates[first], surely)
    if parts and not prior and confirmed >= BY_CHANCE:
        confirmed = min(confirmed, _second_search(view, candidates[order], parts, rng))
    order = order[distinct_silhouettes(view, candidates[order], every)]
    candidates, log_likelihood_ratio = candidates[order], log_likelihood_ratio[order]
    # the most evidence leaves no edge out; where hidden ones were taken in, those that lie near
    # tell the place better
    best = candidates[:1]
    nearer = refine_lm(view, best, every, 8, (5, 3, 2, 1.5))
    ends = np.concatenate([nearer, best])
    scores, each = score(view, ends, every, LAST_REACH), correlation_length(view, candidates[0])
    return LocalizedPose(
        T_camera_base=ends[scores.argmin()],
        score=float(scores.min()),
        log_likelihood_ratio=float(log_likelihood_ratio[0]),
        by_chance=confirmed,
        second=_second(log_likelihood_ratio, each),
        has_prior=prior is not None,
        correlation_length=each,
    )


def _search(
    view: StationView, prior: _PosePrior | None, rng: np.random.Generator, near_prior: bool
) -> Array:
    """Up to three poses (H, 4, 4), the likeliest first."""
    few, more = view.few(4), view.few(8)
    if prior is None:
        each = 4 // len(few)  # more candidates of fewer photographs: these tell less, and cost less
        candidates = _anywhere(view, few, each * GLOBAL_CANDIDATES_REFINED)
        candidates = refine_lm(view, candidates, few, 3, (14, 12, 10, 10, 8, 8))
        candidates = _best(view, candidates, few, reach=8, keep=each * GLOBAL_CANDIDATES_RETAINED)
    else:
        candidates = _random_search(view, prior, rng)
    candidates = refine_lm(view, candidates, few, 5, (8, 8, 6, 6, 5, 5))
    candidates = _best(view, candidates, more, reach=5, keep=24)
    likelier = candidates[: len(candidates) // 2]
    # of photographs that all took part in the descents none could disagree, but for the pose's word
    near = prior is not None and prior.nearness is NEAR
    near_prior = near_prior or prior is None or (not near and len(more) == len(few))
    if not near_prior and len(distinct_silhouettes(view, likelier, more)) == 1:
        others = distinct_silhouettes(view, candidates, more)[1:3]
        candidates = candidates[[*range(LIKELIEST_PLACES_SETTLED), *others]]
    else:
        candidates = _best_about(view, candidates, more, rng)
    candidates, log_likelihood_ratio = refine_ml(view, candidates, more, 5, 5)
    candidates = candidates[np.argsort(-log_likelihood_ratio)]
    return candidates[distinct_silhouettes(view, candidates, more)[:3]]


def _best_about(
    view: StationView, candidates: Array, photographs: Integers, rng: np.random.Generator
) -> Array:
    """The likeliest poses (H, 4, 4) to which candidates, and poses beside the best, are refined."""
    candidates = refine_lm(view, candidates, photographs, 5, (5, 4, 4, 3))
    candidates = _best(view, candidates, photographs, reach=3, keep=24)
    candidates = candidates[distinct_silhouettes(view, candidates, photographs)[:4]]
    # the picture is rugged: what lies beside a good place may be better
    beside = candidates[rng.integers(0, len(candidates), PERTURBED_POSES_TRIED)]
    steps = rng.normal(size=(PERTURBED_POSES_TRIED, 6)) * SHAKEN_SPREAD
    turned = inverse(inverse(beside) @ pose(rotation(steps[:, :3]), steps[:, 3:]))
    candidates, log_likelihood_ratio = refine_ml(
        view, np.concatenate([candidates, turned]), photographs, 3, 2
    )
    return candidates[np.argsort(-log_likelihood_ratio)[:PERTURBED_POSES_RETAINED]]


def _anywhere(view: StationView, few: Integers, keep: int) -> Array:
    """Candidates (keep, 4, 4) from all round the machine."""
    legs = view.legs(np.arange(len(view.configuration)))
    legs = legs if view.guessed is None else legs[0]
    radius = view.machine.values[view.tubes.radius]
    return global_candidates(view.camera, view.tubes, radius, legs, view.tables, few, keep)


def _random_search(view: StationView, prior: _PosePrior, rng: np.random.Generator) -> Array:
    """Candidates (``descending``, 4, 4) about a pose: a wide random draw, then a narrower one
    around its best.
    """
    T_base_camera, (spread, tried, descending, _) = inverse(prior.T_camera_base), prior.nearness

    def shifted(steps: Array) -> Array:
        return inverse(T_base_camera @ pose(rotation(steps[:, :3]), steps[:, 3:]))

    few = view.few(4)

    def likely(steps: Array, reach: float, keep: int) -> Array:
        # two photographs and few places tell which of them are not worth a closer look
        first = np.argsort(score(view, shifted(steps), few[::2], reach, 3))
        steps = steps[first[: max(len(steps) // POSES_FOR_RESCORING, keep)]]
        return steps[np.argsort(score(view, shifted(steps), few, reach))[:keep]]

    steps = rng.normal(size=(tried, 6)) * spread
    steps[0] = 0.0
    best = likely(steps, 12, 4 * descending)
    again = best[rng.integers(0, len(best), tried // 2)]
    again = again + rng.normal(size=again.shape) * (0.45 * spread)
    return shifted(likely(np.concatenate([best, again]), 10, descending))


def _best(
    view: StationView, candidates: Array, photographs: Integers, reach: float, keep: int
) -> Array:
    order = np.argsort(score(view, candidates, photographs, reach))
    return candidates[order[:keep]]


def likelihood_nearby(
    view: StationView,
    readings: Array,
    starts: Array,
    wide: bool,
    few: Integers,
    rng: np.random.Generator,
) -> Array:
    """Log-likelihood ratios (N,) by a short search in ``few`` of the images under each of several
    readings (N, K, m).

    starts : (S, 4, 4) poses from which to search; anywhere, if S = 0. Of many readings, those far
    from the best have minus infinity, except the first. wide : search about the starts first, as
    about a pose by hand.
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
        near = [_about(replace(view, guessed=legs[k : k + 1]), few, starts, rng)
                for k in range(len(legs))]  # fmt: skip
        each = np.stack(near)
    count = each.shape[1]
    view = replace(view, guessed=legs[np.repeat(np.arange(len(legs)), count)])
    ends = refine_lm(view, each.reshape(-1, 4, 4), few, 4, (12, 8, 5))
    scores = score(view, ends, few, 5).reshape(-1, count)
    best = np.argsort(scores.min(axis=1)[1:])[:HYPOTHESES_SETTLED] + 1
    best = np.concatenate([[0], best])
    order = np.argsort(scores[best], axis=1)[:, :NEARBY_PLACES_SETTLED]
    retained = (order + count * best[:, None]).ravel()
    settled = refine_ml(view.guess(retained), ends[retained], few, 5, 3)[1]
    log_likelihood_ratio = np.full(len(legs), -np.inf)
    log_likelihood_ratio[best] = settled.reshape(len(best), -1).max(axis=1)
    return log_likelihood_ratio


def _about(view: StationView, few: Integers, starts: Array, rng: np.random.Generator) -> Array:
    """Candidate poses (H, 4, 4) about poses (S, 4, 4), or anywhere, under one hypothesis of the
    legs.
    """
    if not len(starts):
        places = _anywhere(view, few, FEW_GLOBAL_CANDIDATES)
        return _best(view, places, few, reach=12, keep=FEW_CANDIDATES_RETAINED)
    return np.concatenate([_random_search(view, _PosePrior(T, NEAR), rng) for T in starts])


def _z_scores(
    view: StationView,
    T_camera_base: Array,
    searched: Integers,
    other: Integers,
    rng: np.random.Generator,
) -> Array:
    """z-scores (K,) of some images at a pose (4, 4) that was searched in others, standard normal
    where they do not show the machine there.

    Without the machine, the readings of an image fit it no better than those of others; the
    difference, in units of the scatter of the others, has Student's distribution.
    """
    from scipy.special import ndtri, stdtr

    mine = distances_under(view, T_camera_base[None], searched, 8)
    mixture = mine.mixture(first_mixture(1), rounds=10)
    every = np.arange(len(view.configuration))
    guessed = view.legs(every)[None].joined(view.rivals(rng))
    places = np.broadcast_to(T_camera_base, (len(guessed), 4, 4))
    distances = distances_under(replace(view, guessed=guessed), places, other, 8)
    own, *rivals = by_photograph(distances.log_likelihood(mixture), len(other))
    count, fits = len(rivals), np.stack(rivals)
    scatter = np.maximum(fits.std(axis=0, ddof=1), 1e-9) * np.sqrt(1 + 1 / count)
    away = (own - fits.mean(axis=0)) / scatter
    return -ndtri(np.maximum(stdtr(count - 1, -away), 1e-300))


def _second(log_likelihood_ratio: Array, correlation_length: float) -> float:
    """Posterior probability of the second of two poses, by log-likelihood ratios (H,) of all, the
    likeliest first.
    """
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


def _confirmed(view: StationView, place: Array, distances: Array, surely: list[Array]) -> float:
    """Probability by chance of what photographs said of a pose (4, 4), which was chosen from those
    (F, 4, 4) that they were asked about, ``surely`` (K,) of each.

    A search that ended elsewhere has asked about another place, which says nothing of this one. But
    from so many different ones this was chosen, and any may be confirmed by chance.
    """
    every = view.few(len(view.configuration))
    own = [
        len(distinct_silhouettes(view, np.stack([place, other]), every)) == 1 for other in distances
    ]
    if not any(own):
        return _by_chance(surely)
    choices = len(distinct_silhouettes(view, distances, every))
    about = [sure for sure, mine in zip(surely, own, strict=True) if mine]
    return min(choices * _by_chance(about), 1.0)


def _second_search(
    view: StationView,
    candidates: Array,
    parts: Sequence[tuple[Integers, Integers]],
    rng: np.random.Generator,
) -> float:
    """Probability by chance of what photographs say of the first of some places (H, 4, 4), where a
    search in a part of them ended beside it, at a place that the rest do not confirm.

    It is searched in each part alone, from the place that all have led to, and the rest are asked.
    All have chosen it: from so many places, and in a second attempt.
    """
    surely: list[Array] = []
    for searched, other in parts:
        part = view.select(searched)
        few = part.few(8)
        near, log_likelihood_ratio = refine_ml(
            part, _best_about(part, candidates[:1], few, rng), few, 5, 5
        )
        surely.append(_z_scores(view, near[log_likelihood_ratio.argmax()], searched, other, rng))
    choices = len(distinct_silhouettes(view, candidates, view.few(len(view.configuration))))
    return min(2 * choices * _by_chance(surely), 1.0)


def _by_chance(parts: list[Array]) -> float:
    """p-value of z-scores, (K,) of each part, taken together."""
    if not parts:
        return 1.0
    surely = np.concatenate(parts)
    return 0.5 * math.erfc(float(surely.sum()) / math.sqrt(2 * len(surely)))
