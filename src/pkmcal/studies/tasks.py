"""What a study is made of: settings, batches of runs, and the work on one of them.

A :class:`StudySetting` says how machines, configurations and measurements are drawn, which
estimators are tried, and how far off each is. A batch carries the seeds of all that is drawn for
it, and depends on nothing else, so it may be done anywhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import PkmcalError
from pkmcal.studies.estimates import Fitted
from pkmcal.studies.statistics import Statistic

Key = tuple[str, ...]
"""What was estimated how: a method's name, after those of the truth and the model where a study has
several."""


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


class StudySetting(Protocol):
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

    def draw(self, batch: Batch) -> Any:
        """True machines and their measurements, in the setting's own form."""
        ...

    def solve(self, batch: Batch, data: Any) -> Mapping[Key, Fitted]:
        """Every estimator's answer."""
        ...

    def judge(self, batch: Batch, data: Any, fits: Mapping[Key, Fitted]) -> Mapping[Key, Sample]:
        """How far each is from the truth."""
        ...


class Job(NamedTuple):
    """One batch of one setting: all that a worker needs. name : what errors say it is."""

    setting: StudySetting
    batch: Batch
    name: str = ""


class SolvedBatch(NamedTuple):
    """A batch's samples, and seconds of its solving: on the clock and of the processor."""

    samples: Mapping[Key, Sample]
    wall: float
    cpu: float


Finished = Callable[[int, SolvedBatch], None]
"""Called with a task's number as soon as it is done, from one thread at a time."""
Runner = Callable[[Sequence[Job], Finished], int]
"""Does all tasks in any order, and returns how many workers it had."""


def work(task: Job) -> SolvedBatch:
    """A batch drawn, solved and judged, on one thread."""
    from threadpoolctl import threadpool_limits

    setting, batch = task.setting, task.batch
    try:
        # Small matrices: threads inside the linear algebra would only wait for one another.
        with threadpool_limits(1, "blas"):
            data = setting.draw(batch)
            began, used = time.perf_counter(), time.thread_time()
            fits = setting.solve(batch, data)
            wall, cpu = time.perf_counter() - began, time.thread_time() - used
            return SolvedBatch(setting.judge(batch, data, fits), wall, cpu)
    except PkmcalError as error:
        raise (error.located(task.name) if task.name else error) from None
