"""Hypothesis that diameters were stated as radii.

A machine with tubes of twice the radius is localized as well: its edges match edges beside the
right ones, with the camera at another distance. The likelihood of the images does not decide,
because highlights of a tube are edges at less than its width. The joint estimate decides. With the
stated radii few edges are measured, which are chance matches or disagree with the machine,
sometimes by no more than is accepted of a result; with half of the radii more edges are measured,
and they agree.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pkmcal.calibration.camera_refinement import refinement_of
from pkmcal.calibration.case import Case
from pkmcal.calibration.chance_matches import chance_match_reason
from pkmcal.calibration.handheld import localize_case
from pkmcal.calibration.refinement import RefinementResult, refine_alternating
from pkmcal.identify.verdict import VERDICT
from pkmcal.mechanisms import Machine
from pkmcal.mechanisms.document import Leg
from pkmcal.mechanisms.machine import machine_from_document
from pkmcal.observe.hypotheses import diameters, log_prior_of_each
from pkmcal.outcome.finding import Finding, note
from pkmcal.outcome.hypotheses import (
    Explanation,
    Hypothesis,
    decide,
    estimate_level,
    harmless_misfit,
    posterior,
)
from pkmcal.outcome.progress import no_progress
from pkmcal.session.load import Session

RadiiHypothesis = Hypothesis[Session]


def explain_radii(
    case: Case, turns: RefinementResult | None, refine_camera: bool, seed: int
) -> Explanation:
    """Mistake of diameters stated as radii, if more edges agree with the machine with half of the
    radii.

    turns : refinement with the stated radii, None without an estimate.
    refine_camera : whether the cameras are estimated.
    seed : for the localization of the stations.
    """
    null = _edge_misfit(turns)
    # errors of an imperfect model vary smoothly, so the effective sample size is at most its number
    # of parameters
    n_effective = float(case.session.machine.parameters.free_matrix().shape[1])
    prior = log_prior_of_each(case.session.machine, case.session.joints)
    # The evidence costs a localization and a refinement; it is not needed if edges scatter no more
    # than in right sessions.
    least = max(harmless_misfit(n_effective, prior), VERDICT.edge_scatter)
    if not case.images or null <= least:
        return Explanation()
    inliers = 0.0 if turns is None else float(turns.estimate.edge_weights.sum())
    untested: list[Finding] = []

    def misfit(hypothesis: RadiiHypothesis) -> float:
        other = _refined(case, hypothesis.apply(case.session), refine_camera, seed)
        more = other.estimate.edge_weights.sum() > inliers
        return _edge_misfit(other) if more else np.inf

    def failed(hypothesis: RadiiHypothesis, why: str) -> None:
        untested.append(note(f"{hypothesis.code}_untested", hypothesis.subject, why=why))

    mechanism = case.session.document["mechanism"]
    half = RadiiHypothesis("tube.diameter", mechanism, _of_half_the_radii, prior)
    level = estimate_level(misfit, null, n_effective, VERDICT.too_noisy, failed)
    best = decide(posterior([half], [level]))
    if best is None:
        return Explanation(untested=tuple(untested))
    return Explanation(diameters(mechanism), best.log_odds)


def _edge_misfit(turns: RefinementResult | None) -> float:
    """Noise scale of the edges; at least the untenable scale without an estimate, or if the edges
    may be chance matches, which agree with any machine.
    """
    if turns is None:
        return VERDICT.too_noisy
    scale = turns.estimate.statistics.noise_scale
    return max(scale, VERDICT.too_noisy) if chance_match_reason(turns) else scale


def _refined(case: Case, session: Session, refine_camera: bool, seed: int) -> RefinementResult:
    """The refinement of another session with the images of a case."""
    rng = np.random.default_rng(seed)
    again = localize_case(session, case.images, case.boards, rng)
    cameras = refinement_of(again.session, refine_camera)
    return refine_alternating(again, cameras, no_progress, lambda _step: None)


def _of_half_the_radii(session: Session) -> Session:
    return replace(session, machine=_thinner(session.machine))


def _thinner(machine: Machine) -> Machine:
    legs: list[Leg] = []
    for leg in machine.document.legs:
        tubes = [tube.model_copy(update={"radius": tube.radius / 2}) for tube in leg.tubes]
        legs.append(leg.model_copy(update={"tubes": tuple(tubes)}))
    return machine_from_document(machine.document.model_copy(update={"legs": tuple(legs)}))
