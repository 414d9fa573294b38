"""The tests of a watched machine together: did anything change, and what explains it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pkmcal.mechanisms import Machine
from pkmcal.watching.causes import (
    Cause,
    common_scale,
    joined,
    single_causes,
    whole_legs,
    whole_machine,
    zeros,
)
from pkmcal.watching.chances import (
    Change,
    ChiSquare,
    Level,
    change,
    chi_square,
    detectable,
    detectable_range,
    directions,
    likelihood,
    together,
)
from pkmcal.watching.evidence import Evidence

ODDS = 2 * np.log(100.0)
"""Two causes are told apart where one makes the data a hundred times as likely as the other."""
MOST_CAUSES = 4
"""Changes that are looked for one after the other; more are a machine that was taken apart."""


@dataclass(frozen=True)
class LegTest:
    """One leg, or the legs of one motor.

    legs : from 0. whole : test of all its numbers but the tubes' radii. zero : of its reading's
    zero alone, with the change of it, if nothing else changed; None for a leg without a reading.
    unit, tolerance : of that zero. detects_zero : smallest change of it (m or rad) that is detected
    with POWER. detects_base, detects_platform : the same of its joints (m), in the direction seen
    best, and worst.
    """

    legs: tuple[int, ...]
    whole: ChiSquare
    zero: ChiSquare | None
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


@dataclass(frozen=True)
class Suspect:
    """A cause with the change that it would have made; chi2 : what it explains."""

    cause: Cause
    change: Change
    chi2: float


@dataclass(frozen=True)
class Finding:
    """A cause that explains the data best beside the others found.

    test : what it explains. others : causes that these data cannot tell from it, best first.
    """

    suspect: Suspect
    test: ChiSquare
    others: tuple[Suspect, ...]


@dataclass(frozen=True)
class Judgement:
    """All tests. machine : of all legs' numbers together. scale : of all lengths by one factor.

    alpha : share of machines that did not change that may be flagged. level : of a single test, so
    that all together keep alpha. left : what the findings leave unexplained of ``machine``.
    """

    legs: tuple[LegTest, ...]
    machine: ChiSquare
    scale: ChiSquare
    scale_change: Change
    findings: tuple[Finding, ...]
    left: ChiSquare
    alpha: float
    level: float

    @property
    def changed(self) -> bool:
        """Whether anything is shown to have changed."""
        return min((t.adjusted for t in self.tests), default=1.0) < self.alpha

    @property
    def tests(self) -> tuple[ChiSquare, ...]:
        """All tests that see anything."""
        legs = [t for leg in self.legs for t in (leg.whole, leg.zero)]
        return tuple(t for t in (self.machine, self.scale, *legs) if t is not None and t.dof)


@dataclass(frozen=True)
class Family:
    """All tests that are made, their chances adjusted for their number.

    machine, scale : of all legs. wholes, zeros : one a leg, None for a leg without a reading.
    level : what they are worth together.
    """

    machine: ChiSquare
    scale: ChiSquare
    wholes: tuple[ChiSquare, ...]
    zeros: tuple[ChiSquare | None, ...]
    level: Level

    @property
    def made(self) -> tuple[ChiSquare, ...]:
        """Those that see anything."""
        both = (self.machine, self.scale, *self.wholes, *self.zeros)
        return tuple(t for t in both if t is not None and t.dof)

    @property
    def chance(self) -> float:
        """The least adjusted chance; 1 where nothing is seen."""
        return min((t.adjusted for t in self.made), default=1.0)


def family(found: Evidence, machine: Machine) -> Family:
    """Every test on new data."""
    cameras = found.by.shape[1] - len(machine.parameters)
    zero = zeros(machine, cameras)
    asked = [whole_machine(machine, cameras), common_scale(machine, cameras)]
    asked += [*whole_legs(machine, cameras), *(z for z in zero if z)]
    level = together(found, asked)
    told = [chi_square(found, cause) for cause in asked]
    every, scale, *rest = [replace(t, adjusted=level.adjusted(t.chance)) for t in told]
    own = iter(rest[len(zero) :])
    return Family(
        every, scale, tuple(rest[: len(zero)]), tuple(next(own) if z else None for z in zero), level
    )


def judge(found: Evidence, machine: Machine, alpha: float) -> Judgement:
    """Every test on new data, and what explains a change."""
    cameras = found.by.shape[1] - len(machine.parameters)
    made = family(found, machine)
    level = made.level.single(alpha)
    causes = zip(whole_legs(machine, cameras), zeros(machine, cameras), strict=True)
    tests = zip(made.wholes, made.zeros, strict=True)
    out = Judgement(
        legs=tuple(
            _leg(found, machine, cause, test, level)
            for cause, test in zip(causes, tests, strict=True)
        ),
        machine=made.machine,
        scale=made.scale,
        scale_change=change(found, common_scale(machine, cameras)),
        findings=(),
        left=made.machine,
        alpha=alpha,
        level=level,
    )
    if not out.changed:
        return out
    findings = explained(found, single_causes(machine, cameras), alpha)
    left = _beside(found, [f.suspect.cause for f in findings])
    left = chi_square(left, whole_machine(machine, cameras))
    return replace(out, findings=findings, left=left)


def _leg(
    found: Evidence,
    machine: Machine,
    causes: tuple[Cause, Cause | None],
    tests: tuple[ChiSquare, ChiSquare | None],
    level: float,
) -> LegTest:
    """A leg's tests, of all of it and of its zero, and what they would have found."""
    whole, zero = causes
    cameras = found.by.shape[1] - len(machine.parameters)
    ends = [joints(machine, side, whole.legs, cameras) for side in ("base", "platform")]
    least = float("inf")
    if zero is not None:
        least = min(detectable(found, t, zero.columns[:, 0], level) for t in (zero, whole))
    return LegTest(
        legs=whole.legs,
        whole=tests[0],
        zero=tests[1],
        change=change(found, zero) if zero else None,
        unit=zero.unit if zero else "m",
        tolerance=float(zero.sizes[0]) if zero else float("nan"),
        detects_zero=least,
        detects_base=detectable_range(found, whole, ends[0], level),
        detects_platform=detectable_range(found, whole, ends[1], level),
    )


def explained(found: Evidence, causes: Sequence[Cause], alpha: float) -> tuple[Finding, ...]:
    """Causes one after the other, each the one that is most likely beside those before.

    Each must explain more than chance would in the best of so many. Of two changes, the first that
    is found may be one that resembles both; so where there are two, all pairs are tried, and after
    each further one those before are looked at again.
    """
    chosen: tuple[Cause, ...] = ()
    while len(chosen) < MOST_CAUSES:
        best = _ranked(found, chosen, causes)[0][1]
        told = chi_square(_beside(found, chosen), best)
        if not told.dof or len(causes) * told.chance >= alpha:
            break
        chosen = (*chosen, best)
        if len(chosen) == 2:
            pairs = [(likelihood(found, joined(pair)), pair) for pair in combinations(causes, 2)]
            chosen = max(pairs, key=lambda item: item[0])[1]
        chosen = _exchanged(found, chosen, causes)
    findings = [_finding(found, chosen, k, causes) for k in range(len(chosen))]
    return tuple(sorted(findings, key=lambda f: -f.suspect.chi2))


def _exchanged(
    found: Evidence, chosen: tuple[Cause, ...], causes: Sequence[Cause]
) -> tuple[Cause, ...]:
    """The causes, each replaced by what is most likely beside the others, until all agree."""
    for _ in range(MOST_CAUSES):
        before = chosen
        for k in range(len(chosen)):
            others = chosen[:k] + chosen[k + 1 :]
            best = _ranked(found, others, causes)[0][1]
            chosen = (*chosen[:k], best, *chosen[k + 1 :])
        if all(old is new for old, new in zip(before, chosen, strict=True)):
            break
    return chosen


def _ranked(
    found: Evidence, others: tuple[Cause, ...], causes: Sequence[Cause]
) -> list[tuple[float, Cause]]:
    """Causes by how likely they make the data together with others (twice the log of the odds),
    best first.
    """
    free = [c for c in causes if all(c is not other for other in others)]
    scored = [(likelihood(found, joined((*others, cause))), cause) for cause in free]
    return sorted(scored, key=lambda item: -item[0])


def _finding(
    found: Evidence, chosen: tuple[Cause, ...], place: int, causes: Sequence[Cause]
) -> Finding:
    """One of the chosen causes beside the others, with what cannot be told from it."""
    own, others = chosen[place], chosen[:place] + chosen[place + 1 :]
    left = _beside(found, others)
    # what explains no more than nothing would is no rival, however weak the best
    nothing = likelihood(found, joined(others)) if others else 0.0
    least = max(likelihood(found, joined(chosen)) - ODDS, nothing)
    near = [c for score, c in _ranked(found, others, causes) if score > least and c is not own]
    suspects = [Suspect(c, change(left, c), chi_square(left, c).chi2) for c in (own, *near)]
    return Finding(suspects[0], chi_square(left, own), tuple(suspects[1:]))


def _beside(found: Evidence, chosen: Sequence[Cause]) -> Evidence:
    """The evidence without what other causes explain."""
    left = found
    for cause in chosen:
        left = without(left, directions(left, cause).q)
    return left


def without(found: Evidence, q: np.ndarray) -> Evidence:
    """The evidence with directions q (n, d) taken out: what other causes explain beside them."""
    rest = np.linalg.svd(q, full_matrices=True)[0][:, q.shape[1] :]
    return replace(found, w=rest.T @ found.w, by=rest.T @ found.by)


def joints(machine: Machine, side: str, legs: tuple[int, ...], n_cameras: int) -> Cause:
    """The first leg's joint on one side, moved by a vector."""
    from pkmcal.identify.gauge import centre_index

    index = centre_index(machine.layout)[side == "platform"][legs[0]]
    columns = np.eye(len(machine.parameters) + n_cameras)[:, index]
    part = "base" if side == "base" else "platform"
    return Cause(part, legs[:1], columns, machine.parameters.tolerance[index], "m")
