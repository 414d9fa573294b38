"""Speed of forward kinematics for every built-in machine, on one core.

    OPENBLAS_NUM_THREADS=1 python benchmarks/kinematics.py [gough-stewart …] [--poses 60000]

Readings are drawn uniformly from the ranges; those that the machine cannot reach are left out.
Rate: poses per second in one batch, each solved from home. Latency: one call from a pose one step
away, as in a control loop (1 mm, or 1 mrad of a crank), and the same with a follower, back and
forth. All are the best of several repeats, in processor time, which other programs disturb little,
with wall time beside it. Prints one line per machine; exits with 1 if a batch and single calls
differ.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from pkmcal.mechanisms import Machine, catalogue, load_mechanism

STEP = 1e-3
REPEATS = 7
AGREE = 1e-11
"""Poses closed to 1e-12 m, of machines far from singular poses."""


def drawn(machine: Machine, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Readings (n, m) in range and their poses (n, 4, 4), n <= count."""
    home = machine.inverse(machine.home())
    ranges = machine.joint_ranges
    around = home[:, None] + [-0.03, 0.03]
    low, high = np.where(np.isfinite(ranges), ranges, around).T
    readings = np.random.default_rng(0).uniform(low, high, (count, machine.n_joints))
    fk = machine.forward_result(readings)
    return readings[fk.converged], fk.T_base_platform[fk.converged]


def best(work: Callable[[], object], repeats: int, calls: int = 1) -> tuple[float, float]:
    """Shortest processor and wall-clock time of one call, s."""
    times = np.full(2, np.inf)
    for _ in range(repeats):
        begin = time.process_time(), time.perf_counter()
        for _ in range(calls):
            work()
        end = time.process_time(), time.perf_counter()
        times = np.minimum(times, np.subtract(end, begin) / calls)
    return float(times[0]), float(times[1])


def measure(name: str, count: int) -> bool:
    """Print a machine's line; False where batch and single calls differ."""
    machine = load_mechanism(name)
    readings, poses = drawn(machine, count)
    batch = best(lambda: machine.forward(readings), REPEATS)
    next_one = readings[0] + STEP * np.random.default_rng(1).choice([-1, 1], machine.n_joints)
    single = best(lambda: machine.forward_result(next_one, poses[0]), REPEATS, 50)
    follow, pair = machine.follower(poses[0]), (next_one, readings[0])
    followed = best(lambda: (follow(pair[0]), follow(pair[1])), REPEATS, 200)
    apart = np.abs(follow(next_one) - machine.forward(next_one, poses[0])).max()
    some = np.linspace(0, len(poses) - 1, 20).astype(int)
    regular = some[machine.forward_result(readings[some], poses[some]).singularity > 0.1]
    off = max(
        (float(np.abs(machine.forward(readings[k]) - poses[k]).max()) for k in regular), default=0.0
    )
    print(
        f"{name:14}  {len(poses) / batch[0]:9,.0f} poses/s ({len(poses) / batch[1]:9,.0f} by the"
        f" clock)  {single[0] * 1e6:5.0f} us a call ({single[1] * 1e6:5.0f})"
        f"  {followed[0] / 2 * 1e6:5.0f} us followed ({followed[1] / 2 * 1e6:5.0f})"
        f"  {100 * len(poses) / count:3.0f} % of readings close  single differs {off:.0e}"
    )
    return max(off, apart) < AGREE


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("machines", nargs="*", default=sorted(catalogue()))
    parser.add_argument("--poses", type=int, default=60_000)
    arguments = parser.parse_args()
    agree = [measure(name, arguments.poses) for name in arguments.machines]
    return 0 if all(agree) else 1


if __name__ == "__main__":
    raise SystemExit(main())
