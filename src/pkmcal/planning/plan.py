"""The next configurations worth measuring, and where to put the camera: ``pkmcal plan``.

Configurations are chosen among many that the machine can take, then bettered about where they are;
places of a camera among those on a sphere, or among a session's stations. What the plan promises is
the covariance that the joint estimate would state of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import count as count_from
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, short_repr
from pkmcal.calibration.saved_calibration import CalibrationPrior
from pkmcal.errors import InputError
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.planning.candidates import (
    Configurations,
    camera_ring_places,
    configurations,
    neighbours,
)
from pkmcal.planning.defaults import CONFIGURATIONS_A_CAPTURE
from pkmcal.planning.exchange import PLAN_INDICES, ShareProgress, exchanged, greedy
from pkmcal.planning.information import CandidateRows, Candidates, information_of
from pkmcal.planning.rig import BoardFrom, LegsFrom, Rig, TargetFrom
from pkmcal.planning.route import length, motor_distances, shortest_path
from pkmcal.planning.subject import Subject
from pkmcal.ranges import check_number
from pkmcal.simulation.placement import StationPlace, usable

PLAN_CANDIDATES = 400
"""Configurations among which is chosen."""
CANDIDATES_FOR_EACH_WANTED = 4
"""Of these for each one wanted, at least."""
AT_WORK = 60
"""Poses of the workspace at which the tool counts."""
BETTERING_ROUNDS = 8
"""Rounds, at most, in which the chosen configurations are moved."""
LEAST_ROUND_GAIN = 0.01
"""Part of the deviation that a round has to gain for another one."""
FOR_PLACES = 24
"""Configurations by which places of a camera are compared."""
RANDOM_PLANS_COMPARED = 10
"""Choices by chance that a plan is compared with."""
CAPTURE_MULTIPLES = (2, 4)
"""How many times as many photographs are told as well."""
WORTHWHILE_ACCURACY_GAIN = 0.01
"""Part of its standard deviation by which one more configuration from each place has to better the
tool to be worth it: the hundredth that a hundred others would add up to."""
POSES_BETWEEN_CONFIGURATIONS = 8
"""Poses looked at on the way from one configuration to the next."""
REROUTING_ATTEMPTS = 5
"""Times that another way is looked for where one is blocked."""
CONFIGURATION_NAME_LETTERS = "abcdefghijklmnopqrstuvwxyz"
"""First letters of new configurations' names, one a group of stations."""
PLAN_SEED = 0


@dataclass(frozen=True)
class Accuracy:
    """Standard deviations of the platform's position (m) and turn (rad), mean over the workspace,
    with ``count`` configurations from each place.
    """

    count: float
    position: float
    orientation: float


@dataclass(frozen=True)
class TriedPlace:
    """A camera's place that was tried. alone : m, the platform's position with all configurations
    from there. chosen : whether it is part of the plan.
    """

    place: StationPlace
    alone: float
    chosen: bool


@dataclass(frozen=True)
class MeasurementPlan:
    """What to measure next, in this order.

    subject : what it is for; with the chosen places where these were free. stations : names that
    measure each configuration, (n,) tuples. names, joints (n, m), T_base_platform (n, 4, 4) : the
    configurations, of which those of ``rank`` up to k are the best k from each place. index : what
    was made small. value : its value, and at_random : that of configurations drawn evenly over the
    joints' ranges, mean. now, promised, by_chance : accuracy
    before, with the plan, with such configurations. curve : with fewer and with more. region : the
    workspace. blocked : (n,) True where the straight way to a configuration leaves what the machine
    can take, or its legs touch. travel : how long the slowest motor moves in all, in parts of its
    range, and by chance. tried : places of a camera.
    """

    subject: Subject
    stations: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]
    joints: Array
    T_base_platform: Array
    rank: Integers
    index: str
    value: float
    at_random: float
    now: Accuracy
    promised: Accuracy
    by_chance: Accuracy
    curve: tuple[Accuracy, ...]
    region: Region
    work: Array
    blocked: Booleans
    travel: tuple[float, float]
    tried: tuple[TriedPlace, ...] = ()
    together: bool = False

    __repr__ = short_repr

    @property
    def pays_until(self) -> float | None:
        """Configurations from each place after which one more betters the tool by less than
        :data:`WORTHWHILE_ACCURACY_GAIN`; None where all of those planned pay.
        """
        for before, after in pairwise(self.curve):
            each = 1 - (after.position / before.position) ** (1 / (after.count - before.count))
            if each < WORTHWHILE_ACCURACY_GAIN and after.count <= self.promised.count:
                return before.count
        return None


def plan_measurements(
    subject: Subject,
    *,
    count: int = CONFIGURATIONS_A_CAPTURE,
    index: str = "tool",
    region: Region | None = None,
    together: bool | None = None,
    free_places: int | None = None,
    best_of: int | None = None,
    seed: int = PLAN_SEED,
    progress: ShareProgress | None = None,
) -> MeasurementPlan:
    """The plan.

    count : configurations from each place; of all stations, where these measure together. index :
    one of :data:`~pkmcal.planning.exchange.PLAN_INDICES`. region : where the tool counts; the whole
    reach if absent. together : whether all stations measure every configuration; by default where
    they have cameras or trackers of their own. free_places : how many places of the camera to
    choose on a sphere about the machine. best_of : how many of the rig's stations to choose.
    seed : of what is drawn. progress : called with the share done.
    Raises InputError for what cannot be planned.
    """
    progress = progress or (lambda _share: None)
    rig, rng = subject.rig, np.random.default_rng(seed)
    _check(rig, count, index, free_places, best_of)
    region = region or Region()
    work = poses_in(rig.machine.limits(), region, AT_WORK, seed)
    drawn = configurations(
        rig.machine, max(PLAN_CANDIDATES, CANDIDATES_FOR_EACH_WANTED * count), rng
    )
    progress(0.1)
    tried: tuple[TriedPlace, ...] = ()
    if free_places or best_of:
        rig, reference_values, tried = _with_places(
            subject, work, drawn, count, index, free_places, best_of
        )
        subject = replace(subject, rig=rig, prior=reference_values)
    progress(0.3)
    joined = _together(rig) if together is None else together
    stations = range(len(rig.names))
    groups = (tuple(stations),) if joined else tuple((s,) for s in stations)
    made = _Making(rig, subject.prior, groups, count, index, work)
    pool = made.pool(Candidates.of_all(groups, *drawn))
    item = made.chosen(pool, rng, lambda share: progress(0.3 + 0.6 * share))
    progress(0.9)
    return _ordered(subject, made, item, pool, region, joined, tried, rng)


def _check(rig: Rig, count: int, index: str, free_places: int | None, best_of: int | None) -> None:
    rig.machine.check_free("fixed")
    if index not in PLAN_INDICES:
        raise InputError(
            "there is no such index", where="--index", found=index, expected=", ".join(PLAN_INDICES)
        )
    check_number("plan", "configurations", count, "--configurations")
    check_number("plan", "places", free_places, "--places")
    check_number("plan", "best_of", best_of, "--best-of")
    if rig.machine.layout.n_internal:
        raise InputError(
            f"mechanism {rig.machine.name!r} has side bars that turn on hinges, and how far they"
            " turn is not known where nothing was measured, so no plan is made for it",
            next_step="Plan for the machine with one rod a forearm, such as h4",
        )
    cameras = [one for one in rig.instruments if isinstance(one, LegsFrom | BoardFrom)]
    if free_places and not cameras:
        raise InputError(
            "there is no camera whose place could be chosen",
            where="--places",
            next_step="Leave it out; where a tracker stands does not change what it tells",
        )
    if best_of and not 1 <= best_of <= len(rig.names):
        raise InputError(
            "there are not so many stations to choose from",
            where="--best-of",
            found=str(best_of),
            expected=f"1 to {len(rig.names)}",
        )


def _together(rig: Rig) -> bool:
    """One camera is carried from place to place; several, or a tracker, measure at once."""
    tracked = any(isinstance(one, TargetFrom) for one in rig.instruments)
    return len(rig.names) > 1 and (tracked or len(np.unique(rig.camera_of_station)) > 1)


class _Pool(NamedTuple):
    """Candidates, and what each tells."""

    candidates: Candidates
    info: CandidateRows


@dataclass(frozen=True)
class _Making:
    """What is chosen, and by what."""

    rig: Rig
    prior: CalibrationPrior | None
    groups: tuple[tuple[int, ...], ...]
    count: int
    index: str
    work: Array

    def pool(self, candidates: Candidates, rng: np.random.Generator | None = None) -> _Pool:
        """Candidates with what they tell; rng : as of :func:`information_of`."""
        rig, work, prior = self.rig, self.work, self.prior
        return _Pool(candidates, information_of(rig, candidates, work, prior, rng, self.count))

    def chosen(self, pool: _Pool, rng: np.random.Generator, progress: ShareProgress) -> Candidates:
        """The best of a pool, bettered about where they are."""
        index = PLAN_INDICES[self.index](pool.info)
        first = greedy(pool.info, self.count, index, lambda x: progress(0.4 * x)).chosen
        best = pool.candidates.only(np.sort(exchanged(pool.info, first, index)))
        size = np.inf
        for k in range(BETTERING_ROUNDS):
            progress(0.5 + 0.5 * k / BETTERING_ROUNDS)
            pool, start = self._about(best, rng)
            chosen = np.sort(exchanged(pool.info, start, index))
            best = pool.candidates.only(chosen)
            covariance = pool.info.covariance(pool.info.of(chosen))
            before, size = size, index.size(float(index.value(covariance)), len(covariance))
            if size > (1 - LEAST_ROUND_GAIN) * before:
                break
        return best

    def _about(self, best: Candidates, rng: np.random.Generator) -> tuple[_Pool, Integers]:
        """Chosen candidates and others about each, by the same group; and where those stand."""
        parts: list[Configurations] = []
        group: list[Integers] = []
        start: list[Integers] = []
        for g in range(len(self.groups)):
            own = np.flatnonzero(best.group == g)
            now = Configurations(best.joints[own], best.T_base_platform[own])
            near = neighbours(self.rig.machine, now, rng)
            start.append(sum(map(len, group)) + np.arange(len(own)))
            group.append(np.full(len(own) + len(near.joints), g))
            parts += [now, near]
        joints, poses = map(np.concatenate, zip(*parts, strict=True))
        candidates = Candidates(self.groups, np.concatenate(group), joints, poses)
        return self.pool(candidates), np.concatenate(start)


def _accuracy(info: CandidateRows, covariance: Array, count: float) -> Accuracy:
    return Accuracy(count, *info.tool(covariance))


def _ordered(
    subject: Subject,
    made: _Making,
    value: Candidates,
    drawn: _Pool,
    region: Region,
    together: bool,
    tried: tuple[TriedPlace, ...],
    rng: np.random.Generator,
) -> MeasurementPlan:
    """The plan of what was chosen: in the order of the shortest way, with what it promises."""
    machine, count, groups = subject.rig.machine, made.count, made.groups
    # as good as such photographs turn out, one by one, not as they are on average
    own = made.pool(value, np.random.default_rng(PLAN_SEED)).info
    index, every = PLAN_INDICES[made.index](own), np.arange(len(value.group))
    nested = greedy(own, count, index)
    curve = [_accuracy(own, nested.path[c * len(groups) - 1], c) for c in range(2, count)]
    covariance = own.covariance(own.of(every))
    promised = _accuracy(own, covariance, count)
    more = [_accuracy(own, own.covariance(own.of(every, t)), t * count) for t in CAPTURE_MULTIPLES]
    by_chance, at_random = _by_chance(made, drawn, rng)
    rank = np.empty(len(every), dtype=int)
    rank[nested.chosen] = every // len(groups) + 1
    order, blocked, travel = _route(machine, value, rng)
    return MeasurementPlan(
        subject=subject,
        stations=tuple(tuple(subject.rig.names[s] for s in groups[value.group[k]]) for k in order),
        names=_new_names(value.group[order], subject.names),
        joints=value.joints[order],
        T_base_platform=value.T_base_platform[order],
        rank=rank[order],
        index=made.index,
        value=float(index.value(covariance)),
        at_random=at_random,
        now=_accuracy(own, own.covariance(own.information), 0),
        promised=promised,
        by_chance=by_chance,
        curve=(*curve, promised, *more),
        region=region,
        work=made.work,
        blocked=blocked,
        travel=travel,
        tried=tried,
        together=together,
    )


def _new_names(group: Integers, taken: tuple[str, ...]) -> tuple[str, ...]:
    """Names of configurations, a letter a group and a number, that none has yet."""
    out: list[str] = []
    used = set(taken)
    for g in group.tolist():
        letter = CONFIGURATION_NAME_LETTERS[g % len(CONFIGURATION_NAME_LETTERS)] * (
            1 + g // len(CONFIGURATION_NAME_LETTERS)
        )
        name = next(f"{letter}{n:02d}" for n in count_from(1) if f"{letter}{n:02d}" not in used)
        used.add(name)
        out.append(name)
    return tuple(out)


def _by_chance(made: _Making, drawn: _Pool, rng: np.random.Generator) -> tuple[Accuracy, float]:
    """What configurations drawn evenly over the joints' ranges would give, mean of a few draws."""
    index, n_groups = PLAN_INDICES[made.index](drawn.info), len(made.groups)
    n = len(drawn.info.group) // n_groups
    evenly = np.arange(n // 2, n)  # the first half are at the ends of the ranges
    count = min(made.count, len(evenly))
    results: list[tuple[float, float, float]] = []
    for _ in range(RANDOM_PLANS_COMPARED):
        rows = [g * n + rng.choice(evenly, count, replace=False) for g in range(n_groups)]
        covariance = drawn.info.covariance(drawn.info.of(np.concatenate(rows)))
        results.append((*drawn.info.tool(covariance), float(index.value(covariance))))
    position, orientation, value = np.mean(results, axis=0).tolist()
    return Accuracy(made.count, position, orientation), value


# ------------------------------------------------------------------ the way between them


def _route(
    machine: Machine, value: Candidates, rng: np.random.Generator
) -> tuple[Integers, Booleans, tuple[float, float]]:
    """The order (n,), group by group; which steps are blocked (n,); and how long the way is, and
    one by chance.
    """
    home = machine.inverse(machine.home()[None])[0]
    order: list[Integers] = []
    barred: list[Booleans] = []
    own, chance = 0.0, 0.0
    for g in range(len(value.groups)):
        rows = np.flatnonzero(value.group == g)
        joints, poses = value.joints[rows], value.T_base_platform[rows]
        apart = motor_distances(np.concatenate([joints, home[None]]), machine.joint_ranges)
        path, blocked = _free_path(machine, joints, poses, home, apart)
        order.append(rows[path])
        barred.append(blocked)
        own += length(path, apart[:-1, :-1], apart[-1, :-1])
        chance += length(rng.permutation(len(rows)), apart[:-1, :-1], apart[-1, :-1])
    return np.concatenate(order), np.concatenate(barred), (own, chance)


def _free_path(
    machine: Machine, joints: Array, poses: Array, home: Array, apart: Array
) -> tuple[Integers, Booleans]:
    """A short way that avoids steps on which legs touch or the machine is lost, where that can be;
    and which of its steps are such.
    """
    bars = np.zeros((len(joints), len(joints)), dtype=bool)
    first = apart[-1, :-1].copy()
    path = shortest_path(apart[:-1, :-1], first, bars)
    blocked = _blocked(machine, joints[path], poses[path], home)
    for _ in range(REROUTING_ATTEMPTS):
        steps = np.flatnonzero(blocked[1:])
        if not len(steps) and not blocked[0]:
            break
        bars[path[steps], path[steps + 1]] = bars[path[steps + 1], path[steps]] = True
        if blocked[0]:
            first[path[0]] += len(joints) * apart.max()
        path = shortest_path(apart[:-1, :-1], first, bars)
        blocked = _blocked(machine, joints[path], poses[path], home)
    return path, blocked


def _blocked(machine: Machine, joints: Array, poses: Array, home: Array) -> Booleans:
    """(n,) whether on the way to each, motors moving evenly, the machine is lost or legs touch."""
    before = np.concatenate([home[None], joints[:-1]])
    n = POSES_BETWEEN_CONFIGURATIONS
    share = (np.arange(n) + 0.5)[:, None, None] / n
    between = (before + share * (joints - before)).reshape(-1, joints.shape[1])
    fk = machine.forward_result(between, np.tile(poses, (n, 1, 1)))
    good = fk.converged.copy()
    at = np.flatnonzero(good)
    good[at] = usable(machine, fk.T_base_platform[at], between[at])
    return np.asarray(~good.reshape(POSES_BETWEEN_CONFIGURATIONS, -1).all(axis=0))


# ------------------------------------------------------------------ places of the camera


def _with_places(
    subject: Subject,
    work: Array,
    drawn: Configurations,
    count: int,
    index: str,
    free_places: int | None,
    best_of: int | None,
) -> tuple[Rig, CalibrationPrior | None, tuple[TriedPlace, ...]]:
    """The rig with the best places: free ones on a sphere, or some of its own.

    Each place is an information of its own on the machine, its station's place and shading
    eliminated, from configurations spread over all; the best set of them is chosen as
    configurations are.
    """
    rig = subject.rig
    if free_places:
        wide, spots = _around(rig)
    else:
        wide, spots = rig, tuple(StationPlace.of(T) for T in rig.T_station_base)
    few = np.unique(np.linspace(0, len(drawn.joints) - 1, FOR_PLACES).astype(int))
    part = Configurations(*(x[few] for x in drawn))
    reference_values = subject.prior and subject.prior.only(())
    infos = [
        _view_information(wide.only([s]), part, work, reference_values)
        for s in range(len(wide.names))
    ]
    first = next((info for info in infos if info is not None), None)
    if first is None:
        raise InputError(
            "from no place about the machine anything is seen",
            where="--places",
            expected="a camera that sees the legs, or a board that faces some place",
        )
    start = np.linalg.inv(first.covariance(first.information))
    covariances, alone = np.zeros((len(infos), *start.shape)), np.zeros(len(infos))
    for s, info in enumerate(infos):
        after = np.linalg.inv(start)
        if info is not None:
            after = info.covariance(info.of(np.arange(len(few)), count / len(few)))
            covariances[s] = np.linalg.inv(after) - start
        alone[s] = first.tool(after)[0]
    roots = np.stack([_padded_root(covariances[s]) for s in range(len(covariances))])
    same = np.zeros(len(roots), dtype=int)
    number = np.arange(len(roots), dtype=float)[:, None]  # no two places are the same
    whole = CandidateRows(roots, same, number, start, np.eye(len(start)), first.work)
    rule = PLAN_INDICES[index](whole)
    wanted = free_places or best_of or 1
    best = np.sort(exchanged(whole, greedy(whole, wanted, rule).chosen, rule))
    tried = tuple(
        TriedPlace(place, float(alone[k]), bool(k in best)) for k, place in enumerate(spots)
    )
    chosen = wide.only(best.tolist())
    if free_places:
        names = tuple(f"place{n + 1}" for n in range(len(best)))
        return replace(chosen, names=names), reference_values, tried
    prior = subject.prior and subject.prior.only(best.tolist())
    if prior is not None:  # by their new numbers
        prior = replace(prior, stations=tuple(np.searchsorted(best, prior.stations).tolist()))
    return chosen, prior, tried


def _view_information(
    rig: Rig, part: Configurations, work: Array, prior: CalibrationPrior | None
) -> CandidateRows | None:
    """What configurations tell from one place; None where nothing is seen from there."""
    try:
        return information_of(rig, Candidates.of_all(((0,),), *part), work, prior)
    except InputError:
        return None


def _padded_root(information: Array) -> Array:
    """(p, p) rows R with R^T R = information, whose smallest eigenvalues may be rounding."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T


def _around(rig: Rig) -> tuple[Rig, tuple[StationPlace, ...]]:
    """The rig's first camera at every place of a sphere, with what it sees there."""
    one = next(one for one in rig.instruments if isinstance(one, LegsFrom | BoardFrom))
    board = "platform" if isinstance(one, BoardFrom) else None
    spots = camera_ring_places(rig.machine, one.camera, board)
    T = np.stack([spot.T_camera_base() for spot in spots])
    mine = [other for other in rig.instruments if other.station == one.station]
    instruments = tuple(
        replace(other, station=s, T_camera_base=T[s])
        for s in range(len(spots))
        for other in mine
        if isinstance(other, LegsFrom | BoardFrom)
    )
    wide = replace(
        rig,
        names=tuple(f"place{s + 1}" for s in range(len(spots))),
        T_station_base=T,
        camera_of_station=np.zeros(len(spots), dtype=int),
        instruments=instruments,
    )
    return wide, spots
