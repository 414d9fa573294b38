"""Summaries of errors over simulated runs, each with its Monte-Carlo standard error.

Standard errors are computed from the scatter between runs, because the coordinates within a run are
correlated. Errors are arrays (B,) or (B, n) for B runs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import numpy as np

from pkmcal.arrays import Array

Statistic = Literal["rms", "mean"]


class Summary(NamedTuple):
    """Value and its Monte-Carlo standard error, in the same unit."""

    value: float
    error: float

    def times(self, factor: float) -> Summary:
        """Value and standard error times a factor, for a change of unit."""
        return Summary(factor * self.value, factor * self.error)


def mean(values: Array) -> Summary:
    """Mean of values (B,) and its standard error."""
    return Summary(float(values.mean()), float(values.std() / np.sqrt(len(values))))


def rms_over_runs(errors: Array) -> Summary:
    """Root mean square of errors (B,) or (B, n) over runs and, if there are several, coordinates.

    The standard error follows to first order from the scatter of the runs' mean squares.
    """
    squares = np.square(errors).reshape(len(errors), -1).mean(axis=1)
    value = float(np.sqrt(squares.mean()))
    error = squares.std() / np.sqrt(len(squares)) / (2 * max(value, 1e-300))
    return Summary(value, float(error))


def each_rms(errors: Array) -> Array:
    """Root mean square over runs of each coordinate, (B, n) -> (n,)."""
    return np.sqrt(np.mean(np.square(errors), axis=0))


def ratio_of_figures(summary: Summary, bound: Summary) -> Summary:
    """Ratio of two summaries; their errors are taken as independent."""
    value = summary.value / bound.value
    return Summary(value, value * float(np.hypot(summary.error / summary.value,
                                                 bound.error / bound.value)))  # fmt: skip


def covered(errors: Array, sigma: Array, share: float = 0.95) -> Array:
    """Share (B,) of a run's errors (B, ...) inside the intervals ± z sigma of their stated sigma.

    share : nominal coverage of the intervals, 0.95 for 95 %. Entries with an error or a sigma that
    is not finite do not count; a run without any finite entry has share 0.
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
