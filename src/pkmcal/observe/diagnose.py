"""Why no machine was recognised in a station's photographs: the usual mix-ups, tried one by one."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError
from pkmcal.observe.stations import StationPose, View, find_station

CLEARLY_BETTER = 0.75
"""A hypothesis must lower the score to this share of the best other one's to be named."""


def unrecognised(
    names: list[str],
    views: list[View],
    rough: list[Array],
    found: list[StationPose],
    all_joints: Array,
    configurations: list[Array],
    rng: np.random.Generator,
) -> InputError:
    """The error about stations in whose photographs no leg was recognised.

    names, views, rough, found : by station. all_joints : (K, m) the session's readings.
    configurations : rows of the readings, by station.
    """
    bad = [i for i, pose in enumerate(found) if not pose.good]
    worst = max(bad, key=lambda i: found[i].score)
    for text in (
        _swapped_stations(names, views, rough, found, rng),
        _mixed_columns(views, rough, found, all_joints, configurations, rng),
    ):
        if text is not None:
            return InputError(
                f"the machine is not recognised in the photographs of {names[worst]!r}",
                where="session.yaml, stations",
                found=text[0],
                next_step=text[1],
            )
    return InputError(
        f"the machine is not recognised in the photographs of {names[worst]!r}",
        where=f"session.yaml, stations.{names[worst]}",
        found=f"predicted legs lie {found[worst].score:.2f} of the way to nowhere in them",
        expected="less than 0.34; a good session has 0.2",
        next_step=(
            "Check that these photographs show this machine's legs, that the pose is right to"
            " 10 cm and 10 degrees, that each photograph has its configuration's name, and that"
            " the drawing is this machine's"
        ),
    )


def _swapped_stations(
    names: list[str],
    views: list[View],
    rough: list[Array],
    found: list[StationPose],
    rng: np.random.Generator,
) -> tuple[str, str] | None:
    """Two stations each recognised from the other's pose."""
    bad = [i for i, pose in enumerate(found) if not pose.good]
    for i, j in combinations(bad, 2):
        if find_station(views[i], rough[j], rng).good and find_station(views[j], rough[i], rng).good:
            return (
                f"the photographs of {names[i]!r} fit the pose of {names[j]!r}, and the other way"
                " round",
                f"Swap the poses, or the image folders, of {names[i]!r} and {names[j]!r}",
            )
    return None


def _mixed_columns(
    views: list[View],
    rough: list[Array],
    found: list[StationPose],
    all_joints: Array,
    configurations: list[Array],
    rng: np.random.Generator,
) -> tuple[str, str] | None:
    """Readings whose columns stand in another order: turned round, or two of them swapped."""
    count = all_joints.shape[1]
    i = int(np.argmin([len(v.joints) == 0 for v in views]))
    orders = [np.roll(np.arange(count), r) for r in range(1, count)]
    orders += [_exchanged(count, a, b) for a, b in combinations(range(count), 2)]
    scores = [
        find_station(_with_joints(views[i], all_joints[configurations[i]][:, o]), rough[i], rng)
        for o in orders
    ]
    best = int(np.argmin([s.score for s in scores]))
    if not scores[best].good or scores[best].score > CLEARLY_BETTER * found[i].score:
        return None
    order = orders[best]
    if best < count - 1:
        what = f"everything fits with the readings' columns turned round by {best + 1}"
        return what, (
            f"Number the legs alike in the drawing and in joints.csv: column {order[0] + 1} belongs"
            " to leg 1, and so on round"
        )
    a, b = np.flatnonzero(order != np.arange(count)) + 1
    return (
        f"everything fits with the columns of legs {a} and {b} exchanged",
        f"Exchange the readings of legs {a} and {b} in joints.csv, or the two legs in the drawing",
    )


def _exchanged(count: int, a: int, b: int) -> Array:
    order = np.arange(count)
    order[[a, b]] = order[[b, a]]
    return order


def _with_joints(view: View, joints: Array) -> View:
    poses = view.machine.forward_result(joints).T_base_platform
    return replace(view, joints=joints, poses=poses)
