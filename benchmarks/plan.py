"""Quality of plans: beside random configurations, and beside a long search.

    python benchmarks/plan.py [--long MINUTES]

For each machine: the tool's standard deviation (mean over the workspace) with the plan, with as
many configurations drawn uniformly over the joints' ranges (mean and best of 200 draws), and with
the best of a long search: exchanges from random choices in new pools of candidates, each improved
locally, until the time is over.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from pkmcal.arrays import Integers
from pkmcal.mechanisms import Machine, load_mechanism
from pkmcal.placement.default_camera import camera_of_size
from pkmcal.planning.candidates import Configurations, configurations, neighbours
from pkmcal.planning.defaults import CONFIGURATIONS_A_CAPTURE
from pkmcal.planning.exchange import exchanged
from pkmcal.planning.information import Candidates, information_of
from pkmcal.planning.plan import MeasurementPlan, plan_measurements
from pkmcal.planning.subject import Subject, of_machine
from pkmcal.simulation import board_for

CASES = {
    "hexapod, 3 stations, legs": ("gough-stewart", 3, False),
    "H4, board": ("h4", 1, True),
    "delta, board": ("delta", 1, True),
    "3-RPR, 2 stations, legs": ("3-rpr", 2, False),
}
DRAWS = 200
POOL = 300
"""Configurations of each of the long search's pools."""


def subject_of(name: str, stations: int, board: bool) -> Subject:
    """A catalogue machine with a camera of 1280x960."""
    machine = load_mechanism(name)
    cameras = [camera_of_size((1280, 960))] * stations
    in_view = board_for(machine, "platform") if board else None
    return of_machine(machine, cameras, machine.joint_names, board=in_view)


def by_chance(plan: MeasurementPlan, rng: np.random.Generator) -> tuple[float, float]:
    """Mean and least deviation, m, of DRAWS choices by chance."""
    rig, groups = plan.subject.rig, tuple((s,) for s in range(len(plan.subject.rig.names)))
    drawn = configurations(rig.machine, 2 * POOL, rng)
    evenly = [part[len(part) // 2 :] for part in drawn]
    info = information_of(rig, Candidates.of_all(groups, *evenly), plan.work)
    n = len(evenly[0])
    each = []
    for _ in range(DRAWS):
        rows = [
            g * n + rng.choice(n, CONFIGURATIONS_A_CAPTURE, replace=False)
            for g in range(len(groups))
        ]
        each.append(info.tool(info.covariance(info.of(np.concatenate(rows))))[0])
    return float(np.mean(each)), float(np.min(each))


def long_search(
    plan: MeasurementPlan, seconds: float, rng: np.random.Generator
) -> tuple[float, int]:
    """The least deviation, m, that was found, and how many searches were made."""
    rig, groups = plan.subject.rig, tuple((s,) for s in range(len(plan.subject.rig.names)))
    best, searches, until = np.inf, 0, time.perf_counter() + seconds
    chosen = None
    while time.perf_counter() < until:
        drawn = configurations(rig.machine, POOL, rng)
        pool = Candidates.of_all(groups, *drawn)
        start = np.concatenate(
            [np.flatnonzero(pool.group == g)[
                rng.permutation(len(drawn.joints))[:CONFIGURATIONS_A_CAPTURE]]
             for g in range(len(groups))]
        )  # fmt: skip
        if chosen is not None and searches % 2:  # every other search goes on from the best so far
            pool, start = joined(chosen, pool)
        now = pool
        for _ in range(6):
            info = information_of(rig, pool, plan.work)
            now = pool.only(np.sort(exchanged(info, start)))
            pool, start = joined(now, about(rig.machine, now, rng))
        info = information_of(rig, now, plan.work)
        value = info.tool(info.covariance(info.of(np.arange(len(now.group)))))[0]
        if value < best:
            best, chosen = value, now
        searches += 1
    return best, searches


def about(machine: Machine, now: Candidates, rng: np.random.Generator) -> Candidates:
    """Configurations about chosen ones, by the same groups."""
    group, joints, poses = [], [], []
    for g in range(len(now.groups)):
        own = np.flatnonzero(now.group == g)
        there = Configurations(now.joints[own], now.T_base_platform[own])
        near = neighbours(machine, there, rng)
        group.append(np.full(len(near.joints), g))
        joints.append(near.joints)
        poses.append(near.T_base_platform)
    return Candidates(now.groups, *(np.concatenate(x) for x in (group, joints, poses)))


def joined(chosen: Candidates, others: Candidates) -> tuple[Candidates, Integers]:
    """Chosen candidates before others of their group, and where they stand."""
    group = np.concatenate([chosen.group, others.group])
    order = np.argsort(group, kind="stable")
    both = replace(
        chosen,
        group=group[order],
        joints=np.concatenate([chosen.joints, others.joints])[order],
        T_base_platform=np.concatenate([chosen.T_base_platform, others.T_base_platform])[order],
    )
    return both, np.flatnonzero(order < len(chosen.group))


def main() -> None:
    """One line a machine."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", type=float, default=2.0, metavar="MINUTES")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    head = ("", "plan mm", "chance", "ratio", "best of 200", "long", "plan/long", "searches", "s")
    print(("{:28}" + "{:>12}" * 8).format(*head))
    with threadpool_limits(1, "blas"):
        for name, case in CASES.items():
            rng = np.random.default_rng(options.seed + 1)
            begun = time.process_time()
            value = plan_measurements(subject_of(*case), seed=options.seed)
            took = time.process_time() - begun
            # as on average for all, so that only the choice differs
            rig, n = value.subject.rig, len(value.names)
            numbers = {station: k for k, station in enumerate(rig.names)}
            group = np.array([numbers[s[0]] for s in value.stations])
            groups = tuple((s,) for s in range(len(rig.names)))
            own = Candidates(groups, group, value.joints, value.T_base_platform)
            info = information_of(rig, own, value.work)
            planned = info.tool(info.covariance(info.of(np.arange(n))))[0]
            chance, luckiest = by_chance(value, rng)
            far, searches = long_search(value, 60 * options.long, rng)
            print(
                f"{name:28}{planned * 1e3:12.4f}{chance * 1e3:12.4f}{planned / chance:12.3f}"
                f"{luckiest * 1e3:12.4f}{far * 1e3:12.4f}{planned / far:12.3f}{searches:12d}"
                f"{took:12.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
