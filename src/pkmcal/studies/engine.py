"""One engine of Monte-Carlo studies: batches of simulated runs, drawn, solved and judged.

A :class:`Setting` says how machines, configurations and measurements are drawn, which estimators
are tried, and how far off each is. Runs are worked on in batches, vectorised, on all cores. A batch
carries the seeds of all that is drawn for it, and depends on nothing else: so results do not depend
on the number of workers nor on their order, and a batch may be done anywhere.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from pkmcal.arrays import Array
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.simulated import SimulatedRuns
from pkmcal.studies.statistics import STATISTICS, Statistic, Summary

MOST_THREADS = 4
Key = tuple[str, ...]
"""What was estimated how: a method's name, after those of the truth and the model where a study has
several."""
Told = Callable[[str, float], None]


class Population(NamedTuple):
    """Runs of one kind of truth. batch : how many are solved at once; it belongs to the seeds."""

    name: str
    runs: int
    batch: int


class Quantity(NamedTuple):
    """How a quantity is summed up over the runs, and shown: times ``factor``, in ``unit``."""

    statistic: Statistic
    factor: float = 1.0
    unit: str = ""


@dataclass(frozen=True)
class Batch:
    """Runs of one population that are solved at once, with the seed of all that is drawn."""

    population: str
    runs: int
    seed: np.random.SeedSequence

    def generator(self, use: int) -> np.random.Generator:
        """Independent draws for each use: 0 is the simulation, the others are a setting's own."""
        key = (*self.seed.spawn_key, use)
        return np.random.default_rng(np.random.SeedSequence(self.seed.entropy, spawn_key=key))


@dataclass(frozen=True)
class Sample:
    """One method on all runs. values : by quantity, (B,) or (B, n): errors, and what else a run
    tells. sigma : standard deviations that the method itself states, of the same shape.
    """

    values: Mapping[str, Array]
    sigma: Mapping[str, Array] = field(default_factory=dict[str, Array])


class Setting(Protocol):
    """What is studied: a frozen dataclass. quantities : those that are summed up over the runs.
    doing : what it does, in words.
    """

    @property
    def quantities(self) -> Mapping[str, Quantity]: ...

    @property
    def doing(self) -> str: ...

    def populations(self, runs: int) -> Sequence[Population]:
        """What ``runs`` runs of the study are made of."""
        ...

    def draw(self, batch: Batch) -> SimulatedRuns:
        """True machines and their measurements."""
        ...

    def solve(self, batch: Batch, data: SimulatedRuns) -> Mapping[Key, Fitted]:
        """Every estimator's answer."""
        ...

    def judge(
        self, batch: Batch, data: SimulatedRuns, found: Mapping[Key, Fitted]
    ) -> Mapping[Key, Sample]:
        """How far each is from the truth."""
        ...


S = TypeVar("S", bound=Setting)


@dataclass(frozen=True)
class StudyResult(Generic[S]):
    """What the runs came to.

    samples : of every run, by what was estimated how. accuracy : its quantities summed up, each
    with its Monte-Carlo error. wall : seconds of it all. solving : seconds of the estimators alone,
    on ``threads`` threads. cpu : their processor time.
    """

    setting: S
    runs: int
    seed: int
    samples: Mapping[Key, Sample]
    accuracy: Mapping[Key, Mapping[str, Summary]]
    wall: float
    solving: float
    cpu: float
    threads: int

    def of(self, *key: str) -> Mapping[str, Summary]:
        """The quantities of one method, summed up."""
        return self.accuracy[key]

    def values(self, quantity: str, *key: str) -> Array:
        """A quantity of one method, every run's, (B,) or (B, n)."""
        return self.samples[key].values[quantity]


class _Done(NamedTuple):
    """A batch's samples, and seconds of its solving: on the clock and of the processor."""

    samples: Mapping[Key, Sample]
    wall: float
    cpu: float


def run(setting: S, runs: int, seed: int, told: Told | None = None) -> StudyResult[S]:
    """The whole study. told : called with what is done and the share of it."""
    from threadpoolctl import threadpool_limits

    work = batches(setting, runs, seed)
    threads = max(1, min(MOST_THREADS, os.cpu_count() or 1, len(work)))
    began, done = time.perf_counter(), list[_Done]()
    # Small matrices: threads inside the linear algebra would only wait for one another.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads) as pool:
        for part in pool.map(lambda batch: _work(setting, batch), work):
            done.append(part)
            if told:
                told(setting.doing, len(done) / len(work))
    samples = collected([part.samples for part in done])
    return StudyResult(
        setting=setting,
        runs=runs,
        seed=seed,
        samples=samples,
        accuracy={key: summed_up(setting, sample) for key, sample in samples.items()},
        wall=time.perf_counter() - began,
        solving=sum(part.wall for part in done) / threads,
        cpu=sum(part.cpu for part in done),
        threads=threads,
    )


def batches(setting: Setting, runs: int, seed: int) -> list[Batch]:
    """All that is to be done, the same for any number of workers."""
    parts = [
        (population.name, min(population.batch, population.runs - first))
        for population in setting.populations(runs)
        for first in range(0, population.runs, population.batch)
    ]
    seeds = np.random.SeedSequence(seed).spawn(len(parts))
    return [Batch(name, count, own) for (name, count), own in zip(parts, seeds, strict=True)]


def _work(setting: Setting, batch: Batch) -> _Done:
    data = setting.draw(batch)
    began, used = time.perf_counter(), time.thread_time()
    found = setting.solve(batch, data)
    wall, cpu = time.perf_counter() - began, time.thread_time() - used
    return _Done(setting.judge(batch, data, found), wall, cpu)


def collected(parts: Sequence[Mapping[Key, Sample]]) -> dict[Key, Sample]:
    """Batches' samples as the study's, in the batches' order."""

    def joined(arrays: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
        return {name: np.concatenate([a[name] for a in arrays]) for name in arrays[0]}

    out: dict[Key, Sample] = {}
    for key in dict.fromkeys(key for part in parts for key in part):
        own = [part[key] for part in parts if key in part]
        out[key] = Sample(joined([s.values for s in own]), joined([s.sigma for s in own]))
    return out


def summed_up(setting: Setting, sample: Sample) -> dict[str, Summary]:
    """A sample's quantities over its runs, in SI units."""
    return {
        name: STATISTICS[quantity.statistic](sample.values[name])
        for name, quantity in setting.quantities.items()
        if name in sample.values
    }
