"""Selection of measurements by a greedy start and an exchange algorithm.

Measurements are added in turn, each time the one that lowers an index most; then each chosen one is
removed and replaced by the best, until nothing changes (Fedorov 1972; Mitchell 1974 for a fixed
number). The covariance is updated in each step by the matrix inversion lemma.

Indices, all of them minimized (directions of the machine are in prior sigmas):

- **tool** : variance of the platform's position over the workspace (V- or I-optimality;
  "goal-oriented criterion" in the robot literature).
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
"""Number of candidates whose index is computed exactly: the best by the slope of the index."""
EXCHANGE_ROUNDS = 12
"""Maximum number of exchange rounds; three are usually enough."""
LEAST_READING_DIFFERENCE = 0.1
"""Minimum difference of some motor's reading, relative to its range, between two configurations of
one group. A repeated image shows the same shading in front of the same background: its errors are
the same, however often it is counted.
"""
EXCHANGE_GAIN_ROUNDING = 1e-6
"""Relative gain below which an exchange is rounding."""
LEAST_DIRECTION_INFORMATION = 1e-6
"""Minimum information, in prior sigmas^-2, of a direction in the logarithm of O1: the nominal model
has a million times more.
"""

ShareProgress = Callable[[float], None]


class Index(Protocol):
    """Criterion to be minimized, a function of covariances (..., p, p) of the machine's
    directions.
    """

    def value(self, covariance: Array) -> Array:
        """Values (...) of the index."""
        ...

    def size(self, value: float, p: int, /) -> float:
        """Value converted to the scale of a standard deviation of p directions."""
        ...

    def slope(self, covariance: Array, /) -> Array:
        """F (p, k) at one covariance, with ``d value = tr(F^T dC F)``."""
        ...


@dataclass(frozen=True)
class ToolIndex:
    """Mean variance of the platform's position over the workspace (m^2); weight (p, p)."""

    weight: Array

    def value(self, covariance: Array) -> Array:
        """tr(W C)."""
        return np.einsum("ij,...ij->...", self.weight, covariance)

    def size(self, value: float, _p: int, /) -> float:
        """Standard deviation in m."""
        return float(np.sqrt(value))

    def slope(self, _covariance: Array, /) -> Array:
        """Root of W."""
        return _root(self.weight)


@dataclass(frozen=True)
class DIndex:
    """Index D."""

    def value(self, covariance: Array) -> Array:
        """Log det C."""
        return np.linalg.slogdet(covariance)[1]

    def size(self, value: float, p: int, /) -> float:
        """Standard deviation of a direction in prior sigmas, geometric mean."""
        return float(np.exp(value / (2 * p)))

    def slope(self, covariance: Array) -> Array:
        """Root of C^-1."""
        return _root(np.linalg.inv(covariance))


@dataclass(frozen=True)
class EIndex:
    """Index E."""

    def value(self, covariance: Array) -> Array:
        """Largest eigenvalue of C."""
        return np.linalg.eigvalsh(covariance)[..., -1]

    def size(self, value: float, _p: int, /) -> float:
        """Standard deviation of the worst direction in prior sigmas."""
        return float(np.sqrt(value))

    def slope(self, covariance: Array) -> Array:
        """Eigenvector of the largest eigenvalue."""
        return np.linalg.eigh(covariance)[1][:, -1:]


@dataclass(frozen=True)
class O1Index:
    """Index O1: the information of the data is that of C^-1 less the prior's, which is 1 in each
    direction.
    """

    def value(self, covariance: Array) -> Array:
        """-log of the geometric mean of the singular values."""
        eigenvalues = np.linalg.eigvalsh(np.linalg.inv(covariance)) - 1.0
        return -0.5 * np.log(np.maximum(eigenvalues, LEAST_DIRECTION_INFORMATION)).mean(axis=-1)

    def size(self, value: float, _p: int, /) -> float:
        """Standard deviation of a direction in prior sigmas, geometric mean."""
        return float(np.exp(value))

    def slope(self, covariance: Array) -> Array:
        """Slope by C, through its inverse."""
        eigenvalues, eigenvectors = np.linalg.eigh(np.linalg.inv(covariance))
        excess = np.maximum(eigenvalues - 1.0, LEAST_DIRECTION_INFORMATION)
        return eigenvectors * (eigenvalues / np.sqrt(2 * len(eigenvalues) * excess))


def _tool(info: CandidateRows) -> Index:
    """Index of the tool's variance over the poses of the workspace."""
    shift = info.work[:, 3:]
    return ToolIndex(np.einsum("kap,kaq->pq", shift, shift, optimize=True) / len(shift))


PLAN_INDICES: Mapping[str, Callable[[CandidateRows], Index]] = {
    "tool": _tool,
    "D": lambda _: DIndex(),
    "E": lambda _: EIndex(),
    "O1": lambda _: O1Index(),
}


def _root(matrix: Array) -> Array:
    """F (p, k) with F F^T = matrix, without directions of negligible eigenvalues."""
    eigenvalues, eigenvectors = np.linalg.eigh(matrix)
    significant = eigenvalues > 1e-12 * eigenvalues[-1]
    return eigenvectors[:, significant] * np.sqrt(eigenvalues[significant])


class Greedy(NamedTuple):
    """Greedy selection.

    chosen : (n,) candidates in their order. path : (n, p, p) covariance of the machine after each.
    """

    chosen: Integers
    path: Array


def greedy(
    info: CandidateRows, count: int, index: Index, progress: ShareProgress | None = None
) -> Greedy:
    """Select ``count`` candidates for each group, the best next one of each group in turn.

    Each group must have at least ``count`` candidates. progress : callback with the share done.
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
    """Improve a selection (n,) by exchanges within each group, until none gains."""
    work, now = _Work(info, index), [int(c) for c in chosen]
    work.begin(now)
    value = float(index.value(work.machine))
    for _ in range(EXCHANGE_ROUNDS):
        for k, old in enumerate(now):
            work.add(old, -1.0)
            now[k] = work.best(int(info.group[old]), now[:k] + now[k + 1 :])
            work.add(now[k], 1.0)
        work.begin(now)  # removes the rounding of many updates
        before, value = value, float(index.value(work.machine))
        if before - value <= EXCHANGE_GAIN_ROUNDING * abs(value):
            break
    return np.array(now)


class _Work:
    """Covariance of all unknowns while candidates are added and removed.

    Unknowns are scaled by the information of all candidates together.
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
        """Compute the covariance with the given candidates."""
        rows = self._rows[np.array(chosen, dtype=int)].reshape(-1, len(self._unit))
        half = np.linalg.cholesky(self._information + rows.T @ rows)
        inverse = np.linalg.solve(half, np.eye(len(half)))
        self._covariance = inverse.T @ inverse

    @property
    def machine(self) -> Array:
        """Covariance (p, p) of the machine's directions."""
        return self._directions @ self._covariance @ self._directions.T

    def add(self, candidate: int, sign: float) -> None:
        """Add (sign 1) or remove (sign -1) a candidate by the matrix inversion lemma."""
        rows = self._rows[candidate]
        across = rows @ self._covariance
        inner = np.eye(len(rows)) + sign * across @ rows.T
        self._covariance = self._covariance - sign * across.T @ np.linalg.solve(inner, across)

    def best(self, group: int, taken: list[int]) -> int:
        """Candidate of a group that minimizes the index.

        Excluded are the candidates taken and those too close to one of the group's; among equal
        ones the candidate with the least total variance is returned.
        """
        # Decrease of the index by each candidate to first order.
        now = self.machine
        to_slope = self._covariance @ (self._directions.T @ self._index.slope(now))
        begin, end = np.searchsorted(self._group, [group, group + 1])
        own = np.array([t for t in taken if begin <= t < end], dtype=int)
        free = np.ones(end - begin, dtype=bool)
        free[own - begin] = False
        apart = np.abs(self._where[begin:end, None] - self._where[own]).max(axis=-1)
        new = free & (apart >= LEAST_READING_DIFFERENCE).all(axis=1)
        free = new if new.any() else free
        rows = self._rows[begin:end]  # a view: copies would cost more than the sums
        first = (rows.reshape(-1, rows.shape[-1]) @ to_slope).reshape(len(rows), -1)
        gain = np.where(free, np.einsum("nk,nk->n", first, first), -1.0)
        # Exact index of the best of them.
        top = np.argsort(-gain, kind="stable")[: min(CANDIDATES_TRIED_EXACTLY, int(free.sum()))]
        rows = rows[top]
        across = rows @ self._covariance
        inner = np.eye(rows.shape[1]) + across @ rows.mT
        on_machine = across @ self._directions.T
        after = now - on_machine.mT @ np.linalg.solve(inner, on_machine)
        index = self._index.value(after)
        # While some direction has no information, the largest eigenvalue is the same for all
        # candidates.
        same = index <= index.min() + EXCHANGE_GAIN_ROUNDING * np.abs(index.min())
        spread = np.where(same, after.trace(axis1=1, axis2=2), np.inf)
        return int(begin + top[np.argmin(spread)])
