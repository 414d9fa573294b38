"""How large the noise of each kind of rows is, as the data show it: variance components.

With H the hat matrix of all rows in standard deviations and R = 1 - H, a kind's residuals ``r_k``
have the covariance ``M = R_kk`` where every noise is as it counts. As R is idempotent, that is

    M = M M + F + O,      M M by the kind's own noise, F by what is known beforehand, O by all else,

and where the kind's noise is s times, and all else's t times what it counts for,
``s^2 M M + F + t^2 O``. In the directions u with ``u^T M u = 1`` that make M M diagonal, the
residuals are independent normal numbers z of the variances

    v = s^2 own + t^2 others + fixed,      own + others + fixed = 1 for each,

and these hold all that is known of s: restricted maximum likelihood (Patterson and Thompson 1971).
F is taken as diagonal there; it is small beside the others wherever the data say anything of s.

t is unknown. Edges of a line err alike, and how much of that a pose takes up no other residual
shows; so where readings are far sharper than poses are seen, a change of t by a hundredth would do
to the sum of all z^2 what all of the readings' noise does. Directions in which poses are seen well
and badly tell s and t apart. The interval of s is that of the profile likelihood, t at its best for
every s; where the directions tell little it is wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.identify.covariance import Information
from pkmcal.identify.kinds import KindRows, kind_rows
from pkmcal.identify.problem import Problem
from pkmcal.measurements.rows import Kinds

NOISE_CONTRADICTION_CHANCE = 0.01 / 3
"""Probability of contradicting a noise that is stated right: one in a hundred, shared by the three
kinds of rows."""
LEAST_NOISE_FREEDOM = 5.0
"""Degrees of freedom below which a sum of squares tells no noise."""
LARGEST_NOISE_STEP = 10.0
"""Largest factor on a noise in one step: what follows from it is linear no further."""
LARGEST_GROUP = 400
"""Rows whose residuals are made independent together. Of more, those of some configurations are at
a time, each with its exact variance; what they have in common with the others, by the few unknowns
that all share, is left."""
LEAST_RESIDUAL_SHARE = 1e-10
"""Part of a direction that the unknowns leave in the residuals, below which it is rounding."""
LOG_VARIANCES_TRIED = np.linspace(-20.0, 20.0, 41)
"""Logarithms of s^2 that are tried; the least stands for none."""
LEAST_VARIANCE = float(np.exp(LOG_VARIANCES_TRIED[0]))
LOG_OTHERS_TRIED = np.linspace(-14.0, 14.0, 15)
"""Logarithms of t^2 that are tried first for each of them."""
LOG_OTHERS_STEPS = 1.0, 0.25, 0.0625
"""And then about the best of them: steps by which it is looked for more closely."""
INTERVAL_HALVINGS = 8
HALVINGS_AT_ONCE = 4
"""Halvings of one interval whose points are evaluated together: the likelihood of fifteen points
takes hardly longer than that of one."""


@dataclass(frozen=True)
class Components:
    """What B solutions leave of each kind of rows, see the module.

    chi2 : (B, 4) sums of squares of the residuals. freedom : (B, 4) tr R_kk, what they are expected
    to be.
    """

    chi2: Array
    freedom: Array


def components(info: Information, weight: Kinds[Array]) -> Components:
    """Those of a solution with weights (B, K, G) in use.

    H is Q Q^T of the own unknowns and S S^T of the shared ones, orthogonal to each other; what
    nothing fixes has no part in it.
    """
    problem, sums, half = info.problem, info.by_kind, info.root
    n_readings = float(info.state.T_base_platform.shape[1] * problem.layout.n_readings)
    edges, poses, links = counts(problem, weight)
    count = np.stack([edges, poses, np.full(len(half), n_readings), links], axis=-1)
    kinds = np.flatnonzero(count.any(axis=0))
    shared = np.zeros(count.shape)
    covariance = half @ half.mT
    shared[:, kinds] = np.einsum("bkij,bij->bk", sums.normal[:, kinds], covariance)
    return Components(chi2=sums.chi2, freedom=count - sums.trace - shared)


def counts(problem: Problem, weight: Kinds[Array]) -> Kinds[Array]:
    """Residuals of each kind in use, each counted by its robust weight, (B,)."""
    parts = zip(problem.kinds, weight, strict=True)
    return Kinds(*(np.sum(part * kind.count, axis=(1, 2)) for kind, part in parts))


@dataclass(frozen=True)
class NoiseShares:
    """The independent numbers of a kind's residuals, of B runs; see the module.

    z : (B, n). own, others, fixed : (B, n) parts of their variances. Padding has the fixed variance
    1 and is zero.
    """

    z: Array
    own: Array
    others: Array
    fixed: Array

    @property
    def best(self) -> Array:
        """Factor s (B,) of the highest likelihood, 0 where none is better than any."""
        return np.sqrt(self._best[0])

    def factor(self) -> Array:
        """By what to multiply the kind's noise next, (B,). Where the data allow the present noise
        and any smaller one it stays: they know no better, and a noise of nothing promises too much.
        """
        low, high = self.interval()
        step = np.clip(self.best, 1 / LARGEST_NOISE_STEP, LARGEST_NOISE_STEP)
        return np.where((low == 0) & (high >= 1), 1.0, step)

    def freedom(self, s: Array) -> Array:
        """Numbers (B,) that determine s (B,): by the square of the part that it has in the variance
        of each.
        """
        return self._freedom((s**2)[:, None])[:, 0]

    def interval(self, chance: float = NOISE_CONTRADICTION_CHANCE) -> tuple[Array, Array]:
        """Factors on the kind's noise, smallest and largest (B,) each, that the data allow at the
        level 1 - ``chance``; 0 and infinity where they do not tell an end.

        By the likelihood ratio. The least is none where few numbers determine the best, and the
        largest is not less than what enough of them determine.
        """
        if chance not in self._intervals:
            self._intervals[chance] = self._interval(chance)
        return self._intervals[chance]

    def contradicts(self) -> Booleans:
        """Whether the data do not allow the kind's noise as it is, (B,)."""
        low, high = self.interval()
        return (low > 1) | (high < 1)

    @cached_property
    def _intervals(self) -> dict[float, tuple[Array, Array]]:
        """Those computed so far, by their chance."""
        return {}

    def _interval(self, chance: float) -> tuple[Array, Array]:
        """:meth:`interval`, computed."""
        from scipy.special import chdtri

        n_runs, n = self.z.shape
        if not n:
            return np.zeros(n_runs), np.full(n_runs, np.inf)
        (best, least), tried = self._best, LOG_VARIANCES_TRIED
        level = least + chdtri(1, chance)
        inside = self._grid <= level[:, None]
        with np.errstate(divide="ignore"):
            middle = np.clip(np.log(best), tried[0], tried[-1])
        # from the outermost that was tried, or the best itself, to the next one beyond
        a = np.minimum(np.where(inside, tried, np.inf).min(axis=1), middle)
        b = np.maximum(np.where(inside, tried, -np.inf).max(axis=1), middle)
        before = tried[np.maximum(np.searchsorted(tried, a) - 1, 0)]
        after = tried[np.minimum(np.searchsorted(tried, b, side="right"), len(tried) - 1)]
        ends = self._crossing(np.stack([a, b], axis=1), np.stack([before, after], axis=1), level)
        low, high = ends.T
        has_low = (a > tried[0]) & (self.freedom(np.sqrt(best)) > LEAST_NOISE_FREEDOM)
        high = np.where(b < tried[-1], np.maximum(high, self._least_determined), np.inf)
        return np.where(has_low, np.sqrt(low), 0.0), np.sqrt(high)

    def _crossing(self, inside: Array, outside: Array, level: Array) -> Array:
        """s^2 (B, G) where -2 log likelihood crosses a level (B,) between two logarithms of it
        (B, G).
        """
        for _ in range(INTERVAL_HALVINGS):
            middle = (inside + outside) / 2
            below = self._profile(np.exp(middle))[0] <= level[:, None]
            inside, outside = np.where(below, middle, inside), np.where(below, outside, middle)
        return np.exp((inside + outside) / 2)

    @cached_property
    def _least_determined(self) -> Array:
        """s^2 (B,) from which on enough numbers determine s, infinite for none."""
        low, high = (np.full(len(self.z), end) for end in LOG_VARIANCES_TRIED[[0, -1]])
        enough_at_all = self._freedom(np.exp(high)[:, None])[:, 0] > LEAST_NOISE_FREEDOM
        # bisection, all points of several halvings in one evaluation
        parts = 2**HALVINGS_AT_ONCE
        for _ in range(2 * INTERVAL_HALVINGS // HALVINGS_AT_ONCE):
            tried = np.linspace(low, high, parts + 1, axis=1)
            enough = self._freedom(np.exp(tried[:, 1:-1])) > LEAST_NOISE_FREEDOM
            run, at = np.arange(len(low)), np.zeros(len(low), dtype=int)
            for half in (parts >> k for k in range(1, HALVINGS_AT_ONCE + 1)):
                at = np.where(enough[run, at + half - 1], at, at + half)
            low, high = tried[run, at], tried[run, at + 1]
        return np.where(enough_at_all, np.exp(high), np.inf)

    def _freedom(self, square: Array) -> Array:
        """:meth:`freedom` (B, G) of s^2 (B, G)."""
        others = np.exp(self._profile(square)[1])[..., None]
        own = square[..., None] * self.own[:, None]
        variance = own + others * self.others[:, None] + self.fixed[:, None]
        return np.sum((own / np.maximum(variance, LEAST_VARIANCE)) ** 2, axis=-1)

    @cached_property
    def _grid(self) -> Array:
        """-2 log likelihood (B, G) of the variances tried, the first of them none."""
        return self._profile(_variances_tried(len(self.z)))[0]

    @cached_property
    def _best(self) -> tuple[Array, Array]:
        """s^2 (B,) of the highest likelihood, and -2 log likelihood there."""
        run, at = np.arange(len(self.z)), np.argmin(self._grid, axis=1)
        last = len(LOG_VARIANCES_TRIED) - 1
        log, value = LOG_VARIANCES_TRIED[at], self._grid[run, at]
        step = LOG_VARIANCES_TRIED[1] - LOG_VARIANCES_TRIED[0]
        for _ in range(INTERVAL_HALVINGS):
            step /= 2
            near = np.stack([log - step, log + step], axis=1)
            values = self._profile(np.exp(near))[0]
            k = np.argmin(values, axis=1)
            better = (values[run, k] < value) & (at > 0) & (at < last)
            log = np.where(better, near[run, k], log)
            value = np.where(better, values[run, k], value)
        return np.where(at > 0, np.exp(log), 0.0), value

    def _profile(self, square: Array) -> tuple[Array, Array]:
        """-2 log likelihood (B, G) of s^2 (B, G) with t at its best, and log t^2 there."""
        own = square[..., None] * self.own[:, None] + self.fixed[:, None]
        others, squares = self.others[:, None], np.square(self.z)[:, None]

        def value(log: Array) -> Array:
            variance = np.maximum(own + np.exp(log)[..., None] * others, LEAST_VARIANCE)
            return np.sum(np.log(variance) + squares / variance, axis=-1)

        tried = [np.full(square.shape, log) for log in LOG_OTHERS_TRIED]
        values = np.stack([value(log) for log in tried])
        best, log = values.min(axis=0), LOG_OTHERS_TRIED[values.argmin(axis=0)]
        for step in LOG_OTHERS_STEPS:
            middle, centre = best, log
            a, b = value(centre - step), value(centre + step)
            # the vertex of the parabola through the three, no further than a step
            bend = a + b - 2 * middle
            direction = np.where(
                bend > 0, (a - b) / np.where(bend > 0, bend, 1.0) / 2, np.sign(a - b)
            )
            there = centre + step * np.clip(direction, -1, 1)
            here = value(there)
            for new, place in ((a, centre - step), (b, centre + step), (here, there)):
                log, best = np.where(new < best, place, log), np.minimum(new, best)
        return best, log


def noise_shares(info: Information, kind: int) -> NoiseShares:
    """Those of the readings, or of the poses, at a solution."""
    rows, half = kind_rows(info.problem, info.state, kind), info.root
    in_prior = info.problem.prior @ half
    fixed = in_prior.mT @ in_prior
    runs = [
        _of_run(KindRows(*(part[run] for part in rows)), half[run], fixed[run])
        for run in range(len(half))
    ]
    most = max(len(run[0]) for run in runs)
    padding = 0.0, 0.0, 0.0, 1.0
    return NoiseShares(
        *(
            np.stack(
                [np.pad(run[k], (0, most - len(run[k])), constant_values=fill) for run in runs]
            )
            for k, fill in enumerate(padding)
        )
    )


def _of_run(rows: KindRows, half: Array, fixed: Array) -> tuple[Array, Array, Array, Array]:
    """z, own, others and fixed (n,) of one run."""
    n_configurations, n = rows.value.shape
    used = (rows.value != 0) | rows.own.any(axis=-1) | rows.shared.any(axis=-1)
    shared = rows.shared @ half
    every = shared.reshape(-1, shared.shape[-1])
    across = every.T @ every
    size = max(LARGEST_GROUP // max(n, 1), 1)
    parts = [
        _independent(rows.own[cut], shared[cut], rows.value[cut], used[cut], across, fixed)
        for cut in (slice(k, k + size) for k in range(0, n_configurations, size))
    ]
    z, own, others, fixed = (np.concatenate(part) for part in zip(*parts, strict=True))
    return z, own, others, fixed


def _independent(
    own: Array, shared: Array, value: Array, used: Booleans, across: Array, fixed: Array
) -> tuple[Array, Array, Array, Array]:
    """The same of the rows of some configurations.

    own (K, n, d) and shared (K, n, na) in orthonormal bases, value and used (K, n); across (na, na)
    the product of all configurations' shared rows.
    """
    n_configurations, n, _ = own.shape
    flat_used = used.ravel()
    blocks = np.zeros((n_configurations, n, n_configurations, n))
    each = np.arange(n_configurations)
    blocks[each, :, each] = np.eye(n) - own @ own.mT
    d = blocks.reshape((n_configurations * n,) * 2)[np.ix_(flat_used, flat_used)]
    s, r = shared.reshape(-1, shared.shape[-1])[flat_used], value.ravel()[flat_used]
    residual = d - s @ s.T
    ds = d @ s
    by_own = d @ d - ds @ s.T - s @ ds.T + s @ across @ s.T
    size, turn = np.linalg.eigh(residual)
    some = size > LEAST_RESIDUAL_SHARE
    unit = turn[:, some] / np.sqrt(size[some])
    of_own, turn = np.linalg.eigh(unit.T @ by_own @ unit)
    unit = unit @ turn
    of_own = np.clip(of_own, 0.0, 1.0)
    reference_values = s.T @ unit
    of_fixed = np.clip(
        np.sum(reference_values * (fixed @ reference_values), axis=0), 0.0, 1.0 - of_own
    )
    return unit.T @ r, of_own, 1.0 - of_own - of_fixed, of_fixed


def _variances_tried(n_runs: int) -> Array:
    """s^2 (B, G), the first none."""
    tried = np.exp(LOG_VARIANCES_TRIED)
    tried[0] = 0.0
    return np.broadcast_to(tried, (n_runs, len(tried)))
