"""Noise scale of each kind of rows from the residuals: variance components.

With H the hat matrix of all rows in standard deviations and R = 1 - H, the residuals ``r_k`` of a
kind have the covariance ``M = R_kk`` if all noise is as stated. As R is idempotent, that is

    M = M M + F + O,      M M by the kind's own noise, F by the prior, O by all other rows,

and where the noise of the kind is s times, and that of all others t times the stated one, then
``s^2 M M + F + t^2 O``. In the directions u with ``u^T M u = 1`` that diagonalize M M, the
residuals are independent normal numbers z of the variances

    v = s^2 own + t^2 others + fixed,      own + others + fixed = 1 for each,

and contain all information about s: restricted maximum likelihood (Patterson and Thompson 1971). F
is approximated by its diagonal there; it is small beside the others wherever the data contain
information about s. Directions of which F is nearly all are not part of the likelihood: unknowns
absorb them but for the prior's errors, of which the second order, which is not in M, may be many
times the first (nominal errors of degrees).

t is unknown, a nuisance parameter. Errors of the edges of a line are correlated, and no other
residual shows how much of their common error a pose absorbs; so where readings are far sharper than
poses are measured, a change of t by one hundredth would change the sum of all z^2 by as much as all
of the readings' noise does. Directions in which poses are determined well and badly separate s from
t. The interval of s is that of the profile likelihood, with the best t for every s, up to a factor
at which the others' noise would be refused; it is wide where the directions contain little
information.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pkmcal.arrays import Array, Booleans
from pkmcal.identify.covariance import Information
from pkmcal.identify.problem import Problem
from pkmcal.identify.row_sums import GroupRows, group_rows
from pkmcal.levels import NEGLIGIBLE, UNEXPLAINED_SCALE
from pkmcal.measurements.rows import RowGroups

LEAST_NOISE_FREEDOM = 5.0
"""Degrees of freedom n below which a sum of squares determines no noise: the relative standard
deviation 1 / sqrt(2 n) of the noise is a third; it is 0.45 with half, 0.22 with twice this
number."""


@dataclass(frozen=True)
class NoiseOptions:
    """Constants of the restricted likelihood of a noise."""

    # probability of contradicting a noise that is stated correctly: a negligible one, as of cells
    # of the report's residuals, shared by the three kinds of rows
    contradiction_chance: float = NEGLIGIBLE / 3
    # largest factor on a noise in one step, beyond which the linear model no longer holds
    largest_step: float = 10.0
    # largest number of rows whose residuals are decorrelated together. More rows are handled in
    # groups of configurations: variances remain exact, but correlations between groups, which are
    # due to the few shared unknowns, are neglected
    largest_group: int = 400
    # eigenvalue of M below which it is rounding: the unknowns absorb the whole direction
    rounding: float = 1e-10
    # grid of log s^2: its end to either side (the lower one stands for zero), and number of values
    largest_log_variance: float = 20.0
    variances: int = 41
    # largest t and 1 / t: a noise that is farther from the one in use is not tenable, so that it
    # explains no residuals of another kind
    largest_others: float = UNEXPLAINED_SCALE
    # grid of log t^2 for each s^2, and the steps that refine its best value
    log_others: tuple[float, ...] = (-2.0, 0.0, 2.0)
    others_steps: tuple[float, ...] = (1.0, 0.25, 0.0625)
    # bisections of an interval of log s^2
    halvings: int = 8
    # bisections whose points are evaluated together: the likelihood of fifteen points takes hardly
    # longer than that of one
    halvings_at_once: int = 4

    @property
    def log_variances(self) -> Array:
        """Logarithms of s^2 that are tried."""
        end = self.largest_log_variance
        return np.linspace(-end, end, self.variances)

    @property
    def least_variance(self) -> float:
        """Lower bound of a variance."""
        return float(np.exp(-self.largest_log_variance))


NOISE = NoiseOptions()


@dataclass(frozen=True)
class Components:
    """Residuals of each kind of rows in B solutions.

    chi2 : (B, 4) sums of squared residuals.
    freedom : (B, 4) tr R_kk, expectation of ``chi2`` at the stated noise.
    """

    chi2: Array
    freedom: Array


def components(info: Information, weight: RowGroups[Array]) -> Components:
    """Sums of squares and degrees of freedom of a solution; weight : (B, K, G) in use.

    H is Q Q^T of the own unknowns plus S S^T of the shared ones, orthogonal to each other;
    undetermined directions are not part of it.
    """
    problem, sums, half = info.problem, info.by_kind, info.root
    n_readings = float(info.state.T_base_platform.shape[1] * problem.layout.n_readings)
    count = np.stack([*counts(problem, weight), np.full(len(half), n_readings)], axis=-1)
    kinds = np.flatnonzero(count.any(axis=0))
    shared = np.zeros(count.shape)
    covariance = half @ half.mT
    shared[:, kinds] = np.einsum("bkij,bij->bk", sums.normal[:, kinds], covariance)
    return Components(chi2=sums.chi2, freedom=count - sums.trace - shared)


def counts(problem: Problem, weight: RowGroups[Array]) -> RowGroups[Array]:
    """Number of residuals of each kind, weighted by their robust weights, (B,)."""
    parts = zip(problem.row_groups, weight, strict=True)
    return RowGroups(*(np.sum(part * kind.count, axis=(1, 2)) for kind, part in parts))


@dataclass(frozen=True)
class NoiseShares:
    """Independent residuals of a kind in B runs, with the shares of their variances; see the
    module's docstring.

    z : (B, n).
    own, others, fixed : (B, n). Padding has z = 0 and the fixed share 1.
    """

    z: Array
    own: Array
    others: Array
    fixed: Array
    options: NoiseOptions = NOISE

    @property
    def best(self) -> Array:
        """Factor s (B,) of the highest likelihood, 0 where that is the smallest value of the
        grid.
        """
        return np.sqrt(self.maximum_likelihood[0])

    def factor(self) -> Array:
        """Factor (B,) on the kind's noise for the next step.

        1 where the data allow the present noise and any smaller one: they then contain no estimate,
        and a noise of zero would give too small standard deviations.
        """
        low, high = self.interval()
        most = self.options.largest_step
        step = np.clip(self.best, 1 / most, most)
        return np.where((low == 0) & (high >= 1), 1.0, step)

    def freedom(self, s: Array) -> Array:
        """Effective number of residuals (B,) that determine s (B,): the sum of the squared shares
        of s in their variances.
        """
        return self._freedom((s**2)[:, None])[:, 0]

    def interval(self, chance: float | None = None) -> tuple[Array, Array]:
        """Confidence interval of the factor (B,) on the kind's noise, by the likelihood ratio.

        chance : 1 - confidence level, by default ``contradiction_chance``.

        Bounds are 0 and infinity where there is none. The lower bound is 0 where fewer than
        LEAST_NOISE_FREEDOM residuals determine the best factor, and the upper bound is at least the
        smallest factor that this number of residuals would determine.
        """
        chance = self.options.contradiction_chance if chance is None else chance
        if chance not in self._intervals:
            self._intervals[chance] = self._interval(chance)
        return self._intervals[chance]

    def contradicts(self) -> Booleans:
        """Whether the data exclude the present noise of the kind, (B,)."""
        low, high = self.interval()
        return (low > 1) | (high < 1)

    def stated_chance(self, scale: Array) -> Array:
        """P-value (B,) of all noise being as stated, by the likelihood ratio against the best noise
        of this kind and of all others.

        Directions in which the kind's own noise is negligible are left out: they show that of the
        others, and contain what the prior alone determines.

        scale : (B,) factor on the kind's stated noise in use.
        """
        from scipy.special import chdtrc

        informative = self.own > NEGLIGIBLE * self.own.max(axis=1, keepdims=True, initial=0.0)
        shares = self._restricted_to(informative & self._in_likelihood)
        variance = shares.own / scale[:, None] ** 2 + shares.others + shares.fixed
        stated = np.sum(np.log(variance) + shares.z**2 / variance, axis=-1)
        return chdtrc(2, np.maximum(stated - shares.maximum_likelihood[1], 0.0))

    def _restricted_to(self, directions: Booleans) -> NoiseShares:
        """Only some directions (B, n), the others as padding."""
        z, own, others = (
            np.where(directions, part, 0.0) for part in (self.z, self.own, self.others)
        )
        return NoiseShares(z, own, others, np.where(directions, self.fixed, 1.0), self.options)

    @property
    def _in_likelihood(self) -> Booleans:
        """Directions (B, n) in the likelihood: all but those of the prior alone, in which the
        data's share would be negligible with the largest tenable noise, too.
        """
        most = (self.own + self.others) * self.options.largest_others**2
        return most > NEGLIGIBLE * self.fixed

    @cached_property
    def _by_data(self) -> NoiseShares:
        """The directions in the likelihood."""
        return self._restricted_to(self._in_likelihood)

    @cached_property
    def _intervals(self) -> dict[float, tuple[Array, Array]]:
        """Intervals computed so far, by ``chance``."""
        return {}

    def _interval(self, chance: float) -> tuple[Array, Array]:
        """Compute :meth:`interval`."""
        from scipy.special import chdtri

        n_runs, n = self.z.shape
        if not n:
            return np.zeros(n_runs), np.full(n_runs, np.inf)
        (best, least), tried = self.maximum_likelihood, self.options.log_variances
        level = least + chdtri(1, chance)
        inside = self._grid <= level[:, None]
        with np.errstate(divide="ignore"):
            middle = np.clip(np.log(best), tried[0], tried[-1])
        # brackets of both bounds: outermost grid value inside the interval, and its neighbour
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
        """s^2 (B, G) where -2 log likelihood crosses a level (B,).

        inside, outside : (B, G) logarithms of s^2 below and above the level.
        """
        for _ in range(self.options.halvings):
            middle = (inside + outside) / 2
            below = self._profile(np.exp(middle))[0] <= level[:, None]
            inside, outside = np.where(below, middle, inside), np.where(below, outside, middle)
        return np.exp((inside + outside) / 2)

    @cached_property
    def _least_determined(self) -> Array:
        """Smallest s^2 (B,) that enough residuals would determine, infinite for none."""
        low, high = (np.full(len(self.z), end) for end in self.options.log_variances[[0, -1]])
        enough_at_all = self._freedom(np.exp(high)[:, None])[:, 0] > LEAST_NOISE_FREEDOM
        # bisection, all points of several halvings in one evaluation
        at_once = self.options.halvings_at_once
        parts = 2**at_once
        for _ in range(2 * self.options.halvings // at_once):
            tried = np.linspace(low, high, parts + 1, axis=1)
            enough = self._freedom(np.exp(tried[:, 1:-1])) > LEAST_NOISE_FREEDOM
            run, at = np.arange(len(low)), np.zeros(len(low), dtype=int)
            for half in (parts >> k for k in range(1, at_once + 1)):
                at = np.where(enough[run, at + half - 1], at, at + half)
            low, high = tried[run, at], tried[run, at + 1]
        return np.where(enough_at_all, np.exp(high), np.inf)

    def _freedom(self, square: Array) -> Array:
        """:meth:`freedom` (B, G) of s^2 (B, G)."""
        others = np.exp(self._profile(square)[1])[..., None]
        shares = self._by_data
        own = square[..., None] * shares.own[:, None]
        variance = own + others * shares.others[:, None] + shares.fixed[:, None]
        return np.sum((own / np.maximum(variance, self.options.least_variance)) ** 2, axis=-1)

    @cached_property
    def _grid(self) -> Array:
        """-2 log likelihood (B, G) of the values of s^2 tried, the first of which is zero."""
        tried = np.exp(self.options.log_variances)
        tried[0] = 0.0
        return self._profile(np.broadcast_to(tried, (len(self.z), len(tried))))[0]

    @cached_property
    def maximum_likelihood(self) -> tuple[Array, Array]:
        """s^2 (B,) of the highest likelihood, and -2 log likelihood there."""
        run, at = np.arange(len(self.z)), np.argmin(self._grid, axis=1)
        tried = self.options.log_variances
        last, step = len(tried) - 1, tried[1] - tried[0]
        log, value = tried[at], self._grid[run, at]
        for _ in range(self.options.halvings):
            step /= 2
            near = np.stack([log - step, log + step], axis=1)
            values = self._profile(np.exp(near))[0]
            k = np.argmin(values, axis=1)
            better = (values[run, k] < value) & (at > 0) & (at < last)
            log = np.where(better, near[run, k], log)
            value = np.where(better, values[run, k], value)
        return np.where(at > 0, np.exp(log), 0.0), value

    def _profile(self, square: Array) -> tuple[Array, Array]:
        """-2 log profile likelihood (B, G) of s^2 (B, G), and the best log t^2."""
        shares = self._by_data
        own = square[..., None] * shares.own[:, None] + shares.fixed[:, None]
        others, squares = shares.others[:, None], np.square(shares.z)[:, None]
        options, least_variance = self.options, self.options.least_variance

        def value(log: Array) -> Array:
            """-2 log likelihood (B, G) at log t^2 (B, G)."""
            variance = np.maximum(own + np.exp(log)[..., None] * others, least_variance)
            return np.sum(np.log(variance) + squares / variance, axis=-1)

        end = 2 * np.log(options.largest_others)
        tried = np.array(options.log_others)
        values = np.stack([value(np.full(square.shape, log)) for log in tried])
        best, log = values.min(axis=0), tried[values.argmin(axis=0)]
        for step in options.others_steps:
            middle, centre = best, log
            before, after = np.maximum(centre - step, -end), np.minimum(centre + step, end)
            a, b = value(before), value(after)
            # vertex of the parabola through the three points, at most a step away
            bend = a + b - 2 * middle
            direction = np.where(
                bend > 0, (a - b) / np.where(bend > 0, bend, 1.0) / 2, np.sign(a - b)
            )
            there = np.clip(centre + step * np.clip(direction, -1, 1), -end, end)
            here = value(there)
            for new, place in ((a, before), (b, after), (here, there)):
                log, best = np.where(new < best, place, log), np.minimum(new, best)
        return best, log


def noise_shares(info: Information, kind: int, options: NoiseOptions = NOISE) -> NoiseShares:
    """Independent residuals of the readings, poses or links at a solution."""
    rows = group_rows(info.problem, info.state, kind)
    # The normal matrix holds half of the digits only: by its root, M would get directions of
    # rounding, which the unknowns absorb, but which seem to show that the others' noise is small.
    half = info.root_of_rows
    in_prior = info.problem.prior @ half
    of_prior = in_prior.mT @ in_prior
    runs = [
        _of_run(GroupRows(*(part[run] for part in rows)), half[run], of_prior[run], options)
        for run in range(len(half))
    ]
    most = max(len(run[0]) for run in runs)
    padding = 0.0, 0.0, 0.0, 1.0
    z, own, others, fixed = (
        np.stack([np.pad(run[k], (0, most - len(run[k])), constant_values=fill) for run in runs])
        for k, fill in enumerate(padding)
    )
    return NoiseShares(z, own, others, fixed, options)


def _of_run(
    rows: GroupRows, half: Array, fixed: Array, options: NoiseOptions
) -> tuple[Array, Array, Array, Array]:
    """z, own, others and fixed (n,) of one run."""
    n_configurations, n = rows.value.shape
    used = (rows.value != 0) | rows.own.any(axis=-1) | rows.shared.any(axis=-1)
    shared = rows.shared @ half
    every = shared.reshape(-1, shared.shape[-1])
    across = every.T @ every
    size = max(options.largest_group // max(n, 1), 1)
    parts = [
        _independent(rows.own[cut], shared[cut], rows.value[cut], used[cut], across, fixed, options)
        for cut in (slice(k, k + size) for k in range(0, n_configurations, size))
    ]
    z, own, others, fixed = (np.concatenate(part) for part in zip(*parts, strict=True))
    return z, own, others, fixed


def _independent(
    own: Array,
    shared: Array,
    value: Array,
    used: Booleans,
    across: Array,
    fixed: Array,
    options: NoiseOptions,
) -> tuple[Array, Array, Array, Array]:
    """z, own, others and fixed (n,) of the rows of some configurations.

    own, shared : (K, n, d) and (K, n, na) rows in orthonormal bases.
    value, used : (K, n) residuals, and whether they are in use.
    across : (na, na) product of all configurations' shared rows.
    fixed : (na, na) product of the prior's rows in the same basis.
    """
    n_configurations, n, _ = own.shape
    flat_used = used.ravel()
    # M = 1 - H of these rows, and M M, which also contains the kind's rows outside this group
    blocks = np.zeros((n_configurations, n, n_configurations, n))
    each = np.arange(n_configurations)
    blocks[each, :, each] = np.eye(n) - own @ own.mT
    d = blocks.reshape((n_configurations * n,) * 2)[np.ix_(flat_used, flat_used)]
    s, r = shared.reshape(-1, shared.shape[-1])[flat_used], value.ravel()[flat_used]
    residual = d - s @ s.T
    ds = d @ s
    by_own = d @ d - ds @ s.T - s @ ds.T + s @ across @ s.T
    # directions u with u^T M u = 1
    size, turn = np.linalg.eigh(residual)
    some = size > options.rounding
    unit = turn[:, some] / np.sqrt(size[some])
    # that diagonalize M M
    of_own, turn = np.linalg.eigh(unit.T @ by_own @ unit)
    unit = unit @ turn
    of_own = np.clip(of_own, 0.0, 1.0)
    projected = s.T @ unit
    of_fixed = np.clip(np.sum(projected * (fixed @ projected), axis=0), 0.0, 1.0 - of_own)
    return unit.T @ r, of_own, 1.0 - of_own - of_fixed, of_fixed
