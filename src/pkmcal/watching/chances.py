"""Chi-square tests of changes on :class:`~pkmcal.watching.evidence.Evidence`, and their power.

For a cause with columns D the statistic is the length of w's part along X D: chi-square of as many
degrees of freedom as X D has directions that the data see at all. Its null distribution holds
whatever they are, for what is left out depends on X alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.watching.causes import Cause
from pkmcal.watching.evidence import Evidence

SEEN = 1.0
"""Standard deviations that a change of one tolerance must make for its direction to be tested; a
direction that is hardly seen would only add noise to the test."""
POWER = 0.9
"""Probability with which a detectable change is detected."""


DRAWS = 20_000
"""Draws of noise: a share of 0.01 of them is then known to 7 % of itself."""


class Directions(NamedTuple):
    """What the data see of a cause: q (n, d) orthonormal in w, and gain (d, k) with q^T X D."""

    q: Array
    gain: Array


@dataclass(frozen=True)
class ChiSquare:
    """A statistic, its degrees of freedom and the probability of as much by chance alone.

    adjusted : the same for the largest of all tests that were made; NaN where it stands alone.
    """

    chi2: float
    dof: int
    chance: float
    adjusted: float = float("nan")


@dataclass(frozen=True)
class Change:
    """A cause's k numbers as the data tell them, if nothing else changed.

    value, sigma : (k,) m, rad or a ratio. covariance : (k, k). What is not seen is left at zero,
    with an infinite sigma.
    """

    value: Array
    sigma: Array
    covariance: Array


def directions(found: Evidence, cause: Cause) -> Directions:
    """The directions in w of a cause that the data see."""
    scaled = found.by @ (cause.columns * cause.sizes)
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    seen = s > SEEN
    return Directions(u[:, seen], s[seen, None] * vt[seen] / cause.sizes)


def chi_square(found: Evidence, cause: Cause) -> ChiSquare:
    """Whether the data show the cause."""
    q = directions(found, cause).q
    return by_chance(float(np.sum((q.T @ found.w) ** 2)), q.shape[1])


def by_chance(chi2: float, dof: int) -> ChiSquare:
    """The chance of a statistic; 1 without any degree of freedom."""
    from scipy.special import chdtrc

    return ChiSquare(chi2, dof, float(chdtrc(dof, chi2)) if dof else 1.0)


def likelihood(found: Evidence, cause: Cause) -> float:
    """Twice the log of how many times likelier the data are with the cause than with no change.

    The change's numbers are averaged over normal distributions of their ``sizes``: what one cause
    explains by 0.5 mm and another by 8 mm is rather the first's, and a cause of three numbers must
    explain more than one of a single number.
    """
    q, gain = directions(found, cause)
    told, scaled = q.T @ found.w, gain * cause.sizes
    spread = np.eye(len(told)) + scaled @ scaled.T
    expected = float(told @ np.linalg.solve(spread, told))
    return float(told @ told) - expected - float(np.linalg.slogdet(spread)[1])


@dataclass(frozen=True)
class Level:
    """What several tests made at once are worth.

    least : (DRAWS,) the smallest chance of all tests in each draw of pure noise, in order. count :
    of the tests that see anything.
    """

    least: Array
    count: int

    def adjusted(self, chance: float) -> float:
        """How often noise gives any of the tests such a chance, or a smaller one.

        Where the draws are too few to tell, the chance times the number of tests (Bonferroni).
        """
        often = (np.searchsorted(self.least, chance, side="right") + 1) / (len(self.least) + 1)
        return float(min(often, self.count * chance, 1.0))

    def single(self, alpha: float) -> float:
        """The chance below which a single test counts, so that noise makes any of them count with
        probability alpha.
        """
        inside = int(alpha * (len(self.least) + 1)) - 1
        drawn = float(self.least[inside]) if inside >= 0 and self.count else 0.0
        return max(drawn, alpha / max(self.count, 1))


def together(found: Evidence, causes: Sequence[Cause]) -> Level:
    """The tests of several causes made at once: the same noise goes through all of them.

    Tests overlap (legs share what poses take up), so that the usual allowance for their number
    would be too careful; the null distribution of the smallest chance is drawn instead.
    """
    from scipy.special import chdtrc

    noise = np.random.default_rng(0).standard_normal((DRAWS, len(found.w)))
    parts = [q for q in (directions(found, cause).q for cause in causes) if q.shape[1]]
    least = np.ones(DRAWS)
    for q in parts:
        np.minimum(least, chdtrc(q.shape[1], np.sum((noise @ q) ** 2, axis=1)), out=least)
    return Level(np.sort(least), len(parts))


def change(found: Evidence, cause: Cause) -> Change:
    """The change by least squares, nothing else changed."""
    seen = directions(found, cause)
    inverse = np.linalg.pinv(seen.gain)
    covariance = inverse @ inverse.T
    # a number of which a part is not seen is not told
    lost = (
        1 - np.diag(inverse @ seen.gain) > 1e-2
        if seen.gain.size
        else np.ones(len(cause.sizes), bool)
    )
    sigma = np.where(lost, np.inf, np.sqrt(np.diag(covariance)))
    return Change(inverse @ (seen.q.T @ found.w), sigma, covariance)


def detectable(found: Evidence, tester: Cause, along: Array, level: float) -> float:
    """The smallest change along a direction that a test at a level detects with POWER.

    along : (P + C,) the change of the parameters by one unit (m, rad). inf where it is not seen.
    """
    from scipy.special import chdtri, chndtrinc

    q = directions(found, tester).q
    size = float(np.linalg.norm(q.T @ (found.by @ along)))
    if not q.shape[1] or size == 0.0:
        return float("inf")
    need = float(chndtrinc(chdtri(q.shape[1], level), q.shape[1], 1 - POWER))
    return float(np.sqrt(need) / size)


def detectable_range(
    found: Evidence, tester: Cause, part: Cause, level: float
) -> tuple[float, float]:
    """Smallest detectable changes of a part in the direction that is seen best, and worst."""
    q = directions(found, tester).q
    if not q.shape[1] or not part.sizes.size:
        return float("inf"), float("inf")
    gain = q.T @ found.by @ part.columns
    _, _, vt = np.linalg.svd(gain)
    best, worst = (detectable(found, tester, part.columns @ v, level) for v in (vt[0], vt[-1]))
    return best, worst
