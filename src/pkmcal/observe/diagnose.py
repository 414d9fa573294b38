"""Why no machine was recognised in a station's photographs: the usual mix-ups, tried one by one."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.errors import InputError
from pkmcal.observe.stations import GOOD_SCORE, FoundStation, StationView, find_station
from pkmcal.wording import listed

CLEARLY_BETTER = 0.75
"""A hypothesis must lower the score to this share of the best other one's to be named."""
WELL = 0.26
"""Score below which a station is recognised beyond doubt: two legs mixed up still give 0.29."""


def unrecognised(
    names: list[str],
    views: list[StationView],
    rough: list[Array],
    found: list[FoundStation],
    all_joints: Array,
    configurations: list[Integers],
    rng: np.random.Generator,
) -> InputError:
    """The error about stations in whose photographs no leg was recognised.

    names, views, rough, found : by station. all_joints : (K, m) the session's readings.
    configurations : rows of the readings, by station.
    """
    bad = [i for i, pose in enumerate(found) if not pose.good]
    error = _swapped_stations(names, views, rough, bad, rng)
    worst = max(bad, key=lambda i: found[i].score)
    # One well recognised station shows that the readings are in order.
    if error is None and min(pose.score for pose in found) > WELL:
        rows = configurations[worst]
        error = _mixed_columns(views[worst], rough[worst], found[worst], all_joints[rows], rng)
    if error is not None:
        return error
    others = [names[i] for i in bad if i != worst]
    return InputError(
        f"the machine is not recognised in the photographs of {names[worst]}"
        + (f", nor in those of {listed(others)}" if others else ""),
        where=f"session.yaml, stations.{names[worst]}",
        found=f"a mismatch of {found[worst].score:.2f} between the drawing's legs and the picture",
        expected=f"less than {GOOD_SCORE:g} (0 is perfect, a good session has 0.2)",
        next_step=(
            "Check that these photographs show this machine's legs, that the station's pose is"
            " right to 10 cm and 10 degrees, that each photograph bears the name of its"
            " configuration, and that the drawing is this machine's"
        ),
    )


def _swapped_stations(
    names: list[str],
    views: list[StationView],
    rough: list[Array],
    bad: list[int],
    rng: np.random.Generator,
) -> InputError | None:
    """Two stations each recognised from the other's pose."""
    for i, j in combinations(bad, 2):
        exchanged = (find_station(views[a], rough[b], rng) for a, b in ((i, j), (j, i)))
        if all(pose.good for pose in exchanged):
            return InputError(
                f"stations {names[i]} and {names[j]} are mixed up",
                where="session.yaml, stations",
                found="the photographs of each fit the pose of the other",
                next_step=f"Exchange the poses of {names[i]} and {names[j]} in session.yaml,"
                " or their image folders",
            )
    return None


def _mixed_columns(
    view: StationView, rough: Array, found: FoundStation, joints: Array, rng: np.random.Generator
) -> InputError | None:
    """Readings whose columns stand in another order: turned round, or two of them swapped.

    joints : (K, m) the readings of the view's photographs.
    """
    count = joints.shape[1]
    orders = [np.roll(np.arange(count), -r) for r in range(1, count)]
    orders += [_exchanged(count, a, b) for a, b in combinations(range(count), 2)]
    scores = [find_station(_with_joints(view, joints[:, o]), rough, rng) for o in orders]
    best = int(np.argmin([s.score for s in scores]))
    if not scores[best].good or scores[best].score > CLEARLY_BETTER * found.score:
        return None
    return _other_order(orders[best], turned=best < count - 1)


def _other_order(order: Array, turned: bool) -> InputError:
    """The error about readings that belong to other legs; order : column of each leg, from 0."""
    if turned:
        return InputError(
            "the legs are numbered differently in the readings and in the drawing",
            where="joints.csv",
            found=f"the photographs fit when leg 1 takes the readings of column {order[0] + 1},"
            f" leg 2 those of column {order[1] + 1}, and so on round",
            next_step="Give the columns of joints.csv the order of the legs in the drawing",
        )
    a, b = np.flatnonzero(order != np.arange(len(order))) + 1
    return InputError(
        f"the readings of legs {a} and {b} are mixed up",
        where="joints.csv",
        found="the photographs fit with these two columns exchanged",
        next_step=f"Exchange the columns of legs {a} and {b} in joints.csv, or the two legs in"
        " the drawing",
    )


def _exchanged(count: int, a: int, b: int) -> Integers:
    order = np.arange(count)
    order[[a, b]] = order[[b, a]]
    return order


def _with_joints(view: StationView, joints: Array) -> StationView:
    poses = view.machine.forward_result(joints).T_base_platform
    return replace(view, joints=joints, poses=poses)
