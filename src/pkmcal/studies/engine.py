"""Engine of Monte-Carlo studies: batches of simulated runs are drawn, solved and judged.

Runs are vectorised in batches and batches are distributed over all cores
(:mod:`pkmcal.studies.tasks`). A batch depends on its own seed alone, so results depend neither on
the number of workers nor on their order, and finished batches can be stored and reused.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from pkmcal.arrays import Array
from pkmcal.outcome.progress import Progress
from pkmcal.studies.executors import on_cores
from pkmcal.studies.statistics import SUMMARIES_BY_STATISTIC, Summary
from pkmcal.studies.store import Store
from pkmcal.studies.tasks import Batch, Job, Key, Runner, Sample, SolvedBatch, StudySetting

S = TypeVar("S", bound=StudySetting)


@dataclass(frozen=True)
class StudyResult(Generic[S]):
    """Results of all runs of one setting.

    samples : of all runs, by key.
    accuracy : summaries of the quantities, each with its Monte-Carlo error.
    wall : duration of the whole study, s.
    solving : duration of the estimators alone, divided by the number of ``workers``, s.
    cpu : processor time of the estimators, s.
    """

    setting: S
    runs: int
    seed: int
    samples: Mapping[Key, Sample]
    accuracy: Mapping[Key, Mapping[str, Summary]]
    wall: float
    solving: float
    cpu: float
    workers: int

    def of(self, *key: str) -> Mapping[str, Summary]:
        """Summaries of one method's quantities."""
        return self.accuracy[key]

    def values(self, quantity: str, *key: str) -> Array:
        """Values of one quantity of a method for every run, (B,) or (B, n)."""
        return self.samples[key].values[quantity]


def run(setting: S, runs: int, seed: int, progress: Progress | None = None) -> StudyResult[S]:
    """Study of one setting. progress : callback with a text and the share done."""
    return run_all([setting], runs, seed, progress)[0]


def run_all(
    settings: Sequence[S],
    runs: int,
    seed: int,
    progress: Progress | None = None,
    runner: Runner | None = None,
    store: Store | None = None,
    names: Sequence[str] = (),
) -> list[StudyResult[S]]:
    """Studies of several settings with the same seeds, so that they differ only by their settings.

    runner : all cores of this machine by default.
    store : source of finished batches, and destination of new ones as soon as they are done.
    names : of the settings, for error messages.

    Raises errors of the settings, with the setting's name.
    """
    began = time.perf_counter()
    parts = [
        (cell, number, batch)
        for cell, setting in enumerate(settings)
        for number, batch in enumerate(batches(setting, runs, seed))
    ]
    # Run the first batch of every setting first, so that a setting that cannot be simulated fails
    # at once.
    parts.sort(key=lambda part: (part[1], part[0]))
    done: dict[int, SolvedBatch] = {}
    for k, part in enumerate(parts):
        stored = store.load(*part) if store else None
        if stored is not None:
            done[k] = stored
    pending = [k for k in range(len(parts)) if k not in done]
    if progress and done:
        progress(settings[0].doing, len(done) / len(parts))

    def finished(task: int, result: SolvedBatch) -> None:
        k = pending[task]
        cell, number, _ = parts[k]
        if store:
            store.save(cell, number, result)
        done[k] = result
        if progress:
            progress(settings[cell].doing, len(done) / len(parts))

    jobs = [Job(settings[cell], batch, names[cell] if names else "")
            for cell, _, batch in (parts[k] for k in pending)]  # fmt: skip
    workers = (runner or on_cores)(jobs, finished) if jobs else 1
    wall = time.perf_counter() - began
    out: list[StudyResult[S]] = []
    for cell, setting in enumerate(settings):
        own = [done[k] for k, part in enumerate(parts) if part[0] == cell]
        samples = collected([part.samples for part in own])
        accuracy = {key: summed_up(setting, sample) for key, sample in samples.items()}
        solving = sum(part.wall for part in own) / workers
        cpu = sum(part.cpu for part in own)
        out.append(StudyResult(setting, runs, seed, samples, accuracy, wall, solving, cpu, workers))
    return out


def batches(setting: StudySetting, runs: int, seed: int) -> list[Batch]:
    """All batches of a study with their seeds, independent of the number of workers."""
    parts = [
        (population.name, min(population.batch, population.runs - first))
        for population in setting.populations(runs)
        for first in range(0, population.runs, population.batch)
    ]
    seeds = np.random.SeedSequence(seed).spawn(len(parts))
    return [Batch(name, count, own) for (name, count), own in zip(parts, seeds, strict=True)]


def collected(parts: Sequence[Mapping[Key, Sample]]) -> dict[Key, Sample]:
    """Samples of all batches, concatenated in the order of the batches."""

    def joined(arrays: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
        return {name: np.concatenate([a[name] for a in arrays]) for name in arrays[0]}

    out: dict[Key, Sample] = {}
    for key in dict.fromkeys(key for part in parts for key in part):
        own = [part[key] for part in parts if key in part]
        out[key] = Sample(joined([s.values for s in own]), joined([s.sigma for s in own]))
    return out


def summed_up(setting: StudySetting, sample: Sample) -> dict[str, Summary]:
    """Summaries of a sample's quantities over its runs, in SI units."""
    return {
        name: SUMMARIES_BY_STATISTIC[quantity.statistic](sample.values[name])
        for name, quantity in setting.quantities.items()
        if name in sample.values
    }
