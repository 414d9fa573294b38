"""Plan of the next measurements and of the stations: ``pkmcal plan``.

Configurations are chosen among many feasible ones and then improved locally; stations among poses
on a sphere, or among those of a session. The predicted accuracy is the covariance that the joint
estimate would state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count as count_from
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers, evenly, short_repr
from pkmcal.calibration.saved_calibration import CalibrationPrior
from pkmcal.errors import InputError
from pkmcal.levels import NEGLIGIBLE
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.region import Region, poses_in
from pkmcal.placement.configurations import usable
from pkmcal.placement.stations import StationPose
from pkmcal.planning.candidates import (
    Configurations,
    camera_ring_poses,
    configurations,
    neighbours,
)
from pkmcal.planning.defaults import CONFIGURATIONS_A_CAPTURE
from pkmcal.planning.exchange import ShareProgress, exchanged, greedy, tool_variance, tool_weight
from pkmcal.planning.information import (
    CandidateRows,
    Candidates,
    information_of,
    rows_of_information,
)
from pkmcal.planning.rig import BoardFrom, LegsFrom, Rig, TargetFrom
from pkmcal.planning.route import length, motor_distances, shortest_path
from pkmcal.planning.subject import Subject
from pkmcal.ranges import check_number

CAPTURE_MULTIPLES = (2, 4)
"""Multiples of the planned number of images for which the accuracy is predicted as well."""
CONFIGURATION_NAME_LETTERS = "abcdefghijklmnopqrstuvwxyz"
"""First letters of new configurations' names, one for each group of stations."""
PLAN_SEED = 0


@dataclass(frozen=True)
class PlanOptions:
    """Constants of the choice of configurations and stations."""

    # fewest candidate configurations, and fewest for each wanted one
    candidates: int = 400
    candidates_for_each: int = 4
    # poses of the workspace at which the tool's accuracy is evaluated
    work_poses: int = 60
    # most rounds of local improvement
    rounds: int = 8
    # pairs of places from which hand-held images are taken of a configuration
    handheld_pairs: int = 48
    # camera poses on each ring around the machine, and configurations for their comparison
    poses_a_ring: int = 12
    for_stations: int = 24
    # random selections with which a plan is compared
    random_plans: int = 10
    # poses that are checked on the path between two configurations
    poses_between: int = 8
    # most reroutings around blocked steps
    reroutings: int = 5


PLAN = PlanOptions()


@dataclass(frozen=True)
class Accuracy:
    """Predicted standard deviations of the platform's position (m) and rotation (rad), means over
    the workspace.

    count : number of configurations at each station.
    """

    count: float
    position: float
    orientation: float


@dataclass(frozen=True)
class TriedStation:
    """Candidate pose of a camera.

    alone : standard deviation (m) of the platform's position if all configurations are observed
        from there.
    chosen : whether it is part of the plan.
    """

    place: StationPose
    alone: float
    chosen: bool


@dataclass(frozen=True)
class MeasurementPlan:
    """Planned measurements, in the order of the path through them.

    subject : subject of the plan, with the chosen stations if these were free.
    stations : (n,) tuples of names of the stations that measure each configuration.
    names, joints, T_base_platform : configurations, (n,), (n, m) and (n, 4, 4).
    rank : (n,) order of the configurations at each station: those up to k are the best k.
    now, promised, by_chance : accuracy before the plan, with the plan, and with random
        configurations.
    curve : accuracy with fewer and with more configurations.
    region, work : workspace, and its poses.
    blocked : (n,) True if the machine cannot take the straight path to a configuration, or its legs
        touch on it.
    travel : total motion of the slowest motor, relative to its range, on the planned and on a
        random path.
    tried : candidate stations.
    together : whether all stations measure each configuration.
    """

    subject: Subject
    stations: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]
    joints: Array
    T_base_platform: Array
    rank: Integers
    now: Accuracy
    promised: Accuracy
    by_chance: Accuracy
    curve: tuple[Accuracy, ...]
    region: Region
    work: Array
    blocked: Booleans
    travel: tuple[float, float]
    tried: tuple[TriedStation, ...] = ()
    together: bool = False

    __repr__ = short_repr

    @property
    def pays_until(self) -> float | None:
        """Number of configurations at each station after which one more improves the tool by less
        than a negligible share; None if all planned ones are worthwhile.
        """
        for before, after in pairwise(self.curve):
            each = 1 - (after.position / before.position) ** (1 / (after.count - before.count))
            if each < NEGLIGIBLE and after.count <= self.promised.count:
                return before.count
        return None


def plan_measurements(
    subject: Subject,
    *,
    count: int = CONFIGURATIONS_A_CAPTURE,
    region: Region | None = None,
    together: bool | None = None,
    free_stations: int | None = None,
    best_of: int | None = None,
    seed: int = PLAN_SEED,
    progress: ShareProgress | None = None,
    options: PlanOptions = PLAN,
) -> MeasurementPlan:
    """Plan measurements for a subject.

    count : configurations at each station; in total, if all stations measure together.
    region : workspace over which the tool's accuracy is averaged, by default all reachable poses.
    together : whether all stations measure every configuration; by default if they have cameras of
        their own or there is a tracker.
    free_stations : number of stations to choose on a sphere around the machine.
    best_of : number of the rig's stations to choose.
    seed : seed for all random numbers.
    progress : callback with the share done.
    options : of the search.

    Raises InputError for what cannot be planned.
    """
    progress = progress or (lambda _share: None)
    rig, rng = subject.rig, np.random.default_rng(seed)
    _check(rig, count, free_stations, best_of)
    region = region or Region()
    work = poses_in(rig.machine.limits(), region, options.work_poses, seed)
    # Candidate configurations, by which stations are chosen first, if they are free.
    drawn = max(options.candidates, options.candidates_for_each * count)
    candidates = configurations(rig.machine, drawn, rng)
    progress(0.1)
    tried: tuple[TriedStation, ...] = ()
    if free_stations or best_of:
        rig, prior, tried = _with_stations(
            subject, work, candidates, count, free_stations, best_of, options
        )
        subject = replace(subject, rig=rig, prior=prior)
    progress(0.3)
    if together is None:  # one camera is moved between stations; several measure simultaneously
        tracked = any(isinstance(one, TargetFrom) for one in rig.instruments)
        several = tracked or len(np.unique(rig.camera_of_station)) > 1
        together = len(rig.names) > 1 and several
    # The best configurations for these stations, or with pairs of hand-held images.
    if subject.handheld:
        together = True
        rig = _on_sphere(rig, options.poses_a_ring)[0]
        groups, every = _with_pairs(rig, candidates, options.handheld_pairs, rng)
    else:
        stations = range(len(rig.names))
        groups = (tuple(stations),) if together else tuple((s,) for s in stations)
        every = Candidates.of_all(groups, *candidates)
    selection = _Selection(rig, subject.prior, groups, count, work, options, subject.localized)
    pool = selection.pool(every)
    chosen = selection.chosen(pool, rng, lambda share: progress(0.3 + 0.6 * share))
    progress(0.9)
    return _routed_plan(subject, selection, chosen, pool, region, together, tried, rng)


def _check(rig: Rig, count: int, free_stations: int | None, best_of: int | None) -> None:
    rig.machine.check_free("fixed")
    check_number("plan", "configurations", count, "--configurations")
    check_number("plan", "places", free_stations, "--places")
    check_number("plan", "best_of", best_of, "--best-of")
    if rig.machine.layout.n_internal:
        raise InputError(
            f"mechanism {rig.machine.name!r} has side bars that turn on hinges, and how far they"
            " turn is not known where nothing was measured, so no plan is made for it",
            next_step="Plan for the machine with one rod a forearm, such as h4",
        )
    cameras = [one for one in rig.instruments if isinstance(one, LegsFrom | BoardFrom)]
    if free_stations and not cameras:
        raise InputError(
            "there is no camera whose place could be chosen",
            where="--places",
            next_step="Leave it out; where a tracker stands does not change its information",
        )
    if best_of and not 1 <= best_of <= len(rig.names):
        raise InputError(
            "there are not so many stations to choose from",
            where="--best-of",
            found=str(best_of),
            expected=f"1 to {len(rig.names)}",
        )


class _Pool(NamedTuple):
    """Candidates with their rows."""

    candidates: Candidates
    info: CandidateRows


@dataclass(frozen=True)
class _Selection:
    """Selection of configurations for a rig, with its options.

    localized : share of images that are localized, where each configuration has images of its own,
        from places that no other has, and the groups compete for ``count`` configurations in all;
        None where stations are fixed.
    """

    rig: Rig
    prior: CalibrationPrior | None
    groups: tuple[tuple[int, ...], ...]
    count: int
    work: Array
    options: PlanOptions
    localized: float | None = None

    @property
    def n_groups(self) -> int:
        """Number of groups of which each gets its own configurations."""
        return len(self.groups) if self.localized is None else 1

    def pool(self, candidates: Candidates, rng: np.random.Generator | None = None) -> _Pool:
        """Candidates with their rows. rng : as in :func:`information_of`."""
        rig, work, prior = self.rig, self.work, self.prior
        if self.localized is None:
            return _Pool(candidates, information_of(rig, candidates, work, prior, rng, self.count))
        infos: list[CandidateRows] = []
        for g in np.unique(candidates.group):
            own = candidates.only(np.flatnonzero(candidates.group == g))
            own = replace(own, groups=((0, 1),), group=np.zeros_like(own.group))
            info = information_of(rig.only(self.groups[g]), own, work, prior, rng, 1)
            infos.append(info.alone(self.localized))
        rows, where = ([getattr(info, name) for info in infos] for name in ("rows", "where"))
        group = np.zeros_like(candidates.group)
        whole = replace(
            infos[0], rows=np.concatenate(rows), where=np.concatenate(where), group=group
        )
        return _Pool(candidates, whole)

    def chosen(self, pool: _Pool, rng: np.random.Generator, progress: ShareProgress) -> Candidates:
        """Best candidates of a pool, improved locally."""
        # Global choice among the candidates.
        first = greedy(pool.info, self.count, lambda x: progress(0.4 * x)).chosen
        best = pool.candidates.only(np.sort(exchanged(pool.info, first)))
        # Local improvement, until a round gains too little.
        size = np.inf
        rounds = self.options.rounds
        for k in range(rounds):
            progress(0.5 + 0.5 * k / rounds)
            pool, start = self._with_neighbours(best, rng)
            chosen = np.sort(exchanged(pool.info, start))
            best = pool.candidates.only(chosen)
            covariance = pool.info.covariance(pool.info.of(chosen))
            before, size = size, float(tool_variance(tool_weight(pool.info), covariance)) ** 0.5
            if size > (1 - NEGLIGIBLE) * before:
                break
        return best

    def _with_neighbours(
        self, best: Candidates, rng: np.random.Generator
    ) -> tuple[_Pool, Integers]:
        """Pool of the chosen candidates and their variations for the same group, and the indices of
        the chosen ones.
        """
        parts: list[Configurations] = []
        group: list[Integers] = []
        start: list[Integers] = []
        for g in range(len(self.groups)):
            own = np.flatnonzero(best.group == g)
            if not own.size:
                continue
            now = Configurations(best.joints[own], best.T_base_platform[own])
            near = neighbours(self.rig.machine, now, rng)
            start.append(sum(map(len, group)) + np.arange(len(own)))
            group.append(np.full(len(own) + len(near.joints), g))
            parts += [now, near]
        joints, poses = map(np.concatenate, zip(*parts, strict=True))
        even = np.zeros(len(joints), dtype=bool)
        candidates = Candidates(self.groups, np.concatenate(group), joints, poses, even)
        return self.pool(candidates), np.concatenate(start)


def _accuracy(info: CandidateRows, covariance: Array, count: float) -> Accuracy:
    return Accuracy(count, *info.tool(covariance))


def _routed_plan(
    subject: Subject,
    selection: _Selection,
    chosen: Candidates,
    pool: _Pool,
    region: Region,
    together: bool,
    tried: tuple[TriedStation, ...],
    rng: np.random.Generator,
) -> MeasurementPlan:
    """Plan of the chosen configurations, in the order of the shortest path, with its predicted
    accuracy.
    """
    machine, count, n_groups = subject.rig.machine, selection.count, selection.n_groups
    # edges with drawn rather than mean information, as real images have
    own = selection.pool(chosen, np.random.default_rng(PLAN_SEED)).info
    every = np.arange(len(chosen.group))
    # Accuracy by number of configurations, in the greedy order, and beyond the plan.
    nested = greedy(own, count)
    curve = [_accuracy(own, nested.path[c * n_groups - 1], c) for c in range(2, count)]
    covariance = own.covariance(own.of(every))
    promised = _accuracy(own, covariance, count)
    more = [_accuracy(own, own.covariance(own.of(every, t)), t * count) for t in CAPTURE_MULTIPLES]
    by_chance = _random_accuracy(selection, pool, rng)
    rank = np.empty(len(every), dtype=int)
    rank[nested.chosen] = every // n_groups + 1
    places = [selection.groups[g] for g in chosen.group]
    if selection.localized is not None:  # one way through all of them
        chosen = replace(chosen, groups=((),), group=np.zeros_like(chosen.group))
    order, blocked, travel = _route(machine, chosen, rng, selection.options)
    names = _new_names(chosen.group[order], subject.names)
    if selection.localized is not None:
        rig, stations = _image_rig(selection.rig, [places[k] for k in order], names)
        subject = replace(subject, rig=rig)
    else:
        stations = tuple(tuple(subject.rig.names[s] for s in places[k]) for k in order)
    return MeasurementPlan(
        subject=subject,
        stations=stations,
        names=names,
        joints=subject.commanded(chosen.joints[order]),
        T_base_platform=chosen.T_base_platform[order],
        rank=rank[order],
        now=_accuracy(own, own.covariance(own.information), 0),
        promised=promised,
        by_chance=by_chance,
        curve=(*curve, promised, *more),
        region=region,
        work=selection.work,
        blocked=blocked,
        travel=travel,
        tried=tried,
        together=together,
    )


def _new_names(group: Integers, taken: tuple[str, ...]) -> tuple[str, ...]:
    """New names of configurations, a letter for each group and a number."""
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


def _random_accuracy(selection: _Selection, pool: _Pool, rng: np.random.Generator) -> Accuracy:
    """Accuracy with configurations drawn uniformly over the joints' ranges, mean of some draws."""
    even = pool.candidates.even
    groups = [np.flatnonzero(even & (pool.info.group == g)) for g in range(selection.n_groups)]
    count = min(selection.count, *map(len, groups))
    figures: list[tuple[float, float]] = []
    for _ in range(selection.options.random_plans):
        rows = [rng.choice(rows, count, replace=False) for rows in groups]
        covariance = pool.info.covariance(pool.info.of(np.concatenate(rows)))
        figures.append(pool.info.tool(covariance))
    return Accuracy(selection.count, *np.mean(figures, axis=0).tolist())


# ------------------------------------------------------------------ the way between them


def _route(
    machine: Machine, chosen: Candidates, rng: np.random.Generator, options: PlanOptions
) -> tuple[Integers, Booleans, tuple[float, float]]:
    """Order (n,) of the configurations, group by group, blocked steps (n,), and the lengths of this
    path and of a random one.
    """
    home = machine.inverse(machine.home()[None])[0]
    order: list[Integers] = []
    barred: list[Booleans] = []
    own, chance = 0.0, 0.0
    for g in range(len(chosen.groups)):
        rows = np.flatnonzero(chosen.group == g)
        joints, poses = chosen.joints[rows], chosen.T_base_platform[rows]
        apart = motor_distances(np.concatenate([joints, home[None]]), machine.joint_ranges)
        path, blocked = _free_path(machine, joints, poses, home, apart, options)
        order.append(rows[path])
        barred.append(blocked)
        own += length(path, apart[:-1, :-1], apart[-1, :-1])
        chance += length(rng.permutation(len(rows)), apart[:-1, :-1], apart[-1, :-1])
    return np.concatenate(order), np.concatenate(barred), (own, chance)


def _free_path(
    machine: Machine,
    joints: Array,
    poses: Array,
    home: Array,
    apart: Array,
    options: PlanOptions,
) -> tuple[Integers, Booleans]:
    """Short path that avoids blocked steps where possible, and its blocked steps."""
    bars = np.zeros((len(joints), len(joints)), dtype=bool)
    first = apart[-1, :-1].copy()
    path = shortest_path(apart[:-1, :-1], first, bars)
    blocked = _blocked_steps(machine, joints[path], poses[path], home, options.poses_between)
    for _ in range(options.reroutings):
        steps = np.flatnonzero(blocked[1:])
        if not len(steps) and not blocked[0]:
            break
        bars[path[steps], path[steps + 1]] = bars[path[steps + 1], path[steps]] = True
        if blocked[0]:
            first[path[0]] += len(joints) * apart.max()
        path = shortest_path(apart[:-1, :-1], first, bars)
        blocked = _blocked_steps(machine, joints[path], poses[path], home, options.poses_between)
    return path, blocked


def _blocked_steps(machine: Machine, joints: Array, poses: Array, home: Array, n: int) -> Booleans:
    """Whether the step to each configuration is blocked: with all motors moving uniformly, the
    closure fails or legs touch, at one of ``n`` poses between.
    """
    before = np.concatenate([home[None], joints[:-1]])
    share = (np.arange(n) + 0.5)[:, None, None] / n
    between = (before + share * (joints - before)).reshape(-1, joints.shape[1])
    fk = machine.forward_result(between, np.tile(poses, (n, 1, 1)))
    good = fk.converged.copy()
    at = np.flatnonzero(good)
    good[at] = usable(machine, fk.T_base_platform[at], between[at])
    return np.asarray(~good.reshape(n, -1).all(axis=0))


# ------------------------------------------------------------------ places of the camera


def _with_pairs(
    rig: Rig, configurations: Configurations, count: int, rng: np.random.Generator
) -> tuple[tuple[tuple[int, ...], ...], Candidates]:
    """Pairs of a rig's stations, and candidates with each configuration for one of them.

    A single image of similar legs often fits from two places, so a configuration has two images.
    Both are drawn at random: configurations, of which there are many more than pairs, are then
    chosen with their pair.
    """
    pairs = [tuple(sorted(rng.choice(len(rig.names), 2, replace=False))) for _ in range(count)]
    n = len(configurations.joints)
    group = rng.permutation(n) % count
    order = np.argsort(group, kind="stable")
    parts = configurations.joints[order], configurations.T_base_platform[order]
    groups = tuple((int(a), int(b)) for a, b in pairs)
    return groups, Candidates(groups, group[order], *parts, order >= n // 2)


def _image_rig(
    rig: Rig, places: Sequence[tuple[int, ...]], names: Sequence[str]
) -> tuple[Rig, tuple[tuple[str, ...], ...]]:
    """Rig with a station for each hand-held image, and the images' names by configuration.

    places : stations of the rig from which each configuration's images are taken. names : of the
    configurations.
    """
    spots = [s for pair in places for s in pair]
    stations = tuple(
        tuple(f"{name}-{repeat}" for repeat in range(1, len(pair) + 1))
        for name, pair in zip(names, places, strict=True)
    )
    whole = replace(
        rig,
        names=tuple(image for images in stations for image in images),
        T_station_base=rig.T_station_base[spots],
        camera_of_station=rig.camera_of_station[spots],
        instruments=tuple(
            replace(one, station=k)
            for k, s in enumerate(spots)
            for one in rig.instruments
            if one.station == s
        ),
    )
    return whole, stations


def _with_stations(
    subject: Subject,
    work: Array,
    candidates: Configurations,
    count: int,
    free_stations: int | None,
    best_of: int | None,
    options: PlanOptions,
) -> tuple[Rig, CalibrationPrior | None, tuple[TriedStation, ...]]:
    """Rig with the best stations, on a sphere or among its own.

    The information of each station on the machine, with the station's pose and shading eliminated,
    comes from configurations spread over all; stations are then chosen as configurations are.
    """
    rig = subject.rig
    if free_stations:
        wide, poses = _on_sphere(rig, options.poses_a_ring)
    else:
        wide, poses = rig, tuple(StationPose.of(T) for T in rig.T_station_base)
    # Rows of the same few configurations from each station.
    few = evenly(len(candidates.joints), options.for_stations)
    part = Configurations(*(x[few] for x in candidates))
    machine_prior = subject.prior and subject.prior.only(())
    infos = [
        _view_information(wide.only([s]), part, work, machine_prior) for s in range(len(wide.names))
    ]
    first = next((info for info in infos if info is not None), None)
    if first is None:
        raise InputError(
            "no station around the machine observes anything",
            where="--places",
            expected="a camera that sees the legs, or a board that faces some place",
        )
    # Information of each station on the machine, beyond the prior's.
    start = np.linalg.inv(first.covariance(first.information))
    information, alone = np.zeros((len(infos), *start.shape)), np.zeros(len(infos))
    for s, info in enumerate(infos):
        covariance = np.linalg.inv(start)
        if info is not None:
            covariance = info.covariance(info.of(np.arange(len(few)), count / len(few)))
            information[s] = np.linalg.inv(covariance) - start
        alone[s] = first.tool(covariance)[0]
    rows = rows_of_information(information)
    # The best set of stations; distinct numbers, so that none counts as a repetition of another.
    same = np.zeros(len(rows), dtype=int)
    number = np.arange(len(rows), dtype=float)[:, None]
    whole = CandidateRows(rows, same, number, start, np.eye(len(start)), first.work)
    wanted = free_stations or best_of or 1
    best = np.sort(exchanged(whole, greedy(whole, wanted).chosen))
    tried = tuple(
        TriedStation(place, float(alone[k]), bool(k in best)) for k, place in enumerate(poses)
    )
    chosen = wide.only(best.tolist())
    if free_stations:
        names = tuple(f"place{n + 1}" for n in range(len(best)))
        return replace(chosen, names=names), machine_prior, tried
    prior = subject.prior and subject.prior.only(best.tolist())
    if prior is not None:  # renumber the stations of the prior
        prior = replace(prior, stations=tuple(np.searchsorted(best, prior.stations).tolist()))
    return chosen, prior, tried


def _view_information(
    rig: Rig, part: Configurations, work: Array, prior: CalibrationPrior | None
) -> CandidateRows | None:
    """Rows of configurations observed from one station; None if nothing is visible from there."""
    try:
        return information_of(rig, Candidates.of_all(((0,),), *part), work, prior)
    except InputError:
        return None


def _on_sphere(rig: Rig, poses_a_ring: int) -> tuple[Rig, tuple[StationPose, ...]]:
    """Rig with its first camera at every pose on a sphere, with the instruments of that camera."""
    one = next(one for one in rig.instruments if isinstance(one, LegsFrom | BoardFrom))
    board = "platform" if isinstance(one, BoardFrom) else None
    spots = camera_ring_poses(rig.machine, one.camera, poses_a_ring, board)
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
