"""Score tests of model violations.

One-step update
---------------
A *model violation* is a column (:mod:`pkmcal.measurements.columns`) of k numbers that the model
lacks: the scale of an encoder, another lens, a camera that was moved. With J the Jacobian of the
estimate at its minimum, r its residuals and G the derivatives of the rows by the violation, all in
standard deviations, the part of G that J does not explain is ``H = (I - J J^+) G``, and

    value = -(H^T H)^-1 H^T r,    chi2 = r^T H (H^T H)^-1 H^T r,    moved = -J^+ G value

are, to first order, the results of an estimate with the violation as a further unknown (Rao 1948):
its value, the decrease of chi2, and the change of the unknowns. Under the model, chi2 has as many
degrees of freedom as the violation has numbers that the data determine. A number that can only be
positive, such as a compliance, is tested one-sided: chi2 is zero where its value is negative, and
its p-value half of that of the chi-squared distribution otherwise (Chernoff 1954).

Correlated rows
---------------
Rows of one configuration may have correlated errors, for example edges of a hand-held image that
are shifted by light, or measured near a prediction from the image's own pose. So chi2 is divided by
a cluster-robust factor, the scatter of the products u_c over the configurations relative to its
expectation for independent errors, where that exceeds one,

    f = max(1, K / (K - 1) tr((H^T H)^-1 sum over K configurations c of u_c u_c^T) / k),
    u_c = H_c^T (r + H value)_c,

(Liang and Zeger 1986). f is computed only for violations that would be named, and not for single
readings, which belong to one configuration.

Rivals
------
Two violations may have nearly the same rows after projection: over a small arc the sine of an
eccentric encoder is nearly a scale. Violations are therefore compared as hypotheses are
(:mod:`pkmcal.outcome.hypotheses`), by chi2 / 2 less the cost of their numbers: those that a named
violation does not exclude are its rivals, and its finding names them.

Memory
------
The rows are evaluated twice, some configurations at a time: for an orthonormal basis Q of the range
of the shared unknowns, then for the products of all columns with each other, with the basis and
with r. Only these products are stored, whatever the number of configurations.
``H^T H = G^T G - (Q^T G)^T (Q^T G)`` has some fourteen significant digits, of which
OBSERVABLE_SQUARE_SHARE requires ten.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.identify.assembly import Assembled
from pkmcal.identify.covariance import ROWS_RANK_TOLERANCE, Information
from pkmcal.identify.false_alarm import SESSION_FALSE_ALARM, FalseAlarm, Search
from pkmcal.identify.unknowns import BatchState
from pkmcal.levels import NEGLIGIBLE, ROUNDING
from pkmcal.measurements import Column
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS, parameter_cost
from pkmcal.solver.elimination import Linear, eliminate
from pkmcal.solver.ranks import inverse_root

OBSERVABLE_SQUARE_SHARE = 1e-10
"""Squared length of a projected column, relative to the column, below which it is rounding. For a
reading that is a hundred times sharper than the edges the ratio is 1e-4."""
MOST_VIOLATIONS_SOUGHT = 4
"""Largest number of named violations; a session with more has another fault."""


@dataclass(frozen=True)
class Score:
    """Result of a score test.

    chi2, dof : decrease of chi2, and its degrees of freedom.
    chance : p-value of this test.
    adjusted : p-value among all tests of a session (:mod:`pkmcal.identify.false_alarm`), with equal
        shares of the level for the families; NaN for a single test.
    """

    chi2: float
    dof: int
    chance: float
    adjusted: float = float("nan")


@dataclass(frozen=True)
class OneStepUpdate:
    """First-order estimate of a violation.

    value, sigma : (k,) numbers of the violation; NaN, with infinite sigma, where unobservable.
    by_data : (P,) change of the machine's parameters, m and rad.
    """

    value: Array
    sigma: Array
    by_data: Array


class ScoreTests:
    """Score tests at the minimum of an estimate; the first run of the problem of ``info``.

    Violations are numbered: the listed ones in their order, then, with ``singles``, every reading
    of every configuration in the problem by itself, configuration by configuration.
    """

    def __init__(
        self,
        assembled: Assembled,
        info: Information,
        listed: Sequence[Column],
        families: Sequence[int] | None = None,
        *,
        singles: bool = False,
        beside: Sequence[Column] = (),
        variance: float = 1.0,
        false_alarm: FalseAlarm = SESSION_FALSE_ALARM,
    ) -> None:
        """Evaluate the products of all columns.

        listed : violations to test.
        families : number of each listed violation's family, all one family by default. The level of
            the search is shared equally among the families, and within a family among its tests.
            Single readings are a family of their own.
        singles : test every single reading too.
        beside : columns with a prior, which are further unknowns (random effects).
        variance : factor on the variance of all residuals, for further errors.
        false_alarm : level of the session.
        """
        self._false_alarm = false_alarm
        self._variance, self._scatter = variance, dict[int, float]()
        basis = _augmented_basis(assembled, info, beside)
        self._problem = assembled, info, listed, basis, beside
        self._made = _products(assembled, info, listed, basis, singles, beside)
        family = np.zeros(len(listed), dtype=int) if families is None else np.array(families)
        rest = np.full(self._made.single[..., 0].size, family.max(initial=-1) + 1)
        self._family = np.append(family, rest).astype(int)
        self._moves = -(info.problem.free @ basis[info.problem.unknowns.machine])

    def scores(self, freed: Sequence[int] = ()) -> list[Score]:
        """Scores of all violations in their order, with those in ``freed`` as further unknowns.

        The score of a freed violation is zero.
        """
        from scipy.special import chdtrc

        made, chi2, dof = self._made, np.zeros(len(self._family)), np.zeros(len(self._family))
        one_sided = np.zeros(len(self._family), dtype=bool)
        one_sided[: len(made.listed)] = [one.positive for one in self._problem[2]]
        # listed violations, their columns projected orthogonally to the freed ones
        free = _ProjectedColumns.of(made, freed)
        for k in range(len(made.listed)):
            alone = _ProjectedColumns.of(made, [k])
            across = made.across(k, freed)
            value = _ProjectedColumns(
                alone.scale,
                alone.squared - across @ free.inverse @ across.T,
                alone.value - across @ free.inverse @ free.value,
            )
            chi2[k], dof[k] = value.gain
            if one_sided[k] and value.value[0] > 0:  # the number, -value / squared, is negative
                chi2[k] = 0.0
        chi2[len(made.listed) :], dof[len(made.listed) :] = made.gains_of_singles(freed, free)
        chi2 /= self._variance
        for k, factor in self._scatter.items():
            chi2[k] /= factor
        # p-values, and those adjusted for all tests of the session
        dof[list(freed)] = 0
        tests = np.bincount(self._family, weights=dof > 0)
        times = np.count_nonzero(tests) * tests[self._family]
        chance = np.where(dof > 0, chdtrc(np.maximum(dof, 1), chi2), 1.0)
        chance[one_sided & (chi2 > 0)] /= 2
        adjusted = np.where(
            dof > 0, self._false_alarm.adjusted(Search.VIOLATIONS, chance, times), 1.0
        )
        every = zip(*(x.tolist() for x in (chi2, dof.astype(int), chance, adjusted)), strict=True)
        return [Score(*one) for one in every]

    def significant(self, freed: Sequence[int] = ()) -> list[tuple[int, Score]]:
        """Violations that are significant at the level of the session, by forward selection.

        Returns their numbers and scores, the smallest p-value first; each is tested with the
        previous ones and the ``freed`` ones as further unknowns.
        """
        out: list[tuple[int, Score]] = []
        while len(out) < min(MOST_VIOLATIONS_SOUGHT, len(self._family)):
            scores = self.scores([*freed, *(k for k, _ in out)])
            # p-values that underflow are equal: chi2 decides between them
            best = min(range(len(scores)), key=lambda k: (scores[k].adjusted, -scores[k].chi2))
            if scores[best].adjusted > self._false_alarm.level:
                break
            # the cluster factor is computed for candidates only, which are then ranked again
            if best < len(self._made.listed) and best not in self._scatter:
                self._scatter[best] = self._cluster_factor(best, [*freed, *(k for k, _ in out)])
                continue
            out.append((best, scores[best]))
        return out

    def rivals(self, named: int, others: Sequence[int]) -> list[int]:
        """Listed violations that a named one does not exclude, the likeliest first.

        others : violations that are estimated in either case. Variants of the named violation, with
        its code and subject, are no rivals.
        """
        listed, n = self._problem[2], int(np.count_nonzero(self._problem[0].observed))
        meanings = {
            (listed[k].code, listed[k].subject) for k in (named, *others) if k < len(listed)
        }
        free = [k for k, one in enumerate(listed) if (one.code, one.subject) not in meanings]

        def likely() -> list[tuple[float, int]]:
            scores = self.scores(others)
            odds = [one.chi2 / 2 + parameter_cost(one.dof, n) for one in scores]
            least = max(odds[named] - HYPOTHESIS_THRESHOLDS.act, HYPOTHESIS_THRESHOLDS.report)
            return sorted(((odds[k], k) for k in free if odds[k] > least), reverse=True)

        for _, k in likely():
            if k not in self._scatter:
                self._scatter[k] = self._cluster_factor(k, others)
        once: dict[tuple[str, str], int] = {}
        for _, k in likely():
            once.setdefault((listed[k].code, listed[k].subject), k)
        return list(once.values())

    def fitted(self, freed: Sequence[int]) -> list[OneStepUpdate]:
        """One-step updates of some violations, all estimated together."""
        made, free = self._made, _ProjectedColumns.of(self._made, freed)
        value, sigma = -free.inverse @ free.value, np.sqrt(np.diag(free.inverse))
        factors = [self._variance * self._scatter.get(k, 1.0) for k in freed]
        sigma = sigma * np.sqrt(np.repeat(factors, [made.count(k) for k in freed]))
        # a number with a component in an unobservable direction has no estimate
        sigma[free.hidden > NEGLIGIBLE] = np.inf
        cuts = np.cumsum([made.count(k) for k in freed])[:-1]
        return [
            OneStepUpdate(
                np.where(np.isfinite(s), v, np.nan), s, self._moves @ (made.with_basis(k).T @ v)
            )
            for k, v, s in zip(freed, np.split(value, cuts), np.split(sigma, cuts), strict=True)
        ]

    def _cluster_factor(self, k: int, freed: Sequence[int]) -> float:
        """Cluster-robust factor f of a listed violation, with those in ``freed`` as further
        unknowns.
        """
        assembled, info, listed, basis, random = self._problem
        made, problem = self._made, info.problem
        # single readings belong to one configuration and have no cluster factor
        every = [*(f for f in freed if f < len(made.listed)), k]
        of_basis = np.concatenate([made.with_basis(f) for f in every]).T
        free = _ProjectedColumns.of(made, every)
        value, n = -free.inverse @ free.value, made.count(k)
        # the violation's columns projected orthogonally to those of the other violations
        rest, own = slice(0, len(value) - n), slice(len(value) - n, None)
        gain = np.linalg.pinv(free.squared[rest, rest]) @ free.squared[rest, own]
        part = np.concatenate([-gain, np.eye(n)])
        # scatter of u_c over the configurations (clusters)
        throughout = [listed[f] for f in every if listed[f].station is None]
        columns = columns_of(assembled, info.state, throughout)
        by_random, root = columns_of(assembled, info.state, random), prior_root(random)
        scatter, clusters = np.zeros((n, n)), 0
        for cut, piece in zip(problem.cuts, info.pieces(), strict=True):
            linear = piece.linear
            further = [by_random(cut, linear) @ root, columns(cut, linear)]
            rows, remainder = eliminate_beside(linear, np.concatenate(further, axis=-1))
            count = taken = problem.unknowns.count + root.shape[1]
            wide: list[Array] = []
            for f in every:
                number = listed[f].count
                if listed[f].station is None:
                    wide.append(rows[..., taken : taken + number])
                    taken += number
                    continue
                at = made.listed[f].columns
                later = np.arange(cut.start, cut.start + len(rows)) >= made.listed[f].since
                by = rows[..., problem.unknowns.stations][..., at]
                wide.append(np.where(later[:, None, None], by, 0.0))
            by_basis = rows[..., :count] @ basis
            h = np.concatenate(wide, axis=-1) - by_basis @ of_basis
            remainder = remainder - by_basis @ made.by_basis + h @ value
            products = ((h @ part).mT @ remainder[..., None])[..., 0]
            scatter += products.T @ products
            clusters += int(np.count_nonzero(products.any(axis=-1)))
        # one cluster has no scatter
        if clusters < 2:
            return 1.0
        scale = free.scale[own]
        # trace in the observable directions
        size, vectors = np.linalg.eigh(part.T @ free.squared @ part / scale / scale[:, None])
        observable = size > OBSERVABLE_SQUARE_SHARE
        if not observable.any():
            return 1.0
        vectors = vectors[:, observable] / scale[:, None]
        usual = np.mean(np.einsum("ij,ik,kj->j", vectors, scatter, vectors) / size[observable])
        return max(1.0, float(usual) / self._variance * clusters / (clusters - 1))


class _Listed(NamedTuple):
    """Columns of a listed violation, and the first configuration of the problem that it affects."""

    columns: Integers
    since: int


@dataclass(frozen=True)
class _Products:
    """Products of all columns, the configurations' own unknowns eliminated.

    n : number of columns of the stations and of the listed violations. They come first; then the
        basis, then the residuals, w columns in all.
    after : by first configuration, products (n, w) of these n columns with all, summed from that
        configuration on.
    single : (K', m, w) products of the single readings' columns with all.
    among : (K', m, m) products of the single readings' columns with each other.
    by_basis : (nb,) products of the basis with the residuals, prior rows included.
    """

    listed: tuple[_Listed, ...]
    n: int
    after: dict[int, Array]
    single: Array
    among: Array
    by_basis: Array

    def count(self, k: int) -> int:
        """Number k of a violation's numbers."""
        return len(self.listed[k].columns) if k < len(self.listed) else 1

    def with_all(self, k: int) -> Array:
        """Products (k, w) of a violation's columns with all columns."""
        if k < len(self.listed):
            columns, since = self.listed[k]
            return self.after[since][columns]
        row, motor = divmod(k - len(self.listed), self.single.shape[1])
        return self.single[row, motor : motor + 1]

    def with_basis(self, k: int) -> Array:
        """Products (k, nb) of a violation's columns with the basis."""
        return self.with_all(k)[:, self.n : -1]

    def with_residuals(self, freed: Sequence[int]) -> Array:
        """Products (c,) of some violations' projected columns with the residuals."""
        parts = [np.zeros(0)]
        parts += [self.with_all(k)[:, -1] - self.with_basis(k) @ self.by_basis for k in freed]
        return np.concatenate(parts)

    def between(self, k: int, other: int) -> Array:
        """Products (k, k') of the columns of two violations."""
        if k >= len(self.listed):
            row, motor = divmod(k - len(self.listed), self.single.shape[1])
            return self.singles_with(other)[row, motor : motor + 1]
        if other >= len(self.listed):
            return self.between(other, k).T
        one, two = self.listed[k], self.listed[other]
        return self.after[max(one.since, two.since)][np.ix_(one.columns, two.columns)]

    def across(self, k: int, freed: Sequence[int]) -> Array:
        """Products (k, c) of a violation's projected columns with those of the ``freed`` ones."""
        parts = [np.zeros((self.count(k), 0))]
        parts += [self.between(k, f) - self.with_basis(k) @ self.with_basis(f).T for f in freed]
        return np.concatenate(parts, axis=1)

    def singles_with(self, other: int) -> Array:
        """Products of the single readings' columns with those of a violation, (K', m, k)."""
        if other < len(self.listed):
            columns, since = self.listed[other]
            out = self.single[..., columns].copy()
            out[:since] = 0.0
            return out
        row, motor = divmod(other - len(self.listed), self.single.shape[1])
        out = np.zeros((*self.single.shape[:2], 1))
        out[row, :, 0] = self.among[row, :, motor]
        return out

    def gains_of_singles(
        self, freed: Sequence[int], free: _ProjectedColumns
    ) -> tuple[Array, Array]:
        """Decrease of chi2 by each single reading, (K' m,), with the ``freed`` violations as
        further unknowns, and whether the reading is observable, (K' m,).
        """
        basis, squared = self.single[..., self.n : -1], np.einsum("kmm->km", self.among)
        residual = squared - np.sum(basis**2, axis=-1)
        value = self.single[..., -1] - basis @ self.by_basis
        parts = [np.zeros((*squared.shape, 0))]
        parts += [self.singles_with(f) - basis @ self.with_basis(f).T for f in freed]
        across = np.concatenate(parts, axis=-1)
        residual = residual - np.einsum("kmf,fg,kmg->km", across, free.inverse, across)
        value = value - across @ (free.inverse @ free.value)
        observable = residual > OBSERVABLE_SQUARE_SHARE * squared
        return np.where(
            observable, value**2 / np.where(observable, residual, 1.0), 0.0
        ).ravel(), observable.ravel()


@dataclass(frozen=True)
class _ProjectedColumns:
    """Products of c columns projected orthogonally to all unknowns.

    scale : (c,) lengths of the columns before projection, infinite where they are rounding.
    squared : (c, c) products with each other.
    value : (c,) products with the residuals.
    """

    scale: Array
    squared: Array
    value: Array

    @classmethod
    def of(cls, made: _Products, freed: Sequence[int]) -> _ProjectedColumns:
        """Projection of the columns of some violations."""
        lengths = [np.zeros(0)]
        for k in freed:
            length = np.sqrt(np.maximum(np.diag(made.between(k, k)), 0.0))
            # columns that are rounding, such as a shift of a height probe along the bed
            least = ROUNDING * length.max(initial=0.0)
            lengths.append(np.where(length > least, length, np.inf))
        squared = [np.zeros((0, 0)), *(made.across(k, freed) for k in freed)][len(freed) > 0 :]
        return cls(np.concatenate(lengths), np.concatenate(squared), made.with_residuals(freed))

    def _directions(self) -> tuple[Array, Array]:
        """Eigenvalues and eigenvectors of the products of columns scaled to length one before
        projection.
        """
        return np.linalg.eigh(self.squared / self.scale[:, None] / self.scale)

    @property
    def inverse(self) -> Array:
        """Pseudoinverse (c, c) of the products, in the observable directions."""
        part, vectors = self._directions()
        observable = part > OBSERVABLE_SQUARE_SHARE
        back = vectors[:, observable] / np.sqrt(part[observable]) / self.scale[:, None]
        return back @ back.T

    @property
    def gain(self) -> tuple[float, int]:
        """Joint decrease of chi2, and its degrees of freedom."""
        observable = self._directions()[0] > OBSERVABLE_SQUARE_SHARE
        return float(self.value @ self.inverse @ self.value), int(observable.sum())

    @property
    def hidden(self) -> Array:
        """Share (c,) of each number's direction that is unobservable."""
        part, vectors = self._directions()
        return np.sum(vectors[:, part <= OBSERVABLE_SQUARE_SHARE] ** 2, axis=1)


def shared_basis(info: Information) -> Array:
    """B (na, nb) such that the rows by the shared unknowns times B are orthonormal."""
    half = inverse_root(info.rows[0][:1], ROWS_RANK_TOLERANCE, loose=False)[0]
    return half[:, np.any(half != 0, axis=0)]


def _augmented_basis(assembled: Assembled, info: Information, beside: Sequence[Column]) -> Array:
    """B (na + l, nb + l) such that the rows by the shared unknowns and l random effects, times B,
    are orthonormal.

    Random effects are in prior standard deviations, so their prior rows are the identity; these
    count among the rows. With Q = J B0 the orthonormal rows of the unknowns alone and D the
    effects' columns, the l further columns are ``(D - Q Q^T D) L^-T`` with ``L L^T = 1 + D^T D -
    (Q^T D)^T Q^T D``.
    """
    basis, root = shared_basis(info), prior_root(beside)
    count = root.shape[1]
    if not count:
        return basis
    columns = columns_of(assembled, info.state, beside)
    across, squared = np.zeros((basis.shape[1], count)), np.eye(count)
    na = len(basis)
    for cut, piece in zip(assembled.problem.cuts, info.pieces(), strict=True):
        rows, _ = eliminate_beside(piece.linear, columns(cut, piece.linear) @ root)
        flat = rows.reshape(-1, na + count)
        across += (flat[:, :na] @ basis).T @ flat[:, na:]
        squared += flat[:, na:].T @ flat[:, na:]
    triangle = np.linalg.inv(np.linalg.cholesky(squared - across.T @ across)).T
    return np.block(
        [[basis, -basis @ across @ triangle], [np.zeros((count, basis.shape[1])), triangle]]
    )


def _products(
    assembled: Assembled,
    info: Information,
    listed: Sequence[Column],
    basis: Array,
    singles: bool,
    beside: Sequence[Column],
) -> _Products:
    """Products of the violations' columns.

    basis : of the unknowns and of ``beside``, by :func:`_augmented_basis`.
    """
    problem, observed = assembled.problem, assembled.observed
    stations, motors = problem.unknowns.stations, problem.layout.n_readings if singles else 0
    # columns of each violation; a moved station has those of its pose, from a configuration on
    parts: list[_Listed] = []
    n = 6 * problem.unknowns.n_stations
    for effect in listed:
        if effect.station is None:
            parts.append(_Listed(n + np.arange(effect.count), 0))
            n += effect.count
        else:
            since = int(np.count_nonzero(observed[: effect.since]))
            parts.append(_Listed(6 * effect.station + np.arange(6), since))
    # sums over the configurations
    begins = sorted({0, *(part.since for part in parts)})
    width = n + basis.shape[1] + 1
    sums: dict[int, Array] = {begin: np.zeros((n, width)) for begin in begins}
    single, among, gradient = (
        [np.zeros((0, motors, width))],
        [np.zeros((0, motors, motors))],
        0.0,
    )
    throughout = [effect for effect in listed if effect.station is None]
    columns = columns_of(assembled, info.state, throughout, singles=singles)
    random, root = columns_of(assembled, info.state, beside), prior_root(beside)
    for cut, piece in zip(problem.cuts, info.pieces(), strict=True):
        linear = piece.linear
        further = [random(cut, linear) @ root, columns(cut, linear)]
        rows, value = eliminate_beside(linear, np.concatenate(further, axis=-1))
        count = problem.unknowns.count
        if not cut.start:
            gradient = (linear.shared_by @ basis[:count]).T @ linear.shared_value[0]
        first, split = count + root.shape[1], rows.shape[-1] - motors
        own = [rows[..., stations], rows[..., first:split], rows[..., :first] @ basis]
        wide = np.concatenate([*own, value[..., None]], axis=-1)
        for begin in begins:
            flat = wide[max(begin - cut.start, 0) :].reshape(-1, width)
            sums[begin] += flat[:, :n].T @ flat
        gradient = gradient + np.einsum("kri,kr->i", own[-1], value)
        if singles:
            by_single = rows[..., split:]
            single.append(by_single.mT @ wide)
            among.append(by_single.mT @ by_single)
    return _Products(
        tuple(parts),
        n,
        sums,
        np.concatenate(single),
        np.concatenate(among),
        np.asarray(gradient),
    )


def prior_root(columns: Sequence[Column]) -> Array:
    """Root (k, l) of the joint prior covariance of the numbers of columns."""
    from scipy.linalg import block_diag

    return np.array(block_diag(np.zeros((0, 0)), *(one.prior for one in columns)))


def eliminate_beside(linear: Linear, columns: Array) -> tuple[Array, Array]:
    """Eliminate the configurations' own unknowns from rows with further columns.

    columns : (K', r, k) beside those of the shared unknowns; zero in rows that are rejected or
        padding. Returns rows (K', r, na + k) and residuals (K', r).
    """
    extra = np.where(linear.usable[0][..., None], columns, 0.0)
    wide = linear._replace(
        by_shared=np.concatenate([linear.by_shared, extra[None]], axis=-1),
        shared_by=np.pad(linear.shared_by, ((0, 0), (0, extra.shape[-1]))),
    )
    reduced = eliminate(wide)
    return reduced.rows[0], reduced.value[0]


def columns_of(
    assembled: Assembled, state: BatchState, listed: Sequence[Column], *, singles: bool = False
) -> Callable[[slice, Linear], Array]:
    """Function that evaluates the columns (K', r, k) of some configurations, from the problem's
    rows there.

    Columns are those of the ``listed`` ones in their order, then, with ``singles``, of each single
    reading.
    """
    problem, places = assembled.problem, assembled.places
    counts = [effect.count for effect in listed]
    m, n = problem.layout.n_readings, sum(counts)
    # columns by readings, edges, poses and motions of stations
    readings = np.zeros((len(problem.blocks.present), m, n + (m if singles else 0)))
    readings[..., n:] = np.eye(m)[:, : readings.shape[-1] - n]
    placed: list[tuple[slice, Array | None, Array | None]] = []
    moving: list[tuple[slice, Array]] = []
    for effect, end in zip(listed, np.cumsum(counts).tolist(), strict=True):
        where = slice(end - effect.count, end)
        if effect.readings is not None:
            readings[..., where] = effect.readings[assembled.observed]
        parts = effect.edges_of(len(places.edges.row)), effect.poses_of(len(places.poses.row))
        edges, poses = (
            None if part is None else at.filled(part)
            for at, part in zip(places, parts, strict=False)
        )
        placed.append((where, edges, poses))
        if effect.motion is not None:
            moving.append((where, effect.motion[:, assembled.observed]))

    def columns(cut: slice, linear: Linear) -> Array:
        part = problem.among(cut)
        c = part.closure(part.state_among(state, cut))
        out = np.zeros((len(part.blocks.present), part.n_rows, readings.shape[-1]))
        out[:, part.closure_rows] = part.by_readings(c, readings[cut])[0]
        # whitened derivatives of edges and poses; residuals are predicted minus measured
        of_edges = part.data.weighed[0]
        of_poses = (np.sqrt(part.pose_data.weight)[..., None, None] * part.pose_data.whiten)[0]
        before, after = (out[:, kind.rows] for kind in part.row_groups[:2])
        for where, edges, poses in placed:
            shape = (len(out), -1, where.stop - where.start)
            if edges is not None:
                before[..., where] = -(of_edges @ edges[cut]).reshape(shape)
            if poses is not None:
                after[..., where] = -(of_poses @ poses[cut]).reshape(shape)
        # motions act as the stations' poses do
        by_station = linear.by_shared[0][..., problem.unknowns.stations]
        for where, motion in moving:
            each = motion[:, cut].swapaxes(0, 1)
            out[..., where] += by_station @ each.reshape(len(out), -1, each.shape[-1])
        return out

    return columns
