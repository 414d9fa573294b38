"""What errors over simulated runs come to, each figure with its Monte-Carlo standard error.

Standard errors come from the runs' scatter, as coordinates within a run are correlated. Errors are
arrays (B,) or (B, n), B runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array

Statistic = Literal["rms", "mean"]


class Summary(NamedTuple):
    """A figure and its Monte-Carlo standard error, in one unit."""

    value: float
    error: float

    def times(self, factor: float) -> Summary:
        """The same in another unit."""
        return Summary(factor * self.value, factor * self.error)


def mean(values: Array) -> Summary:
    """Of values (B,)."""
    return Summary(float(values.mean()), float(values.std() / np.sqrt(len(values))))


def rms_over_runs(errors: Array) -> Summary:
    """Root mean square over runs, and over coordinates where a run has several."""
    squares = np.square(errors).reshape(len(errors), -1).mean(axis=1)
    value = float(np.sqrt(squares.mean()))
    error = squares.std() / np.sqrt(len(squares)) / (2 * max(value, 1e-300))
    return Summary(value, float(error))


def each_rms(errors: Array) -> Array:
    """Root mean square over runs of every coordinate, (B, n) -> (n,)."""
    return np.sqrt(np.mean(np.square(errors), axis=0))


def ratio_of_figures(summary: Summary, bound: Summary) -> Summary:
    """One figure over another, as if their errors were independent."""
    value = summary.value / bound.value
    return Summary(value, value * float(np.hypot(summary.error / summary.value,
                                                 bound.error / bound.value)))  # fmt: skip


def covered(errors: Array, sigma: Array, share: float = 0.95) -> Array:
    """Part (B,) of a run's errors (B, ...) that lie in the intervals that their stated sigma
    promises, of those where both are known.
    """
    from scipy.special import ndtri

    finite = np.isfinite(sigma) & np.isfinite(errors)
    inside = finite & (np.abs(errors) <= float(ndtri(0.5 + share / 2)) * sigma)
    axes = tuple(range(1, errors.ndim))
    return np.sum(inside, axis=axes) / np.maximum(np.sum(finite, axis=axes), 1)


SUMMARIES_BY_STATISTIC: Mapping[Statistic, Callable[[Array], Summary]] = {
    "rms": rms_over_runs,
    "mean": mean,
}
