"""The whole simulation of [C]: runs in chunks on threads, all estimators, put together."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.papers.inverse_kinematic import Form
from pkmcal.papers.rotation_axis import rotation_axis
from pkmcal.reproduce.paper_c_methods import (
    Errors,
    Fitted,
    at_poses,
    bound,
    errors,
    fitted,
    joint,
    places,
    start,
)
from pkmcal.reproduce.paper_c_simulation import (
    LARGER,
    Kind,
    Settings,
    Truth,
    measurements,
    model,
    simulate,
)
from pkmcal.reproduce.paper_c_validation import (
    control_residuals,
    residuals_before,
    square,
    straightness,
    table_2_of,
)

CHUNK = 20
RODS_SHARE = 5
"""One run with rods for so many others: it has 82 parameters and takes ten times as long."""
MOST_THREADS = 4
DRAWING, EQ3, EQ5, WHITENED, JOINT, BOUND = (
    "drawing", "eq. 3", "eq. 5", "eq. 5 whitened", "joint", "bound",
)  # fmt: skip
PLAN: dict[Kind, tuple[tuple[Kind, tuple[str, ...]], ...]] = {
    "design": (
        ("design", (DRAWING, EQ3, EQ5, WHITENED, JOINT, BOUND)),
        ("calibration", (EQ5, WHITENED, JOINT)),
    ),
    "calibration": (
        ("design", (DRAWING, EQ3, JOINT)),
        ("calibration", (EQ3, EQ5, WHITENED, JOINT, BOUND)),
    ),
    "rods": (
        ("design", (JOINT,)),
        ("calibration", (JOINT,)),
        ("rods", (WHITENED, JOINT)),
    ),
}
"""For each truth the models that are fitted to it, and how."""
PRINTED: tuple[tuple[str, Form], ...] = ((EQ3, "joint"), (EQ5, "implicit"))
Key = tuple[Kind, Kind, str]
"""Truth, model, method."""


class Accuracy(NamedTuple):
    """Root mean squares over runs and poses, m and rad: in the measured volume and in a workspace
    LARGER times as long, and the latter's Monte-Carlo standard errors. chi2 : mean per degree
    of freedom, NaN where rows are not whitened.
    """

    shift: float
    turn: float
    larger_shift: float
    larger_turn: float
    larger_shift_error: float
    larger_turn_error: float
    chi2: float
    runs: int


class Validation(NamedTuple):
    """[C] IV.C and IV.D of one method, leading axis B. table_2 : (B, 12), of Model 12 only."""

    control_mean: Array
    control_rms: Array
    straightness: Array
    square: Array
    table_2: Array


class Axis(NamedTuple):
    """[C] IV.B of runs (B,): spread of the axis over pairs and of single poses, rad; chi2, dof."""

    spread: Array
    expected: Array
    tilt: Array
    chi2: Array
    dof: int


@dataclass(frozen=True)
class Study:
    """What the runs came to. truth : one run's, for what does not depend on the noise."""

    runs: int
    seed: int
    settings: Settings
    accuracy: dict[Key, Accuracy]
    validation: dict[str, Validation]
    axis: Axis
    truth: Truth
    wall: float
    threads: int
    ranks: dict[tuple[Kind, str], tuple[int, int]] = field(default_factory=dict)


class _Part(NamedTuple):
    """A chunk's results: errors in two workspaces and chi2 by key; the rest of the first truth."""

    errors: dict[Key, tuple[Errors, Errors, Array]]
    validation: dict[str, Validation]
    axis: Axis | None
    truth: Truth
    ranks: dict[tuple[Kind, str], tuple[int, int]]


def study(
    runs: int = 100,
    settings: Settings | None = None,
    seed: int = 2003,
    told: Callable[[str, float], None] | None = None,
) -> Study:
    """All truths, models and methods; the result does not depend on the threads."""
    from threadpoolctl import threadpool_limits

    settings = settings or Settings()
    work = _work(runs, seed)
    threads = max(1, min(MOST_THREADS, os.cpu_count() or 1, len(work)))
    began, parts = time.perf_counter(), list[_Part]()
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads) as pool:
        for k, part in enumerate(pool.map(lambda w: _solve(settings, *w), work)):
            parts.append(part)
            if told:
                told("Board poses", (k + 1) / len(work))
    first = next(p for p in parts if p.validation)
    ranks = {key: value for part in parts for key, value in part.ranks.items()}
    return Study(
        runs=runs,
        seed=seed,
        settings=settings,
        accuracy=_accuracy(parts),
        validation={name: _validation(parts, name) for name in first.validation},
        axis=_axis([p.axis for p in parts if p.axis is not None]),
        truth=first.truth,
        wall=time.perf_counter() - began,
        threads=threads,
        ranks=ranks,
    )


def _work(runs: int, seed: int) -> list[tuple[Kind, int, np.random.SeedSequence]]:
    """Truth, number of runs and seed of each chunk."""
    out: list[tuple[Kind, int]] = []
    for kind in PLAN:
        count = max(2, runs // RODS_SHARE) if kind == "rods" else runs
        size = CHUNK // 4 if kind == "rods" else CHUNK
        out.extend((kind, min(size, count - first)) for first in range(0, count, size))
    seeds = np.random.SeedSequence(seed).spawn(len(out))
    return [(kind, n, s) for (kind, n), s in zip(out, seeds, strict=True)]


def _solve(settings: Settings, kind: Kind, runs: int, seed: np.random.SeedSequence) -> _Part:
    """All models and methods on a chunk of one truth."""
    simulation, drawn, space, lines = (np.random.default_rng(s) for s in seed.spawn(4))
    truth = simulate(kind, settings, runs, simulation)
    near, far = (places(truth, space, larger) for larger in (1.0, LARGER))
    found: dict[Key, tuple[Errors, Errors, Array]] = {}
    checked: dict[str, Validation] = {}
    ranks: dict[tuple[Kind, str], tuple[int, int]] = {}
    for name, methods in PLAN[kind]:
        fits = _fits(truth, settings, name, methods, drawn, ranks)
        for method, fit in fits.items():
            one, other = (errors(model(name), fit.theta, at, settings) for at in (near, far))
            found[kind, name, method] = (one, other, fit.chi2)
            if kind == "design" and method != BOUND:
                label = f"{name}, {method}"
                checked[label] = _checked(truth, settings, name, method, fit, lines)
    axis = _axis_of(truth, settings) if kind == "design" else None
    return _Part(found, checked, axis, truth, ranks)


def _fits(
    truth: Truth,
    settings: Settings,
    name: Kind,
    methods: tuple[str, ...],
    rng: np.random.Generator,
    ranks: dict[tuple[Kind, str], tuple[int, int]],
) -> dict[str, Fitted]:
    """Every asked method's estimate with one model. Only rods need the drawing as a prior."""
    machine, prior = model(name), name == "rods"
    runs = len(truth.theta)
    out: dict[str, Fitted] = {}
    begin = start(machine, truth)
    none = np.full(runs, np.nan)
    frames = np.broadcast_to(np.eye(4), (runs, 4, 4))
    if DRAWING in methods:
        drawing = np.broadcast_to(machine.parameters.drawing, (runs, len(machine.parameters)))
        out[DRAWING] = Fitted(drawing, frames, frames, none)
    for method, form in PRINTED:
        if method in methods:
            fit = at_poses(machine, truth, settings, begin, form, whitened=False)
            out[method] = fitted(fit)
            ranks[name, method] = (fit.rank, int(fit.problem.keep.sum()))
    whitened = at_poses(
        machine, truth, settings, begin, "implicit", whitened=True, use_drawing=prior
    )
    if not prior:
        ranks[name, WHITENED] = (whitened.rank, int(whitened.problem.keep.sum()))
    if WHITENED in methods:
        out[WHITENED] = fitted(whitened)
    out[JOINT] = joint(machine, truth, settings, whitened, use_drawing=prior)[0]
    if BOUND in methods:
        out[BOUND] = bound(machine, truth, settings, rng)
    return out


def _checked(
    truth: Truth, settings: Settings, name: Kind, method: str, fit: Fitted, rng: np.random.Generator
) -> Validation:
    """[C] IV.C and IV.D of one estimate."""
    machine = model(name)
    if method == DRAWING:
        control = residuals_before(machine, truth)
    else:
        control = control_residuals(machine, fit, truth)
    two = table_2_of(machine, fit.theta) if name == "design" else np.zeros((len(fit.theta), 0))
    return Validation(
        control.mean,
        control.rms,
        straightness(machine, fit.theta, truth, settings, rng),
        square(machine, fit.theta, truth),
        two,
    )


def _axis_of(truth: Truth, settings: Settings) -> Axis:
    found = [
        rotation_axis(measurements(truth, settings, run).poses, "schoenflies")
        for run in range(len(truth.theta))
    ]
    return Axis(
        np.array([f.spread for f in found]),
        np.array([f.expected_spread for f in found]),
        np.array([np.sqrt(np.mean(f.tilt**2)) for f in found]),
        np.array([f.chi2 for f in found]),
        found[0].dof,
    )


def _axis(parts: list[Axis]) -> Axis:
    spread, expected, tilt, chi2 = (
        np.concatenate(arrays) for arrays in zip(*(p[:4] for p in parts), strict=True)
    )
    return Axis(spread, expected, tilt, chi2, parts[0].dof)


def _validation(parts: list[_Part], name: str) -> Validation:
    own = [p.validation[name] for p in parts if name in p.validation]
    return Validation(*(np.concatenate(arrays) for arrays in zip(*own, strict=True)))


def _accuracy(parts: list[_Part]) -> dict[Key, Accuracy]:
    keys = dict.fromkeys(key for part in parts for key in part.errors)
    return {key: _accuracy_of([p.errors[key] for p in parts if key in p.errors]) for key in keys}


def _accuracy_of(parts: list[tuple[Errors, Errors, Array]]) -> Accuracy:
    near = Errors(*(np.concatenate(a) for a in zip(*(p[0] for p in parts), strict=True)))
    far = Errors(*(np.concatenate(a) for a in zip(*(p[1] for p in parts), strict=True)))
    chi2 = np.concatenate([p[2] for p in parts])
    return Accuracy(
        _rms(near.shift), _rms(near.turn), _rms(far.shift), _rms(far.turn),
        _rms_error(far.shift), _rms_error(far.turn), float(chi2.mean()), len(chi2),
    )  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rms_error(values: Array) -> float:
    """Standard error of a root mean square, by the runs' scatter."""
    return float(np.std(values**2) / np.sqrt(len(values)) / (2 * _rms(values)))
