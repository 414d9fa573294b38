"""Where a station's camera stands: a coarse search for the machine in its photographs.

From a rough pose many near it are tried at random; of a station without one, places all round the
machine (:mod:`pkmcal.observe.places`). The best descend by damped steps on the distances of
predicted silhouettes from picture edges (:mod:`pkmcal.observe.tables`), on more and more
photographs, with distances cut off ever nearer.

What was found is weighed. A place on a predicted silhouette has either a picture edge of the
machine near by, or what chance has put there: a mixture, whose two numbers each hypothesis may
choose for itself. Its likelihood against chance alone is the evidence, counted by the length of
the silhouettes. The most evidence is found in any picture, machine or not. So the place is searched
in some of the photographs, and the others are asked: at that place, do their own readings fit
better than those that other photographs of the session bear? Without the machine they do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.cameras import Camera
from pkmcal.geometry.rigid import cross, dot, inverse, of_components, perturb, pose, rotation
from pkmcal.mechanisms import Machine
from pkmcal.observe.places import anywhere
from pkmcal.observe.predict import (
    TubeList,
    edge_points,
    legs_in_camera,
    of_edges,
    plane_normals,
    visible_stretch,
)
from pkmcal.observe.tables import BIN, DistanceTables

SEARCH_ANGLE = np.radians(6.0)
SEARCH_DISTANCE = 0.06
"""Spread (per axis, rad and m) of the poses tried around the user's: its norm over three axes
is 10 degrees and 10 cm."""
TRIES = 800
FEWER_TRIES = 160
"""Poses tried where one of thirty hypotheses is looked at."""
ANYWHERE = 600
"""Poses from all round the machine that are looked at more closely."""
FIRST_DAMPING = 1e-3
"""Of a step, relative to the normal equations' diagonal."""
SHAKEN = 48
"""Poses beside the best ones that are tried before the last descent."""
LAST_REACH = 4.0
"""Reduced pixels at which the final score cuts distances off."""
FEWEST_RIVALS, MOST_RIVALS = 8, 24
"""Other readings for each photograph, which tell what evidence chance gives."""
HALVES, THIRDS = 7, 5
"""Photographs from which half of them, or a third, are kept from the search to be asked; of fewer,
each in its turn."""
DECIDED = 10.0
"""Times less than the probability asked for, by some of the photographs, at which the others need
not be asked."""
AWAY = np.repeat([0.2, 0.1], 3)
"""Turn (rad) and shift (in distances of base and platform) of a platform that is elsewhere."""
BY_CHANCE, BY_CHANCE_TOLD = 1e-3, 1e-2
"""Probability of as much evidence by chance, below which the machine is recognised: anywhere, and
where it was looked for about a pose by hand, which says much the same already."""
APART = 8.0
"""Reduced pixels between two hypotheses' silhouettes from which they are not the same place."""
DOUBT = 0.05
"""Probability of a second place being as good above which neither is believed."""


@dataclass(frozen=True)
class StationView:
    """What the search looks at: one station's photographs and what should be in them.

    configuration : (K,) rows of the session's readings. all_joints : (M, m) these readings.
    all_poses : T_base_platform (M, 4, 4) by the drawing.
    """

    machine: Machine
    camera: Camera
    tubes: TubeList
    configuration: Integers
    all_joints: Array
    all_poses: Array
    tables: DistanceTables

    @property
    def joints(self) -> Array:
        """Readings (K, m) of the photographs."""
        return self.all_joints[self.configuration]

    @property
    def poses(self) -> Array:
        """Poses (K, 4, 4) of the platform in the photographs."""
        return self.all_poses[self.configuration]

    def few(self, count: int) -> Integers:
        """Numbers of up to ``count`` photographs, spread over all."""
        n = len(self.configuration)
        return np.unique(np.linspace(0, n - 1, min(count, n)).astype(int))

    def with_joints(self, joints: Array) -> StationView:
        """The same photographs with other readings (M, m)."""
        found = self.machine.forward_result(joints).T_base_platform
        return replace(self, all_joints=joints, all_poses=found)

    def select(self, photographs: Integers) -> StationView:
        """Some of the photographs alone."""
        return replace(
            self,
            configuration=self.configuration[photographs],
            tables=self.tables.select(photographs),
        )

    def rivals(self, rng: np.random.Generator) -> list[StationView]:
        """The same photographs with readings that are not their own: each time those of the
        configurations that follow by so many; where the session has few, platforms elsewhere too.
        """
        count, own = len(self.all_joints), self.configuration
        steps = np.unique(np.linspace(1, count - 1, MOST_RIVALS).astype(int)) if count > 1 else ()
        views: list[StationView] = [
            replace(self, configuration=(own + step) % count) for step in steps
        ]
        for _ in range(len(views), FEWEST_RIVALS):
            away = rng.normal(size=(len(own), 6)) * AWAY
            away[:, 3:] *= np.linalg.norm(self.poses[:, :3, 3], axis=-1, keepdims=True)
            views.append(
                replace(
                    self,
                    configuration=np.arange(len(own)),
                    all_joints=self.joints,
                    all_poses=perturb(self.poses, away),
                )
            )
        return views


@dataclass(frozen=True)
class FoundStation:
    """A found pose T_camera_base (4, 4) and its score: 0 perfect, 1 nothing fits.

    evidence : log likelihood against chance, by reduced pixels of silhouette. by_chance :
    probability of as much without the machine. second : probability that another place is as good.
    told : whether it was looked for about a pose that is known. grain : reduced pixels of
    silhouette that count as one measurement.
    """

    T_camera_base: Array
    score: float
    evidence: float
    by_chance: float
    second: float = 0.0
    told: bool = False
    grain: float = 1.0

    def likelier(self, other: FoundStation) -> float:
        """Log odds of this explanation of the photographs against another one of the same."""
        return (self.evidence - other.evidence) / self.grain

    @property
    def limit(self) -> float:
        """What ``by_chance`` must stay below."""
        return BY_CHANCE_TOLD if self.told else BY_CHANCE

    @property
    def good(self) -> bool:
        """Whether the machine was recognised, and at one place only."""
        return self.by_chance < self.limit and self.second < DOUBT

    @property
    def sure(self) -> bool:
        """Whether it was recognised without what is said of the pose."""
        return self.by_chance < BY_CHANCE and self.second < DOUBT


def find_station(
    view: StationView, T_camera_base: Array | None, rng: np.random.Generator
) -> FoundStation:
    """The pose near a rough one, or anywhere, from half of the photographs, or all but one or two
    of few; what the others say of it decides, each in its turn. Then every photograph takes part.
    """
    count = len(view.configuration)
    number = np.arange(count)
    folds = 2 if count >= HALVES else 3 if count >= THIRDS else count
    kept: list[Array] = []
    surely = np.zeros(0)
    for fold in range(folds if count > 1 else 0):  # one alone has none to be asked
        asked = number % folds == fold
        searched, other = np.flatnonzero(~asked), np.flatnonzero(asked)
        found = _search(view.select(searched), T_camera_base, rng)
        kept.append(found)
        surely = np.concatenate([surely, _surely(view, found[0], searched, other, rng)])
        if _by_chance(surely) < BY_CHANCE / DECIDED:
            break
    candidates = np.concatenate(kept) if kept else _search(view, T_camera_base, rng)
    every = view.few(count)
    candidates = settle(view, candidates, every, 8, 8)
    evidence = evidence_of(view, candidates, every, 8).sum(axis=-1)
    order = np.argsort(-evidence)
    order = order[apart(view, candidates[order], every)]
    candidates, evidence = candidates[order], evidence[order]
    # the most evidence leaves no edge out; where hidden ones were taken in, those that lie near
    # tell the place better
    best = candidates[:1]
    nearer = descend(view, best, every, 8, (5, 4, 3, 2, 2, 1.5, 1.5))
    ends = np.concatenate([nearer, best])
    scores = score(view, ends, every, LAST_REACH)
    return FoundStation(
        T_camera_base=ends[scores.argmin()],
        score=float(scores.min()),
        evidence=float(evidence[0]),
        by_chance=_by_chance(surely),
        second=_second(evidence, each := grain(view, candidates[0])),
        told=T_camera_base is not None,
        grain=each,
    )


def _search(view: StationView, T_camera_base: Array | None, rng: np.random.Generator) -> Array:
    """Up to three places (H, 4, 4), the one with the most evidence first."""
    few, more = view.few(4), view.few(8)
    if T_camera_base is None:
        each = 4 // len(few)  # more candidates of fewer photographs: these tell less, and cost less
        candidates = _anywhere(view, few, each * ANYWHERE)
        candidates = _best(view, candidates, few, reach=12, keep=each * 96)
        candidates = descend(view, candidates, few, 3, (14, 12, 10, 10, 8, 8))
        candidates = _best(view, candidates, few, reach=8, keep=each * 24)
    else:
        candidates = _random_search(view, T_camera_base, rng)
    candidates = descend(view, candidates, few, 5, (8, 8, 6, 6, 5, 5))
    candidates = _best(view, candidates, more, reach=5, keep=12)
    candidates = descend(view, candidates, more, 5, (5, 4, 4, 3))
    candidates = _best(view, candidates, more, reach=3, keep=12)
    candidates = candidates[apart(view, candidates, more)[:4]]
    # the picture is rugged: what lies beside a good place may be better
    beside = candidates[rng.integers(0, len(candidates), SHAKEN)]
    spread = np.repeat([SEARCH_ANGLE, SEARCH_DISTANCE], 3) / 3
    steps = rng.normal(size=(SHAKEN, 6)) * spread
    turned = inverse(inverse(beside) @ pose(rotation(steps[:, :3]), steps[:, 3:]))
    candidates = settle(view, np.concatenate([candidates, turned]), more, 5, 6)
    evidence = evidence_of(view, candidates, more, 5).sum(axis=-1)
    candidates = candidates[np.argsort(-evidence)]
    return candidates[apart(view, candidates, more)[:3]]


def _anywhere(view: StationView, few: Integers, keep: int) -> Array:
    """Candidates (keep, 4, 4) from all round the machine."""
    legs = legs_in_camera(view.machine, np.eye(4), view.poses, view.joints)
    radius = view.machine.values[view.tubes.radius]
    return anywhere(view.camera, view.tubes, radius, legs, view.tables, few, keep)


def _random_search(
    view: StationView, T_camera_base: Array, rng: np.random.Generator, tries: int = TRIES
) -> Array:
    """Candidates (16, 4, 4): a wide random draw, then a narrower one around its best."""
    spread = np.repeat([SEARCH_ANGLE, SEARCH_DISTANCE], 3)
    T_base_camera = inverse(T_camera_base)

    def moved(steps: Array) -> Array:
        return inverse(T_base_camera @ pose(rotation(steps[:, :3]), steps[:, 3:]))

    few = view.few(4)
    steps = rng.normal(size=(tries, 6)) * spread
    steps[0] = 0.0
    best = steps[np.argsort(score(view, moved(steps), few, reach=12))[:60]]
    again = best[rng.integers(0, len(best), tries // 2)]
    steps = np.concatenate([best, again + rng.normal(size=again.shape) * (0.45 * spread)])
    order = np.argsort(score(view, moved(steps), few, reach=10))[:16]
    return moved(steps[order])


def _best(
    view: StationView, candidates: Array, photographs: Integers, reach: float, keep: int
) -> Array:
    order = np.argsort(score(view, candidates, photographs, reach))
    return candidates[order[:keep]]


def apart(view: StationView, candidates: Array, photographs: Integers) -> list[int]:
    """Of candidates (H, 4, 4), best first, those that are not the same place as a better one."""
    legs = legs_in_camera(
        view.machine, candidates[:, None], view.poses[photographs], view.joints[photographs]
    )
    pixel = edge_points(view.machine, view.camera, legs, view.tubes, 2).pixel
    kept: list[int] = []
    for h in range(len(candidates)):
        off = np.sqrt(np.nansum((pixel[kept] - pixel[h]) ** 2, axis=-1)) / view.tables.scale
        if all(np.nanmedian(other) > APART for other in off):
            kept.append(h)
    return kept


def score(
    view: StationView, T_camera_base: Array, photographs: Integers, reach: float, samples: int = 5
) -> Array:
    """Mean distance from predicted edges to picture edges, cut off at ``reach``: (H,), 0 to 1.

    T_camera_base : (H, 4, 4) hypotheses. reach : reduced pixels. Edges are taken as the chords
    between their ends, which is exact for a pinhole and near enough for this search elsewhere.
    """
    tubes = view.tubes
    legs = legs_in_camera(
        view.machine, T_camera_base[:, None], view.poses[photographs], view.joints[photographs]
    )
    a, b, u = of_edges(legs, tubes)
    radius = view.machine.values[tubes.radius]
    normal, ok = plane_normals(a, u, radius, tubes)
    first, last = visible_stretch(a, b, tubes)
    base = a + radius[:, None] * normal
    begin, end = (view.camera.project(base + at[..., None] * u) for at in (first, last))
    chord = end - begin
    direction = view.tables.direction(of_components(-chord[..., 1], chord[..., 0]))
    fraction = (np.arange(samples) + 0.5) / samples
    points = of_components(
        *(begin[..., None, k] + fraction * chord[..., None, k] for k in (0, 1))
    )  # (H, K, E, n, 2)
    number = np.arange(len(view.configuration))[photographs][:, None, None]
    found, inside = view.tables.look(direction[..., None], points, number)
    cost = np.where(inside & ok[..., None], np.minimum(found, reach) / reach, 1.0)
    weight = np.nan_to_num(np.sqrt(dot(chord, chord)))
    total = np.maximum(np.sum(weight, axis=(1, 2)), 1e-9)
    return np.sum(cost.mean(axis=-1) * weight, axis=(1, 2)) / total


class _Mixture(NamedTuple):
    """What a hypothesis says of the distances found, (H,): the share that chance has put there, and
    the standard deviation (reduced px) of the rest.
    """

    share: Array
    sigma: Array

    def ratio(self, found: Array, chance: Array) -> Array:
        """Density of distances (H, n) on the machine's edges, of those that chance gives."""
        sigma = self.sigma[:, None]
        return np.sqrt(2 / np.pi) / sigma * np.exp(-0.5 * (found / sigma) ** 2) / chance


class _Look(NamedTuple):
    """The picture under predicted edges, (H, n): distance found and whether in the image; the
    distance's derivatives by the camera frame's motion (H, n, 6); density of such distances by
    chance; reduced pixels of silhouette for which each place stands.
    """

    found: Array
    inside: Booleans
    jac: Array
    chance: Array
    length: Array

    def weight(self, reach: float) -> Array:
        """Geman-McClure: what is further than the reach is another edge."""
        return np.where(self.inside, (1 + (self.found / reach) ** 2) ** -2.0, 0.0)

    def cost(self, reach: float) -> Array:
        """What the weights minimise, (H,): 0 to 1 an edge point, and 1 outside the image."""
        part = (self.found / reach) ** 2
        return np.where(self.inside, part / (1 + part), 1.0).mean(axis=-1)

    def mixture(self, mixture: _Mixture, rounds: int = 3) -> _Mixture:
        """The likeliest mixture, from another on (expectation and maximisation)."""
        for _ in range(rounds):
            own = self.length * self.own(mixture)
            total = np.maximum(np.sum(self.length * self.inside, axis=-1), 1e-9)
            share = np.clip(1 - own.sum(axis=-1) / total, 0.01, 0.99)
            square = np.sum(own * self.found**2, axis=-1) / np.maximum(own.sum(axis=-1), 1e-9)
            mixture = _Mixture(share, np.clip(np.sqrt(square), BIN, LAST_REACH))
        return mixture

    def own(self, mixture: _Mixture) -> Array:
        """Probability (H, n) of each place's edge being the machine's."""
        own = (1 - mixture.share[:, None]) * mixture.ratio(self.found, self.chance)
        return np.where(self.inside, own / (own + mixture.share[:, None]), 0.0)

    def evidence(self, mixture: _Mixture) -> Array:
        """Log likelihood (H, n) of each place against chance."""
        share = mixture.share[:, None]
        gain = np.log((1 - share) * mixture.ratio(self.found, self.chance) + share)
        return np.where(self.inside, self.length * gain, 0.0)

    def where(self, better: Booleans, other: _Look) -> _Look:
        """Take some of the hypotheses from here, the rest from the other look."""
        keep = better[:, None]
        return _Look(
            *(
                np.where(keep[..., None] if mine.ndim == 3 else keep, mine, its)
                for mine, its in zip(self, other, strict=True)
            )
        )


def descend(
    view: StationView,
    candidates: Array,
    photographs: Integers,
    samples: int,
    reaches: tuple[float, ...],
) -> Array:
    """Levenberg-Marquardt on the distances, candidates (H, 4, 4) side by side, a step a reach.

    Upright legs hardly say where their camera stands; undamped, steps there go astray.
    """
    look = _look(view, candidates, photographs, samples)
    damping = np.full(len(candidates), FIRST_DAMPING)
    for reach in reaches:
        trial = _step(candidates, look, look.weight(reach), damping)
        seen = _look(view, trial, photographs, samples)
        better = seen.cost(reach) < look.cost(reach)
        candidates = np.where(better[:, None, None], trial, candidates)
        look = seen.where(better, look)
        damping = np.where(better, 0.3, 10.0) * damping
    return candidates


def settle(
    view: StationView, candidates: Array, photographs: Integers, samples: int, steps: int
) -> Array:
    """The same to the most evidence: how far edges scatter is learnt on the way."""
    look = _look(view, candidates, photographs, samples)
    damping = np.full(len(candidates), FIRST_DAMPING)
    mixture = _first_mixture(len(candidates))
    for _ in range(steps):
        mixture = look.mixture(mixture)
        trial = _step(candidates, look, look.length * look.own(mixture), damping)
        seen = _look(view, trial, photographs, samples)
        better = seen.evidence(mixture).sum(axis=-1) > look.evidence(mixture).sum(axis=-1)
        candidates = np.where(better[:, None, None], trial, candidates)
        look = seen.where(better, look)
        damping = np.where(better, 0.3, 10.0) * damping
    return candidates


def _first_mixture(count: int) -> _Mixture:
    return _Mixture(np.full(count, 0.5), np.full(count, LAST_REACH / 2))


def evidence_of(view: StationView, candidates: Array, photographs: Integers, samples: int) -> Array:
    """Evidence (H, K) of candidates (H, 4, 4) in each photograph."""
    look = _look(view, candidates, photographs, samples)
    mixture = look.mixture(_first_mixture(len(candidates)), rounds=10)
    return look.evidence(mixture).reshape(len(candidates), len(photographs), -1).sum(axis=-1)


def evidence_by_name(view: StationView, T_camera_base: Array, names: Integers) -> Array:
    """Evidence (K, n) of a pose (4, 4) in each photograph under each of the names (n,), rows of the
    readings; edges scatter as they do under the names that the view has.
    """
    every = view.few(len(view.configuration))
    look = _look(view, T_camera_base[None], every, 8)
    mixture = look.mixture(_first_mixture(1), rounds=10)
    fits: list[Array] = []
    for name in names:
        other = replace(view, configuration=np.full(len(every), name))
        look = _look(other, T_camera_base[None], every, 8)
        fits.append(look.evidence(mixture).reshape(len(every), -1).sum(axis=-1))
    return np.stack(fits, axis=1)


def settled(view: StationView, T_camera_base: Array) -> Array:
    """The pose (4, 4) with the most evidence near another."""
    return settle(view, T_camera_base[None], view.few(len(view.configuration)), 8, 8)[0]


def evidence_from(view: StationView, places: Array) -> float:
    """The most evidence, of all photographs, to which any of the places (H, 4, 4) settles.

    Searches end up to fifty measurements apart, whatever they look for; so explanations of the same
    photographs are compared from the same places.
    """
    every = view.few(len(view.configuration))
    places = settle(view, places, every, 8, 8)
    return float(evidence_of(view, places, every, 8).sum(axis=-1).max())


def evidence_nearby(
    view: StationView, starts: Array, wide: bool, rng: np.random.Generator
) -> float:
    """What a short search from poses (H, 4, 4) finds in a few photographs; from none, anywhere.

    wide : look about the starts first, as about a pose by hand.
    """
    few = view.few(4)
    if not len(starts):
        starts = _best(view, _anywhere(view, few, FEWER_TRIES), few, reach=12, keep=16)
    elif wide:
        tried = [_random_search(view, T, rng, FEWER_TRIES)[:8] for T in starts]
        starts = np.concatenate(tried)
    starts = descend(view, starts, few, 4, (12, 10, 8, 6, 5))
    starts = settle(view, _best(view, starts, few, reach=5, keep=8), few, 4, 3)
    return float(evidence_of(view, starts, few, 5).sum(axis=-1).max())


def _surely(
    view: StationView,
    T_camera_base: Array,
    searched: Integers,
    other: Integers,
    rng: np.random.Generator,
) -> Array:
    """How surely each of some photographs shows the machine at a pose (4, 4) that was found from
    others, ``searched``: standard normal (K,) where it does not.

    Without the machine, a photograph's own readings fit it no better than others do; by how much
    they do, in units of the others' scatter, has Student's distribution.
    """
    from scipy.special import ndtri, stdtr

    def evidence(view: StationView) -> Array:
        look = _look(view, T_camera_base[None], other, 8)
        return look.evidence(mixture).reshape(len(other), -1).sum(axis=-1)

    mixture = _look(view, T_camera_base[None], searched, 8).mixture(_first_mixture(1), rounds=10)
    fits = np.stack([evidence(rival) for rival in view.rivals(rng)], axis=1)
    count = fits.shape[1]
    scatter = np.maximum(fits.std(axis=1, ddof=1), 1e-9) * np.sqrt(1 + 1 / count)
    away = (evidence(view) - fits.mean(axis=1)) / scatter
    return -ndtri(np.maximum(stdtr(count - 1, -away), 1e-300))


def grain(view: StationView, T_camera_base: Array) -> float:
    """Reduced pixels of half a predicted edge: what moves an edge moves its places together, so
    each half counts as one measurement.
    """
    every = view.few(len(view.configuration))
    length = _look(view, T_camera_base[None], every, 2).length[0]
    seen = length[length > 0]
    # two samples stand for an edge's length each; where no edge is in the picture none counts
    return float(seen.mean()) / 2 if seen.size else 1.0


def _second(evidence: Array, grain: float) -> float:
    """Probability that the second of places is the machine's and not the first, by their evidence
    (H,).
    """
    if len(evidence) < 2:
        return 0.0
    return 1 / (1 + math.exp(min(float(evidence[0] - evidence[1:].max()) / grain, 500.0)))


def _by_chance(surely: Array) -> float:
    """Probability of so sure photographs (K,), taken together, by chance."""
    if not len(surely):
        return 1.0
    return 0.5 * math.erfc(float(surely.sum()) / math.sqrt(2 * len(surely)))


def _look(view: StationView, candidates: Array, photographs: Integers, samples: int) -> _Look:
    """Distances under the edges predicted from poses (H, 4, 4)."""
    number = np.arange(len(view.configuration))[photographs][:, None, None]
    legs = legs_in_camera(
        view.machine, candidates[:, None], view.poses[photographs], view.joints[photographs]
    )
    points = edge_points(view.machine, view.camera, legs, view.tubes, samples)
    direction = view.tables.direction(points.outward)
    step = points.outward * view.tables.scale
    found, inside = view.tables.look_smooth(direction, points.pixel, number)
    ahead, _ = view.tables.look_smooth(direction, points.pixel + step, number)
    behind, _ = view.tables.look_smooth(direction, points.pixel - step, number)
    slope = np.clip((ahead - behind) / 2, -1, 1)
    inside = inside & points.valid
    slope = np.where(inside, slope, 0.0) / view.tables.scale
    # the pixel moves outward by across . (omega x P + tau) for a motion of the camera frame
    turn = cross(points.point, points.across)
    motion = [part[..., k] for part in (turn, points.across) for k in range(3)]
    jac = np.where(inside[..., None], of_components(*(slope * m for m in motion)), 0.0)
    found = np.where(inside, found, 0.0)
    chord = points.pixel[..., -1, :] - points.pixel[..., 0, :]
    length = np.nan_to_num(np.sqrt(dot(chord, chord)) / (view.tables.scale * (samples - 1)))
    length = np.broadcast_to(length[..., None], found.shape)
    flat = (len(candidates), -1)
    return _Look(
        found.reshape(flat),
        inside.reshape(flat),
        jac.reshape(*flat, 6),
        view.tables.by_chance(direction, found).reshape(flat),
        length.reshape(flat),
    )


def _step(candidates: Array, look: _Look, weight: Array, damping: Array) -> Array:
    """One damped Gauss-Newton step of every candidate's pose, (H, 4, 4).

    weight : (H, n) of the places. damping : (H,).
    """
    weighted = (look.jac * weight[..., None]).mT
    normal = weighted @ look.jac
    diagonal = np.einsum("hii->hi", normal) + 1e-12
    normal = normal + (damping[:, None] * diagonal)[..., None] * np.eye(6)
    step = -np.linalg.solve(normal, weighted @ look.found[..., None])[..., 0]
    step = np.clip(step, -0.1, 0.1)  # further, the tables' slopes say nothing
    # turn about the camera: R <- Exp(omega) R, t <- Exp(omega) t + tau
    turned = pose(rotation(step[:, :3]), np.zeros((len(step), 3))) @ candidates
    return perturb(turned, np.concatenate([np.zeros((len(step), 3)), step[:, 3:]], axis=-1))
