"""False-alarm level of a session, shared by everything that is searched for in its data.

A session makes several searches, each of several tests. By Bonferroni's inequality, the chance that
any test of a session that agrees with its model is significant is at most the level, if each search
has an equal share of the level, and each test of a search an equal share of that. The inequality
holds however the tests depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkmcal.arrays import Array, Integers


@dataclass(frozen=True)
class FalseAlarm:
    """Level of a session, and the number of searches that share it."""

    # chance that a session that agrees with its model shows any named violation, any discrepancy,
    # or any measured pose that disagrees with all others: one session of two hundred
    level: float = 0.005
    # searches that share it: score tests of model violations (score.py), tubes' outlines,
    # components of the discrepancy, and measured poses that disagree with the others
    searches: int = 4

    def of_test(self, tests: int) -> float:
        """Level of each of the tests of one search."""
        return self.level / (self.searches * max(tests, 1))

    def scale(self, dof: float) -> float:
        """Root mean square of normal errors, in their standard deviations, that one search exceeds
        by chance at its level.
        """
        from scipy.special import chdtri

        dof = max(dof, 1.0)
        return float(np.sqrt(chdtri(dof, self.of_test(1)) / dof))

    def adjusted(self, chance: Array | float, tests: Array | Integers | int) -> Array:
        """P-values among all tests of a session, from the p-values of tests and the number of tests
        that share the level of their search.
        """
        return np.minimum(self.searches * np.asarray(tests) * chance, 1.0)


SESSION_FALSE_ALARM = FalseAlarm()
"""The level of all sessions."""
