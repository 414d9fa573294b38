"""False-alarm level of a session, shared by all significance tests on its data.

A session makes several searches, each of several tests. By Bonferroni's inequality, the probability
that any test is significant although the session agrees with its model is at most the level, if
each search has an equal share of the level, and each of its tests an equal share of that. The
inequality holds however the tests depend on each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from pkmcal.arrays import Array, Integers
from pkmcal.levels import FALSE_ALARM, NOISE_EXCESS


class Search(StrEnum):
    """Searches that share the level of a session; each names itself where it tests."""

    VIOLATIONS = "score tests of model violations"
    OUTLINES = "tubes of another outline"
    DISCREPANCY = "components of the model discrepancy"
    OUTLIERS = "measured poses that disagree with all others"
    NOISE = "measurements that scatter more than stated"
    INTRINSICS = "the cameras' intrinsics of the files, compared with refined ones"


EQUAL_SHARES = MappingProxyType(dict.fromkeys(Search, 1 / len(Search)))


@dataclass(frozen=True)
class FalseAlarm:
    """Level of a session, and the searches that share it."""

    # probability of any significant test (violation, discrepancy, outlier) in a session that agrees
    # with its model
    level: float = FALSE_ALARM
    # share of the level that each search has
    shares: Mapping[Search, float] = field(default_factory=lambda: EQUAL_SHARES)

    def of_test(self, search: Search, tests: int) -> float:
        """Level of each of the tests of one search."""
        return self.level * self.shares[search] / max(tests, 1)

    def scale(self, search: Search, dof: float) -> float:
        """Threshold of the root mean square of ``dof`` normal errors, in standard deviations, at
        the level of one search.
        """
        from scipy.special import chdtri

        dof = max(dof, 1.0)
        return float(np.sqrt(chdtri(dof, self.of_test(search, 1)) / dof))

    def usual_scale(self, dof: float) -> float:
        """Largest ratio of errors to their stated noise, root mean square, that is no reason for a
        report.
        """
        return max(NOISE_EXCESS, self.scale(Search.NOISE, dof))

    @property
    def of_noise(self) -> float:
        """Level of the test whether measurements scatter more than stated."""
        return self.of_test(Search.NOISE, 1)

    def adjusted(
        self, search: Search, chance: Array | float, tests: Array | Integers | int
    ) -> Array:
        """P-values adjusted for all tests of a session.

        chance : p-values of the tests. tests : number of tests that share the level of their
            search.
        """
        return np.minimum(np.asarray(tests) * chance / self.shares[search], 1.0)


SESSION_FALSE_ALARM = FalseAlarm()
"""The level of all sessions."""
