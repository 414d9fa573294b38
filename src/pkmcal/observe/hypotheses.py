"""What is not as the session says: the usual mix-ups, as hypotheses beside the one that was found.

A hypothesis is the same photographs with other readings, other names, or mirrored. It is looked at
where the machine was found, and where that is not where the user says, there too; only the
likeliest are searched in full, and named where they explain the photographs better, one by one. A
machine that was recognised is asked too: with two columns exchanged, four legs in six still fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, combinations, islice
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.geometry.rigid import angle_between
from pkmcal.mechanisms.reading_hypotheses import reversed_motors
from pkmcal.observe.pose_likelihood import (
    StationView,
    likelihood_from,
    log_likelihood_by_name,
    settled,
)
from pkmcal.observe.station_localization import LocalizedPose, find_station, likelihood_nearby
from pkmcal.wording import DISPLAY_UNITS, how_often, listed, number

DIAGNOSIS_LOG_ODDS = math.log(30 / 0.05)
"""Log odds from which one of some thirty hypotheses replaces the session's word, or excludes
another."""
NEAR_SEARCH_TURN = np.radians(15.0)
"""Turn from the pose by hand beyond which hypotheses are looked for about that, too."""
OTHER_POSE_TURN = np.radians(45.0)
"""Turn from the pose by hand beyond which the machine was found where the user does not see it: a
machine of three or six equal parts looks the same from there."""
RIGHT_NAME_SHARE = 0.1
"""Share of what a photograph of a recognised machine tells on average that one under the right name
has to tell more: of two configurations that are nearly alike, what the drawing has wrong decides.
Of simulated machines exchanged ones told 0.2 to 2 times as much, right ones up to 0.03."""
NAMING_ROUNDS = 3
"""Rounds of names for photographs, and of the pose that these tell."""
FEW_CONFIGURATIONS = 4
"""Photographs of which all hypotheses about the readings are asked."""
HYPOTHESES_SEARCHED = 3
"""Hypotheses about the readings, likeliest first, that are searched in full."""
ENOUGH_PHOTOGRAPHS_ALONE, USUAL_PHOTOGRAPHS = 4, 15
"""Photographs below which there are no two halves to search and to ask, and one that says little
leaves it open whether the machine is there; and how many are usual."""
STATION_PAIRS_SEARCHED = 15
"""Pairs of stations that are searched for the other's pose: of six stations, all."""


class SuspectStation(NamedTuple):
    """A station: its name, the files of its photographs and the names of the session's
    configurations, its view, pose by hand (4, 4) if there is one, and what was found.
    """

    name: str
    files: list[str]
    configurations: tuple[str, ...]
    view: StationView
    by_hand: Array | None
    localization: LocalizedPose

    @property
    def elsewhere(self) -> bool:
        """Whether the machine was found far from where the user says, or not at all."""
        return not self.localization.good or self.turned > OTHER_POSE_TURN

    @property
    def turned(self) -> float:
        """Turn (rad) of the found pose from the one by hand; 0 without one."""
        if self.by_hand is None:
            return 0.0
        return float(angle_between(self.localization.T_camera_base, self.by_hand))


class Hypothesis(NamedTuple):
    """What the photographs may show instead, the error that names it, and the logarithm of how many
    of its kind it was chosen from. readings : (K, m) that the photographs would have, where nothing
    else is another.
    """

    view: Callable[[], StationView]
    error: InputError
    log_choices: float = 0.0
    readings: Array | None = None


def mistake(stations: list[SuspectStation], rng: np.random.Generator) -> InputError | None:
    """The error about stations whose photographs show something else than the session says."""
    error = _swapped_stations([s for s in stations if s.elsewhere], rng)
    if error is not None or not stations:
        return error
    bad = [station for station in stations if not station.localization.good]
    worst = max(
        stations, key=lambda s: (not s.localization.good, s.elsewhere, s.localization.by_chance)
    )
    # one station that is where the user says shows that its readings are in order
    in_order = any(s.by_hand is not None and not s.elsewhere for s in stations)
    error = _mixed_up(worst, in_order, rng)
    if error is not None:
        return error
    if not bad:  # readings are wrong for all stations, but names for one alone
        rest = (station for station in stations if station is not worst)
        named = ((s, list(_other_photographs(s))) for s in rest)
        errors = (_likelier(s, others, True, rng, len(others)) for s, others in named)
        return next((error for error in errors if error is not None), None)
    others = [station.name for station in bad if station is not worst]
    at = ", nor in those of " + listed(others) if others else ""
    few = len(worst.view.configuration) < ENOUGH_PHOTOGRAPHS_ALONE
    return InputError(
        f"the machine is not recognised in the photographs of {worst.name}{at}",
        where=f"session.yaml, stations.{worst.name}",
        found=_little(worst),
        expected="one place where its legs lie on edges of the picture far oftener than any"
        " machine's would",
        next_step=(
            f"Take more photographs from there, {USUAL_PHOTOGRAPHS} are usual: of so few it"
            " cannot be said whether anything is mixed up. If there are more, check"
            if few
            else "Check"
        )
        + " that these photographs show this machine's legs, that each bears the name"
        " of its configuration, and that the drawing is this machine's"
        + ("" if worst.by_hand is not None else "; a pose by hand, right to 20 cm, may help"),
        code="station.not_recognised",
    )


def _little(station: SuspectStation) -> str:
    """What of the evidence is too little."""
    localization = station.localization
    if localization.by_chance < localization.limit:
        return "legs that fit nearly as well at another place"
    count = len(station.view.configuration)
    if count < 2:
        return "one photograph alone, and none to confirm what it seems to show"
    few = f"{count} photographs alone, and " if count < ENOUGH_PHOTOGRAPHS_ALONE else ""
    often = how_often(localization.by_chance)
    return f"{few}legs that readings of other configurations fit as well {often}"


def _swapped_stations(
    stations: list[SuspectStation], rng: np.random.Generator
) -> InputError | None:
    """Two stations each recognised near the other's pose, and better than mirrored at its own: a
    symmetric machine's mirror image looks much as the machine does from the other side.
    """
    for one, other in islice(combinations(stations, 2), STATION_PAIRS_SEARCHED):
        if one.by_hand is None or other.by_hand is None:
            continue
        swapped = (one._replace(by_hand=other.by_hand), other._replace(by_hand=one.by_hand))
        swapped = [
            s._replace(localization=find_station(s.view, s.by_hand, rng, near_prior=True))
            for s in swapped
        ]
        if any(station.elsewhere for station in swapped):
            continue
        view = replace(one.view, tables=one.view.tables.mirrored())
        mirrored = find_station(view, one.by_hand, rng, near_prior=True)
        if not (mirrored.good and mirrored.likelier(swapped[0].localization) > DIAGNOSIS_LOG_ODDS):
            return InputError(
                f"stations {one.name} and {other.name} are mixed up",
                where="session.yaml, stations",
                found="the photographs of each fit the pose of the other",
                next_step=f"Exchange the poses of {one.name} and {other.name} in session.yaml,"
                " or their image folders",
                code="station.exchanged",
            )
    return None


def _mixed_up(
    station: SuspectStation, in_order: bool, rng: np.random.Generator
) -> InputError | None:
    """The hypothesis that explains a station's photographs better than the session, if any."""
    view, localization = station.view, station.localization
    starts = (
        [localization.T_camera_base] if localization.good or station.by_hand is not None else []
    )
    wide = station.elsewhere or station.turned > NEAR_SEARCH_TURN
    if wide and station.by_hand is not None:
        starts.append(station.by_hand)
    begin = np.array(starts).reshape(-1, 4, 4)
    hypotheses = list(_hypotheses(station))
    display = [h.readings for h in hypotheses if h.readings is not None]
    few, every = view.few(FEW_CONFIGURATIONS), view.few(len(view.configuration))
    own, *log_likelihood_ratio = likelihood_nearby(
        view, np.stack([view.joints, *display]), begin, wide, few, rng
    )
    for h in hypotheses[len(log_likelihood_ratio) :]:  # other legs, with the same readings
        other = h.view()
        log_likelihood_ratio.append(
            likelihood_nearby(other, other.joints[None], begin, wide, few, rng)[0]
        )
    best = np.argsort(np.negative(log_likelihood_ratio))[:HYPOTHESES_SEARCHED]
    if not station.elsewhere:
        # where the machine is as the user says, another word has to be better there at once, of few
        # photographs, any of which another may fit better by chance, and of all
        best = [k for k in best if log_likelihood_ratio[k] > own]
        if best:
            queries = np.stack([view.joints, *(display[k] for k in best)])
            own, *log_likelihood_ratio = likelihood_nearby(view, queries, begin, wide, every, rng)
            best = [k for k, e in zip(best, log_likelihood_ratio, strict=True) if e > own]
    likely = [hypotheses[k] for k in best]
    others = list(_other_photographs(station))
    tried = len(hypotheses) + len(others)
    return _likelier(station, [*others, *likely], in_order, rng, tried)


def _likelier(
    station: SuspectStation,
    others: list[Hypothesis],
    in_order: bool,
    rng: np.random.Generator,
    query: int,
) -> InputError | None:
    """The likeliest of hypotheses, searched in full, that explain a station better than the
    session, if any; with it those that it does not exclude. query : of how many they are the best.
    """
    if not others:
        return None
    view, localization = station.view, station.localization
    in_view = [h.view() for h in others]
    own, *searched = (
        find_station(each, station.by_hand, rng, near_prior=True) for each in (view, *in_view)
    )
    places = np.stack([f.T_camera_base for f in (localization, own, *searched)])
    named = likelihood_from(view, places)
    odds = [
        (likelihood_from(other, places) - named) / localization.correlation_length
        for other in in_view
    ]
    better = [
        (o, h)
        for o, f, h in zip(odds, searched, others, strict=True)
        if _replaces(f, o - h.log_choices, station, in_order or h.readings is None, query)
    ]
    if not better:
        return None
    better.sort(key=lambda item: -item[0])
    first, error = better[0][0], better[0][1].error
    # several constants of one motor are told by the same words
    also = [h.error.what for o, h in better[1:]
            if first - o < DIAGNOSIS_LOG_ODDS and h.error.what != error.what]  # fmt: skip
    if station.elsewhere and localization.good:
        also.append("the pose by hand is of another side of the machine")
    if not also:
        return error
    distinct = dict.fromkeys(also)  # and several numberings
    message = f"{error.found}; they fit as well if {' or '.join(distinct)}"
    return InputError(
        error.what, where=error.where, found=message, next_step=error.next_step, code=error.code
    )


def _replaces(
    localization: LocalizedPose, odds: float, station: SuspectStation, in_order: bool, query: int
) -> bool:
    """Whether a hypothesis, found there, explains a station better than its own readings, by log
    odds against these; it has to be recognised more surely by as much as there were others, for of
    thirty that are asked of two photographs of any machine, chance confirms one sooner or later.
    Where its own readings put the camera elsewhere than the user, and no other station shows that
    they are in order, to be recognised where the user says is enough.
    """
    if not localization.good or station._replace(localization=localization).elsewhere:
        return False
    if station.elsewhere and station.localization.good and not in_order:
        return True
    return odds > DIAGNOSIS_LOG_ODDS and localization.by_chance * query < localization.limit


def _hypotheses(station: SuspectStation) -> Iterator[Hypothesis]:
    """What is tried: motors that count the other way, columns turned, turned round and exchanged,
    names shifted; of a station that was not recognised, diameters taken for radii.
    """
    view = station.view
    count = view.all_joints.shape[1]
    own = np.arange(count)
    for h in chain(*reversed_motors(view.all_joints, view.machine.joint_ranges)):
        error = _reversed(h.motors[0] + 1, h.constant, view.machine.joint_units[h.motors[0]])
        readings = h.joints[view.configuration]
        yield Hypothesis(partial(view.with_joints, h.joints), error, readings=readings)
    exchanged: dict[tuple[int, ...], InputError] = {}
    for a, b in combinations(range(count), 2):
        order = own.copy()
        order[[a, b]] = b, a
        exchanged[tuple(order.tolist())] = _two_legs(a + 1, b + 1)
    turned = [np.roll(own, -r) for r in range(1, count)]
    turned += [np.roll(own[::-1], r) for r in range(count)]
    if station.localization.good and station.by_hand is None:
        turned.clear()  # of a machine with equal thirds, any of its equal numberings would do
    for order in turned:
        exchanged.setdefault(tuple(order.tolist()), _numbering(order))
    exchanged.pop(tuple(own.tolist()), None)
    for columns, error in exchanged.items():
        joints = view.all_joints[:, columns]
        readings = joints[view.configuration]
        yield Hypothesis(partial(view.with_joints, joints), error, readings=readings)
    names = view.configuration
    if 2 < len(names) == len(np.unique(names)):
        for step in (1, -1):
            shifted = partial(replace, view, configuration=np.roll(names, step))
            readings = view.all_joints[np.roll(names, step)]
            yield Hypothesis(shifted, _shifted(step), readings=readings)
    # thin legs of few pixels are as likely to be thinner still, and two photographs of right ones
    # can fit so by chance: only where nothing else explains
    if not station.localization.good and len(names) > 2:
        values = view.machine.values.copy()
        values[np.unique(view.tubes.radius)] /= 2
        thinner = partial(replace, view, machine=view.machine.with_values(values))
        yield Hypothesis(thinner, diameters("mechanism.yaml"))


def _other_photographs(station: SuspectStation) -> Iterator[Hypothesis]:
    """Photographs under the names that fit each of them best; where the machine was not recognised,
    or elsewhere than the user says, as its mirror image is, mirrored ones.
    """
    view, T_camera_base = station.view, station.localization.T_camera_base
    names = view.configuration
    if station.elsewhere:
        mirrored = partial(replace, view, tables=view.tables.mirrored())
        yield Hypothesis(mirrored, _mirrored(station))
    if not 2 < len(names) == len(np.unique(names)):
        return
    columns = np.arange(len(names))
    # any name could be on each photograph, and the fewest that bear wrong ones are two; without
    # this, photographs of configurations that are alike would change names for nothing
    choices, own = math.log(len(names)), station.localization
    keep_evidence = (
        own.log_likelihood_ratio / (own.correlation_length * len(names)) if own.good else 0.0
    )
    keeps = (
        np.eye(len(names))
        * station.localization.correlation_length
        * (DIAGNOSIS_LOG_ODDS / 2 + choices)
    )
    for _ in range(NAMING_ROUNDS):  # the wrong names have moved the pose, and it the names
        fits = log_likelihood_by_name(
            replace(view, configuration=names[columns]), T_camera_base, names
        )
        before, columns = columns, _best_names(fits + keeps)
        if np.array_equal(before, columns):
            break
        T_camera_base = settled(replace(view, configuration=names[columns]), T_camera_base)
    shifted = np.flatnonzero(columns != np.arange(len(names)))
    if 0 < len(shifted) <= len(names) // 2:
        right = partial(replace, view, configuration=names[columns])
        error = _misnamed(station, shifted, names[columns[shifted]])
        yield Hypothesis(right, error, len(shifted) * (choices + RIGHT_NAME_SHARE * keep_evidence))


def _best_names(score: Array) -> Integers:
    """The name (n,) of each photograph, each given once, with the largest sum of scores (n, n)."""
    others = np.where(np.eye(len(score), dtype=bool), -np.inf, score).max(axis=1)
    gain = np.sort(others - np.diag(score))
    # two photographs at least have to leave their own names for others; where that loses, as a
    # rule, all keep theirs, and SciPy's, which takes a while to import, is not asked
    if gain[-2:].sum() < 0:
        return np.arange(len(score))
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(-score)[1]


def _reversed(motor: int, constant: float, unit: str) -> InputError:
    """The error about a motor, counted from 1, whose readings are the constant less its values."""
    scale, display = DISPLAY_UNITS[unit]
    sum_ = f"{number(scale * constant, 0 if unit == 'm' else 1)} {display}"
    less = f"some {sum_} less the reading" if constant else "the reading with the other sign"
    return InputError(
        f"the readings of motor {motor} count the other way",
        where="joints.csv",
        found=f"the photographs fit with {less}",
        next_step=f"Turn the motor's direction round where it is set, or write {less} into this"
        " column; what is left of a constant is calibrated",
    )


def _two_legs(a: int, b: int) -> InputError:
    return InputError(
        f"the readings of legs {a} and {b} are mixed up",
        where="joints.csv",
        found="the photographs fit with these two columns exchanged",
        next_step=f"Exchange the columns of legs {a} and {b} in joints.csv, or the two legs in"
        " the drawing",
        code="readings.exchanged",
    )


def _numbering(order: Integers) -> InputError:
    """The error about legs numbered otherwise; order : column of each leg, from 0."""
    rising = bool((order[1] - order[0]) % len(order) == 1)
    return InputError(
        "the legs are numbered differently in the readings and in the drawing",
        where="joints.csv",
        found=f"the photographs fit when leg 1 takes the readings of column {order[0] + 1},"
        f" leg 2 those of column {order[1] + 1}, and so on {'round' if rising else 'backwards'}",
        next_step="Give the columns of joints.csv the order of the legs in the drawing",
        code="readings.numbering_turned" if rising else "readings.numbering_reversed",
    )


def _shifted(step: int) -> InputError:
    return InputError(
        "the photographs are shifted against the readings",
        where="joints.csv",
        found="each photograph fits the readings of the configuration"
        f" {'before' if step > 0 else 'after'} its own",
        next_step="Look for a row or a photograph that is missing or was taken twice, and name the"
        " photographs by the readings at which they were taken",
        code="image.shifted",
    )


def _misnamed(station: SuspectStation, photographs: Integers, fitting: Integers) -> InputError:
    """The error about photographs, by number, that fit other rows of the readings."""
    files = [station.files[k] for k in photographs]
    fit = [station.configurations[k] for k in fitting]
    return InputError(
        f"photographs of {station.name} bear each other's names",
        where=files[0],
        found="; ".join(f"{f} fits configuration {c}" for f, c in zip(files, fit, strict=True)),
        next_step="Give these photographs, or the rows of joints.csv, the right names",
        code="image.exchanged",
    )


def _mirrored(station: SuspectStation) -> InputError:
    if len(station.files) == 1:
        return InputError(
            f"this photograph of {station.name} is mirrored",
            where=station.files[0],
            found="the machine is recognised with left and right exchanged",
            next_step="Flip this photograph, or take it again without mirroring",
            code="image.mirrored",
        )
    return InputError(
        f"the photographs of {station.name} are mirrored",
        where=f"session.yaml, stations.{station.name}",
        found="the machine is recognised with left and right exchanged",
        next_step="Switch mirroring off in the camera or in the program that saved them, or flip"
        " the photographs and the camera's calibration alike",
        code="image.mirrored",
    )


def diameters(mechanism: str) -> InputError:
    """The error about radii that are twice too large; mechanism : the drawing's file."""
    return InputError(
        "the tubes' radii look like diameters",
        where=f"{mechanism}, tubes",
        found="the photographs fit with radii half as large",
        next_step="Divide the radii by 2",
        code="tube.diameter",
    )
