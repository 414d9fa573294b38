"""Levenberg-Marquardt search of many runs at once, each of which stops by itself.

**States and data of many runs** are arrays, or frozen dataclasses or named tuples of arrays, whose
leading axis counts the runs; see :func:`take`, :func:`put` and :func:`of_runs`.

**Robust weights**: Geman-McClure weights for a search (:func:`soft_weights`), weights with a finite
cut for the estimate (:func:`final_weights`) with their loss (:func:`final_loss`).
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
"""Damping at the start of a search, in effect none: near a solution, where most starts are, the
full step is best, and any damping costs steps along weakly determined directions."""
DAMPING_GROWTH = 8.0
"""Factor on the damping after a refused step, and on that factor after each further refusal in a
row: from LEAST_DAMPING to 0.01 in five refusals."""
STRONG_DAMPING = 1e-2
"""Damping from which on a step is small in any case, so that its size does not show convergence."""
MOST_DAMPING = 1e9
"""Damping beyond which a step is below rounding: there is no step downhill."""
STEP_TOLERANCE = 1e-7
"""Change of all fitted values together, in standard deviations, below which a step ends the search:
a ten-millionth of what the noise changes, and above their rounding of about 1e-9."""
REFUSED_STEP_TOLERANCE = 1e-3
"""Predicted change below which a refused step ends the search, in standard deviations: the rounding
of the residuals where one direction is determined a million times worse than the others."""
COST_ROUNDING = 1e-13
"""Relative rounding of the cost."""
CACHED_PROBLEM_PARTS = 16
"""Parts of a problem whose intermediate results are stored with their residuals, so that the next
step continues from them: some 5 MB each. Further parts are evaluated again, so that memory does not
grow with the problem."""

FULL_WEIGHT_DISTANCE, NO_WEIGHT_DISTANCE = 4.0, 6.5
"""Distances in standard deviations up to which final weights are 1, and from which on they are 0.
Of pairs of residuals without outliers 3 in 10^4 lose part of their weight and none all of it, so
the efficiency is above 0.999."""

Runs = TypeVar("Runs")
"""An array, or a frozen dataclass or named tuple of arrays, with a leading axis of runs."""


class Stop(Enum):
    """Reason why a search stopped; the value is the text that the user reads."""

    CONVERGED = "converged"
    STALLED = (
        "no step downhill was found; check the start, the stations' poses first, and that the "
        "readings belong to the photographs"
    )
    STEPS = "the step limit was reached before convergence; start nearer, or allow more steps"
    NOT_FINITE = "nothing can be predicted at the start; check the stations' poses and the drawing"
    RUNNING = "not finished"


class Values(NamedTuple):
    """Residuals at a state.

    value : (B, K, r), NaN where nothing can be predicted.
    shared_value : (B, c) of the rows on shared unknowns only.
    rows : function that completes the Jacobian from the residuals' intermediate results; None where
    these are not stored.
    """

    value: Array
    shared_value: Array
    rows: Callable[[], Compact] | None = None


class LeastSquares(Protocol):
    """Contract of a least-squares problem; ``state`` is the problem's own type, opaque here."""

    def residuals(self, state: Any) -> Values:
        """Residuals at a state."""
        ...

    def linearize(self, state: Any) -> Linear:
        """Residuals and exact Jacobian; rows that cannot be predicted are zero."""
        ...

    def retract(self, state: Any, shared: Array, own: Array) -> Any:
        """Retract the state along steps (B, na) of the shared and (B, K, d) of the own unknowns."""
        ...

    def select(self, runs: Integers) -> LeastSquares:
        """The problem restricted to some runs."""
        ...


class Divisible(LeastSquares, Protocol):
    """A problem that can be restricted to some configurations, so that the Jacobian of all of them
    never stands in memory at once.
    """

    def among(self, configurations: slice) -> Divisible:
        """The problem restricted to some configurations, with all shared unknowns."""
        ...

    def state_among(self, state: Any, configurations: slice) -> Any:
        """The state restricted to some configurations."""
        ...

    def compact(self, state: Any) -> Compact:
        """Residuals and exact Jacobian, with strips stored compactly."""
        ...

    @property
    def extent(self) -> tuple[int, int]:
        """Number of configurations K, and of the rows of each, r."""
        ...


def _is_divisible(problem: LeastSquares) -> TypeGuard[Divisible]:
    """Whether a problem is :class:`Divisible`.

    One attribute is tested, since isinstance on the protocol takes a tenth of the millisecond that
    a small step takes.
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
    """Data of some runs; arrays that all runs share (leading axis of length 1) stay."""
    return _each(lambda array: array if len(array) == 1 else array[runs], data)


def _count(state: Any) -> int:
    """Number of runs in a state."""
    if isinstance(state, np.ndarray):
        return len(state)
    first = state[0] if isinstance(state, tuple) else getattr(state, fields(state)[0].name)
    return len(cast(Array, first))


def _each(function: Callable[..., Array], first: Runs, *others: Runs) -> Runs:
    """Apply a function to corresponding arrays of one or more states."""
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

    state : final state.
    cost : (B,) final cost; predicted by the linear model where the last step needed no trial.
    steps : (B,) number of steps.
    stop : reason of each run.
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
) -> Solution:
    """Minimise the sum of squares from ``start``, all runs at once.

    tolerance : change of the fitted values, in standard deviations, that ends a run.
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
    """A problem and its restrictions to groups of configurations that fit into the processor's
    cache.
    """

    problem: LeastSquares
    parts: list[tuple[slice, LeastSquares]]

    @classmethod
    def of(cls, problem: LeastSquares, n_runs: int, count: int, rows: int) -> _Divided:
        """Divide a problem of ``n_runs`` runs and ``count`` configurations of ``rows`` rows, if it
        is :class:`Divisible`.
        """
        cuts = divisions(count, n_runs * rows)
        if not _is_divisible(problem) or len(cuts) < 2:
            return cls(problem, [(slice(0, count), problem)])
        return cls(problem, [(cut, problem.among(cut)) for cut in cuts])

    def select(self, runs: Integers) -> _Divided:
        """The same division for some runs."""
        parts = [(cut, part.select(runs)) for cut, part in self.parts]
        return self._replace(problem=self.problem.select(runs), parts=parts)

    def rows(self, state: Any, values: list[Values] | None) -> Iterator[Compact]:
        """Residuals and Jacobian of one part after the other.

        values : residuals of each part at the state, where they have been evaluated.
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
        """Residuals of each part; those of the shared rows only in the first part."""
        results = [self.parts[0][1].residuals(self._state_among(state, 0))]
        for k in range(1, len(self.parts)):
            values = self.parts[k][1].residuals(self._state_among(state, k))
            values = values._replace(shared_value=values.shared_value[:, :0])
            results.append(values if k < CACHED_PROBLEM_PARTS else values._replace(rows=None))
        return results

    def _state_among(self, state: Any, k: int) -> Any:
        """State restricted to the configurations of part k."""
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
    """Minimise a divided problem; values : its residuals at the start, where they were
    evaluated.
    """
    n_runs = _count(start)
    cost, steps = np.full(n_runs, np.inf), np.zeros(n_runs, dtype=int)
    stop = [Stop.RUNNING] * n_runs
    active, search = np.arange(n_runs), _Search.begun(n_runs)
    state, part, here, at = start, problem, start, values
    normal: Array | None = None
    for _ in range(max_steps):
        # a step of the active runs
        new, gain = _try(part, here, at, search, tolerance)
        steps[active] += 1
        here, at = _accepted_state(here, new, gain)
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


def _accepted_state(here: Any, new: Any, gain: _Gain) -> tuple[Any, list[Values] | None]:
    """State after the accepted steps, and its residuals where they were evaluated."""
    if gain.accepted.all():
        return new, gain.values
    runs = np.flatnonzero(gain.accepted)
    return put(here, runs, take(new, runs)), None


class _Search(NamedTuple):
    """Damping schedule of each run, (B,) each.

    damping : of the next step.
    growth : factor on the damping if the next step is refused.
    size : change of all residuals by the last step; infinite where that was damped or refused.
    """

    damping: Array
    growth: Array
    size: Array

    @classmethod
    def begun(cls, n_runs: int) -> _Search:
        """Schedule before the first step."""
        return cls(*(np.full(n_runs, x) for x in (LEAST_DAMPING, DAMPING_GROWTH, np.inf)))

    def after(self, accepted: Booleans, ratio: Array, size: Array) -> _Search:
        """Schedule after a step.

        accepted, ratio, size : (B,) whether the step was accepted, actual relative to predicted
        decrease of the cost, and change of all residuals.
        """
        less = np.where(ratio > 0.5, 0.05, np.where(ratio > 0.2, 0.5, 2.0))
        damping = self.damping * np.where(accepted, less, self.growth)
        return _Search(
            np.clip(damping, LEAST_DAMPING, MOST_DAMPING),
            np.where(accepted, DAMPING_GROWTH, DAMPING_GROWTH * self.growth),
            np.where(accepted & self.undamped, size, np.inf),
        )

    @property
    def undamped(self) -> Booleans:
        """Whether the next step is a full Gauss-Newton step, (B,)."""
        return self.damping <= LEAST_DAMPING

    def remaining(self, size: Array) -> Array:
        """Estimated remaining distance (B,) after a full step of this size, infinite if unknown.

        Steps that shrink by a factor q each leave ``q / (1 - q)`` of the last one (Hairer and
        Wanner, Solving Ordinary Differential Equations II, IV.8).
        """
        shrinking = self.undamped & np.isfinite(self.size) & (size < self.size)
        return np.where(shrinking, size**2 / np.where(shrinking, self.size - size, 1.0), np.inf)


class _Gain(NamedTuple):
    """Outcome of one step of B runs.

    values : residuals of each part after the step; None where the step was not tried.
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
) -> tuple[Any, _Gain]:
    """One damped step of every run: the states after it, and its outcome.

    values : residuals of each part at the state, where they were evaluated.
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
    small = (size < tolerance * unit) | (np.abs(promised) < COST_ROUNDING * cost)
    last = search.remaining(size) < tolerance * unit
    usable = [part.usable for part in normal.parts]
    any_usable = total(np.sum(part, axis=(1, 2)) for part in usable) > 0
    trial = problem.problem.retract(state, shared, np.concatenate(own, axis=1))
    if np.all(search.undamped & any_usable & (small | last)):
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
    accepted = cost_trial <= cost * (1 + COST_ROUNDING)
    small |= accepted & last
    # a step that is refused by rounding only is taken: the linear model is the better evidence
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
    """Stop reason of one run after a step."""
    if not usable:
        return Stop.NOT_FINITE
    if small and damping < STRONG_DAMPING:
        return Stop.CONVERGED
    return Stop.STALLED if not accepted and damping >= MOST_DAMPING else Stop.RUNNING


def soft_weights(distance: Array, scale: Array | float) -> Array:
    """Geman-McClure weights ``(c^2 / (c^2 + d^2))^2`` of distances d at scale c; 0 where nothing
    can be predicted.

    A search starts with a scale so wide that all measurements have weight, and narrows it.
    """
    square = scale**2
    weight = (square / (square + np.nan_to_num(distance) ** 2)) ** 2
    return np.where(np.isfinite(distance), weight, 0.0)


def final_weights(distance: Array) -> Array:
    """Weights of distances in standard deviations: 1 up to FULL_WEIGHT_DISTANCE, then a cosine down
    to 0 at NO_WEIGHT_DISTANCE; 0 where nothing can be predicted.
    """
    x = np.clip(
        (distance - FULL_WEIGHT_DISTANCE) / (NO_WEIGHT_DISTANCE - FULL_WEIGHT_DISTANCE), 0, 1
    )
    return np.where(np.isfinite(distance), 0.5 * (1 + np.cos(np.pi * x)), 0.0)


def final_loss(distance: Array) -> Array:
    """Robust loss of distances whose weights are :func:`final_weights`: ``2 int_0^d w(t) t dt``.

    It takes the place of the squared distance and is constant from NO_WEIGHT_DISTANCE on: the loss
    of a rejected measurement, and of one that cannot be predicted.
    """
    width = NO_WEIGHT_DISTANCE - FULL_WEIGHT_DISTANCE
    x = np.minimum(np.where(np.isfinite(distance), distance, np.inf), NO_WEIGHT_DISTANCE)
    angle = np.pi * (x - FULL_WEIGHT_DISTANCE) / width
    beyond = (x**2 + FULL_WEIGHT_DISTANCE**2) / 2 + width / np.pi * (
        x * np.sin(angle) + width / np.pi * (np.cos(angle) - 1)
    )
    return np.where(x < FULL_WEIGHT_DISTANCE, x**2, beyond)
