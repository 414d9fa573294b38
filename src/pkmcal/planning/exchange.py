"""The best choice among many measurements: greedily, then by exchange.

Measurements are taken in turn, each time the one that lowers an index most; then each chosen one is
put back and the best taken in its place, until nothing changes (Fedorov 1972; Mitchell 1974 for
the form with a fixed count). The covariance follows each step by the matrix inversion lemma.

Indices, all of them better the smaller (directions of the machine in tolerances of its drawing):

- **tool** : variance of the platform's position over the workspace (V- or I-optimality, which the
  robot literature calls the goal-oriented criterion).
- **D** : logarithm of the determinant of the machine's covariance.
- **E** : its largest eigenvalue.
- **O1** : minus the logarithm of the noise amplification index of Borm and Menq (1991), the
  geometric mean of the singular values of the identification Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.planning.information import CandidateRows

CANDIDATES_TRIED_EXACTLY = 24
"""Candidates that are tried exactly; the others are farther by what the index' slope promises."""
EXCHANGE_ROUNDS = 12
"""Rounds of exchanges; they end before, as a rule after three."""
LEAST_READING_DIFFERENCE = 0.1
"""Part of its range by which some motor's reading differs at least between two configurations that
one group measures. A photograph taken twice shows the same shading before the same background: its
errors are the same, however often it is counted.
"""
EXCHANGE_GAIN_ROUNDING = 1e-6
"""Relative gain below which an exchange is rounding."""
LEAST_DIRECTION_INFORMATION = 1e-6
"""Information, in tolerances^-2, that a direction has at least for the logarithm of O1: a drawing
knows it a million times better."""

ShareProgress = Callable[[float], None]


class Index(Protocol):
    """What is to be small, of covariances (..., p, p) of the machine's directions."""

    def value(self, covariance: Array) -> Array:
        """(...)."""
        ...

    def size(self, value: float, p: int, /) -> float:
        """A value as what goes like a standard deviation of p directions."""
        ...

    def slope(self, covariance: Array, /) -> Array:
        """F (p, k) at one covariance, with ``d value = tr(F^T dC F)``."""
        ...


@dataclass(frozen=True)
class ToolIndex:
    """Variance of the platform's position (m^2), mean over the workspace; weight (p, p)."""

    weight: Array

    def value(self, covariance: Array) -> Array:
        """tr(W C)."""
        return np.einsum("ij,...ij->...", self.weight, covariance)

    def size(self, value: float, _p: int, /) -> float:
        """Metres."""
        return float(np.sqrt(value))

    def slope(self, _covariance: Array, /) -> Array:
        """W's root."""
        return _root(self.weight)


@dataclass(frozen=True)
class DIndex:
    """D."""

    def value(self, covariance: Array) -> Array:
        """Log det C."""
        return np.linalg.slogdet(covariance)[1]

    def size(self, value: float, p: int, /) -> float:
        """In tolerances, of a direction."""
        return float(np.exp(value / (2 * p)))

    def slope(self, covariance: Array) -> Array:
        """The root of C^-1."""
        return _root(np.linalg.inv(covariance))


@dataclass(frozen=True)
class EIndex:
    """E."""

    def value(self, covariance: Array) -> Array:
        """The largest eigenvalue of C."""
        return np.linalg.eigvalsh(covariance)[..., -1]

    def size(self, value: float, _p: int, /) -> float:
        """In tolerances, of the worst direction."""
        return float(np.sqrt(value))

    def slope(self, covariance: Array) -> Array:
        """Its eigenvector."""
        return np.linalg.eigh(covariance)[1][:, -1:]


@dataclass(frozen=True)
class O1Index:
    """O1: the data's own information is what the drawing, one in each direction, did not know."""

    def value(self, covariance: Array) -> Array:
        """-log of the geometric mean of the singular values."""
        eigenvalues = np.linalg.eigvalsh(np.linalg.inv(covariance)) - 1.0
        return -0.5 * np.log(np.maximum(eigenvalues, LEAST_DIRECTION_INFORMATION)).mean(axis=-1)

    def size(self, value: float, _p: int, /) -> float:
        """In tolerances."""
        return float(np.exp(value))

    def slope(self, covariance: Array) -> Array:
        """By C, through its inverse."""
        values, vectors = np.linalg.eigh(np.linalg.inv(covariance))
        excess = np.maximum(values - 1.0, LEAST_DIRECTION_INFORMATION)
        return vectors * (values / np.sqrt(2 * len(values) * excess))


def _tool(info: CandidateRows) -> Index:
    shift = info.work[:, 3:]
    return ToolIndex(np.einsum("kap,kaq->pq", shift, shift, optimize=True) / len(shift))


PLAN_INDICES: Mapping[str, Callable[[CandidateRows], Index]] = {
    "tool": _tool,
    "D": lambda _: DIndex(),
    "E": lambda _: EIndex(),
    "O1": lambda _: O1Index(),
}


def _root(matrix: Array) -> Array:
    """F (p, k) with F F^T = matrix."""
    values, vectors = np.linalg.eigh(matrix)
    retained_rows = values > 1e-12 * values[-1]
    return vectors[:, retained_rows] * np.sqrt(values[retained_rows])


class Greedy(NamedTuple):
    """chosen : (n,) candidates in their order. path : (n, p, p) the machine's covariance after
    each.
    """

    chosen: Integers
    path: Array


def greedy(
    info: CandidateRows, count: int, index: Index, progress: ShareProgress | None = None
) -> Greedy:
    """``count`` candidates of each group, the best next one of each group in turn.

    Each group has ``count`` candidates or more. progress : called with the share done.
    """
    work, groups = _Work(info, index), int(info.group.max()) + 1
    chosen, path = list[int](), list[Array]()
    work.begin([])
    for k in range(count * groups):
        best = work.best(k % groups, chosen)
        work.add(best, 1.0)
        chosen.append(best)
        path.append(work.machine)
        if progress:
            progress((k + 1) / (count * groups))
    return Greedy(np.array(chosen), np.array(path))


def exchanged(info: CandidateRows, chosen: Integers, index: Index) -> Integers:
    """A choice (n,) bettered: each is put back for the best of its group, until none gains."""
    work, now = _Work(info, index), [int(c) for c in chosen]
    work.begin(now)
    value = float(index.value(work.machine))
    for _ in range(EXCHANGE_ROUNDS):
        for k, old in enumerate(now):
            work.add(old, -1.0)
            now[k] = work.best(int(info.group[old]), now[:k] + now[k + 1 :])
            work.add(now[k], 1.0)
        work.begin(now)  # without the rounding of so many steps
        before, value = value, float(index.value(work.machine))
        if before - value <= EXCHANGE_GAIN_ROUNDING * abs(value):
            break
    return np.array(now)


class _Work:
    """The covariance of all unknowns while candidates come and go; unknowns in units of what all
    candidates together tell.
    """

    def __init__(self, info: CandidateRows, index: Index) -> None:
        diagonal = np.diag(info.information) + np.einsum("nri,nri->i", info.rows, info.rows)
        self._unit = np.sqrt(diagonal)
        self._rows = info.rows / self._unit
        self._group, self._where = info.group, info.where
        self._information = info.information / np.outer(self._unit, self._unit)
        self._directions = info.machine / self._unit
        self._index = index
        self._covariance = np.zeros_like(self._information)

    def begin(self, chosen: list[int]) -> None:
        """The covariance with these candidates."""
        rows = self._rows[np.array(chosen, dtype=int)].reshape(-1, len(self._unit))
        half = np.linalg.cholesky(self._information + rows.T @ rows)
        inverse = np.linalg.solve(half, np.eye(len(half)))
        self._covariance = inverse.T @ inverse

    @property
    def machine(self) -> Array:
        """(p, p) of the machine's directions."""
        return self._directions @ self._covariance @ self._directions.T

    def add(self, candidate: int, sign: float) -> None:
        """A candidate comes (1) or goes (-1)."""
        rows = self._rows[candidate]
        across = rows @ self._covariance
        inner = np.eye(len(rows)) + sign * across @ rows.T
        self._covariance = self._covariance - sign * across.T @ np.linalg.solve(inner, across)

    def best(self, group: int, taken: list[int]) -> int:
        """The candidate of a group, none of those taken nor the same as one of them, whose coming
        makes the index smallest; of those with which it is equal, the one of the least variance.
        """
        now = self.machine
        to_slope = self._covariance @ (self._directions.T @ self._index.slope(now))
        begin, end = np.searchsorted(self._group, [group, group + 1])
        own = np.array([t for t in taken if begin <= t < end], dtype=int)
        free = np.ones(end - begin, dtype=bool)
        free[own - begin] = False
        apart = np.abs(self._where[begin:end, None] - self._where[own]).max(axis=-1)
        new = free & (apart >= LEAST_READING_DIFFERENCE).all(axis=1)
        free = new if new.any() else free
        rows = self._rows[begin:end]  # a view: copies of all would cost more than the sums
        first = (rows.reshape(-1, rows.shape[-1]) @ to_slope).reshape(len(rows), -1)
        gain = np.where(free, np.einsum("nk,nk->n", first, first), -1.0)
        top = np.argsort(-gain, kind="stable")[: min(CANDIDATES_TRIED_EXACTLY, int(free.sum()))]
        rows = rows[top]
        across = rows @ self._covariance
        inner = np.eye(rows.shape[1]) + across @ rows.mT
        shifted = across @ self._directions.T
        after = now - shifted.mT @ np.linalg.solve(inner, shifted)
        value = self._index.value(after)
        # while some direction is told nothing, the largest eigenvalue is the same whatever comes
        same = value <= value.min() + EXCHANGE_GAIN_ROUNDING * np.abs(value.min())
        spread = np.where(same, after.trace(axis1=1, axis2=2), np.inf)
        return int(begin + top[np.argmin(spread)])
