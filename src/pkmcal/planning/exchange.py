"""Selection of measurements by a greedy start and an exchange algorithm.

The criterion is the variance of the platform's position, mean over the workspace (V- or
I-optimality; "goal-oriented criterion" in the robot literature). Measurements are added in turn,
each time the one that lowers the criterion most; then each chosen one is removed and replaced by
the best, until nothing changes (Fedorov 1972; Mitchell 1974 for a fixed number). The covariance is
updated in each step by the matrix inversion lemma.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.planning.information import CandidateRows

CANDIDATES_TRIED_EXACTLY = 24
"""Number of candidates whose variance is computed exactly: the best to first order."""
EXCHANGE_ROUNDS = 12
"""Maximum number of exchange rounds; three are usually enough."""
LEAST_READING_DIFFERENCE = 0.1
"""Minimum difference of some motor's reading, relative to its range, between two configurations of
one group. A repeated image has the same shading and the same background, so its errors are the same
and do not average out.
"""
EXCHANGE_GAIN_ROUNDING = 1e-6
"""Relative gain below which an exchange is rounding."""
ShareProgress = Callable[[float], None]


def tool_weight(info: CandidateRows) -> Array:
    """W (p, p) with the mean variance of the platform's position (m^2) as ``tr(W C)``."""
    shift = info.work[:, 3:]
    return np.einsum("kap,kaq->pq", shift, shift, optimize=True) / len(shift)


def tool_variance(weight: Array, covariance: Array) -> Array:
    """Mean variances (...) of the platform's position, m^2, for covariances (..., p, p)."""
    return np.einsum("ij,...ij->...", weight, covariance)


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


def greedy(info: CandidateRows, count: int, progress: ShareProgress | None = None) -> Greedy:
    """Select ``count`` candidates for each group, the best next one of each group in turn.

    Each group must have at least ``count`` candidates. progress : callback with the share done.
    """
    work, groups = _Work(info), int(info.group.max()) + 1
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


def exchanged(info: CandidateRows, chosen: Integers) -> Integers:
    """Improve a selection (n,) by exchanges within each group, until none gains."""
    work, now = _Work(info), [int(c) for c in chosen]
    work.begin(now)
    value = work.variance
    for _ in range(EXCHANGE_ROUNDS):
        for k, old in enumerate(now):
            work.add(old, -1.0)
            now[k] = work.best(int(info.group[old]), now[:k] + now[k + 1 :])
            work.add(now[k], 1.0)
        work.begin(now)  # removes the rounding of many updates
        before, value = value, work.variance
        if before - value <= EXCHANGE_GAIN_ROUNDING * abs(value):
            break
    return np.array(now)


class _Work:
    """Covariance of all unknowns while candidates are added and removed.

    Unknowns are scaled by the information of all candidates together.
    """

    def __init__(self, info: CandidateRows) -> None:
        diagonal = np.diag(info.information) + np.einsum("nri,nri->i", info.rows, info.rows)
        self._unit = np.sqrt(diagonal)
        self._rows = info.rows / self._unit
        self._group, self._where = info.group, info.where
        self._information = info.information / np.outer(self._unit, self._unit)
        self._directions = info.machine / self._unit
        self._weight = tool_weight(info)
        self._slope = self._directions.T @ _root(self._weight)
        self._covariance = np.zeros_like(self._information)

    def begin(self, chosen: list[int]) -> None:
        """Compute the covariance with the given candidates."""
        rows = self._rows[np.array(chosen, dtype=int)].reshape(-1, len(self._unit))
        half = np.linalg.cholesky(self._information + rows.T @ rows)
        inverse = np.linalg.solve(half, np.eye(len(half)))
        self._covariance = inverse.T @ inverse

    @property
    def variance(self) -> float:
        """Mean variance of the platform's position, m^2."""
        return float(tool_variance(self._weight, self.machine))

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
        """Candidate of a group that minimizes the variance of the tool.

        Candidates that are chosen already, or too close to a chosen one of the group, are excluded;
        among equal ones the candidate with the least total variance is returned.
        """
        # Decrease of the variance by each candidate to first order.
        now = self.machine
        to_slope = self._covariance @ self._slope
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
        # Exact variance with the best of them.
        top = np.argsort(-gain, kind="stable")[: min(CANDIDATES_TRIED_EXACTLY, int(free.sum()))]
        rows = rows[top]
        across = rows @ self._covariance
        inner = np.eye(rows.shape[1]) + across @ rows.mT
        on_machine = across @ self._directions.T
        after = now - on_machine.mT @ np.linalg.solve(inner, on_machine)
        variance = tool_variance(self._weight, after)
        same = variance <= variance.min() * (1 + EXCHANGE_GAIN_ROUNDING)
        spread = np.where(same, after.trace(axis1=1, axis2=2), np.inf)
        return int(begin + top[np.argmin(spread)])
