"""Tests for a change of a calibrated machine, their power, and the causes that explain a change.

For a cause with columns D the statistic is the squared length of the projection of w onto X D
(:class:`~pkmcal.judge.fixed_machine.Evidence`): chi-square with as many degrees of freedom as X D
has observable directions. The null distribution holds for any selection of directions, because it
depends on X alone.
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
from pkmcal.levels import MAJORITY, NEGLIGIBLE
from pkmcal.mechanisms import Machine
from pkmcal.outcome.hypotheses import HYPOTHESIS_THRESHOLDS
from pkmcal.ranges import default

CHANGE_ALPHA: float = default("watch", "alpha")
"""False-alarm rate: share of unchanged machines that are reported as changed."""
DETECTION_POWER = 0.9
"""Probability with which a detectable change is detected."""
WATCH_NOISE_DRAWS = 20_000
"""Number of draws of noise: a share of 0.01 of them is known to a relative 7 %."""
DISTINCT_LOG_ODDS = 2 * HYPOTHESIS_THRESHOLDS.act
"""Twice the log-odds, nats, from which one cause excludes another."""
MOST_CAUSES = 4
"""Maximum number of changes that are identified; more occur in a machine that was taken apart."""


class ObservableCause(NamedTuple):
    """Observable directions of a cause: q (n, d), orthonormal in w, and gain (d, k) = q^T X D."""

    q: Array
    gain: Array


@dataclass(frozen=True)
class Change:
    """Estimate of a cause's k numbers, if nothing else has changed.

    value, sigma : (k,) m, rad or a ratio.
    covariance : (k, k).

    Unobservable numbers are zero with an infinite sigma.
    """

    value: Array
    sigma: Array
    covariance: Array

    def document(self) -> dict[str, Any]:
        """Document for programs."""
        return {"change": self.value, "sigma": self.sigma}


def observable_directions(evidence: Evidence, cause: Cause) -> ObservableCause:
    """Observable directions in w of a cause."""
    scaled = evidence.along(cause.columns * cause.sizes)
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    # data of which most of the information, s^2 / (1 + s^2), is not the prior's
    observable = s**2 > MAJORITY * (1 + s**2)
    return ObservableCause(u[:, observable], s[observable, None] * vt[observable] / cause.sizes)


def chi_square(evidence: Evidence, cause: Cause) -> Score:
    """Score test of a cause."""
    from scipy.special import chdtrc

    q = observable_directions(evidence, cause).q
    chi2, dof = float(np.sum((q.T @ evidence.w) ** 2)), q.shape[1]
    return Score(chi2, dof, float(chdtrc(dof, chi2)) if dof else 1.0)


def twice_log_odds(evidence: Evidence, cause: Cause) -> float:
    """Twice the log of the Bayes factor of a cause against no change.

    The numbers of the change are averaged over normal distributions with their ``sizes``: of two
    causes, one that explains the data by 0.5 mm is more likely than one that needs 8 mm, and a
    cause with three numbers must explain more than a cause with a single one.
    """
    q, gain = observable_directions(evidence, cause)
    projected, scaled = q.T @ evidence.w, gain * cause.sizes
    spread = np.eye(len(projected)) + scaled @ scaled.T
    expected = float(projected @ np.linalg.solve(spread, projected))
    return float(projected @ projected) - expected - float(np.linalg.slogdet(spread)[1])


@dataclass(frozen=True)
class CommonLevel:
    """Joint significance of several tests on the same data.

    least : (WATCH_NOISE_DRAWS,) smallest p-value of all tests in each draw of pure noise, sorted.
    count : number of tests with observable directions.
    """

    least: Array
    count: int

    def adjusted(self, chance: float) -> float:
        """Probability that noise gives any of the tests such a p-value, or a smaller one.

        Beyond the resolution of the draws, the p-value times the number of tests (Bonferroni).
        """
        often = (np.searchsorted(self.least, chance, side="right") + 1) / (len(self.least) + 1)
        return float(min(often, self.count * chance, 1.0))

    def single(self, alpha: float) -> float:
        """Level of a single test for which the family-wise false-alarm rate is alpha."""
        inside = int(alpha * (len(self.least) + 1)) - 1
        drawn = float(self.least[inside]) if inside >= 0 and self.count else 0.0
        return max(drawn, alpha / max(self.count, 1))


def common_level(evidence: Evidence, causes: Sequence[Cause]) -> CommonLevel:
    """Joint significance of the tests of several causes, which all have the same noise.

    The tests are correlated (the legs share the nuisance poses), so a Bonferroni correction would
    be too conservative; the null distribution of the least p-value is simulated instead.
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
    """Least-squares estimate of a change, if nothing else has changed."""
    observable = observable_directions(evidence, cause)
    inverse = np.linalg.pinv(observable.gain)
    covariance = inverse @ inverse.T
    # a number that is partly unobservable is not reported
    lost = (
        1 - np.diag(inverse @ observable.gain) > NEGLIGIBLE
        if observable.gain.size
        else np.ones(len(cause.sizes), bool)
    )
    sigma = np.where(lost, np.inf, np.sqrt(np.diag(covariance)))
    return Change(inverse @ (observable.q.T @ evidence.w), sigma, covariance)


def detectable(evidence: Evidence, tester: Cause, along: Array, level: float) -> float:
    """Smallest change along a direction that a test detects with DETECTION_POWER; inf if
    unobservable.

    along : (P,) change of the parameters by one unit (m, rad). level : of the test.
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
    """Smallest detectable changes of a part in its most and in its least observable direction."""
    q = observable_directions(evidence, tester).q
    if not q.shape[1] or not part.sizes.size:
        return float("inf"), float("inf")
    gain = q.T @ evidence.along(part.columns)
    _, _, vt = np.linalg.svd(gain)
    best, worst = (detectable(evidence, tester, part.columns @ v, level) for v in (vt[0], vt[-1]))
    return best, worst


@dataclass(frozen=True)
class LegTest:
    """Tests of one leg, or of the legs of one motor.

    legs : from 0.
    whole : test of all parameters except those of the tubes.
    zero, change : test of the reading's zero, and its estimate if nothing else has changed; None
        for a leg without a reading.
    unit, tolerance : unit and prior sigma of that zero.
    detects_zero : smallest change of the zero (m or rad) that is detected with DETECTION_POWER.
    detects_base, detects_platform : smallest detectable displacements of the joints (m), in the
        most and in the least observable direction.
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
        """Smaller of both adjusted p-values; NaN if nothing of the leg is observable."""
        both = [t.adjusted for t in (self.whole, self.zero) if t and t.dof]
        return min(both) if both else float("nan")

    def document(self) -> dict[str, Any]:
        """Document for programs, legs from 1; null for what a test cannot observe."""
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
    """Test of whether a camera that is assumed to be unmoved has moved.

    station : index in the session.
    test : score test.
    change : (phi, s) along the camera's axes, if nothing else has changed.
    """

    station: int
    test: Score
    change: Change


@dataclass(frozen=True)
class Suspect:
    """Cause with the estimate of its change. chi2 : decrease of chi2 by the cause."""

    cause: Cause
    change: Change
    chi2: float

    def document(self, machine: Machine) -> dict[str, Any]:
        """Document for programs, with the names of its numbers: parameters, or the subject of a
        ratio.
        """
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
    """Most likely cause, given the other identified causes.

    test : score test of the cause.
    others : causes that the data do not distinguish from it, best first.
    """

    suspect: Suspect
    test: Score
    others: tuple[Suspect, ...]


@dataclass(frozen=True)
class ChangeTests:
    """All tests for a change.

    machine : score test of all parameters of all legs.
    scale : score test of a common scale of all lengths.
    stations : tests of each camera that is assumed to be unmoved.
    alpha : family-wise false-alarm rate of all tests.
    level : level of a single test for that rate.
    rest : ``machine``, given the causes that were identified.
    another_machine : whether a change of all parameters within their prior sigmas excludes an
        explanation by a few causes (DISTINCT_LOG_ODDS); these are then not among the findings.
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
    another_machine: bool = False

    @property
    def changed(self) -> bool:
        """Whether a change is significant."""
        return min((t.adjusted for t in self.tests), default=1.0) < self.alpha

    @property
    def moved(self) -> tuple[int, ...]:
        """Indices of cameras assumed to be unmoved that have moved, rather than that the machine
        has changed.

        Those that are identified causes; if no single cause is identified, those whose own test
        fails.
        """
        if self.findings:
            named = [f.suspect.cause.station for f in self.findings]
            return tuple(station for station in named if station >= 0)
        return tuple(s.station for s in self.stations if s.test.adjusted < self.alpha)

    @property
    def tests(self) -> tuple[Score, ...]:
        """All tests with observable directions."""
        legs = [t for leg in self.legs for t in (leg.whole, leg.zero)]
        stations = [station.test for station in self.stations]
        every = (self.machine, self.scale, *legs, *stations)
        return tuple(t for t in every if t is not None and t.dof)

    def document(self, machine: Machine) -> dict[str, Any]:
        """Document of tests and findings for programs: m, rad and ratios, legs from 1."""
        return {
            "alpha": self.alpha,
            "level": self.level,
            "power": DETECTION_POWER,
            "changed": self.changed,
            "another_machine": self.another_machine,
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
    """All tests on new data, with p-values adjusted for their number, and their joint significance.

    First the tests of all legs, of a common scale, of each arm's legs, and of each camera that was
    left in place; then those of each arm's zero, None for an arm without one.
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
    """Test for changes and identify their causes.

    alpha : false-alarm rate, the share of unchanged machines that are flagged.
    """
    # Tests of the machine, of a common scale, and of each leg and kept station.
    (every, scale, *each), own, level = made_tests(evidence, machine)
    single = level.single(alpha)
    wholes, of_stations = each[: len(own)], each[len(own) :]
    rows = zip(whole_legs(machine), zeros(machine), wholes, own, strict=True)
    out = ChangeTests(
        legs=tuple(_leg_test(evidence, machine, *row, single) for row in rows),
        machine=every,
        scale=scale,
        scale_change=change(evidence, common_scale(machine)),
        findings=(),
        rest=every,
        alpha=alpha,
        level=single,
        stations=tuple(
            StationTest(cause.station, test, change(evidence, cause))
            for cause, test in zip(stations_moved(evidence), of_stations, strict=True)
        ),
    )
    if not out.changed:
        return out
    # Causes of a significant change, and what they do not explain.
    findings = explained(evidence, single_causes(machine, evidence), alpha)
    causes = [f.suspect.cause for f in findings]
    few = twice_log_odds(evidence, joined_causes(causes)) if causes else 0.0
    if twice_log_odds(evidence, whole_machine(machine)) > few + DISTINCT_LOG_ODDS:
        return replace(out, another_machine=True)
    rest = _project_out(evidence, causes)
    rest = chi_square(rest, whole_machine(machine))
    return replace(out, findings=findings, rest=rest)


def _leg_test(
    evidence: Evidence,
    machine: Machine,
    whole: Cause,
    zero: Cause | None,
    test: Score,
    test_zero: Score | None,
    level: float,
) -> LegTest:
    """Tests of a leg and of its zero, with their power."""
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
    """Identify causes by forward selection, each the most likely given those before.

    Each must explain more than the best of so many causes would by chance. The first cause of two
    changes may be one that resembles both; so with two causes all pairs are tried, and after each
    further cause the earlier ones are reconsidered.
    """
    chosen: tuple[Cause, ...] = ()
    while len(chosen) < MOST_CAUSES:
        best = _rank(evidence, chosen, causes)[0][1]
        score = chi_square(_project_out(evidence, chosen), best)
        if not score.dof or len(causes) * score.chance >= alpha:
            break
        chosen = (*chosen, best)
        if len(chosen) == 2:
            pairs = [
                (twice_log_odds(evidence, joined_causes(pair)), pair)
                for pair in combinations(causes, 2)
            ]
            chosen = max(pairs, key=lambda item: item[0])[1]
        chosen = _exchange(evidence, chosen, causes)
    findings = [_explanation(evidence, chosen, k, causes) for k in range(len(chosen))]
    return tuple(sorted(findings, key=lambda f: -f.suspect.chi2))


def _exchange(
    evidence: Evidence, chosen: tuple[Cause, ...], causes: Sequence[Cause]
) -> tuple[Cause, ...]:
    """Causes with each one replaced by the most likely given the others, repeated until none
    changes.
    """
    for _ in range(MOST_CAUSES):
        before = chosen
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            best = _rank(evidence, others, causes)[0][1]
            chosen = (*chosen[:k], best, *chosen[k + 1 :])
        if all(old is new for old, new in zip(before, chosen, strict=True)):
            break
    return chosen


def _rank(
    evidence: Evidence, others: tuple[Cause, ...], causes: Sequence[Cause]
) -> list[tuple[float, Cause]]:
    """Causes with twice the log odds of the data for them together with others, best first."""
    free = [c for c in causes if all(c is not other for other in others)]
    scored = [(twice_log_odds(evidence, joined_causes((*others, cause))), cause) for cause in free]
    return sorted(scored, key=lambda item: -item[0])


def _explanation(
    evidence: Evidence, chosen: tuple[Cause, ...], place: int, causes: Sequence[Cause]
) -> Explanation:
    """One of the identified causes given the others, with the causes that cannot be distinguished
    from it.
    """
    own, others = chosen[place], chosen[:place] + chosen[place + 1 :]
    rest = _project_out(evidence, others)
    # a cause that is no more likely than no change at all is no rival
    nothing = twice_log_odds(evidence, joined_causes(others)) if others else 0.0
    least = max(twice_log_odds(evidence, joined_causes(chosen)) - DISTINCT_LOG_ODDS, nothing)
    near = [c for score, c in _rank(evidence, others, causes) if score > least and c is not own]
    suspects = [Suspect(c, change(rest, c), chi_square(rest, c).chi2) for c in (own, *near)]
    return Explanation(suspects[0], chi_square(rest, own), tuple(suspects[1:]))


def _project_out(evidence: Evidence, chosen: Sequence[Cause]) -> Evidence:
    """Evidence with the directions of other causes projected out."""
    out = evidence
    for cause in chosen:
        q = observable_directions(out, cause).q
        rest = np.linalg.svd(q, full_matrices=True)[0][:, q.shape[1] :]
        out = replace(out, w=rest.T @ out.w, by=rest.T @ out.by)
    return out
