"""The whole simulation of [A] 4.3: runs in chunks on threads, errors put together."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.problem import Problem
from pkmcal.mechanisms import Machine
from pkmcal.reproduce.paper_a_methods import (
    Errors,
    Start,
    bound,
    evaluated,
    four_steps,
    joint,
    parameters_of,
    start_off_drawing,
    thirty,
)
from pkmcal.reproduce.paper_a_simulation import (
    Settings,
    Truth,
    joint_problem,
    simulate,
    study_machine,
)

PHOTOGRAPHS = 25 * 45
"""Photographs of all runs that are solved at once; more only leaves the processor's cache."""
MOST_THREADS = 4
DRAWS = 4
"""Draws from each run's bound, so that the bound's end-effector is known twice as well."""
RIGHT = 1.5
"""A run whose chi2 per degree of freedom is below has found its minimum; a false one has far
more than a hundred."""
DRAWING, PRINTED, CORRECTED = "drawing", "four steps as printed", "four steps"
JOINT, BOUND = "joint", "bound"
METHODS = (DRAWING, PRINTED, CORRECTED, JOINT, BOUND)

Told = Callable[[str, float], None]
R = TypeVar("R")


class Accuracy(NamedTuple):
    """RMSE over runs, m and rad. base_xy to offset : the thirty parameters in the frames of
    centres 1, 3 and 5. displacement, orientation : mean error of the end-effector, [A] eq. 20,
    in those frames; the last two with frames registered on all centres, so that the error of
    the frames' own definition by three joints is left out.
    """

    base_xy: float
    base_z: float
    platform_xy: float
    platform_z: float
    offset: float
    displacement: float
    orientation: float
    displacement_registered: float
    orientation_registered: float

    @property
    def parameters(self) -> float:
        """RMSE over all thirty parameters."""
        squares = np.square([self.base_xy, self.base_z, self.platform_xy, self.platform_z])
        return float(np.sqrt((squares @ [9, 3, 9, 3] + 6 * self.offset**2) / 30))


@dataclass(frozen=True)
class Study:
    """What the runs came to, by method of METHODS.

    accuracy, and its Monte-Carlo standard error. mean_error : mean |error| of the thirty
    parameters (30,), m. chi2_per_dof, steps : of the joint estimate, each run. converged : runs
    that ended at the right answer. wall, cpu : seconds of the four steps, both forms, and the
    joint estimate together. freedom : degrees of freedom of a run.
    """

    runs: int
    settings: Settings
    accuracy: dict[str, Accuracy]
    error: dict[str, Accuracy]
    mean_error: dict[str, Array]
    chi2_per_dof: Array
    freedom: int
    steps: Integers
    converged: int
    wall: float
    cpu: float
    threads: int


class _Solved(NamedTuple):
    """A chunk's estimates by method, chi2 per degree of freedom, steps, and seconds of work."""

    theta: dict[str, Array]
    chi2: Array
    freedom: int
    steps: Integers
    seconds: float


@dataclass(frozen=True)
class _Chunk:
    """Runs that are solved at once, with the seed of all that is drawn for them."""

    machine: Machine
    settings: Settings
    runs: int
    seed: np.random.SeedSequence
    start_error: float | None

    def generator(self, use: int) -> np.random.Generator:
        """Independent draws for each use: 0 simulation, 1 evaluation, 2 start, 3 bound."""
        key = (*self.seed.spawn_key, use)
        return np.random.default_rng(np.random.SeedSequence(self.seed.entropy, spawn_key=key))

    def truth(self) -> Truth:
        """The simulated runs."""
        return simulate(self.machine, self.settings, self.runs, self.generator(0))


def study(
    runs: int = 100,
    settings: Settings | None = None,
    seed: int = 20020,
    *,
    start_error: float | None = None,
    told: Told | None = None,
) -> Study:
    """The whole study. start_error : start the joint estimate this far off the drawing (m,
    uniform) instead of from the four steps. The result does not depend on the threads.
    """
    from threadpoolctl import threadpool_limits

    told = told or (lambda _text, _share: None)
    machine, settings = study_machine(), settings or Settings()
    chunks = _chunks(machine, settings, runs, seed, start_error)
    threads = max(1, min(MOST_THREADS, os.cpu_count() or 1, len(chunks)))
    # Small matrices: threads inside the linear algebra would only wait for one another.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads) as pool:
        told("Simulating", 0.0)
        truths = list(pool.map(_Chunk.truth, chunks))
        told("Four steps and joint estimate", 0.1)
        began = time.perf_counter()
        solved = _mapped(pool, _solve, chunks, truths)
        wall = time.perf_counter() - began
        told("Bound and end-effector", 0.7)
        errors = _mapped(pool, _errors, chunks, truths, solved)
        told("", 1.0)
    return _together(machine, settings, solved, errors, wall, threads)


def _together(
    machine: Machine,
    settings: Settings,
    solved: list[_Solved],
    errors: list[dict[str, Errors]],
    wall: float,
    threads: int,
) -> Study:
    """All chunks as one study."""
    joined = {name: _joined([e[name] for e in errors]) for name in METHODS}
    pairs = {name: accuracy(machine, found) for name, found in joined.items()}
    chi2 = np.concatenate([part.chi2 for part in solved])
    return Study(
        runs=len(chi2),
        settings=settings,
        accuracy={name: pair[0] for name, pair in pairs.items()},
        error={name: pair[1] for name, pair in pairs.items()},
        mean_error={name: _mean_error(name, found) for name, found in joined.items()},
        chi2_per_dof=chi2,
        freedom=solved[0].freedom,
        steps=np.concatenate([part.steps for part in solved]),
        converged=int(np.sum(chi2 < RIGHT)),
        wall=wall,
        cpu=sum(part.seconds for part in solved),
        threads=threads,
    )


def _mapped(pool: ThreadPoolExecutor, work: Callable[..., R], *parts: Sequence[object]) -> list[R]:
    return list(pool.map(work, *parts))


def _chunks(
    machine: Machine, settings: Settings, runs: int, seed: int, start_error: float | None
) -> list[_Chunk]:
    """Chunks of about PHOTOGRAPHS photographs, the same for any number of threads."""
    size = max(1, PHOTOGRAPHS // (3 * settings.poses))
    counts = [min(size, runs - first) for first in range(0, runs, size)]
    seeds = np.random.SeedSequence(seed).spawn(len(counts))
    return [
        _Chunk(machine, settings, n, s, start_error) for n, s in zip(counts, seeds, strict=True)
    ]


def _solve(chunk: _Chunk, truth: Truth) -> _Solved:
    """All methods on a chunk."""
    began = time.thread_time()
    machine = chunk.machine
    steps = four_steps(machine, chunk.settings, truth)
    printed, corrected = (parameters_of(machine, steps[f]) for f in ("printed", "corrected"))
    problem = joint_problem(machine, chunk.settings, truth)
    start = Start(corrected, steps["corrected"].T_camera_base)
    if chunk.start_error is not None:
        start = start_off_drawing(machine, truth, _start_error(chunk))
    found = joint(machine, problem, truth, start)
    theta = {
        PRINTED: printed,
        CORRECTED: corrected,
        JOINT: problem.theta(found.solution.state),
    }
    freedom = degrees_of_freedom(problem)
    chi2 = found.solution.cost / freedom
    return _Solved(theta, chi2, freedom, found.steps, time.thread_time() - began)


def _start_error(chunk: _Chunk) -> Array:
    """Uniform errors (B, P) of the parameters that are not held."""
    table = chunk.machine.parameters
    free = np.any(table.free_matrix() != 0, axis=1)
    draws = chunk.generator(2).uniform(-1, 1, (chunk.runs, len(table)))
    return np.where(free, draws * (chunk.start_error or 0.0), 0.0)


def _errors(chunk: _Chunk, truth: Truth, solved: _Solved) -> dict[str, Errors]:
    """Errors of every method, at the same poses."""
    machine = chunk.machine
    theta = {DRAWING: np.broadcast_to(machine.parameters.drawing, truth.theta.shape)}
    out = {
        name: evaluated(machine, values, truth, chunk.generator(1))
        for name, values in {**theta, **solved.theta}.items()
    }
    return {**out, BOUND: _bound_errors(chunk, truth)}


def _bound_errors(chunk: _Chunk, truth: Truth) -> Errors:
    """The bound's standard deviations, and the end-effector's errors by draws from it."""
    machine = chunk.machine
    root = bound(machine, joint_problem(machine, chunk.settings, truth), truth)
    draws = chunk.generator(3).normal(size=(DRAWS, chunk.runs, root.shape[-1], 1))
    theta = truth.theta + (root @ draws)[..., 0]
    found = [evaluated(machine, values, truth, chunk.generator(1)).effector for values in theta]
    sigma = np.linalg.norm(thirty(machine).rows @ root, axis=-1)
    return Errors(sigma, np.mean(found, axis=0))


def _joined(parts: list[Errors]) -> Errors:
    return Errors(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def accuracy(machine: Machine, errors: Errors) -> tuple[Accuracy, Accuracy]:
    """Root mean squares by group and means of the end-effector, and their standard errors.

    The standard errors come from the runs' scatter; coordinates within a run are correlated.
    """
    names = np.array(thirty(machine).names)
    groups = [
        np.char.startswith(names, letter) & (np.char.endswith(names, "z") == z)
        for letter in "AB"
        for z in (False, True)
    ]
    groups.append(np.char.startswith(names, "q"))
    root_n = np.sqrt(max(len(errors.thirty), 1))
    squares = np.stack([np.mean(errors.thirty[:, g] ** 2, axis=1) for g in groups], axis=-1)
    rms = np.sqrt(squares.mean(axis=0))
    rms_error = squares.std(axis=0) / root_n / (2 * np.maximum(rms, 1e-300))
    effector = errors.effector.mean(axis=0)
    effector_error = errors.effector.std(axis=0) / root_n
    return (
        Accuracy(*rms.tolist(), *effector.tolist()),
        Accuracy(*rms_error.tolist(), *effector_error.tolist()),
    )


def _mean_error(name: str, errors: Errors) -> Array:
    """Mean |error| (30,); of the bound's standard deviations, that of a normal distribution."""
    return np.abs(errors.thirty).mean(axis=0) * (np.sqrt(2 / np.pi) if name == BOUND else 1.0)


def degrees_of_freedom(problem: Problem) -> int:
    """Residuals less unknowns of a study's problem; the gauge's rows fix twelve of them."""
    n_configurations = problem.blocks.leg.shape[0]
    data = n_configurations * (problem.edge_rows.stop + problem.layout.n_legs)
    shared = problem.unknowns.stations.stop - 12
    return data - shared - 6 * n_configurations
