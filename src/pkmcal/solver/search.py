"""The search: damped steps of all runs at once, each of which stops on its own.

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
from pkmcal.solver.elimination import Linear, divisions
from pkmcal.solver.strips import (
    Compact,
    compact,
    cost_of,
    normal_equations,
    total,
)

LEAST_DAMPING = 1e-14
"""Damping that a search begins with, as good as none: near an answer, and starts mostly are, a full
step is the best, and any damping costs steps along what is known little of."""
DAMPING_GROWTH = 8.0
"""Factor on it after a step that was refused, and that factor's after each more in a row: from
nothing to a hundredth in five."""
STRONG_DAMPING = 1e-2
"""Damping from which on a step is small anywhere, so that its size tells nothing."""
MOST_DAMPING = 1e9
"""Damping beyond which a step is below rounding: nothing downhill was found."""
STEP_TOLERANCE = 1e-7
"""A step that changes all fitted values together by less, in standard deviations, ends the
search: a ten-millionth of what the noise does, and above the rounding of 1e-9 or so."""
REFUSED_STEP_TOLERANCE = 1e-3
"""The same of a step that the residuals refuse, though the linear model promises something: so
little is their rounding, where a direction is a millionth as well known as the others."""
COST_ROUNDING = 1e-13
"""Of the cost, relative."""
CACHED_PROBLEM_PARTS = 16
"""Parts of a problem of which is kept what their residuals took, so that the next step goes on from
it: some 5 MB each. Of those of a larger problem it is found again, so that memory does not grow."""

Runs = TypeVar("Runs")
"""An array, or a frozen dataclass or named tuple of arrays, with a leading axis of runs."""


class Stop(Enum):
    """Why a search ended; the text is what the user reads."""

    CONVERGED = "converged"
    STALLED = (
        "no step downhill was found; check the start, the stations' poses first, and that the "
        "readings belong to the photographs"
    )
    STEPS = "the step limit was reached before convergence; start nearer, or allow more steps"
    NOT_FINITE = "nothing can be predicted at the start; check the stations' poses and the drawing"
    RUNNING = "not finished"


class Values(NamedTuple):
    """Residuals alone: value (B, K, r) with NaN where nothing can be predicted, shared (B, c).

    rows : gives the Jacobian there, where it costs less to go on from what these took.
    """

    value: Array
    shared_value: Array
    rows: Callable[[], Compact] | None = None


class LeastSquares(Protocol):
    """What the solver needs of a problem; ``state`` is the problem's own, opaque here."""

    def residuals(self, state: Any) -> Values:
        """Residuals at a state."""
        ...

    def linearize(self, state: Any) -> Linear:
        """Residuals and exact Jacobian; rows that cannot be predicted are zero."""
        ...

    def retract(self, state: Any, shared: Array, own: Array) -> Any:
        """The state moved by steps (B, na) and (B, K, d)."""
        ...

    def select(self, runs: Integers) -> LeastSquares:
        """The problem of some runs only."""
        ...


class Divisible(LeastSquares, Protocol):
    """A problem of which some configurations can be looked at alone, so that the Jacobian of all
    never stands in memory at once.
    """

    def among(self, configurations: slice) -> Divisible:
        """The problem of some configurations, with all that they share."""
        ...

    def state_among(self, state: Any, configurations: slice) -> Any:
        """What that problem needs of a state."""
        ...

    def compact(self, state: Any) -> Compact:
        """As :meth:`linearize`."""
        ...

    @property
    def extent(self) -> tuple[int, int]:
        """Configurations K and rows of each, r."""
        ...


def _is_divisible(problem: LeastSquares) -> TypeGuard[Divisible]:
    """Whether a problem is one: told by a method, since asking a protocol takes a tenth of the
    millisecond that a small step does.
    """
    return hasattr(problem, "state_among")


def take(state: Runs, runs: Integers) -> Runs:
    """The state of some runs."""
    return _each(lambda array: array[runs], state)


def put(state: Runs, runs: Integers, part: Runs) -> Runs:
    """The state with some runs' values replaced by those of ``part``."""

    def replaced(array: Array, new: Array) -> Array:
        out = array.copy()
        out[runs] = new
        return out

    return _each(replaced, state, part)


def of_runs(data: Runs, runs: Integers) -> Runs:
    """The measured numbers of some runs; what all runs share (a leading axis of 1) stays."""
    return _each(lambda array: array if len(array) == 1 else array[runs], data)


def _count(state: Any) -> int:
    """Runs of a state."""
    if isinstance(state, np.ndarray):
        return len(state)
    first = state[0] if isinstance(state, tuple) else getattr(state, fields(state)[0].name)
    return len(cast(Array, first))


def _each(function: Callable[..., Array], first: Runs, *others: Runs) -> Runs:
    """A function of the arrays of states, array by array."""
    if isinstance(first, np.ndarray):
        return cast(Runs, function(first, *others))
    states: tuple[Any, ...] = (first, *others)
    if not isinstance(first, tuple):
        names = [field.name for field in fields(states[0])]
        states = tuple(tuple(getattr(state, name) for name in names) for state in states)
    return type(first)(*(function(*part) for part in zip(*states, strict=True)))


@dataclass(frozen=True)
class Solution:
    """Result of a search: state, cost (B,), steps (B,), stop (B,) of Stop.

    cost : of a search whose last step needed no trial, as the linear model says.
    normal : (B, na, na) the reduced normal matrix where the last step was made, which is at the end
    but for that step.
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
) -> Solution:
    """Least squares from ``start``, all runs at once; each stops on its own.

    tolerance : in the place of STEP_TOLERANCE, where less will do.
    """
    values: list[Values] | None = None
    if _is_divisible(problem):
        rows = problem.extent
    else:
        values = [problem.residuals(start)]
        rows = values[0].value.shape[1:]
    n_runs = _count(start)
    cuts = divisions(n_runs, prod(rows))
    if len(cuts) < 2:
        return _minimised(_Divided.of(problem, n_runs, *rows), start, values, max_steps, tolerance)
    results: list[Solution] = []
    for cut in cuts:
        runs = np.arange(cut.start, cut.stop)
        part = _Divided.of(problem.select(runs), len(runs), *rows)
        results.append(_minimised(part, take(start, runs), None, max_steps, tolerance))
    return Solution(
        _each(lambda *states: np.concatenate(states), *(one.state for one in results)),
        np.concatenate([one.cost for one in results]),
        np.concatenate([one.steps for one in results]),
        tuple(reason for one in results for reason in one.stop),
        np.concatenate([one.normal for one in results]),
    )


class _Divided(NamedTuple):
    """A problem with its parts of some configurations, small enough for the processor's cache."""

    problem: LeastSquares
    parts: list[tuple[slice, LeastSquares]]

    @classmethod
    def of(cls, problem: LeastSquares, n_runs: int, count: int, rows: int) -> _Divided:
        """A problem of so many runs and configurations of so many rows, divided where it can be."""
        cuts = divisions(count, n_runs * rows)
        if not _is_divisible(problem) or len(cuts) < 2:
            return cls(problem, [(slice(0, count), problem)])
        return cls(problem, [(cut, problem.among(cut)) for cut in cuts])

    def select(self, runs: Integers) -> _Divided:
        """The same of some runs."""
        parts = [(cut, part.select(runs)) for cut, part in self.parts]
        return self._replace(problem=self.problem.select(runs), parts=parts)

    def rows(self, state: Any, values: list[Values] | None) -> Iterator[Compact]:
        """Residuals and Jacobian of one part after the other; values : the residuals there, where
        they are known.
        """
        for k, (cut, part) in enumerate(self.parts):
            reference_values = values[k].rows if values else None
            if reference_values:
                yield reference_values()
            elif _is_divisible(part):
                yield part.compact(part.state_among(state, cut))
            else:
                yield compact(part.linearize(state))

    def residuals(self, state: Any) -> list[Values]:
        """Residuals of each part; those of shared unknowns only in the first."""
        results = [self.parts[0][1].residuals(self._state_among(state, 0))]
        for k in range(1, len(self.parts)):
            values = self.parts[k][1].residuals(self._state_among(state, k))
            values = values._replace(shared_value=values.shared_value[:, :0])
            results.append(values if k < CACHED_PROBLEM_PARTS else values._replace(rows=None))
        return results

    def _state_among(self, state: Any, k: int) -> Any:
        """What a part needs of a state."""
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
) -> Solution:
    """The same of few runs; values : the residuals at the start, where they are known."""
    n_runs = _count(start)
    cost, steps = np.full(n_runs, np.inf), np.zeros(n_runs, dtype=int)
    stop = [Stop.RUNNING] * n_runs
    active, search = np.arange(n_runs), _Search.begun(n_runs)
    state, part, here, at = start, problem, start, values
    normal: Array | None = None
    for _ in range(max_steps):
        new, gain = _try(part, here, at, search, tolerance)
        steps[active] += 1
        here, at = _accepted_state(here, new, gain)
        if active.size == n_runs:
            state, normal = here, gain.normal
        else:
            state, normal = put(state, active, here), put(cast(Array, normal), active, gain.normal)
        cost[active], search = gain.cost, gain.search
        for run, reason in zip(active, gain.stop, strict=True):
            stop[run] = reason
        keep = np.array([k for k, reason in enumerate(gain.stop) if reason is Stop.RUNNING])
        if keep.size == 0:
            break
        if keep.size < active.size:
            active = active[keep]
            part, here, at = problem.select(active), take(state, active), None
            search = take(search, keep)
    final = tuple(Stop.STEPS if s is Stop.RUNNING else s for s in stop)
    return Solution(state, cost, steps, final, cast(Array, normal))


def _accepted_state(here: Any, new: Any, gain: _Gain) -> tuple[Any, list[Values] | None]:
    """The state with the steps that were accepted, and the residuals there where they are known."""
    if gain.accepted.all():
        return new, gain.values
    runs = np.flatnonzero(gain.accepted)
    return put(here, runs, take(new, runs)), None


class _Search(NamedTuple):
    """Where a search stands, (B,) each.

    damping : of the next step. growth : by how much more of it, should that be refused. size : of
    the last step's change of all residuals; infinite where it was damped or refused.
    """

    damping: Array
    growth: Array
    size: Array

    @classmethod
    def begun(cls, n_runs: int) -> _Search:
        """Before the first step."""
        return cls(*(np.full(n_runs, x) for x in (LEAST_DAMPING, DAMPING_GROWTH, np.inf)))

    def after(self, accepted: Booleans, ratio: Array, size: Array) -> _Search:
        """After a step of a size that kept a ratio of what it promised."""
        less = np.where(ratio > 0.5, 0.05, np.where(ratio > 0.2, 0.5, 2.0))
        damping = self.damping * np.where(accepted, less, self.growth)
        return _Search(
            np.clip(damping, LEAST_DAMPING, MOST_DAMPING),
            np.where(accepted, DAMPING_GROWTH, DAMPING_GROWTH * self.growth),
            np.where(accepted & self.undamped, size, np.inf),
        )

    @property
    def undamped(self) -> Booleans:
        """Whether the next step is a full one."""
        return self.damping <= LEAST_DAMPING

    def remaining(self, size: Array) -> Array:
        """How much is left to go after a full step of this size. Steps that shrink by a factor q
        each leave ``q / (1 - q)`` of the last (Hairer and Wanner, Solving Ordinary Differential
        Equations II, IV.8).
        """
        shrinking = self.undamped & np.isfinite(self.size) & (size < self.size)
        return np.where(shrinking, size**2 / np.where(shrinking, self.size - size, 1.0), np.inf)


class _Gain(NamedTuple):
    """What came of a step. values : each part's residuals after it; None where it was not tried."""

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
) -> tuple[Any, _Gain]:
    """One damped step of every run; returns the states after it and what came of it.

    values : the residuals at the state, where they are known.
    """
    damping = search.damping
    normal = normal_equations(problem.rows(state, values), damping)
    shared, own = normal.step(damping)
    descent, size2 = normal.promise(shared, own)
    cost, promised = normal.cost, descent - size2
    size, unit = np.sqrt(size2), 1 + 1e-3 * np.sqrt(cost)
    # a step near the end changes the cost by less than its rounding, and then it cannot be judged
    small = (size < tolerance * unit) | (np.abs(promised) < COST_ROUNDING * cost)
    last = search.remaining(size) < tolerance * unit
    usable = [part.usable for part in normal.parts]
    any_usable = total(np.sum(part, axis=(1, 2)) for part in usable) > 0
    trial = problem.problem.retract(state, shared, np.concatenate(own, axis=1))
    if np.all(search.undamped & any_usable & (small | last)):
        # full steps as short as these keep what they promise: nothing is left to be tried
        every = np.ones(len(cost), dtype=bool)
        stop = [Stop.CONVERGED] * len(cost)
        return trial, _Gain(every, None, cost - promised, search, normal.matrix, stop)
    values = problem.residuals(trial)
    cost_trial = total(
        cost_of(part.value, part.shared_value, use)
        for part, use in zip(values, usable, strict=True)
    )
    ratio = (cost - cost_trial) / np.maximum(promised, 1e-300)
    accepted = cost_trial <= cost * (1 + COST_ROUNDING)
    small |= accepted & last
    # a step that is refused for its rounding is better taken: all that is known of it is good
    little = (
        ~accepted & (promised < (REFUSED_STEP_TOLERANCE * unit) ** 2) & (damping < STRONG_DAMPING)
    )
    small, accepted = (
        small | little,
        accepted | (little & (cost_trial - cost < REFUSED_STEP_TOLERANCE**2)),
    )
    stop = [_reason(*run) for run in zip(any_usable, small, accepted, damping, strict=True)]
    cost, search = np.where(accepted, cost_trial, cost), search.after(accepted, ratio, size)
    return trial, _Gain(accepted, values, cost, search, normal.matrix, stop)


def _reason(usable: bool, small: bool, accepted: bool, damping: float) -> Stop:
    if not usable:
        return Stop.NOT_FINITE
    if small and damping < STRONG_DAMPING:
        return Stop.CONVERGED
    return Stop.STALLED if not accepted and damping >= MOST_DAMPING else Stop.RUNNING
