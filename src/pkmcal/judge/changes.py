"""Tests of a change of a calibrated machine, their power, and what explains a change best.

For a cause with columns D the statistic is the length of w's part along X D
(:class:`~pkmcal.judge.fixed_machine.Evidence`): chi-square of as many degrees of freedom as X D has
directions that the data see at all. Its null distribution holds whatever they are, for what is left
out depends on X alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from pkmcal.arrays import Array
from pkmcal.identify.score import Score
from pkmcal.judge.causes import (
    JOINT_SIDES,
    Cause,
    common_scale,
    joined_causes,
    joint_of,
    single_causes,
    stations_moved,
    whole_legs,
    whole_machine,
    zeros,
)
from pkmcal.judge.fixed_machine import Evidence
from pkmcal.mechanisms import Machine

LEAST_OBSERVABLE_DEVIATIONS = 1.0
"""Standard deviations that a change of one tolerance must make for its direction to be tested; a
direction that is hardly seen would only add noise to the test."""
DETECTION_POWER = 0.9
"""Probability with which a detectable change is detected."""
WATCH_NOISE_DRAWS = 20_000
"""Draws of noise: a share of 0.01 of them is then known to 7 % of itself."""
DISTINCT_LOG_ODDS = 2 * np.log(100.0)
"""Two causes are told apart where one makes the data a hundred times as likely as the other."""
MOST_CAUSES = 4
"""Changes that are looked for one after the other; more are a machine that was taken apart."""


class ObservableCause(NamedTuple):
    """What the data see of a cause: q (n, d) orthonormal in w, and gain (d, k) with q^T X D."""

    q: Array
    gain: Array


@dataclass(frozen=True)
class Change:
    """A cause's k numbers as the data tell them, if nothing else changed.

    value, sigma : (k,) m, rad or a ratio. covariance : (k, k). What is not seen is left at zero,
    with an infinite sigma.
    """

    value: Array
    sigma: Array
    covariance: Array

    def document(self) -> dict[str, Any]:
        """For programs."""
        return {"change": self.value, "sigma": self.sigma}


def observable_directions(evidence: Evidence, cause: Cause) -> ObservableCause:
    """The directions in w of a cause that the data see."""
    scaled = evidence.along(cause.columns * cause.sizes)
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    observable = s > LEAST_OBSERVABLE_DEVIATIONS
    return ObservableCause(u[:, observable], s[observable, None] * vt[observable] / cause.sizes)


def chi_square(evidence: Evidence, cause: Cause) -> Score:
    """Whether the data show the cause."""
    from scipy.special import chdtrc

    q = observable_directions(evidence, cause).q
    chi2, dof = float(np.sum((q.T @ evidence.w) ** 2)), q.shape[1]
    return Score(chi2, dof, float(chdtrc(dof, chi2)) if dof else 1.0)


def twice_log_odds(evidence: Evidence, cause: Cause) -> float:
    """Twice the log of how many times likelier the data are with the cause than with no change.

    The change's numbers are averaged over normal distributions of their ``sizes``: what one cause
    explains by 0.5 mm and another by 8 mm is rather the first's, and a cause of three numbers must
    explain more than one of a single number.
    """
    q, gain = observable_directions(evidence, cause)
    projected, scaled = q.T @ evidence.w, gain * cause.sizes
    spread = np.eye(len(projected)) + scaled @ scaled.T
    expected = float(projected @ np.linalg.solve(spread, projected))
    return float(projected @ projected) - expected - float(np.linalg.slogdet(spread)[1])


@dataclass(frozen=True)
class CommonLevel:
    """What several tests made at once are worth.

    least : (WATCH_NOISE_DRAWS,) the smallest chance of all tests in each draw of pure noise, in
    order. count : of the tests that see anything.
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


def common_level(evidence: Evidence, causes: Sequence[Cause]) -> CommonLevel:
    """The tests of several causes made at once: the same noise goes through all of them.

    Tests overlap (legs share what poses take up), so that the usual allowance for their number
    would be too careful; the null distribution of the smallest chance is drawn instead.
    """
    from scipy.special import chdtrc

    noise = np.random.default_rng(0).standard_normal((WATCH_NOISE_DRAWS, len(evidence.w)))
    parts = [
        q for q in (observable_directions(evidence, cause).q for cause in causes) if q.shape[1]
    ]
    least = np.ones(WATCH_NOISE_DRAWS)
    for q in parts:
        np.minimum(least, chdtrc(q.shape[1], np.sum((noise @ q) ** 2, axis=1)), out=least)
    return CommonLevel(np.sort(least), len(parts))


def change(evidence: Evidence, cause: Cause) -> Change:
    """The change by least squares, nothing else changed."""
    visible = observable_directions(evidence, cause)
    inverse = np.linalg.pinv(visible.gain)
    covariance = inverse @ inverse.T
    # a number of which a part is not seen is not told
    lost = (
        1 - np.diag(inverse @ visible.gain) > 1e-2
        if visible.gain.size
        else np.ones(len(cause.sizes), bool)
    )
    sigma = np.where(lost, np.inf, np.sqrt(np.diag(covariance)))
    return Change(inverse @ (visible.q.T @ evidence.w), sigma, covariance)


def detectable(evidence: Evidence, tester: Cause, along: Array, level: float) -> float:
    """The smallest change along a direction that a test at a level detects with DETECTION_POWER.

    along : (P,) the change of the parameters by one unit (m, rad). inf where it is not seen.
    """
    from scipy.special import chdtri, chndtrinc

    q = observable_directions(evidence, tester).q
    size = float(np.linalg.norm(q.T @ (evidence.along(along[:, None]))))
    if not q.shape[1] or size == 0.0:
        return float("inf")
    need = float(chndtrinc(chdtri(q.shape[1], level), q.shape[1], 1 - DETECTION_POWER))
    return float(np.sqrt(need) / size)


def detectable_range(
    evidence: Evidence, tester: Cause, part: Cause, level: float
) -> tuple[float, float]:
    """Smallest detectable changes of a part in the direction that is seen best, and worst."""
    q = observable_directions(evidence, tester).q
    if not q.shape[1] or not part.sizes.size:
        return float("inf"), float("inf")
    gain = q.T @ evidence.along(part.columns)
    _, _, vt = np.linalg.svd(gain)
    best, worst = (detectable(evidence, tester, part.columns @ v, level) for v in (vt[0], vt[-1]))
    return best, worst


@dataclass(frozen=True)
class LegTest:
    """One leg, or the legs of one motor.

    legs : from 0. whole : test of all its numbers but the tubes' radii. zero : of its reading's
    zero alone, with the change of it, if nothing else changed; None for a leg without a reading.
    unit, tolerance : of that zero. detects_zero : smallest change of it (m or rad) that is detected
    with DETECTION_POWER. detects_base, detects_platform : the same of its joints (m), in the
    direction seen best, and worst.
    """

    legs: tuple[int, ...]
    whole: Score
    zero: Score | None
    change: Change | None
    unit: str
    tolerance: float
    detects_zero: float
    detects_base: tuple[float, float]
    detects_platform: tuple[float, float]

    @property
    def chance(self) -> float:
        """The smaller of both adjusted chances; NaN where nothing is seen of the leg."""
        both = [t.adjusted for t in (self.whole, self.zero) if t and t.dof]
        return min(both) if both else float("nan")

    def document(self) -> dict[str, Any]:
        """For programs, legs from 1; what a test does not see is null."""
        zero = None
        if self.zero is not None:
            zero = {**asdict(self.zero), "unit": self.unit}
            zero |= self.change.document() if self.change else {}
        return {
            "legs": [j + 1 for j in self.legs],
            **asdict(self.whole),
            "zero": zero,
            "detectable": {
                "zero": self.detects_zero,
                "base": self.detects_base,
                "platform": self.detects_platform,
            },
        }


@dataclass(frozen=True)
class StationTest:
    """Whether a camera that is said to have been left in place was moved, by its number in the
    session; change : (phi, s) in its own axes, if nothing else changed.
    """

    station: int
    test: Score
    change: Change


@dataclass(frozen=True)
class Suspect:
    """A cause with the change that it would have made; chi2 : what it explains."""

    cause: Cause
    change: Change
    chi2: float

    def document(self, machine: Machine) -> dict[str, Any]:
        """For programs, with its numbers' names: parameters, or what a ratio is of."""
        columns = self.cause.columns
        names = (*machine.parameters.names, *("magnification",) * len(columns))
        numbers = [names[int(abs(column).argmax())] for column in columns.T]
        place = [f"{number}.{axis}" for number in ("turn", "shift") for axis in "xyz"]
        own = {"scale": ["scale"], "station": place}
        return {
            "part": self.cause.part,
            "legs": [j + 1 for j in self.cause.legs],
            "numbers": own.get(self.cause.part, numbers),
            **self.change.document(),
            "chi2": self.chi2,
        }


@dataclass(frozen=True)
class Explanation:
    """A cause that explains the data best beside the others found.

    test : what it explains. others : causes that these data cannot tell from it, best first.
    """

    suspect: Suspect
    test: Score
    others: tuple[Suspect, ...]


@dataclass(frozen=True)
class ChangeTests:
    """All tests. machine : of all legs' numbers together. scale : of all lengths by one factor.
    stations : of each camera that is said to have been left in place.

    alpha : share of machines that did not change that may be flagged. level : of a single test, so
    that all together keep alpha. rest : what the findings leave unexplained of ``machine``.
    """

    legs: tuple[LegTest, ...]
    machine: Score
    scale: Score
    scale_change: Change
    findings: tuple[Explanation, ...]
    rest: Score
    alpha: float
    level: float
    stations: tuple[StationTest, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether anything is shown to have changed."""
        return min((t.adjusted for t in self.tests), default=1.0) < self.alpha

    @property
    def moved(self) -> tuple[int, ...]:
        """Numbers of the cameras that are said to have been left in place, and were moved rather
        than that the machine has changed: those that explain the data best; where no single cause
        does, those whose own test fails.
        """
        if self.findings:
            named = [f.suspect.cause.station for f in self.findings]
            return tuple(station for station in named if station >= 0)
        return tuple(s.station for s in self.stations if s.test.adjusted < self.alpha)

    @property
    def tests(self) -> tuple[Score, ...]:
        """All tests that see anything."""
        legs = [t for leg in self.legs for t in (leg.whole, leg.zero)]
        retained = [station.test for station in self.stations]
        every = (self.machine, self.scale, *legs, *retained)
        return tuple(t for t in every if t is not None and t.dof)

    def document(self, machine: Machine) -> dict[str, Any]:
        """All tests and findings for programs: m, rad and ratios, legs from 1."""
        return {
            "alpha": self.alpha,
            "level": self.level,
            "power": DETECTION_POWER,
            "changed": self.changed,
            "machine": asdict(self.machine),
            "legs": [leg.document() for leg in self.legs],
            "scale": {**asdict(self.scale), **self.scale_change.document()},
            "findings": [
                {
                    **finding.suspect.document(machine),
                    "test": asdict(finding.test),
                    "or": [other.document(machine) for other in finding.others],
                }
                for finding in self.findings
            ],
            "unexplained": asdict(self.rest),
        }


def made_tests(
    evidence: Evidence, machine: Machine
) -> tuple[tuple[Score, ...], tuple[Score | None, ...], CommonLevel]:
    """Every test on new data, chances adjusted for their number, and what they are worth together.

    First of all legs, of all lengths by one factor, of each arm's legs, and of each camera that was
    left in place; then of each arm's zero, None for one without a reading.
    """
    causes = [whole_machine(machine), common_scale(machine), *whole_legs(machine)]
    causes += stations_moved(evidence)
    zero = zeros(machine)
    level = common_level(evidence, [*causes, *(cause for cause in zero if cause)])

    def test(cause: Cause) -> Score:
        score = chi_square(evidence, cause)
        return replace(score, adjusted=level.adjusted(score.chance))

    return tuple(map(test, causes)), tuple(test(cause) if cause else None for cause in zero), level


def detect_changes(evidence: Evidence, machine: Machine, alpha: float) -> ChangeTests:
    """Every test on new data, and what explains a change.

    alpha : share of machines that did not change that may be flagged.
    """
    (every, scale, *each), own, level = made_tests(evidence, machine)
    single = level.single(alpha)
    wholes, retained = each[: len(own)], each[len(own) :]
    rows = zip(whole_legs(machine), zeros(machine), wholes, own, strict=True)
    out = ChangeTests(
        legs=tuple(_leg(evidence, machine, *row, single) for row in rows),
        machine=every,
        scale=scale,
        scale_change=change(evidence, common_scale(machine)),
        findings=(),
        rest=every,
        alpha=alpha,
        level=single,
        stations=tuple(
            StationTest(cause.station, test, change(evidence, cause))
            for cause, test in zip(stations_moved(evidence), retained, strict=True)
        ),
    )
    if not out.changed:
        return out
    findings = explained(evidence, single_causes(machine, evidence), alpha)
    remainder = _beside(evidence, [f.suspect.cause for f in findings])
    remainder = chi_square(remainder, whole_machine(machine))
    return replace(out, findings=findings, rest=remainder)


def _leg(
    evidence: Evidence,
    machine: Machine,
    whole: Cause,
    zero: Cause | None,
    test: Score,
    test_zero: Score | None,
    level: float,
) -> LegTest:
    """A leg's tests, of all of it and of its zero, and what they would have found."""
    base, platform = (
        detectable_range(evidence, whole, joint_of(machine, side, whole.legs[0]), level)
        for side in JOINT_SIDES
    )
    least = float("inf")
    if zero is not None:
        least = min(detectable(evidence, t, zero.columns[:, 0], level) for t in (zero, whole))
    return LegTest(
        legs=whole.legs,
        whole=test,
        zero=test_zero,
        change=change(evidence, zero) if zero else None,
        unit=zero.unit if zero else "m",
        tolerance=float(zero.sizes[0]) if zero else float("nan"),
        detects_zero=least,
        detects_base=base,
        detects_platform=platform,
    )


def explained(evidence: Evidence, causes: Sequence[Cause], alpha: float) -> tuple[Explanation, ...]:
    """Causes one after the other, each the one that is most likely beside those before.

    Each must explain more than chance would in the best of so many. Of two changes, the first that
    is found may be one that resembles both; so where there are two, all pairs are tried, and after
    each further one those before are looked at again.
    """
    chosen: tuple[Cause, ...] = ()
    while len(chosen) < MOST_CAUSES:
        best = _ranked(evidence, chosen, causes)[0][1]
        score = chi_square(_beside(evidence, chosen), best)
        if not score.dof or len(causes) * score.chance >= alpha:
            break
        chosen = (*chosen, best)
        if len(chosen) == 2:
            pairs = [
                (twice_log_odds(evidence, joined_causes(pair)), pair)
                for pair in combinations(causes, 2)
            ]
            chosen = max(pairs, key=lambda item: item[0])[1]
        chosen = _exchanged(evidence, chosen, causes)
    findings = [_finding(evidence, chosen, k, causes) for k in range(len(chosen))]
    return tuple(sorted(findings, key=lambda f: -f.suspect.chi2))


def _exchanged(
    evidence: Evidence, chosen: tuple[Cause, ...], causes: Sequence[Cause]
) -> tuple[Cause, ...]:
    """The causes, each replaced by what is most likely beside the others, until all agree."""
    for _ in range(MOST_CAUSES):
        before = chosen
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            best = _ranked(evidence, others, causes)[0][1]
            chosen = (*chosen[:k], best, *chosen[k + 1 :])
        if all(old is new for old, new in zip(before, chosen, strict=True)):
            break
    return chosen


def _ranked(
    evidence: Evidence, others: tuple[Cause, ...], causes: Sequence[Cause]
) -> list[tuple[float, Cause]]:
    """Causes by how likely they make the data together with others (twice the log of the odds),
    best first.
    """
    free = [c for c in causes if all(c is not other for other in others)]
    scored = [(twice_log_odds(evidence, joined_causes((*others, cause))), cause) for cause in free]
    return sorted(scored, key=lambda item: -item[0])


def _finding(
    evidence: Evidence, chosen: tuple[Cause, ...], place: int, causes: Sequence[Cause]
) -> Explanation:
    """One of the chosen causes beside the others, with what cannot be told from it."""
    own, others = chosen[place], chosen[:place] + chosen[place + 1 :]
    remainder = _beside(evidence, others)
    # what explains no more than nothing would is no rival, however weak the best
    nothing = twice_log_odds(evidence, joined_causes(others)) if others else 0.0
    least = max(twice_log_odds(evidence, joined_causes(chosen)) - DISTINCT_LOG_ODDS, nothing)
    near = [c for score, c in _ranked(evidence, others, causes) if score > least and c is not own]
    suspects = [
        Suspect(c, change(remainder, c), chi_square(remainder, c).chi2) for c in (own, *near)
    ]
    return Explanation(suspects[0], chi_square(remainder, own), tuple(suspects[1:]))


def _beside(evidence: Evidence, chosen: Sequence[Cause]) -> Evidence:
    """The evidence without what other causes explain: their directions taken out."""
    remainder = evidence
    for cause in chosen:
        q = observable_directions(remainder, cause).q
        rest = np.linalg.svd(q, full_matrices=True)[0][:, q.shape[1] :]
        remainder = replace(remainder, w=rest.T @ remainder.w, by=rest.T @ remainder.by)
    return remainder
