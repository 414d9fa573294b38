"""Settings, batches and jobs of a study, and the computation of one batch.

A :class:`StudySetting` defines how machines, configurations and measurements are drawn, which
estimators are applied, and how their errors are computed. A batch carries the seed of all its
random draws and depends on nothing else, so it can be computed anywhere.
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
"""Identification of a sample: the method's name, preceded by the names of the truth and the model
if a study has several.
"""


class Population(NamedTuple):
    """Runs with one kind of truth.

    batch : number of runs that are solved together; results depend on it, since each batch has its
    own seed.
    """

    name: str
    runs: int
    batch: int


class Quantity(NamedTuple):
    """Statistic of a quantity over the runs, and its display: times ``factor``, in ``unit``."""

    statistic: Statistic
    factor: float = 1.0
    unit: str = ""


@dataclass(frozen=True)
class Batch:
    """Runs of one population that are solved together, with the seed of all their random draws."""

    population: str
    runs: int
    seed: np.random.SeedSequence

    def generator(self, use: int) -> np.random.Generator:
        """Independent random generator for each use: 0 is the simulation, others belong to the
        setting.
        """
        key = (*self.seed.spawn_key, use)
        return np.random.default_rng(np.random.SeedSequence(self.seed.entropy, spawn_key=key))


@dataclass(frozen=True)
class Sample:
    """Results of one method for all runs.

    values : by quantity, (B,) or (B, n): errors and other figures of a run. sigma : standard
    deviations stated by the method, of the same shape.
    """

    values: Mapping[str, Array]
    sigma: Mapping[str, Array] = field(default_factory=dict[str, Array])


class StudySetting(Protocol):
    """Interface of a study's setting, a frozen dataclass.

    quantities : the quantities that are summarized over the runs. doing : description of the work,
    for progress displays.
    """

    @property
    def quantities(self) -> Mapping[str, Quantity]: ...

    @property
    def doing(self) -> str: ...

    def populations(self, runs: int) -> Sequence[Population]:
        """Populations of a study with ``runs`` runs."""
        ...

    def draw(self, batch: Batch) -> Any:
        """Draw true machines and their measurements, in the setting's own form."""
        ...

    def solve(self, batch: Batch, data: Any) -> Mapping[Key, Fitted]:
        """Apply every estimator to the data."""
        ...

    def judge(self, batch: Batch, data: Any, fits: Mapping[Key, Fitted]) -> Mapping[Key, Sample]:
        """Errors of every estimate with respect to the truth."""
        ...


class Job(NamedTuple):
    """One batch of one setting, all that a worker needs. name : location of errors."""

    setting: StudySetting
    batch: Batch
    name: str = ""


class SolvedBatch(NamedTuple):
    """Samples of a batch, and the wall and processor time of its solution in seconds."""

    samples: Mapping[Key, Sample]
    wall: float
    cpu: float


Finished = Callable[[int, SolvedBatch], None]
"""Callback with a task's number and result as soon as the task is done; never called
concurrently.
"""
Runner = Callable[[Sequence[Job], Finished], int]
"""Function that runs all tasks, in any order, and returns the number of workers."""


def work(task: Job) -> SolvedBatch:
    """Draw, solve and judge a batch on one thread.

    Raises the setting's PkmcalError, located at the task's name.
    """
    from threadpoolctl import threadpool_limits

    setting, batch = task.setting, task.batch
    try:
        # The matrices are small: threads inside the linear algebra would only wait for one another.
        with threadpool_limits(1, "blas"):
            data = setting.draw(batch)
            began, used = time.perf_counter(), time.thread_time()
            fits = setting.solve(batch, data)
            wall, cpu = time.perf_counter() - began, time.thread_time() - used
            return SolvedBatch(setting.judge(batch, data, fits), wall, cpu)
    except PkmcalError as error:
        raise (error.located(task.name) if task.name else error) from None
