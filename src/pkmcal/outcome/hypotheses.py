"""Hypotheses about what is wrong with a session, and their posterior odds.

A hypothesis is a transformation of the data: two columns of readings exchanged, images mirrored, a
board that moved. The null hypothesis is the data as stated. The log-odds of a hypothesis h are

    log O(h) = log L(data | h) - log L(data | null) + log prior odds of h

in nats. Levels of evidence, the cheapest first, compute the log-likelihood ratios of all remaining
hypotheses; the first level that decides ends the comparison. Each level uses the effective sample
size: correlated residuals count once.

A likelihood ratio compares explanations, none of which may be tenable. So there are absolute tests
too: whether the machine is in the images at all, and whether the residuals of a hypothesis are as
small as their noise. A level returns minus infinity for hypotheses that fail them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import log
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np

from pkmcal.arrays import Array
from pkmcal.errors import InputError, PkmcalError
from pkmcal.outcome.finding import Finding

Data = TypeVar("Data")
Subject = TypeVar("Subject", bound="Hypothesis[Any]")


@dataclass(frozen=True)
class HypothesisOptions:
    """Thresholds of all decisions between hypotheses, in nats.

    act : log-odds above which data are repaired and the user is informed afterwards; also the
        log-odds by which a hypothesis excludes another.
    report : log-odds above which a hypothesis is reported, as the reason of a refusal or as a
        warning. The user can verify a report, so one false report in twenty is acceptable.
    beam : log-likelihood ratio to the best explanation below which a hypothesis is discarded before
        the next level of evidence: e^-12 = 6e-6, far less than a finer level changes.
    most : maximum number of hypotheses for a level that takes seconds for each.
    """

    act: float = log(1000.0)
    report: float = log(20.0)
    beam: float = 12.0
    most: int = 6


HYPOTHESIS_THRESHOLDS = HypothesisOptions()
NO_ESTIMATE = (PkmcalError, np.linalg.LinAlgError)
"""Errors by which an estimate under a hypothesis fails."""


@dataclass(frozen=True)
class Hypothesis(Generic[Data]):
    """Possible mistake in a session, as a transformation of its data.

    code : code of its finding, such as readings.exchanged.
    subject : motor, station, file or image concerned. Hypotheses with one code and one subject are
        variants of one explanation.
    apply : function from the data (of a session, of a station, of poses) as stated to the data
        without the mistake.
    log_prior : prior log-odds. They contain the number of alternatives of the same kind and the
        cost of free parameters (:func:`parameter_cost`).
    action : what is done if the hypothesis is decided for.
    facts : for the finding, by name.
    """

    code: str
    subject: str
    apply: Callable[[Data], Data]
    log_prior: float = 0.0
    action: Literal["refuse", "repair"] = "refuse"
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def meaning(self) -> tuple[str, str]:
        """Code and subject, common to all variants of one explanation."""
        return self.code, self.subject


class EvidenceLevel(NamedTuple, Generic[Subject]):
    """Evidence by which hypotheses are compared.

    log_likelihood_ratios : function that returns (N,) nats of N hypotheses against the null; minus
        infinity for untenable ones.
    decides : whether the comparison may end at this level.
    most : maximum number of hypotheses for the next level, None for no limit.
    """

    name: str
    log_likelihood_ratios: Callable[[Sequence[Subject]], Array]
    decides: bool = True
    most: int | None = None


def estimate_level(
    misfit: Callable[[Subject], float],
    null: float,
    n_effective: float,
    tenable: float,
    failed: Callable[[Subject, str], None],
) -> EvidenceLevel[Subject]:
    """Level of evidence by an estimate under each hypothesis.

    misfit : function that returns the misfit (:func:`log_likelihood`) of the residuals without the
        mistake; it raises one of NO_ESTIMATE where there is no estimate.
    null : misfit of the data as stated.
    n_effective : number of independent residuals.
    tenable : misfit above which a hypothesis is untenable.
    failed : callback with each hypothesis without an estimate, and the reason.
    """

    def ratios(hypotheses: Sequence[Subject]) -> Array:
        values = np.full(len(hypotheses), np.inf)
        for k, one in enumerate(hypotheses):
            try:
                values[k] = misfit(one)
            except NO_ESTIMATE as error:
                failed(one, str(error).rstrip("."))
        values = np.where(values < tenable, values, np.inf)
        return log_likelihood(values, n_effective) - log_likelihood(np.array(null), n_effective)

    return EvidenceLevel("estimate", ratios)


class Ranked(NamedTuple, Generic[Subject]):
    """A hypothesis with its log-odds against the null, and the level of evidence that gave them."""

    hypothesis: Subject
    log_odds: float
    level: str = "prior"


class Explanation(NamedTuple):
    """Decision between the hypotheses about one kind of data.

    error : error that names the mistake; None if no hypothesis is likely enough.
    log_odds : of the mistake, nats.
    untested : notes on hypotheses that could not be tested.
    """

    error: InputError | None = None
    log_odds: float = -math.inf
    untested: tuple[Finding, ...] = ()


def posterior(
    hypotheses: Sequence[Subject],
    levels: Sequence[EvidenceLevel[Subject]],
    options: HypothesisOptions = HYPOTHESIS_THRESHOLDS,
) -> list[Ranked[Subject]]:
    """Hypotheses that all levels of evidence retain, the likeliest first.

    levels : cheapest first. Later levels are skipped once one that may decide has found a
    hypothesis with odds of ``act`` against the null and against each other explanation.
    """
    ranked = [Ranked(h, h.log_prior) for h in hypotheses]
    for level in levels:
        if not ranked:
            break
        ratios = np.asarray(level.log_likelihood_ratios([one.hypothesis for one in ranked]))
        # prior odds are the same at all levels, so the likelihood alone decides what is retained
        least = max(float(ratios.max()), 0.0) - options.beam
        ranked = [
            Ranked(one.hypothesis, one.hypothesis.log_prior + float(ratio), level.name)
            for one, ratio in zip(ranked, ratios, strict=True)
            if ratio > least
        ]
        ranked.sort(key=lambda one: -one.log_odds)
        sure = bool(ranked) and ranked[0].log_odds > options.act
        if level.decides and sure and not rivals_of(ranked, options):
            break
        ranked = ranked[: level.most]
    return ranked


def decide(
    ranked: Sequence[Ranked[Subject]], options: HypothesisOptions = HYPOTHESIS_THRESHOLDS
) -> Ranked[Subject] | None:
    """Hypothesis to follow, None if none is likely enough for its action."""
    if not ranked:
        return None
    limit = options.act if ranked[0].hypothesis.action == "repair" else options.report
    return ranked[0] if ranked[0].log_odds > limit else None


def likely(
    ranked: Sequence[Ranked[Subject]], options: HypothesisOptions = HYPOTHESIS_THRESHOLDS
) -> list[Ranked[Subject]]:
    """Hypothesis to follow, then its rivals to be reported; empty if none is likely enough.

    A rival is an explanation that the first hypothesis does not exclude.
    """
    first = decide(ranked, options)
    rivals = rivals_of(ranked, options) if first else []
    return [one for one in (first, *rivals) if one and one.log_odds > options.report]


def rivals_of(
    ranked: Sequence[Ranked[Subject]], options: HypothesisOptions = HYPOTHESIS_THRESHOLDS
) -> list[Ranked[Subject]]:
    """Rivals of the first of the ranked hypotheses: other explanations that it does not exclude,
    each once.
    """
    first, out = ranked[0], dict[tuple[str, str], Ranked[Subject]]()
    for one in ranked[1:]:
        if one.log_odds > first.log_odds - options.act:
            out.setdefault(one.hypothesis.meaning, one)
    out.pop(first.hypothesis.meaning, None)
    return list(out.values())


def refuse(*explanations: Callable[[], Explanation]) -> tuple[Finding, ...]:
    """Raise the error of the likeliest explanation; otherwise return notes on untested hypotheses.

    explanations : functions, the cheapest first. Later ones are not called once one has log-odds of
        ``act``.
    """
    likeliest, untested = Explanation(), list[Finding]()
    for explain in explanations:
        likeliest = max(likeliest, one := explain(), key=lambda one: one.log_odds)
        untested += one.untested
        if likeliest.log_odds > HYPOTHESIS_THRESHOLDS.act:
            break
    if likeliest.error is not None:
        raise likeliest.error
    return tuple(untested)


def parameter_cost(count: int, n_effective: float) -> float:
    """Log-prior of ``count`` free parameters that a hypothesis adds, by the Bayesian information
    criterion (Schwarz, Estimating the dimension of a model, 1978): half of log n each.
    """
    return -0.5 * count * log(max(n_effective, 1.0))


def harmless_misfit(
    n_effective: float, log_prior: float, log_odds: float = HYPOTHESIS_THRESHOLDS.report
) -> float:
    """Misfit of the data as stated (:func:`log_likelihood`) up to which no hypothesis is searched.

    A hypothesis whose residuals have the stated noise does not reach ``log_odds`` there. One with
    smaller residuals could, but the data as stated fit nearly as well.

    log_prior : of the most probable hypothesis.
    """
    return math.exp((log_odds - log_prior) / max(n_effective, 1.0))


def log_likelihood(misfit: Array, n_effective: float) -> Array:
    """Log-likelihood (nats) of residuals with a root mean square ``misfit``, up to a constant.

    The misfit is in stated standard deviations. The true scale s of the noise is unknown: at least
    the stated one, and otherwise at its maximum-likelihood value, so that an imperfect model does
    not make small differences decisive: -n (log s + misfit^2 / (2 s^2)).

    n_effective : number n of independent residuals.
    """
    misfit = np.asarray(misfit, dtype=float)
    scale = np.maximum(misfit, 1.0)
    with np.errstate(invalid="ignore"):
        value = -n_effective * (np.log(scale) + 0.5 * (misfit / scale) ** 2)
    return np.where(np.isfinite(misfit), value, -np.inf)
