"""Levenberg-Marquardt search of all runs at once, each with its own damping and stop.

**States and data of many runs** are arrays, or frozen dataclasses or named tuples of arrays, whose
leading axis counts the runs; see :func:`take`, :func:`put` and :func:`of_runs`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from enum import Enum
from math import prod
from typing import Any, NamedTuple, Protocol, TypeGuard, TypeVar, cast

import numpy as np

from pkmcal.arrays import Array, Booleans, Integers
from pkmcal.solver.elimination import SOLVER_ROWS_AT_ONCE, Linear, divisions
from pkmcal.solver.strips import (
    Compact,
    compact,
    cost_of,
    normal_equations,
    total,
)

STEP_TOLERANCE = 1e-7
"""A search ends with a step whose change of all fitted values together, in standard deviations, is
smaller: a ten-millionth of the noise, and above the rounding of some 1e-9."""
CACHED_PROBLEM_PARTS = 16
"""Parts of a problem whose intermediate results of the residuals, some 5 MB each, are kept for the
Jacobian. Parts beyond are computed again, so that memory does not grow with the problem."""

Runs = TypeVar("Runs")
"""An array, or a frozen dataclass or named tuple of arrays, with a leading axis of runs."""


@dataclass(frozen=True)
class SearchOptions:
    """Constants of the step control."""

    # first damping, practically none: most starts are near the solution, where a full step is best,
    # and damping costs steps along directions that are poorly determined
    least_damping: float = 1e-14
    # factor on the damping after a refused step, and on this factor after each further one in a
    # row: from the least damping to 0.01 in five steps
    growth: float = 8.0
    # damping from which on every step is small, so that a small step is no sign of convergence
    strong_damping: float = 1e-2
    # damping beyond which steps are below rounding: no step downhill exists
    most_damping: float = 1e9
    # ratio of the actual to the predicted decrease of the cost above which an accepted step's
    # damping is multiplied by the factor beside it, and the factor below all of them
    less_damping: tuple[tuple[float, float], ...] = ((0.5, 0.05), (0.2, 0.5))
    more_damping: float = 2.0
    # as STEP_TOLERANCE, for a step that raises the cost although the linear model predicts a
    # decrease: the residuals' rounding is so large where a direction is a million times less
    # determined than others
    refused_step_tolerance: float = 1e-3
    # relative rounding error of the cost
    cost_rounding: float = 1e-13


SEARCH = SearchOptions()


class Stop(Enum):
    """Reason why a search ended; the text is the user's message."""

    CONVERGED = "converged"
    STALLED = (
        "no step downhill was found; check the start, the stations' poses first, and that the "
        "readings belong to the images"
    )
    STEPS = "the step limit was reached before convergence; start nearer, or allow more steps"
    NOT_FINITE = (
        "nothing can be predicted at the start; check the stations' poses and the nominal model"
    )
    RUNNING = "not finished"


class Values(NamedTuple):
    """Residuals at a state.

    rows : the Jacobian there, where intermediate results of the residuals make it cheaper.
    """

    value: Array
    shared_value: Array
    rows: Callable[[], Compact] | None = None


class LeastSquares(Protocol):
    """Interface of a problem; ``state`` is opaque to the solver."""

    def residuals(self, state: Any) -> Values:
        """Residuals at a state."""
        ...

    def linearize(self, state: Any) -> Linear:
        """Residuals and exact Jacobian; rows that cannot be predicted are zero."""
        ...

    def retract(self, state: Any, shared: Array, own: Array) -> Any:
        """Retract the state along steps (B, na) and (B, K, d)."""
        ...

    def select(self, runs: Integers) -> LeastSquares:
        """The problem of some of the runs."""
        ...


class Divisible(LeastSquares, Protocol):
    """A problem that can be linearized for some configurations at a time, so that the Jacobian of
    all is never in memory at once.
    """

    def among(self, configurations: slice) -> Divisible:
        """The problem of some configurations, with all shared unknowns."""
        ...

    def state_among(self, state: Any, configurations: slice) -> Any:
        """The part of a state that the problem of these configurations needs."""
        ...

    def compact(self, state: Any) -> Compact:
        """Residuals and Jacobian with strips."""
        ...

    @property
    def extent(self) -> tuple[int, int]:
        """Number of configurations K, and of rows of each, r."""
        ...

    @property
    def rows_at_once(self) -> int:
        """Rows of the configurations that are linearized together."""
        ...


def _is_divisible(problem: LeastSquares) -> TypeGuard[Divisible]:
    """Whether a problem is divisible, by one method: an isinstance check of the protocol takes a
    tenth of the millisecond of a small step.
    """
    return hasattr(problem, "state_among")


def take(state: Runs, runs: Integers) -> Runs:
    """State of some runs."""
    return _each(lambda array: array[runs], state)


def put(state: Runs, runs: Integers, part: Runs) -> Runs:
    """State with the values of some runs replaced by those of ``part``."""

    def replaced(array: Array, new: Array) -> Array:
        """Copy of an array with new values in some runs."""
        out = array.copy()
        out[runs] = new
        return out

    return _each(replaced, state, part)


def of_runs(data: Runs, runs: Integers) -> Runs:
    """The data of some runs; arrays that all runs share (a leading axis of 1) stay."""
    return _each(lambda array: array if len(array) == 1 else array[runs], data)


def _count(state: Any) -> int:
    """Number of runs of a state."""
    if isinstance(state, np.ndarray):
        return len(state)
    first = state[0] if isinstance(state, tuple) else getattr(state, fields(state)[0].name)
    return len(cast(Array, first))


def _each(function: Callable[..., Array], first: Runs, *others: Runs) -> Runs:
    """Apply a function to the arrays of states, array by array."""
    if isinstance(first, np.ndarray):
        return cast(Runs, function(first, *others))
    states: tuple[Any, ...] = (first, *others)
    if not isinstance(first, tuple):
        names = [field.name for field in fields(states[0])]
        states = tuple(tuple(getattr(state, name) for name in names) for state in states)
    return type(first)(*(function(*part) for part in zip(*states, strict=True)))


@dataclass(frozen=True)
class Solution:
    """Result of a search over B runs.

    cost : by the linear model where the last step was taken without a trial.
    normal : (B, na, na) reduced normal matrix at the state before the last step.
    """

    state: Any
    cost: Array
    steps: Integers
    stop: tuple[Stop, ...]
    normal: Array


def minimise(
    problem: LeastSquares,
    start: Any,
    max_steps: int = 100,
    tolerance: float = STEP_TOLERANCE,
    options: SearchOptions = SEARCH,
) -> Solution:
    """Minimize the sum of squares from ``start``, all runs at once; each stops on its own.

    tolerance : of the last step, instead of STEP_TOLERANCE.
    """
    values: list[Values] | None = None
    at_once = SOLVER_ROWS_AT_ONCE
    if _is_divisible(problem):
        rows, at_once = problem.extent, problem.rows_at_once
    else:
        values = [problem.residuals(start)]
        rows = values[0].value.shape[1:]
    n_runs = _count(start)
    cuts = divisions(n_runs, prod(rows), at_once)
    if len(cuts) < 2:
        whole = _Divided.of(problem, n_runs, *rows)
        return _minimised(whole, start, values, max_steps, tolerance, options)
    results: list[Solution] = []
    for cut in cuts:
        runs = np.arange(cut.start, cut.stop)
        part = _Divided.of(problem.select(runs), len(runs), *rows)
        results.append(_minimised(part, take(start, runs), None, max_steps, tolerance, options))
    return Solution(
        _each(lambda *states: np.concatenate(states), *(one.state for one in results)),
        np.concatenate([one.cost for one in results]),
        np.concatenate([one.steps for one in results]),
        tuple(reason for one in results for reason in one.stop),
        np.concatenate([one.normal for one in results]),
    )


class _Divided(NamedTuple):
    """A problem and its parts, of some configurations each, that fit into the processor's cache."""

    problem: LeastSquares
    parts: list[tuple[slice, LeastSquares]]

    @classmethod
    def of(cls, problem: LeastSquares, n_runs: int, count: int, rows: int) -> _Divided:
        """Divide a problem of ``count`` configurations of ``rows`` rows, where it is divisible."""
        if _is_divisible(problem):
            cuts = divisions(count, n_runs * rows, problem.rows_at_once)
            if len(cuts) > 1:
                return cls(problem, [(cut, problem.among(cut)) for cut in cuts])
        return cls(problem, [(slice(0, count), problem)])

    def select(self, runs: Integers) -> _Divided:
        """The divided problem of some runs."""
        parts = [(cut, part.select(runs)) for cut, part in self.parts]
        return self._replace(problem=self.problem.select(runs), parts=parts)

    def rows(self, state: Any, values: list[Values] | None) -> Iterator[Compact]:
        """Residuals and Jacobian of one part after another; values : residuals there, if known."""
        for k, (cut, part) in enumerate(self.parts):
            make_rows = values[k].rows if values else None
            if make_rows:
                yield make_rows()
            elif _is_divisible(part):
                yield part.compact(part.state_among(state, cut))
            else:
                yield compact(part.linearize(state))

    def residuals(self, state: Any) -> list[Values]:
        """Residuals of each part; rows on shared unknowns only are in the first part."""
        results = [self.parts[0][1].residuals(self._state_among(state, 0))]
        for k in range(1, len(self.parts)):
            values = self.parts[k][1].residuals(self._state_among(state, k))
            values = values._replace(shared_value=values.shared_value[:, :0])
            results.append(values if k < CACHED_PROBLEM_PARTS else values._replace(rows=None))
        return results

    def _state_among(self, state: Any, k: int) -> Any:
        """The part of a state that part k of the problem needs."""
        cut, part = self.parts[k]
        if len(self.parts) > 1 and _is_divisible(part):
            return part.state_among(state, cut)
        return state


def _minimised(
    problem: _Divided,
    start: Any,
    values: list[Values] | None,
    max_steps: int,
    tolerance: float,
    options: SearchOptions,
) -> Solution:
    """:func:`minimise` of a few runs; values : residuals at the start, if known."""
    n_runs = _count(start)
    cost, steps = np.full(n_runs, np.inf), np.zeros(n_runs, dtype=int)
    stop = [Stop.RUNNING] * n_runs
    active, search = np.arange(n_runs), _Search.begun(n_runs, options)
    state, part, here, at = start, problem, start, values
    normal: Array | None = None
    for _ in range(max_steps):
        # a step of the active runs
        before = here
        new, gain = _try(part, before, at, search, tolerance, options)
        steps[active] += 1
        # accepted steps; the residuals are known where all are
        here, at = new, gain.values
        if not gain.accepted.all():
            runs = np.flatnonzero(gain.accepted)
            here, at = put(before, runs, take(new, runs)), None
        # accepted states into the result
        if active.size == n_runs:
            state, normal = here, gain.normal
        else:
            state, normal = put(state, active, here), put(cast(Array, normal), active, gain.normal)
        cost[active], search = gain.cost, gain.search
        for run, reason in zip(active, gain.stop, strict=True):
            stop[run] = reason
        # continue with the runs that have not stopped
        keep = np.array([k for k, reason in enumerate(gain.stop) if reason is Stop.RUNNING])
        if keep.size == 0:
            break
        if keep.size < active.size:
            active = active[keep]
            part, here, at = problem.select(active), take(state, active), None
            search = take(search, keep)
    final = tuple(Stop.STEPS if s is Stop.RUNNING else s for s in stop)
    return Solution(state, cost, steps, final, cast(Array, normal))


class _Search(NamedTuple):
    """State of the step control, (B,) each.

    damping : of the next step.
    growth : factor on the damping if that step is refused.
    size : norm of the last step's change of all residuals; infinite where it was damped or refused.
    """

    damping: Array
    growth: Array
    size: Array

    @classmethod
    def begun(cls, n_runs: int, options: SearchOptions) -> _Search:
        """Step control before the first step."""
        return cls(*(np.full(n_runs, x) for x in (options.least_damping, options.growth, np.inf)))

    def after(
        self, accepted: Booleans, ratio: Array, size: Array, options: SearchOptions
    ) -> _Search:
        """Step control after a step; ratio : actual by predicted decrease of the cost."""
        less = np.full(ratio.shape, options.more_damping)
        for least, factor in reversed(options.less_damping):
            less = np.where(ratio > least, factor, less)
        damping = self.damping * np.where(accepted, less, self.growth)
        return _Search(
            np.clip(damping, options.least_damping, options.most_damping),
            np.where(accepted, options.growth, options.growth * self.growth),
            np.where(accepted & self.undamped(options), size, np.inf),
        )

    def undamped(self, options: SearchOptions) -> Booleans:
        """Whether the next step is a full Gauss-Newton step."""
        return self.damping <= options.least_damping

    def remaining(self, size: Array, options: SearchOptions) -> Array:
        """Estimated distance to the solution after a full step of this size.

        Steps that shrink by a factor q each leave ``q / (1 - q)`` of the last (Hairer and Wanner,
        Solving Ordinary Differential Equations II, IV.8).
        """
        shrinking = self.undamped(options) & np.isfinite(self.size) & (size < self.size)
        return np.where(shrinking, size**2 / np.where(shrinking, self.size - size, 1.0), np.inf)


class _Gain(NamedTuple):
    """Result of a step.

    values : residuals of each part after the step; None where it was not tried.
    """

    accepted: Booleans
    values: list[Values] | None
    cost: Array
    search: _Search
    normal: Array
    stop: list[Stop]


def _try(
    problem: _Divided,
    state: Any,
    values: list[Values] | None,
    search: _Search,
    tolerance: float,
    options: SearchOptions,
) -> tuple[Any, _Gain]:
    """Try one damped step of every run; returns the states after the step, and its result.

    values : residuals at the state, if known.
    """
    damping = search.damping
    # step and its predicted effect
    normal = normal_equations(problem.rows(state, values), damping)
    shared, own = normal.step(damping)
    descent, size2 = normal.promise(shared, own)
    cost, promised = normal.cost, descent - size2
    # convergence by the linear model
    size, unit = np.sqrt(size2), 1 + 1e-3 * np.sqrt(cost)
    # near the end a step changes the cost by less than the cost's rounding, which cannot be judged
    small = (size < tolerance * unit) | (np.abs(promised) < options.cost_rounding * cost)
    last = search.remaining(size, options) < tolerance * unit
    usable = [part.usable for part in normal.parts]
    any_usable = total(np.sum(part, axis=(1, 2)) for part in usable) > 0
    trial = problem.problem.retract(state, shared, np.concatenate(own, axis=1))
    if np.all(search.undamped(options) & any_usable & (small | last)):
        # full steps as short as these decrease the cost as predicted: no trial is needed
        every = np.ones(len(cost), dtype=bool)
        stop = [Stop.CONVERGED] * len(cost)
        return trial, _Gain(every, None, cost - promised, search, normal.matrix, stop)
    # trial: residuals at the new state
    values = problem.residuals(trial)
    cost_trial = total(
        cost_of(part.value, part.shared_value, use)
        for part, use in zip(values, usable, strict=True)
    )
    ratio = (cost - cost_trial) / np.maximum(promised, 1e-300)
    accepted = cost_trial <= cost * (1 + options.cost_rounding)
    small |= accepted & last
    # a step that is refused by rounding only is taken: the linear model is the better evidence
    least = options.refused_step_tolerance
    little = ~accepted & (promised < (least * unit) ** 2) & (damping < options.strong_damping)
    small, accepted = (
        small | little,
        accepted | (little & (cost_trial - cost < least**2)),
    )
    stop = [
        _reason(*run, options) for run in zip(any_usable, small, accepted, damping, strict=True)
    ]
    cost = np.where(accepted, cost_trial, cost)
    search = search.after(accepted, ratio, size, options)
    return trial, _Gain(accepted, values, cost, search, normal.matrix, stop)


def _reason(
    usable: bool, small: bool, accepted: bool, damping: float, options: SearchOptions
) -> Stop:
    """Stop reason of one run after a step."""
    if not usable:
        return Stop.NOT_FINITE
    if small and damping < options.strong_damping:
        return Stop.CONVERGED
    return Stop.STALLED if not accepted and damping >= options.most_damping else Stop.RUNNING
